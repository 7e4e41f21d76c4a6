"""NCOM codec against the public vectors: values of the vendor's decoder, values of the manual, byte identity.

Two sets (tests/support.py): "excerpt" in tests/golden/data, and "complete" in the reference data. A shortened case
ends after one of its packets; stream, packet rows and status rows end there as well, so every check applies to both.
Tolerance: relative 1e-9; `time` and `tow` 1e-6 s (README of the vectors). Each `allow_*` function describes one
property of the vendor's decoder by which the results may differ.
"""

import csv
import math
from functools import cache

import pytest
from oxts_bridge import ncom
from oxts_bridge.channels import decode_channel
from oxts_bridge.export import write_csv
from oxts_bridge.file_decoder import KINDS, UNKNOWN_TIME, decode_file
from oxts_bridge.stream import NcomParser
from support import GOLDEN_DATA, SETS, vectors

CASES = {
    "excerpt": ("startup", "extremes", "corrupt", "inner_checksums", "filters", "local_frame"),
    "complete": (
        "startup",
        "all_channels",
        "extremes",
        "corrupt",
        "inner_checksums",
        "rollover",
        "triggers",
        "wheel_speed",
        "drive_100hz",
        "filters",
        "local_frame",
        "manual_channels",
    ),
}
every_case = pytest.mark.parametrize(("which", "case"), [(which, case) for which in SETS for case in CASES[which]])
ABSOLUTE = {
    "time": 1e-6,
    "tow": 1e-6,
    "WSpeedTime": 1e-6,
    "TrigTime": 1e-6,
    "Trig2Time": 1e-6,
    "DigitalOutTime": 1e-6,
    "Trig3Time": 1e-6,
    "Trig4Time": 1e-6,
    "DigitalOut2Time": 1e-6,
}


