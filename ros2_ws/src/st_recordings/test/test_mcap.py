"""The bag writer: what independent readers find, what remains after a kill or on a full disk, and what is rejected."""

import errno
import json
import math
import os
import resource
import shutil
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import pytest
import yaml
from bags import DEFINITION, TYPE, TYPE_HASH, add_numbered_topic, numbered, read_numbers, read_numbers_with_mcap
from st_recordings.bag_metadata import make_qos
from st_recordings.mcap import FLUSH_PERIOD, BagWriter
from st_recordings.recovery import recover

START_NS = 1_790_000_000_000_000_000


def new_bag(directory: Path, *topics: str) -> tuple[BagWriter, list[int]]:
    bag = BagWriter(directory, {"configuration": {"hash": "0123", "vehicle": "mass: 1\nlength: 2\n"}})
    return bag, [add_numbered_topic(bag, topic) for topic in topics or ("/a",)]


def test_two_independent_readers_find_every_message(tmp_path: Path) -> None:
    bag, (a, b) = new_bag(tmp_path / "bag", "/a", "/b")
    for k in range(5000):
        bag.write(a, numbered(k, "x" * 100), START_NS + k * 4_000_000, START_NS)
        if k % 10 == 0:
            bag.write(b, numbered(-k), START_NS + k * 4_000_000)
    bag.close()
    expected = {"/a": list(range(5000)), "/b": [-k for k in range(0, 5000, 10)]}
    assert read_numbers(tmp_path / "bag") == expected
    assert read_numbers_with_mcap(bag.path) == expected
    assert bag.message_count == 5500
    assert (bag.error, bag.lost_count) == ("", 0)


def test_file_contains_times_schema_and_metadata(tmp_path: Path) -> None:
    from mcap.reader import make_reader

    bag, (a,) = new_bag(tmp_path / "bag")
    bag.write(a, numbered(1), START_NS + 7, START_NS + 3)
    bag.close()
    with bag.path.open("rb") as stream:
        reader = make_reader(stream)
        (schema, channel, message), = reader.iter_messages()
        records = {record.name: record.metadata for record in reader.iter_metadata()}
        assert reader.get_header().profile == "ros2"
    assert (message.log_time, message.publish_time) == (START_NS + 7, START_NS + 3)
    assert (schema.name, schema.encoding, schema.data.decode()) == (TYPE, "ros2msg", DEFINITION)
    assert channel.message_encoding == "cdr"
    assert channel.metadata["topic_type_hash"] == TYPE_HASH
    assert yaml.safe_load(channel.metadata["offered_qos_profiles"])[0]["reliability"] == "reliable"
    assert records["configuration"] == {"hash": "0123", "vehicle": "mass: 1\nlength: 2\n"}
    information = yaml.safe_load(records["rosbag2"]["serialized_metadata"])["rosbag2_bagfile_information"]
    assert information["message_count"] == 1


