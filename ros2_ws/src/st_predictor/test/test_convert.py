"""Conversion of messages to plain values and back."""

import math

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")
pytest.importorskip("st_msgs", reason="needs the built workspace")

from nav_msgs.msg import Odometry
from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import deserialize_message, serialize_message
from st_core.prediction import Start, predict
from st_core.types import STATE_NAMES, ControlInput, InsSample, Trajectory, VehicleState
from st_core.vehicle import VehicleParameters
from st_msgs.msg import Prediction
from st_predictor import convert
from st_predictor.nodes._bands import BandMessages, read_bands
from st_recordings.bag_metadata import make_qos
from st_ros.polling import from_nanoseconds
from support import LEAF

pytestmark = pytest.mark.ros
TIME_NS = 1_790_000_000_123_456_789
CAR = VehicleParameters.from_yaml(LEAF.read_text())


def odometry(yaw: float = 2.0, frame: str = "map") -> Odometry:
    message = Odometry()
    message.header.stamp, message.header.frame_id = from_nanoseconds(TIME_NS), frame
    pose, twist = message.pose.pose, message.twist.twist
    pose.position.x, pose.position.y, pose.position.z = 10.0, -20.0, 3.0
    pose.orientation.z, pose.orientation.w = math.sin(yaw / 2), math.cos(yaw / 2)
    twist.linear.x, twist.linear.y, twist.angular.z = 8.0, 0.1, -0.3
    return message


def test_odometry_is_converted_to_an_ins_sample() -> None:
    sample = convert.read_ins_sample(odometry(), "map")
    assert sample == pytest.approx(InsSample(TIME_NS, 10.0, -20.0, 2.0, 8.0, 0.1, -0.3), rel=1e-15)
    assert sample.time_ns == TIME_NS


def test_yaw_is_independent_of_roll_and_pitch() -> None:
    """Yaw of the z-y-x (yaw, pitch, roll) sequence."""
    yaw, pitch, roll = 1.2, 0.2, -0.3
    message = odometry()
    cy, sy, cp, sp, cr, sr = (f(a / 2) for a in (yaw, pitch, roll) for f in (math.cos, math.sin))
    q = message.pose.pose.orientation
    q.w, q.x = cr * cp * cy + sr * sp * sy, sr * cp * cy - cr * sp * sy
    q.y, q.z = cr * sp * cy + sr * cp * sy, cr * cp * sy - sr * sp * cy
    assert convert.read_ins_sample(message, "map").yaw == pytest.approx(yaw)


def test_unusable_odometry_is_rejected_with_a_reason() -> None:
    assert "'odom'" in convert.read_ins_sample(odometry(frame="odom"), "map")
    message = odometry()
    message.twist.twist.linear.y = math.nan
    assert "NaN" in convert.read_ins_sample(message, "map")
    message = odometry()
    message.pose.pose.position.x = math.inf
    assert "infinite" in convert.read_ins_sample(message, "map")
    message = odometry()
    message.pose.pose.orientation.w = message.pose.pose.orientation.z = 0.0
    assert "unit quaternion" in convert.read_ins_sample(message, "map")


def predict_example() -> tuple[Start, Trajectory]:
    state = VehicleState(1.0, 2.0, 9.0, 0.2, 3.0, 0.4)
    inputs = ControlInput(0.05, -0.5)
    return Start(TIME_NS, state, inputs), predict("nonlinear", CAR, state, inputs)


def test_prediction_is_unchanged_by_serialisation() -> None:
    start, trajectory = predict_example()
    message = convert.make_prediction_message(start, "nonlinear", trajectory, CAR, "map", "ab" * 32)
    received = deserialize_message(serialize_message(message), Prediction)
    start_ns, read = convert.read_trajectory(received)
    assert (start_ns, read.step) == (TIME_NS, 0.05)
    assert ControlInput(received.road_wheel_angle, received.velocity_x_dot) == start.inputs
    np.testing.assert_array_equal(read.states, trajectory.states)
    assert (received.model, received.configuration_hash, received.header.frame_id) == ("nonlinear", "ab" * 32, "map")


def test_unusable_predictions_are_rejected_with_a_reason() -> None:
    start, trajectory = predict_example()

    def read_with(**changes) -> str:
        message = convert.make_prediction_message(start, "nonlinear", trajectory, CAR, "map", "")
        for name, value in changes.items():
            setattr(message, name, value)
        return convert.read_trajectory(message)

    assert "length" in read_with(yaw=[0.0, 1.0])
    assert "step" in read_with(step=0.0)
    assert "step" in read_with(step=math.nan)
    assert "start state" in read_with(x=[math.nan] * 101)
    assert "length" in read_with(**{name: [] for name in STATE_NAMES})


def test_reused_path_message_is_filled_completely() -> None:
    start, trajectory = predict_example()
    builder = convert.PathBuilder("map", 101)
    builder.fill(TIME_NS - 10**9, Trajectory(0.05, trajectory.states + 5.0), CAR)
    path = builder.fill(start.time_ns, trajectory, CAR)
    for k, pose in enumerate(path.poses):
        x, y, _, _, yaw, _ = trajectory.states[k]
        assert pose.pose.position.x == pytest.approx(x - 0.398 * math.cos(yaw))
        assert pose.pose.position.y == pytest.approx(y - 0.398 * math.sin(yaw))
        assert pose.pose.orientation.z == pytest.approx(math.sin(yaw / 2))
        assert pose.pose.orientation.w == pytest.approx(math.cos(yaw / 2))
        assert pose.header.stamp == from_nanoseconds(TIME_NS + k * 50_000_000)


def test_qos_is_converted_to_that_of_a_bag() -> None:
    plain = convert.make_bag_qos(QoSProfile(depth=50))
    assert plain == make_qos(liveliness="system_default")
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL, deadline=Duration(seconds=2))
    assert convert.make_bag_qos(latched)["durability"] == "transient_local"
    assert convert.make_bag_qos(latched)["deadline"] == {"sec": 2, "nsec": 0}


def test_band_message_has_the_newest_half_widths() -> None:
    widths = np.zeros((3, 5), np.float32)
    messages = BandMessages({"linear": {("forecast", 0.9): widths.T}})
    for scale in (1.0, 2.0):
        widths[:] = scale * np.arange(15.0).reshape(3, 5)
        prediction = Prediction(x=[0.0] * 5, bands=messages.fill()["linear"])
        received = deserialize_message(serialize_message(prediction), Prediction)
        (key, read), = read_bands(received).items()
        assert key == ("forecast", 0.9) and read.T.tolist() == widths.tolist()