@cache
def rows(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def agree(name, expected, got):
    """Whether the texts are equal or both numbers agree within the tolerance; empty equals only empty."""
    if expected == got:
        return True
    try:
        a, b = float(expected), float(got)
    except ValueError:
        return False
    return math.isclose(a, b, rel_tol=1e-9, abs_tol=ABSOLUTE.get(name, 0.0))


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Set -> folder of CSV files of its cases, as `st ncom` writes them."""

    @cache
    def write(which):
        folder, out = vectors(which, "ncom"), tmp_path_factory.mktemp(which)
        for case in CASES[which]:
            write_csv(folder / f"{case}.ncom", out / f"{case}.csv", out / f"{case}.status.csv")
        return out

    return write


def allow_time_of_first_channel_0(name, packet, expected, first_timed):
    """The vendor applies the first channel 0 from the next packet on; this decoder stamps its own packet too."""
    return (
        name in ("time", "week", "tow")
        and expected[packet][name] == ""
        and packet == first_timed
        and expected[packet]["channel"] == "0"
    )


def allow_first_angular_acceleration(name, packet, expected, first_timed):
    """The vendor differentiates its first timed packet against rate 0 at time 0: 1e-10 deg/s^2 instead of a
    difference."""
    return (
        name in ("Yx", "Yy", "Yz")
        and packet == first_timed + 1
        and expected[packet - 1]["time"] == ""
        and abs(float(expected[packet][name])) < 1e-8
    )


@every_case
def test_packets_equal_those_of_the_vendor(which, case, written):
    expected, got = rows(vectors(which, f"ncom/{case}.expected.csv")), rows(written(which) / f"{case}.csv")
    assert len(got) == len(expected) > 0
    assert set(expected[0]) <= set(got[0])
    first_timed = next(i for i, row in enumerate(got) if row["time"])
    different = [
        (i, name, row[name], got[i][name])
        for i, row in enumerate(expected)
        for name in row
        if not agree(name, row[name], got[i][name])
        and not allow_time_of_first_channel_0(name, i, expected, first_timed)
        and not allow_first_angular_acceleration(name, i, expected, first_timed)
    ]
    assert different == []
    allowed = sum(allow_time_of_first_channel_0("time", i, expected, first_timed) for i in range(len(expected)))
    assert allowed <= 1


def changes(table):
    """(packet, field) -> (channel, valid, value), without rows that repeat the state of the field."""
    result, current = {}, {}
    for row in table:
        state = (row["valid"], row["value"])
        # The vector tool repeats a row when unused bytes after a text, or the age of an innovation, have changed.
        if current.get(row["field"]) != state:
            current[row["field"]] = state
            result[int(row["pkt"]), row["field"]] = (row["channel"], *state)
    return result


def allow_wheel_wrap(field, expected, got):
    """The vendor subtracts 32-bit counts without wrap: once a large negative frequency, where this one is correct."""
    return field == "WSpeedFreq" and abs(float(expected[2])) > 1e7 and 0 <= float(got[2]) < 1e9


@every_case
def test_status_changes_equal_those_of_the_vendor(which, case, written):
    expected = changes(rows(vectors(which, f"ncom/{case}.status.csv")))
    got = changes(rows(written(which) / f"{case}.status.csv"))
    assert expected
    different = [
        (key, state, got.get(key))
        for key, state in expected.items()
        if key not in got
        or state[:2] != got[key][:2]
        or (not agree(key[1], state[2], got[key][2]) and not allow_wheel_wrap(key[1], state, got[key]))
    ]
    assert different == []
    tables = [rows(vectors(which, f"ncom/{name}.status.csv")) for name in CASES[which]]
    vendor_fields = {row["field"] for table in tables for row in table}
    assert [key for key in got if key not in expected and key[1] in vendor_fields] == []


def test_fields_have_the_values_of_the_manual(tmp_path):
    file = GOLDEN_DATA / "ncom/manual_channels.ncom"
    columns = decode_file(file)
    table = rows(GOLDEN_DATA / "ncom/manual_channels.manual.csv")
    assert len(table) > 400
    write_csv(file, tmp_path / "packets.csv", tmp_path / "status.csv")
    status = changes(rows(tmp_path / "status.csv"))
    missing = {row["field"] for row in table if row["valid"] == "1"} - {field for _, field in status}
    assert missing == set()
    times = {"Trig3Time": 79, "Trig4Time": 80, "DigitalOut2Time": 81}
    different = []
    for row in table:
        packet = int(row["pkt"])
        assert columns.channel[packet] == int(row["channel"])
        if row["field"] in times:  # combined from four raw fields: only in the status CSV
            got = status.get((packet, row["field"]))
            ok = got is not None and agree(row["field"], row["value"], got[2])
        else:
            got = decode_channel(int(row["channel"]), columns.batch_s[:, packet].tobytes())[row["field"]]
            ok = (got is not None) == (row["valid"] == "1") and (got is None or agree("", row["value"], repr(got)))
        if not ok:
            different.append(row)
    assert different == []


@every_case
def test_encoding_of_a_decoded_packet_gives_the_same_bytes(which, case):
    """Except structure B, private to the vendor, and wrong inner checksums (case inner_checksums), which are corrected.
    """
    columns = decode_file(vectors(which, f"ncom/{case}.ncom"))
    checked = 0
    for row in columns.raw:
        data = row.tobytes()
        if data[21] == ncom.STRUCTURE_B:
            continue
        encoded = ncom.encode(ncom.decode(data))
        if ncom.inner_checksums_match(data):
            assert encoded == data
        else:
            assert case == "inner_checksums"
            assert {i for i in range(72) if encoded[i] != data[i]} <= {22, 61, 71}
        checked += 1
    assert checked >= 30


@pytest.mark.parametrize("size", [1, 37, 72, 1472, 10**6])
@every_case
def test_stream_and_file_decoder_agree_for_all_chunk_sizes(which, case, size):
    data = vectors(which, f"ncom/{case}.ncom").read_bytes()
    columns = decode_file(data)
    parser = NcomParser()
    received = [packet for at in range(0, len(data), size) for packet in parser.feed(data[at : at + size])]
    decoded = [i for i in range(len(columns)) if columns.navigation_status[i] != ncom.STRUCTURE_B]
    assert [packet.offset for packet in received] == columns.offset[decoded].tolist()
    assert [packet.kind for packet in received] == [KINDS[kind] for kind in columns.kind[decoded]]
    assert [packet.order for packet in received] == columns.order[decoded].tolist()
    for name in ("gps_ns", "utc_ns"):
        times = [UNKNOWN_TIME if getattr(p, name) is None else getattr(p, name) for p in received]
        assert times == getattr(columns, name)[decoded].tolist()
    counters = parser.counters
    assert (columns.checksum_errors, columns.skipped_bytes) == (counters.checksum_errors, counters.skipped_bytes)


@pytest.mark.parametrize("which", SETS)
def test_numbers_of_packets_and_skipped_bytes_equal_the_summary(which):
    table = rows(vectors(which, "ncom/summary.csv"))
    assert [row["case"] for row in table] == list(CASES[which])
    for row in table:
        file = vectors(which, f"ncom/{row['case']}.ncom")
        columns = decode_file(file)
        assert len(columns) == int(row["packets"])
        # The summary excludes bytes before the first and after the last packet.
        inside = int(columns.offset[-1]) - int(columns.offset[0]) + 72
        assert inside - 72 * len(columns) == int(row["skipped_bytes"])
        total = file.stat().st_size
        assert total == int(row["bytes"])
        assert columns.skipped_bytes <= total - 72 * len(columns) < columns.skipped_bytes + 72
