"""Bags of other software: the user names the topic and field of the steering angle; unknown topics are listed."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from ros_messages import STORE, header, make, odometry, serialise
from rosbags.rosbag2 import StoragePlugin, Writer
from st_core.vehicle import VehicleParameters
from st_offline.checking import gate
from st_offline.checking.gate import check_bag
from st_recordings.paths import config
from st_recordings.runs import ReadSettings, find_runs, read
from st_recordings.runs.bag import read_bag
from st_recordings.runs.cdr import ODOMETRY
from st_recordings.runs.errors import RunError
from st_recordings.runs.run_types import SteeringField

START_NS = 1_700_000_000_000_000_000
N, STEP_NS = 400, 10_000_000
FLOAT, STAMPED, TEXT = "std_msgs/msg/Float64", "geometry_msgs/msg/Vector3Stamped", "std_msgs/msg/String"
JOINTS = "sensor_msgs/msg/JointState"


def angle(k: int) -> float:
    return 0.001 * np.sin(0.05 * k)


def write_bag(folder: Path, storage: StoragePlugin = StoragePlugin.MCAP) -> Path:
    """Odometry in frame odom; the steering angle without a stamp, stamped 30 ms before reception, and in a list."""
    with Writer(folder, version=9, storage_plugin=storage) as writer:
        names = {"/odom": ODOMETRY, "/steering_angle": FLOAT, "/rack": STAMPED, "/notes": TEXT, "/joints": JOINTS}
        connections = {topic: writer.add_connection(topic, name, typestore=STORE) for topic, name in names.items()}
        for k in range(N):
            now = START_NS + k * STEP_NS
            messages = {
                "/odom": odometry(now, 0.1 * k, 0.0, 0.0, 10.0, frame="odom", child_frame="base_link"),
                "/steering_angle": serialise(FLOAT, data=angle(k)),
                "/rack": serialise(STAMPED, header=header(now - 30_000_000),
                                   vector=make("geometry_msgs/msg/Vector3", x=7.0, y=angle(k), z=0.0)),
                "/notes": serialise(TEXT, data="x"),
                "/joints": serialise(JOINTS, header=header(now), name=["left", "right"],
                                     position=np.array([9.0, angle(k)]), velocity=np.zeros(2), effort=np.zeros(2)),
            }
            for topic, message in messages.items():
                writer.write(connections[topic], now, message)
    return folder


@pytest.mark.parametrize("storage", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_steering_angle_is_read_from_any_numeric_field(tmp_path, storage):
    folder = write_bag(tmp_path / "drive", storage)
    expected = np.array([angle(k) for k in range(N)])
    drive = read_bag(folder, steering=SteeringField("steering_angle"))
    np.testing.assert_array_equal(drive.log.road_wheel_angle, expected)
    np.testing.assert_array_equal(drive.log.steering_time_ns, START_NS + np.arange(N) * STEP_NS)  # time of reception
    assert drive.frame == "odom" and drive.topics["st_msgs/msg/Steering"] == "/steering_angle"
    assert sorted(drive.unknown_topics) == [f"/joints ({JOINTS})", f"/notes ({TEXT})", f"/rack ({STAMPED})"]
    drive = read_bag(folder, steering=SteeringField("/rack", "vector.y"))
    np.testing.assert_array_equal(drive.log.road_wheel_angle, expected)
    np.testing.assert_array_equal(drive.log.steering_time_ns, START_NS + np.arange(N) * STEP_NS - 30_000_000)  # stamp
    drive = read_bag(folder, steering=SteeringField("/joints", "position.1"))
    np.testing.assert_array_equal(drive.log.road_wheel_angle, expected)


def test_steering_wheel_angle_is_converted_by_the_vehicle_file(tmp_path):
    folder = write_bag(tmp_path / "drive")
    vehicle = VehicleParameters.from_yaml(config("vehicle/leaf.yaml").read_text())
    vehicle = replace(vehicle, steering_wheel_offset=0.02)
    (source,) = find_runs([folder])
    settings = ReadSettings(steering=SteeringField("/steering_angle", quantity="wheel"))
    wheel = np.array([angle(k) for k in range(N)])
    np.testing.assert_allclose(read(source, vehicle, settings).log.road_wheel_angle,
                               (wheel - 0.02) / vehicle.steering_ratio, rtol=1e-12)


@pytest.mark.parametrize(("topic", "field", "message"), [
    ("/angle", "data", "topic /angle has no messages in this bag; name one of the recorded topics: /joints, /notes, "
     "/odom, /rack, /steering_angle"),
    ("/rack", "data", "'data' is not one of the fields (header, vector)"),
    ("/rack", "vector.y.z", "'z' is not one of the fields (none)"),
    ("/rack", "vector", "is not a number"),
    ("/notes", "data", "is not a number"),
    ("/joints", "position", "'position' of /joints is a list of 2 elements; add an index, such as position.0"),
    ("/joints", "position.2", "'2' is not one of the fields (none)"),
])
def test_invalid_steering_field_is_rejected_with_its_name(tmp_path, topic, field, message):
    folder = write_bag(tmp_path / "drive")
    with pytest.raises(RunError) as error:
        check_bag(folder, None, True, ReadSettings(steering=SteeringField(topic, field)))
    assert message in str(error.value) and "\n" not in str(error.value)


def test_bag_of_ros_1_is_not_replayed(tmp_path):
    with pytest.raises(RunError, match="the nodes cannot receive ROS 1 messages; convert the bag with rosbags"):
        check_bag(tmp_path / "drive.bag", None, True)


def test_bag_without_odometry_is_not_replayed(tmp_path, monkeypatch):
    """It is refused before it is read and checked, although other commands read it as a table."""
    monkeypatch.setattr(gate, "read", lambda *args, **kwargs: pytest.fail("read"))
    folder = tmp_path / "drive"
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        writer.write(writer.add_connection("/angle", FLOAT, typestore=STORE), START_NS, serialise(FLOAT, data=0.0))
    with pytest.raises(RunError, match=r"no message of type nav_msgs/msg/Odometry, which the nodes need; use st check"):
        gate.check_bag(folder, None, True, ReadSettings(steering=SteeringField("/angle")))


def test_missing_steering_topic_is_reported_with_the_option(tmp_path):
    with pytest.raises(RunError, match=r"/steering_angle \(std_msgs/msg/Float64\).*--steering-topic"):
        read_bag(write_bag(tmp_path / "drive"))
