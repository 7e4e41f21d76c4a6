"""MF4 logs with damaged block descriptions: rejected in one sentence before asammdf reads them."""

import math
import re
import struct
import warnings
from pathlib import Path

import pytest
from mdf_files import LogFrame, MdfFile, write_layout_2
from st_recordings.runs.errors import RunError
from st_recordings.runs.mf4 import read_mf4
from support import GOLDEN_DATA

REAL = GOLDEN_DATA / "can/canedge2_2F6913DB_00000004_00000001.MF4"
START_NS = 1_700_000_000_000_000_000
FRAMES = [LogFrame(500 * k, 1, 0x002, bytes(5)) for k in range(20)]


def read_link(data: bytes, block: int, number: int) -> int:
    return struct.unpack_from("<Q", data, block + 24 + 8 * number)[0]


def find_offsets(data: bytes) -> dict[str, int]:
    """Byte offsets of the blocks of the first group and of numbers in them."""
    groups = read_link(data, 64, 0)
    group = read_link(data, groups, 1)
    time = read_link(data, group, 1)
    frame = read_link(data, time, 0)
    member, conversion, records = read_link(data, frame, 1), read_link(data, time, 4), read_link(data, groups, 2)
    return {
        "next data group": groups + 24, "size of identifiers": groups + 56, "next group": group + 24,
        "count": group + 80, "flags": group + 88, "size": group + 96, "next channel": time + 24, "kind": time + 88,
        "type of time": time + 90,
        "times": conversion + 80, "factor": conversion + 88, "byte": member + 92, "bits": member + 96,
        "bit": member + 91, "data type": member + 90, "name": read_link(data, member, 2) + 24, "frame": frame,
        "composition": frame + 32, "data group": groups, "records": records,
    }


def write_damaged(tmp_path: Path, field: str, layout: str, value: object) -> Path:
    file = write_layout_2(tmp_path / "log.MF4", START_NS, FRAMES)
    data = bytearray(file.read_bytes())
    struct.pack_into(layout, data, find_offsets(data)[field], value)
    file.write_bytes(data)
    return file


@pytest.mark.parametrize(("field", "layout", "value", "error"), [
    ("byte", "<I", 34, r"the channel at byte \d+ ends at byte 36 of a record of 21 bytes"),
    ("byte", "<I", 2**32 - 1, "ends at byte 4294967297 of a record"),
    ("bits", "<I", 80, "invalid start bit 0 or length of 80 bits"),
    ("bit", "<B", 9, "invalid start bit 9 or length of 11 bits"),
    ("data type", "<B", 10, "the ID of its frames is not an integer"),
    ("name", "<16s", b"CAN_DataFrame.II", "its frames have no ID"),
    ("composition", "<Q", 0, "its frames have no ID"),
    ("size", "<I", 2**30, "has impossible records of 1073741824 bytes"),
    ("flags", "<H", 7, "has channels, but records of variable length"),
    ("size of identifiers", "<B", 3, "has record identifiers of 3 bytes"),
    ("next data group", "<Q", 64, "two links refer to the block at byte 64"),
    ("next channel", "<Q", 0, "the log contains no CAN frames"),
    ("next channel", "<Q", 2**63, "a block refers to byte 9223372036854775808"),
    ("kind", "<B", 0, "its records have no time channel"),
    ("type of time", "<B", 15, "the time channel at byte"),
    ("factor", "<d", math.nan, "time conversion at byte .* is invalid"),
    ("factor", "<d", 1e307, "the times of its frames are invalid"),
    ("factor", "<d", 1e200, "the times of its frames are invalid"),
    ("times", "<d", -1e12, "the times of its frames are invalid"),
])
def test_damaged_description_is_rejected_in_one_sentence(tmp_path, capfd, field, layout, value, error):
    file = write_damaged(tmp_path, field, layout, value)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(RunError, match=rf"log\.MF4: .*{error}"):
            read_mf4(file)
    assert capfd.readouterr() == ("", "")


def test_frame_count_is_checked_only_in_a_finalised_file(tmp_path):
    file = write_damaged(tmp_path, "count", "<Q", 1000)
    assert len(read_mf4(file).frames) == 20  # not finalised: the count is not used
    data = bytearray(file.read_bytes())
    struct.pack_into("<H", data, 60, 4)
    file.write_bytes(data)
    with pytest.raises(RunError, match="declares 22000 bytes of records, but there are 440"):
        read_mf4(file)


def test_circular_links_are_rejected(tmp_path):
    file = write_layout_2(tmp_path / "log.MF4", START_NS, FRAMES)
    data = bytearray(file.read_bytes())
    offsets = find_offsets(data)
    struct.pack_into("<Q", data, offsets["next data group"], offsets["data group"])
    file.write_bytes(data)
    with pytest.raises(RunError, match=f"two links refer to the block at byte {offsets['data group']}"):
        read_mf4(file)


@pytest.mark.parametrize("offset", [2**63, 2**64 - 1, 2**31])
def test_payload_offset_outside_the_file_is_rejected(tmp_path, offset):
    """In layout 1 a record contains the offset of its payload; asammdf does not check it."""
    content = bytearray(REAL.read_bytes())
    records = read_link(content, read_link(content, 64, 0), 2) + 24
    struct.pack_into("<Q", content, records + 1 + 14, offset)
    file = tmp_path / "log.MF4"
    file.write_bytes(content)
    with pytest.raises(RunError, match="the payload offsets in its frames are invalid"):
        read_mf4(file)


def test_truncated_file_with_two_unsorted_groups_is_read_to_its_last_frame(tmp_path):
    content = bytearray(REAL.read_bytes())
    group = read_link(content, 64, 0)
    records = read_link(content, group, 2)
    file = MdfFile(content[:records])
    first_records = file.block(b"##DT", (), bytes(4))
    channels = file.block(b"##CG", (0, 0, file.text("x"), 0, 0, 0), struct.pack("<QQHH4xII", 0, 1, 0, 0, 3, 0))
    file.link(64, 0, file.block(b"##DG", (group, channels, first_records, 0), struct.pack("<B7x", 1)))
    file.link(group, 2, len(file.content))
    truncated = tmp_path / "log.MF4"
    truncated.write_bytes(file.content + content[records:-5])
    log = read_mf4(truncated)
    assert len(log.frames) == 261 and "no complete frame follows byte" in log.warnings[0]


@pytest.mark.parametrize("layout", [1, 2])
def test_damage_within_the_records_is_reported_with_its_place_and_size(tmp_path, layout):
    """asammdf ends silently at the first record with an unknown identifier."""
    frames = [LogFrame(500 * k, 1, 0x002, bytes(5)) for k in range(200)]
    content = bytearray(REAL.read_bytes() if layout == 1 else
                        write_layout_2(tmp_path / "log.MF4", START_NS, frames).read_bytes())
    records = read_link(content, read_link(content, 64, 0), 2) + 24
    middle = records + (len(content) - records) // 2 // 22 * 22
    content[middle:middle + 80] = b"\xff" * 80
    damaged = tmp_path / "damaged.MF4"
    damaged.write_bytes(content)
    log = read_mf4(damaged)
    assert 50 < len(log.frames) < (262 if layout == 1 else 200)
    assert re.search(r"(the record at byte \d+ is invalid|no complete frame follows byte \d+); the last \d+ of \d+"
                     r" bytes .*\((4\d|5\d)(\.\d+)? %\) are not used", log.warnings[0])
