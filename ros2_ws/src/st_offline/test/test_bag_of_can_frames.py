"""Bags of other software: odometry and can_msgs/Frame, from which the signal table and DBC give the steering."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from raw_drives import LEAF, write_drives
from ros_messages import STORE, header, odometry, serialise
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore
from st_core.clock_types import Verdict
from st_core.log import DriveLog
from st_core.vehicle import VehicleParameters
from st_offline.checking.gate import check_bag
from st_offline.discovery.drives import read_drive
from st_recordings.runs import ReadSettings, find_runs, read
from st_recordings.runs.can_logs import read_can_logs
from st_recordings.runs.cdr import CAN_MSGS_FRAME, ODOMETRY
from st_recordings.runs.errors import RunError
from st_recordings.runs.frames import EXTENDED, Frames
from st_recordings.runs.raw import read_pair

CAR = VehicleParameters.from_yaml(LEAF.read_text())
REPORT = "autoware_vehicle_msgs/msg/SteeringReport"
BUSES = ("/can0/from_can_bus", "/can10/from_can_bus")


@pytest.fixture(scope="module")
def raw(tmp_path_factory: pytest.TempPathFactory) -> tuple[DriveLog, Frames]:
    """A drive of the virtual Leaf as its own reader gives it, and the frames of its CAN log."""
    folder = write_drives(tmp_path_factory.mktemp("raw"), {}, 4, (("sweep", 12.0),))
    (source,) = find_runs([folder])
    log = read(source, CAR, ReadSettings(offset=0.0, accept_doubtful=True)).log
    return log, read_can_logs(source.can).frames


def serialise_frame(frames: Frames, k: int, stamp_ns: int, bus: str) -> bytes:
    return serialise(CAN_MSGS_FRAME, header=header(stamp_ns, bus.split("/")[1]), id=int(frames.id[k]) & ~EXTENDED,
                     is_rtr=False, is_extended=bool(frames.id[k] & EXTENDED), is_error=False,
                     dlc=int(frames.length[k]), data=frames.payload[k, :8])


def write_bag(folder: Path, log: DriveLog, frames: Frames, storage: StoragePlugin = StoragePlugin.MCAP,
              stamped: bool = True, report: Callable[[Any], bytes] | None = None, store: Typestore = STORE) -> Path:
    """Frames of odd identifiers are on the second bus. report: makes a steering report with a stamp."""
    with Writer(folder, version=9, storage_plugin=storage) as writer:
        odom = writer.add_connection("/odom", ODOMETRY, typestore=STORE)
        buses = [writer.add_connection(bus, CAN_MSGS_FRAME, typestore=STORE) for bus in BUSES]
        if report is not None:
            reports = writer.add_connection("/steering_status", REPORT, typestore=store)
        for k, time_ns in enumerate(log.ins_time_ns.tolist()):
            pose = odometry(time_ns, log.x[k], log.y[k], log.yaw[k], log.velocity_x[k], log.velocity_y[k],
                            log.yaw_rate[k])
            writer.write(odom, time_ns, pose)
            if report is not None:
                stamp = header(time_ns, "").stamp
                writer.write(reports, time_ns, report(stamp))
        for k, time_ns in enumerate(frames.time_ns.tolist()):
            bus = int(frames.id[k]) % 2
            writer.write(buses[bus], time_ns, serialise_frame(frames, k, time_ns if stamped else 0, BUSES[bus]))
    return folder


@pytest.mark.slow
@pytest.mark.parametrize(("storage", "stamped"), [
    (StoragePlugin.MCAP, True), (StoragePlugin.MCAP, False), (StoragePlugin.SQLITE3, True)])
def test_steering_is_decoded_from_the_frames(raw, tmp_path, storage, stamped):
    log, frames = raw
    folder = write_bag(tmp_path / "drive", log, frames, storage, stamped)
    read_frames = read_can_logs([folder]).frames
    np.testing.assert_array_equal(read_frames.time_ns, frames.time_ns)
    np.testing.assert_array_equal(read_frames.id, frames.id)
    np.testing.assert_array_equal(read_frames.payload, frames.payload[:, :8])
    assert {*read_frames.bus.tolist()} == {1, 2}
    (source,) = find_runs([folder])
    run = read(source, CAR)
    np.testing.assert_allclose(run.log.steering_time_ns, log.steering_time_ns, atol=1)
    np.testing.assert_allclose(run.log.road_wheel_angle, log.road_wheel_angle, rtol=1e-12)
    np.testing.assert_array_equal(run.log.ins_time_ns, log.ins_time_ns)
    assert run.alignment.verdict is Verdict.NOT_NEEDED
    assert any("have no stamp; the times of reception are used" in text for text in run.warnings) == (not stamped)


@pytest.mark.parametrize("has_steering", [True, False])
def test_frames_are_preferred_to_a_steering_report(raw, tmp_path, has_steering: bool) -> None:
    log, frames = raw
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg("builtin_interfaces/Time stamp\nfloat32 steering_tire_angle\n", REPORT))
    if not has_steering:
        frames = replace(frames, id=frames.id + np.uint32(1))
    folder = write_bag(tmp_path / "drive", log, frames,
                       report=lambda stamp: store.serialize_cdr(store.types[REPORT](stamp, 0.25), REPORT), store=store)
    run = read(find_runs([folder])[0], CAR)
    assert (float(run.log.road_wheel_angle.min()) == 0.25) != has_steering
    assert any("for its type" in warning for warning in run.warnings) != has_steering


def test_bag_with_frames_is_a_drive_of_a_discovery(raw, tmp_path):
    (source,) = find_runs([write_bag(tmp_path / "drive", *raw)])
    drive = read_drive(source, CAR, ReadSettings())
    assert not drive.problem and drive.metadata["vehicle"] == ""


def test_bag_needs_no_alignment_but_a_search_is_done(raw, tmp_path):
    folder = write_bag(tmp_path / "drive", *raw)
    with pytest.raises(RunError, match="all its messages are on one clock, so there is nothing to align"):
        read_pair([folder], ReadSettings())
    pair = read_pair([folder], ReadSettings(search=(-1.0, 1.0)))
    assert abs(pair.alignment.offset_ns) < 50_000_000


def test_frames_without_steering_are_rejected(raw, tmp_path):
    log, frames = raw
    folder = write_bag(tmp_path / "drive", log, replace(frames, id=frames.id + np.uint32(1)))
    (source,) = find_runs([folder])
    with pytest.raises(RunError, match=r"the steering message Leaf_Steering .* is not in the log"):
        read(source, CAR)


def test_replay_of_frames_alone_is_rejected(raw, tmp_path):
    folder = write_bag(tmp_path / "drive", *raw)
    with pytest.raises(RunError, match="its steering is only in CAN frames") as error:
        check_bag(folder, LEAF, force=True)
    assert "--steering-topic" not in str(error.value)  # no topic of this bag can carry the angle


def test_bag_without_frames_is_not_a_can_log(raw, tmp_path):
    log, frames = raw
    folder = write_bag(tmp_path / "drive", log, frames.select(slice(0, 0)))
    with pytest.raises(RunError, match="this bag contains no CAN frames"):
        read_can_logs([folder])
