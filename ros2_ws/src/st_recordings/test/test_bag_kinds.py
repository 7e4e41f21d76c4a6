"""One drive in bags of many programs: read correctly, with a warning on what is not used, or rejected."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from drive_kinds import CAR, assert_same, assert_warned, write_bag
from mcap.writer import CompressionType, IndexType
from st_core.log import DriveLog
from st_recordings.runs import ReadSettings, RunError, find_runs, read
from st_recordings.runs.run_types import SteeringField


def write_splits(folder: Path, log: DriveLog) -> Path:
    edges = np.linspace(0, len(log.x), 13).astype(int)
    for k in range(12):
        write_bag(folder / f"drive_{k}.mcap", log, edges[k], edges[k + 1])
    return folder


BAGS: list[tuple[str, Callable[[Path, DriveLog], Path], ReadSettings, str]] = [
    ("no message index", lambda folder, log: write_bag(
        folder / "a.mcap", log, index_types=IndexType.ATTACHMENT | IndexType.CHUNK | IndexType.METADATA),
     ReadSettings(), ""),
    ("channels not repeated", lambda folder, log: write_bag(
        folder / "a.mcap", log, repeat_channels=False, repeat_schemas=False), ReadSettings(), ""),
    ("no chunks", lambda folder, log: write_bag(folder / "a.mcap", log, use_chunking=False), ReadSettings(), ""),
    ("no statistics", lambda folder, log: write_bag(folder / "a.mcap", log, use_statistics=False), ReadSettings(), ""),
    ("lz4", lambda folder, log: write_bag(folder / "a.mcap", log, compression=CompressionType.LZ4), ReadSettings(), ""),
    ("stamps zero", lambda folder, log: write_bag(folder / "a.mcap", log, stamps="zero"), ReadSettings(),
     r"all \d+ stamps of /odom are 0 s; the times of reception are used"),
    ("stamps of whole seconds", lambda folder, log: write_bag(folder / "a.mcap", log, stamps="seconds"), ReadSettings(),
     r"stamps \(9\d %\) of /odom repeat the previous one; the times of reception are used"),
    ("stamps since boot", lambda folder, log: write_bag(folder / "a.mcap", log, stamps="boot"), ReadSettings(),
     "do not overlap in time; the times of reception are used"),
    ("twelve splits", write_splits, ReadSettings(), ""),
    ("custom type, degrees, right positive", lambda folder, log: write_bag(
        folder / "a.mcap", log, custom_steering=True),
     ReadSettings(steering=SteeringField("/rack", "angle_deg", "wheel", "deg", -1), odometry="/odom"), ""),
]


@pytest.mark.slow
@pytest.mark.parametrize(("write", "settings", "warning"), [row[1:] for row in BAGS], ids=[row[0] for row in BAGS])
def test_bag_gives_the_drive(tmp_path: Path, drive_log: DriveLog, write, settings: ReadSettings, warning: str) -> None:
    (source,) = find_runs([write(tmp_path, drive_log)])
    run = read(source, CAR, settings)
    assert_same(run.log, drive_log, max_lost=0)
    assert_warned(run.warnings, warning)


def test_missing_split_of_a_bag_causes_a_warning(tmp_path: Path, drive_log: DriveLog) -> None:
    write_splits(tmp_path, drive_log)
    for k in (4, 5):
        (tmp_path / f"drive_{k}.mcap").unlink()
    first, second = (read(source, CAR) for source in find_runs([tmp_path]))
    assert not first.warnings
    assert_warned(second.warnings, "2 files between drive_3.mcap and this one are missing, so these two are")


@pytest.mark.parametrize("in_folder", [True, False])
def test_splits_with_numbers_in_another_order_are_ordered_by_time(tmp_path: Path, drive_log: DriveLog,
                                                                  in_folder: bool) -> None:
    edges = np.linspace(0, len(drive_log.x), 4).astype(int)
    (tmp_path / "bag").mkdir()
    for k, number in enumerate((2, 0, 1)):
        write_bag(tmp_path / "bag" / f"drive_{number}.mcap", drive_log, edges[k], edges[k + 1])
    if in_folder:
        (tmp_path / "bag/metadata.yaml").write_text("rosbag2_bagfile_information: {relative_file_paths: [drive_0.mcap, "
                                                    "drive_1.mcap, drive_2.mcap]}\n")
    (source,) = find_runs([tmp_path / "bag"] if in_folder else sorted((tmp_path / "bag").iterdir()))
    run = read(source, CAR)
    assert_same(run.log, drive_log, max_lost=0)
    assert not run.warnings


def test_date_and_time_in_names_of_bags_is_not_a_split_number(tmp_path: Path, drive_log: DriveLog) -> None:
    write_splits(tmp_path, drive_log)
    (tmp_path / "drive_1.mcap").unlink()
    for number, name in ((0, "d_20260401101112000000000"), (2, "d_20260501101112000000000")):
        (tmp_path / f"drive_{number}.mcap").rename(tmp_path / f"{name}.mcap")
    assert len(find_runs([tmp_path])) == 3  # the other parts are one run


def test_time_of_day_in_names_of_bags_is_not_a_split_number(tmp_path: Path, drive_log: DriveLog) -> None:
    write_splits(tmp_path, drive_log)
    for file in tmp_path.glob("drive_*.mcap"):
        if name := {"drive_0": "drive_101500", "drive_2": "drive_104500"}.get(file.stem):
            file.rename(tmp_path / f"{name}.mcap")
        else:
            file.unlink()
    for source in find_runs([tmp_path]):
        assert not [warning for warning in read(source, CAR).warnings if "missing" in warning]


def test_bag_with_another_encoding_is_rejected(tmp_path: Path, drive_log: DriveLog) -> None:
    file = write_bag(tmp_path / "json.mcap", drive_log, 0, 5, encoding="json")
    with pytest.raises(RunError, match="its messages are encoded as json, but only CDR, the encoding of ROS 2"):
        read(find_runs([file])[0], CAR)


def test_messages_of_ros_1_in_an_mcap_file_are_rejected(tmp_path: Path, drive_log: DriveLog) -> None:
    file = write_bag(tmp_path / "ros1.mcap", drive_log, 0, 5, encoding="ros1")
    with pytest.raises(RunError, match=r"give the \.bag of ROS 1 from which it was converted"):
        read(find_runs([file])[0], CAR)


def test_bag_with_another_definition_of_a_known_type_is_rejected(tmp_path: Path, drive_log: DriveLog) -> None:
    file = write_bag(tmp_path / "a.mcap", drive_log, 0, 5, compression=CompressionType.NONE, enable_crcs=False)
    file.write_bytes(file.read_bytes().replace(b"Vector3 linear", b"Vector3 planar"))
    with pytest.raises(RunError, match=r"nav_msgs/msg/Odometry differs from the ROS 2 definition.*linear"):
        read(find_runs([file])[0], CAR)


def test_bag_with_a_damaged_chunk_is_rejected(tmp_path: Path, drive_log: DriveLog) -> None:
    file = write_bag(tmp_path / "a.mcap", drive_log, compression=CompressionType.NONE)
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)
    with pytest.raises(RunError, match=r"the chunk at byte \d+ is damaged: wrong checksum"):
        read(find_runs([file])[0], CAR)