def test_metadata_yaml_equals_that_of_rosbag2_jazzy(tmp_path: Path) -> None:
    bag = BagWriter(tmp_path / "bag")
    latched = make_qos(durability="transient_local", depth=1)
    a = bag.add_topic("/a", TYPE, (latched,), DEFINITION, TYPE_HASH)
    for k in range(3):
        bag.write(a, numbered(k), START_NS + k * 10**9)
    bag.close()
    information = yaml.safe_load((tmp_path / "bag" / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    (topic,) = information.pop("topics_with_message_count")
    assert information == {
        "version": 9, "storage_identifier": "mcap", "message_count": 3, "ros_distro": "jazzy", "custom_data": None,
        "duration": {"nanoseconds": 2 * 10**9}, "starting_time": {"nanoseconds_since_epoch": START_NS},
        "compression_format": "", "compression_mode": "", "relative_file_paths": ["bag_0.mcap"],
        "files": [{"path": "bag_0.mcap", "starting_time": {"nanoseconds_since_epoch": START_NS},
                   "duration": {"nanoseconds": 2 * 10**9}, "message_count": 3}],
    }
    infinite = {"sec": 9223372036, "nsec": 854775807}
    assert topic == {"message_count": 3, "topic_metadata": {
        "name": "/a", "type": TYPE, "serialization_format": "cdr", "type_description_hash": TYPE_HASH,
        "offered_qos_profiles": [{
            "history": "keep_last", "depth": 1, "reliability": "reliable", "durability": "transient_local",
            "deadline": infinite, "lifespan": infinite, "liveliness": "automatic",
            "liveliness_lease_duration": infinite, "avoid_ros_namespace_conventions": False}]}}


def test_messages_out_of_order_are_read_in_order(tmp_path: Path) -> None:
    bag, (a, b) = new_bag(tmp_path / "bag", "/a", "/b")
    for k in (3, 1, 2, 0):
        bag.write(a, numbered(k), START_NS + k)
        bag.flush()
        bag.write(b, numbered(k), START_NS + 10 - k)
    bag.close()
    assert read_numbers(tmp_path / "bag") == {"/a": [0, 1, 2, 3], "/b": [3, 2, 1, 0]}
    assert read_numbers_with_mcap(bag.path) == {"/a": [0, 1, 2, 3], "/b": [3, 2, 1, 0]}


def test_empty_bag_is_readable(tmp_path: Path) -> None:
    bag, _ = new_bag(tmp_path / "bag")
    bag.close()
    bag.close()  # has no effect
    assert read_numbers(tmp_path / "bag") == {}
    assert read_numbers_with_mcap(bag.path) == {}


def test_directory_with_content_is_not_used(tmp_path: Path) -> None:
    (tmp_path / "other.txt").write_text("x")
    with pytest.raises(FileExistsError, match="not overwritten"):
        BagWriter(tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["other.txt"]


def test_empty_directory_is_used(tmp_path: Path) -> None:
    bag, (a,) = new_bag(tmp_path)
    bag.write(a, numbered(5), START_NS)
    bag.close()
    assert read_numbers(tmp_path) == {"/a": [5]}


def test_unwritable_path_is_an_error_at_the_start(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(OSError, match="Not a directory"):
        BagWriter(tmp_path / "file" / "bag")


WRITER = """
    import sys, time
    sys.path[:0] = {path!r}
    from bags import add_numbered_topic, numbered
    from st_recordings.mcap import BagWriter
    bag = BagWriter({directory!r})
    a = add_numbered_topic(bag)
    print("ready", flush=True)
    for k in range(100_000):
        bag.write(a, numbered(k, {text!r}), time.time_ns())
        {pause}
        if bag.error: break
    bag.close()
    import json; print(json.dumps([bag.error, bag.message_count, bag.lost_count]))
"""


def start_writer(directory: Path, text: str = "", pause: str = "pass", **options) -> subprocess.Popen:
    program = textwrap.dedent(WRITER).format(path=sys.path, directory=str(directory), text=text, pause=pause)
    return subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True, **options)


def test_kill_loses_at_most_the_last_second(tmp_path: Path) -> None:
    process = start_writer(tmp_path / "bag", pause="time.sleep(0.004); bag.flush_when_due()")
    assert process.stdout.readline() == "ready\n"
    time.sleep(3.0)
    killed_ns = time.time_ns()
    os.kill(process.pid, signal.SIGKILL)
    process.communicate(timeout=20)
    report = recover(tmp_path / "bag")
    numbers = read_numbers(tmp_path / "bag")["/a"]
    assert numbers == list(range(len(numbers)))
    assert report.files[0].count == len(numbers) > 200
    assert killed_ns - report.files[0].end_ns < 1_000_000_000
    assert read_numbers_with_mcap(tmp_path / "bag" / "bag_0.mcap") == {"/a": numbers}


def test_bag_that_is_still_recorded_is_not_recovered(tmp_path: Path) -> None:
    bag, (a,) = new_bag(tmp_path / "bag")
    bag.write(a, numbered(1), START_NS)
    bag.flush()
    program = f"from st_recordings.recovery import recover; recover({str(tmp_path / 'bag')!r})"
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=30, check=False)
    bag.close()
    assert "still being recorded" in result.stderr
    assert read_numbers(tmp_path / "bag") == {"/a": [1]}


def check_stopped_bag(process: subprocess.Popen, directory: Path) -> None:
    """Recording that ran out of space: it is closed and readable, and reports the messages that were lost."""
    output, _ = process.communicate(timeout=60)
    error, count, lost = json.loads(output.splitlines()[-1])
    assert process.returncode == 0
    assert "recording stopped" in error
    assert "recover" not in error  # it has an index
    numbers = read_numbers(directory)["/a"]
    assert numbers == list(range(len(numbers)))
    assert count == len(numbers) > 100
    assert lost > 0
    assert read_numbers_with_mcap(directory / f"{directory.name}_0.mcap") == {"/a": numbers}
    assert all(part.is_intact for part in recover(directory).files)


def test_file_size_limit_stops_the_recording_and_keeps_what_was_written(tmp_path: Path) -> None:
    limit = 400_000
    process = start_writer(tmp_path / "bag", text=os.urandom(200).hex(), pause="k % 500 or bag.flush()",
                     preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)))
    check_stopped_bag(process, tmp_path / "bag")
    assert limit / 2 < (tmp_path / "bag" / "bag_0.mcap").stat().st_size <= limit


