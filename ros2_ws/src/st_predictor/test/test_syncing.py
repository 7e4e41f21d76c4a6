"""Power loss: unsynced data are lost, at most the last second of the recording."""

import errno
import os
import threading
import time
from itertools import pairwise
from pathlib import Path

import pytest
from bags import DEFINITION, TYPE, TYPE_HASH, numbered, read_numbers
from st_recordings import mcap
from st_recordings.mcap import BagWriter
from st_recordings.recovery import recover

START_NS = 1_790_000_000_000_000_000
RATE = 500  # messages/s


class Disk:
    """Length of each file that survives a power loss: that at the call of the last completed fdatasync.

    delay: of each fdatasync [s]; error: errno with which fdatasync fails, 0 for none.
    """

    def __init__(self, delay: float = 0.0, error: int = 0):
        self.safe: dict[int, int] = {}  # bytes by inode
        self.delay, self.error, self.threads = delay, error, set()
        self._real = os.fdatasync

    def fdatasync(self, descriptor: int) -> None:
        self.threads.add(threading.current_thread())
        if self.error:
            raise OSError(self.error, os.strerror(self.error))
        status = os.fstat(descriptor)
        self._real(descriptor)
        time.sleep(self.delay)
        self.safe[status.st_ino] = status.st_size

    def lose_power(self, file: Path, target: Path, tail: bytes = b"") -> Path:
        """The bag after the power loss; the unsynced part of the file is missing or filled with `tail`."""
        length, whole = self.safe.get(file.stat().st_ino, 0), file.stat().st_size
        target.mkdir()
        (target / file.name).write_bytes(file.read_bytes()[:length] + (tail * whole)[:whole - length])
        return target


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Disk:
    disk = Disk()
    monkeypatch.setattr(mcap.os, "fdatasync", disk.fdatasync)
    return disk


def record(directory: Path, seconds: float, synced: bool = True, padding: str = "") -> tuple[BagWriter, list[float]]:
    """An open bag, written as by the recorder, and the time at which each message was written [s, monotonic]."""
    bag = BagWriter(directory, {"configuration": {"hash": "0123"}}, synced=synced)
    topic = bag.add_topic("/a", TYPE, definition=DEFINITION, type_hash=TYPE_HASH)
    written: list[float] = []
    began = time.monotonic()
    while (now := time.monotonic()) < began + seconds:
        while len(written) < (now - began) * RATE:
            bag.write(topic, numbered(len(written), padding), START_NS + len(written))
            written.append(now)
        bag.flush_when_due()
        time.sleep(0.02)
    return bag, written


@pytest.mark.slow
@pytest.mark.parametrize("tail", [b"", b"\0", b"\xa5"], ids=["cut", "zeros", "old bytes"])
@pytest.mark.parametrize("seconds", [1.6, 2.3])
def test_power_loss_loses_at_most_the_last_second(disk: Disk, tmp_path: Path, seconds: float, tail: bytes) -> None:
    disk.delay = 0.1  # a slow memory card
    bag, written = record(tmp_path / "bag", seconds)
    now = time.monotonic()
    found = disk.lose_power(bag.path, tmp_path / "found", tail)
    bag.close()
    recover(found)
    kept = read_numbers(found)["/a"]
    assert kept == list(range(len(kept)))
    assert len(kept) >= sum(one < now - 1.0 for one in written) > 0
    assert len(kept) < len(written)  # otherwise nothing was lost and nothing is tested
    assert threading.current_thread() not in disk.threads


def test_nothing_is_synced_without_the_option(disk: Disk, tmp_path: Path) -> None:
    bag, _ = record(tmp_path / "bag", 1.2, synced=False)
    assert not disk.safe and bag.syncer is None
    bag.close()


def test_sync_rate_is_limited_for_many_chunks(disk: Disk, tmp_path: Path) -> None:
    bag, written = record(tmp_path / "bag", 1.2, padding="x" * 50_000)  # a chunk of 1 MiB every 40 ms
    assert bag.syncer is not None
    assert 3 <= bag.syncer.call_count <= 1.2 / mcap.MIN_SYNC_PERIOD + 3
    bag.close()
    assert read_numbers(tmp_path / "bag")["/a"] == list(range(len(written)))


def test_slow_disk_does_not_delay_the_writer(disk: Disk, tmp_path: Path) -> None:
    disk.delay = 1.5
    bag, written = record(tmp_path / "bag", 2.2)
    assert bag.syncer is not None
    gaps = [b - a for a, b in pairwise(written)]
    assert max(gaps) < 1.0
    assert bag.syncer.delay > 0.5
    bag.close()
    assert bag.error == "" and read_numbers(tmp_path / "bag")["/a"] == list(range(len(written)))


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EIO])
def test_failing_disk_is_reported_and_recording_continues(disk: Disk, tmp_path: Path, number: int) -> None:
    disk.error = number
    bag, before = record(tmp_path / "bag", 0.8)
    assert bag.syncer is not None and bag.syncer.error == os.strerror(number)
    disk.error = 0
    time.sleep(0.3)
    assert bag.syncer.error == os.strerror(number)  # data of a failed sync remain uncertain
    bag.close()
    assert bag.error == "" and read_numbers(tmp_path / "bag")["/a"] == list(range(len(before)))


def test_threads_and_files_are_released(tmp_path: Path) -> None:
    threads, files = threading.active_count(), len(os.listdir("/proc/self/fd"))
    bag, _ = record(tmp_path / "closed", 0.6)
    bag.close()
    bag, _ = record(tmp_path / "renamed", 0.6)
    bag.directory.rename(tmp_path / "elsewhere")
    time.sleep(0.6)
    bag.flush_when_due()
    assert bag.was_moved
    bag.close()
    assert threading.active_count() == threads and len(os.listdir("/proc/self/fd")) == files


def test_recording_check_reports_slow_and_failing_disk(disk: Disk, tmp_path: Path) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2")
    from st_predictor.nodes._bag import is_complete, make_recording_check
    from st_ros import diagnostics

    bag, _ = record(tmp_path / "bag", 0.7)
    assert make_recording_check(bag).level == diagnostics.OK and is_complete(bag)
    disk.error = errno.EIO
    bag.write(1, numbered(0), START_NS)
    bag.flush()
    time.sleep(0.4)
    check = make_recording_check(bag)
    assert check.level == diagnostics.ERROR and "Input/output error" in check.message and not is_complete(bag)
    bag.close()
    assert not is_complete(bag)
    disk.error, disk.delay = 0, 1.6
    slow, _ = record(tmp_path / "slow", 1.3)
    check = make_recording_check(slow)
    assert check.level == diagnostics.WARN and "the disk is slow" in check.message, check
    slow.close()


@pytest.mark.ros
def test_evaluator_that_cannot_record_names_the_command_that_replaces_it(tmp_path: Path) -> None:
    rclpy = pytest.importorskip("rclpy")
    from ros_processes import free_domain
    from st_predictor.nodes.evaluator import EvaluatorNode
    from support import LEAF

    rclpy.init(args=["--ros-args", "-p", f"vehicle_file:={LEAF}", "-p", f"output_directory:={tmp_path / 'errors'}"],
               domain_id=free_domain())
    try:
        node = EvaluatorNode()
        node._bag.error = "recording stopped: No space left on device"
        message = next(check.message for check in node._make_checks() if check.name == "recording")
        node.destroy_node()
    finally:
        rclpy.shutdown()
    assert message == "recording stopped: No space left on device; compute lost errors with st evaluate"