def test_full_disk_stops_the_recording_and_keeps_what_was_written(tmp_path: Path) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=512k", "tmpfs", str(disk)]
    if subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("cannot mount a small disk here (needs root); the file size limit is tested instead")
    try:
        process = start_writer(disk / "bag", text="x" * 50, pause="k % 200 or bag.flush()")
        check_stopped_bag(process, disk / "bag")
    finally:
        subprocess.run(["umount", str(disk)], check=True)


@pytest.mark.parametrize("replaced", [False, True], ids=["renamed", "renamed and replaced"])
def test_renamed_bag_is_detected_and_closed_under_its_new_name(tmp_path: Path, replaced: bool) -> None:
    bag, (topic,) = new_bag(tmp_path / "bag")
    bag.write(topic, numbered(1), 1)
    bag.flush()
    (tmp_path / "bag").rename(tmp_path / "renamed")
    if replaced:
        BagWriter(tmp_path / "bag").close()
    bag.write(topic, numbered(2), 2)
    time.sleep(FLUSH_PERIOD)
    bag.flush_when_due()
    names = tmp_path / "bag" / "bag_0.mcap", tmp_path / "renamed" / "bag_0.mcap"
    assert bag.was_moved and bag.error == f"recording stopped: {names[0]} was moved to {names[1]}"
    bag.write(topic, numbered(3), 3)
    bag.close()
    assert bag.lost_count == 1
    assert read_numbers(tmp_path / "renamed") == {"/a": [1, 2]}


def test_file_moved_within_its_directory_is_named(tmp_path: Path) -> None:
    bag, _ = new_bag(tmp_path / "bag")
    moved = bag.path.rename(tmp_path / "bag" / "other.mcap")
    time.sleep(FLUSH_PERIOD)
    bag.flush_when_due()
    assert bag.was_moved and bag.error == f"recording stopped: {bag.path} was moved to {moved}"


def test_messages_that_a_renamed_bag_cannot_hold_are_counted_as_lost(tmp_path: Path, monkeypatch) -> None:
    bag, (topic,) = new_bag(tmp_path / "bag")
    bag.write(topic, numbered(1), 1)
    bag.flush()
    (tmp_path / "bag").rename(tmp_path / "renamed")
    bag.write(topic, numbered(2), 2)

    def fail(data: bytes) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(bag._file, "write", fail)
    monkeypatch.setattr(bag, "_next_flush", math.inf)
    time.sleep(FLUSH_PERIOD)
    bag.flush_when_due()
    bag.close()
    assert bag.was_moved and (bag.message_count, bag.lost_count) == (1, 1)


def test_deleted_bag_is_detected(tmp_path: Path) -> None:
    bag, (topic,) = new_bag(tmp_path / "bag")
    bag.write(topic, numbered(1), 1)
    shutil.rmtree(tmp_path / "bag")
    time.sleep(FLUSH_PERIOD)
    bag.flush_when_due()
    assert bag.was_moved and bag.error == f"recording stopped: {tmp_path / 'bag' / 'bag_0.mcap'} was deleted"
    bag.write(topic, numbered(2), 2)
    bag.close()
    assert bag.lost_count == 2
    assert not (tmp_path / "bag").exists()
