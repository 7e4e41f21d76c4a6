"""Bags without odometry, as INS drivers and Autoware record them, and bags of ROS 1 are read; others are rejected with
what to do."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drive_kinds import CAR, assert_same, assert_warned, columns, to_degrees
from ros_messages import STORE, header, make
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore
from st_core.log import DriveLog
from st_core.types import body_to_map
from st_recordings.runs import ReadSettings, RunSource, axes, find_runs, read
from st_recordings.runs.axes import MIN_COURSE_SPREAD, convert_odometry, rotate_to_body_axes
from st_recordings.runs.bag import ODOMETRY, read_bag
from st_recordings.runs.errors import RunError
from st_recordings.runs.ins_log import are_stored_out_of_order
from st_recordings.runs.readers.bag import _is_command, add_steering
from st_recordings.runs.run_types import SteeringField

STEER = ReadSettings(steering=SteeringField("/steer", "data", "wheel"))
DEFINITIONS = {
    "autoware_vehicle_msgs/msg/SteeringReport": "builtin_interfaces/Time stamp\nfloat32 steering_tire_angle\n",
    "autoware_vehicle_msgs/msg/VelocityReport": "std_msgs/Header header\nfloat32 longitudinal_velocity\n"
                                                "float32 lateral_velocity\nfloat32 heading_rate\n",
    "ackermann_msgs/msg/AckermannDrive": "float32 steering_angle\n",
    "ackermann_msgs/msg/AckermannDriveStamped": "std_msgs/Header header\nackermann_msgs/AckermannDrive drive\n",
    "raptor_dbw_msgs/msg/SteeringReport": "std_msgs/Header header\nfloat32 steering_wheel_angle\n",
    "pacmod3_msgs/msg/SystemRptFloat": "std_msgs/Header header\nfloat64 output\n",
    "own_msgs/msg/Wheel": "builtin_interfaces/Time stamp\nfloat64 steering_wheel_angle_deg\n"}
Messages = dict[str, Callable[[int], Any]]


def make_store(base: Stores, definitions: dict[str, str]) -> Typestore:
    store = get_typestore(base)
    for name, text in definitions.items():
        store.register(get_types_from_msg(text, name))
    return store


def vector(x: float, y: float, z: float = 0.0, kind: str = "Vector3") -> Any:
    return make(f"geometry_msgs/msg/{kind}", x=float(x), y=float(y), z=float(z))


def make_messages(log: DriveLog, store: Typestore = STORE, stamp_offset_ns: int = 0) -> Messages:
    """Topic -> function that makes the message of a row, for every topic of these tests."""
    wheel, (latitude, longitude), nine = columns(log)[7], to_degrees(log), np.zeros(9)

    def orientation(k: int) -> Any:
        return make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=float(np.sin(log.yaw[k] / 2)),
                    w=float(np.cos(log.yaw[k] / 2)))

    def twist(k: int, yaw: float = 0.0, yaw_rate: float | None = None) -> Any:
        east, north = body_to_map(log.velocity_x[k], log.velocity_y[k], yaw)
        return make("geometry_msgs/msg/Twist", linear=vector(east, north),
                    angular=vector(0, 0, log.yaw_rate[k] if yaw_rate is None else yaw_rate))

    def odometry(k: int, velocity: Any) -> Any:
        return make(ODOMETRY, header=stamped(k), child_frame_id="base_link",
                    pose=make("geometry_msgs/msg/PoseWithCovariance", pose=pose(k), covariance=np.zeros(36)),
                    twist=make("geometry_msgs/msg/TwistWithCovariance", twist=velocity, covariance=np.zeros(36)))

    def pose(k: int) -> Any:
        return make("geometry_msgs/msg/Pose", position=vector(log.x[k], log.y[k], kind="Point"),
                    orientation=orientation(k))

    def stamped(k: int, frame: str = "map") -> Any:
        return header(int(log.ins_time_ns[k]) + stamp_offset_ns, frame)

    def twist_over_ground(frame: str) -> Callable[[int], Any]:
        return lambda k: make("geometry_msgs/msg/TwistStamped", header=stamped(k, frame),
                              twist=twist(k, yaw=log.yaw[k], yaw_rate=0.0))

    return {
        **dict.fromkeys(("/imu/data", "/imu/second"), lambda k: make(
            "sensor_msgs/msg/Imu", header=stamped(k), orientation=orientation(k), orientation_covariance=nine,
            angular_velocity=vector(0, 0, log.yaw_rate[k]), angular_velocity_covariance=nine,
            linear_acceleration=vector(0, 0, 9.8), linear_acceleration_covariance=nine)),
        "/fix": lambda k: make(
            "sensor_msgs/msg/NavSatFix", header=stamped(k), latitude=float(latitude[k]), longitude=float(longitude[k]),
            altitude=0.0, status=make("sensor_msgs/msg/NavSatStatus", status=0, service=1), position_covariance=nine,
            position_covariance_type=0),
        "/twist": lambda k: make("geometry_msgs/msg/TwistStamped", header=stamped(k, "base_link"), twist=twist(k)),
        "/twist_in_map": lambda k: make("geometry_msgs/msg/TwistStamped", header=stamped(k, "map"), twist=twist(k)),
        **{f"/{frame}_velocity": twist_over_ground(frame) for frame in ("map", "gps", "base_link")},
        "/pose": lambda k: make("geometry_msgs/msg/PoseStamped", header=stamped(k), pose=pose(k)),
        "/ekf/pose_with_covariance": lambda k: make(
            "geometry_msgs/msg/PoseWithCovarianceStamped", header=stamped(k), pose=odometry(k, twist(k)).pose),
        "/twist_with_covariance": lambda k: make(
            "geometry_msgs/msg/TwistWithCovarianceStamped", header=stamped(k, "base_link"),
            twist=odometry(k, twist(k)).twist),
        "/odom": lambda k: odometry(k, twist(k)),
        "/odom_over_ground": lambda k: odometry(k, twist(k, yaw=log.yaw[k])),
        "/wheel": lambda k: store.types["own_msgs/msg/Wheel"](
            stamp=stamped(k).stamp, steering_wheel_angle_deg=float(np.degrees(wheel[k]))),
        "/clock": lambda k: make("rosgraph_msgs/msg/Clock", clock=stamped(k).stamp),
        **dict.fromkeys(("/steer", "/steering_cmd"), lambda k: make("std_msgs/msg/Float64", data=float(wheel[k]))),
        "/drive": lambda k: store.types["ackermann_msgs/msg/AckermannDriveStamped"](
            header=stamped(k), drive=store.types["ackermann_msgs/msg/AckermannDrive"](steering_angle=float(wheel[k]))),
        **dict.fromkeys(("/vehicle/status/steering_status", "/second/steering_status"), lambda k: store.types[
            "autoware_vehicle_msgs/msg/SteeringReport"](
            stamp=stamped(k).stamp, steering_tire_angle=float(CAR.road_wheel_angle(wheel[k])))),
        "/raptor/steering_report": lambda k: store.types["raptor_dbw_msgs/msg/SteeringReport"](
            header=stamped(k), steering_wheel_angle=float(np.degrees(wheel[k]))),
        **dict.fromkeys(("/pacmod/steer_rpt", "/pacmod/brake_rpt"), lambda k: store.types[
            "pacmod3_msgs/msg/SystemRptFloat"](header=stamped(k), output=float(wheel[k]))),
        "/vehicle/status/velocity_status": lambda k: store.types["autoware_vehicle_msgs/msg/VelocityReport"](
            header=stamped(k, "base_link"), longitudinal_velocity=float(log.velocity_x[k]),
            lateral_velocity=float(log.velocity_y[k]), heading_rate=float(log.yaw_rate[k]))}


def write(folder: Path, log: DriveLog, *topics: str, stamp_offset_ns: int = 0, rows: slice = slice(None), pace: int = 1,
          change: Mapping[str, Callable[[Any, int], Any]] | None = None) -> Path:
    """stamp_offset_ns: stamps minus times of reception. rows: of the log. pace: real time in a second of the log [s].
    change: topic -> function that changes the message of a row."""
    store = make_store(Stores.ROS2_JAZZY, DEFINITIONS)
    messages = make_messages(log, store, stamp_offset_ns)
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for topic in topics:
            kind = messages[topic](0).__msgtype__
            connection = writer.add_connection(topic, kind, typestore=store)
            for k, time_ns in [*enumerate(log.ins_time_ns.tolist())][rows]:
                message = (change or {}).get(topic, lambda message, k: message)(messages[topic](k), k)
                received_ns = int(log.ins_time_ns[0]) + pace * (time_ns - int(log.ins_time_ns[0]))
                writer.write(connection, received_ns, store.serialize_cdr(message, kind))
    return folder


def to_ros1(message: Any, store: Typestore) -> Any:
    """The message with types of ROS 1, whose headers have a sequence number."""
    if not hasattr(message, "__msgtype__"):
        return message
    names = [name for name, _ in STORE.fielddefs[message.__msgtype__][1]]
    fields = {name: to_ros1(getattr(message, name), store) for name in names}
    further = {"seq": 7} if message.__msgtype__ == "std_msgs/msg/Header" else {}
    return store.types[message.__msgtype__](**further, **fields)


def write_ros1(file: Path, log: DriveLog, *topics: str) -> Path:
    store, messages = make_store(Stores.ROS1_NOETIC, {}), make_messages(log)
    with Ros1Writer(file) as writer:
        for topic in topics:
            kind = messages[topic](0).__msgtype__
            connection = writer.add_connection(topic, kind, typestore=store)
            for k, time_ns in enumerate(log.ins_time_ns.tolist()):
                writer.write(connection, time_ns, store.serialize_ros1(to_ros1(messages[topic](k), store), kind))
    return file


@pytest.mark.slow
@pytest.mark.parametrize(("topics", "settings", "rotated"), [
    (("/imu/data", "/fix", "/twist", "/steer"), STEER, True), (("/pose", "/twist", "/steer"), STEER, False),
    (("/ekf/pose_with_covariance", "/twist_with_covariance", "/steer"), STEER, False),
    (("/pose", "/vehicle/status/velocity_status", "/vehicle/status/steering_status"), ReadSettings(), False)],
    ids=["INS driver", "pose and twist", "with covariance", "Autoware"])
def test_bag_without_odometry_is_read_as_a_table(tmp_path: Path, drive_log: DriveLog, topics, settings: ReadSettings,
                                                 rotated: bool) -> None:
    (source,) = find_runs([write(tmp_path / "drive", drive_log, *topics)])
    run = read(source, CAR, settings)
    assert_same(run.log, drive_log, max_lost=0, rotated=rotated)
    assert all("for its type" in warning for warning in run.warnings)
    assert run.log.name == "drive" and run.provenance["recorded"] == {}


@pytest.mark.slow
@pytest.mark.parametrize(("topics", "warning"), [
    (("/imu/data", "/fix", "/map_velocity", "/steer"), ""), (("/imu/data", "/fix", "/gps_velocity", "/steer"), ""),
    (("/imu/data", "/pose", "/base_link_velocity", "/steer"),
     r"only as velocities to the east and north \(frame_id is 'base_link'\); they were rotated"),
    (("/pose", "/twist_in_map", "/steer"), r"only as velocities in body axes \(frame_id is 'map'\)$"),
    (("/odom_over_ground", "/steer"), "only as velocities to the east and north; they were rotated into body axes")])
def test_axes_of_velocities_follow_from_their_direction(tmp_path: Path, drive_log: DriveLog, topics,
                                                        warning: str) -> None:
    """The yaw rate of the receivers is 0, so that of the Imu is read."""
    (source,) = find_runs([write(tmp_path / "drive", drive_log, *topics)])
    run = read(source, CAR, STEER)
    assert_same(run.log, drive_log, max_lost=0, rotated="/fix" in topics)
    assert_warned(run.warnings, warning)


@pytest.mark.slow
def test_exchanged_channels_of_a_bag_are_corrected_by_a_run_file(tmp_path: Path, drive_log: DriveLog) -> None:
    exchanged = replace(drive_log, x=drive_log.y, y=drive_log.x)
    write(tmp_path / "drive", exchanged, "/odom", "/steer")
    (tmp_path / "run.yaml").write_text("bag: drive\ncolumns: {x: y, y: x}\n")
    (source,) = find_runs([tmp_path])
    run = read(source, CAR, STEER)
    assert_same(run.log, drive_log, max_lost=0, rotated=False)
    assert_warned(run.warnings, "corrected by its run.yaml: x from y; y from x")


def test_two_channels_from_one_of_a_bag_are_refused(tmp_path: Path, drive_log: DriveLog) -> None:
    write(tmp_path / "drive", drive_log, "/odom", "/steer")
    (tmp_path / "run.yaml").write_text("bag: drive\ncolumns: {x: y}\n")
    (source,) = find_runs([tmp_path])
    assert "can only exchange its channels, as {x: y, y: x}" in str(source.problem)


@pytest.mark.parametrize(("frame_id", "yaw", "is_rotated"), [
    ("map", 0.05, True), ("robot/odom", 0.05, True), ("gps_link", 0.05, True), ("", 0.05, False),
    ("base_link", 0.05, False), ("base_link", 0.3, True), ("map", 0.3, True), ("imu_link", -1.6, True)])
def test_frame_decides_on_the_axes_where_the_direction_does_not(frame_id: str, yaw: float, is_rotated: bool) -> None:
    columns = {"velocity_x": np.full(50, 10 * np.cos(yaw)), "velocity_y": np.full(50, 10 * np.sin(yaw)),
               "yaw": np.full(50, yaw)}
    rotate_to_body_axes(columns, frame_id)
    np.testing.assert_allclose(columns["velocity_y"], 0.0 if is_rotated else 10 * np.sin(yaw), atol=1e-12)


def test_velocities_to_the_north_and_east_are_rotated() -> None:
    yaw = np.linspace(0.0, 2.0, 50)
    columns = {"velocity_x": 10 * np.sin(yaw), "velocity_y": 10 * np.cos(yaw), "yaw": yaw}
    assert "to the north and east; they were rotated" in rotate_to_body_axes(columns)
    np.testing.assert_allclose(columns["velocity_x"], 10.0)


def to_ned(message: Any, z_down: bool, over_ground: bool) -> Any:
    """Odometry with x to the north and y to the east. z_down: also in body axes."""
    pose, twist = message.pose.pose, message.twist.twist
    yaw = 2.0 * np.arctan2(pose.orientation.z, pose.orientation.w)
    turned = make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=float(np.sin(np.pi / 4 - yaw / 2)),
                  w=float(np.cos(np.pi / 4 - yaw / 2)))
    sign = -1.0 if z_down else 1.0
    east, north = body_to_map(twist.linear.x, twist.linear.y, yaw)
    linear = vector(north, east) if over_ground else vector(twist.linear.x, sign * twist.linear.y)
    return replace(
        message, header=replace(message.header, frame_id="odom_ned"),
        pose=replace(message.pose, pose=make("geometry_msgs/msg/Pose", position=vector(
            pose.position.y, pose.position.x, kind="Point"), orientation=turned)),
        twist=replace(message.twist, twist=replace(twist, linear=linear, angular=vector(0, 0, sign * twist.angular.z))))


@pytest.mark.parametrize(("z_down", "over_ground"), [(True, False), (False, False), (True, True)])
def test_odometry_in_north_east_down(tmp_path: Path, drive_log: DriveLog, z_down: bool, over_ground: bool) -> None:
    folder = write(tmp_path / "drive", drive_log, "/odom", "/steer", change={
        "/odom": lambda message, k: to_ned(message, z_down, over_ground)})
    run = read(find_runs([folder])[0], CAR, STEER)
    assert_same(run.log, drive_log, max_lost=0)
    assert_warned(run.warnings, "frame_id is 'odom_ned': x, y and yaw were converted")
    assert read_bag(folder, steering=STEER.steering).conversions  # `st replay` would play the recorded values


@pytest.mark.parametrize(("yaw", "is_rotated"), [(np.pi, False), (0.0, False), (np.pi, True), (1.2, True)])
def test_velocity_of_a_reversing_car(yaw: float, is_rotated: bool) -> None:
    """In body axes the velocity points backward at any heading; over ground its direction is opposite to yaw."""
    time = np.linspace(0.0, 5.0, 50)
    over_ground = -2.0 * np.exp(1j * yaw)
    velocity = over_ground if is_rotated else -2.0
    columns = {"velocity_x": np.full(50, velocity.real), "velocity_y": np.full(50, velocity.imag),
               "yaw": np.full(50, yaw), "x": over_ground.real * time, "y": over_ground.imag * time}
    assert bool(rotate_to_body_axes(columns)) == is_rotated
    np.testing.assert_allclose(columns["velocity_x"], -2.0)
    np.testing.assert_allclose(columns["velocity_y"], 0.0, atol=1e-12)


@pytest.mark.parametrize("over_ground", [False, True])
@pytest.mark.parametrize("turn", [0.15, 0.23])  # rad, largest change of the course
@pytest.mark.parametrize("misalignment", [0.0, 0.05])  # rad, of the yaw
def test_velocity_on_a_road_to_the_east(over_ground: bool, turn: float, misalignment: float) -> None:
    """A straight road with one S-bend, on which the direction of the velocity alone shows nothing."""
    time = np.linspace(0.0, 20.0, 2001)
    course = turn * np.sin(2.0 * np.pi * (time - 10.0) / 5.0) * (np.abs(time - 12.5) < 2.5)
    velocity = 12.0 * np.exp(1j * course)
    noise = np.random.default_rng(3).normal(scale=0.001, size=(2, 2001))
    position = np.cumsum(velocity) * 0.01
    yaw = course + misalignment
    recorded = velocity if over_ground else velocity * np.exp(-1j * yaw)
    columns = {"velocity_x": recorded.real, "velocity_y": recorded.imag, "yaw": yaw, "x": position.real + noise[0],
               "y": position.imag + noise[1]}
    assert ("they were rotated" in rotate_to_body_axes(columns)) == over_ground
    np.testing.assert_allclose(columns["velocity_y"], -12.0 * np.sin(misalignment), atol=1e-9)


def test_limit_of_the_course_at_half_and_twice(monkeypatch) -> None:
    for factor in (0.5, 2.0):
        monkeypatch.setattr(axes, "MIN_COURSE_SPREAD", factor * MIN_COURSE_SPREAD)
        for over_ground in (False, True):
            test_velocity_on_a_road_to_the_east(over_ground, 0.23, 0.0)


@pytest.mark.parametrize("channel", ["yaw", "x", "velocity_y"])
def test_unknown_values_do_not_change_the_axes_of_the_velocity(channel: str) -> None:
    """A car that weaves on a road to the east, with one unknown value in a hundred."""
    time = np.linspace(0.0, 60.0, 6001)
    yaw, sideslip = 0.05 * np.sin(0.6 * time), -0.01 * np.cos(0.6 * time)
    position, velocity = np.cumsum(15.0 * np.exp(1j * (yaw + sideslip))) * 0.01, 15.0 * np.exp(1j * sideslip)
    columns = {"velocity_x": velocity.real.copy(), "velocity_y": velocity.imag.copy(), "yaw": yaw,
               "x": position.real.copy(), "y": position.imag}
    columns[channel][::100] = np.nan
    lateral = columns["velocity_y"].copy()
    assert rotate_to_body_axes(columns) == ""
    np.testing.assert_array_equal(columns["velocity_y"], lateral)


def test_yaw_of_the_wrong_sign_does_not_change_the_axes_of_the_velocity() -> None:
    time = np.linspace(0.0, 20.0, 2001)
    course = 0.2 * np.sin(time)
    position = np.cumsum(12.0 * np.exp(1j * course)) * 0.01
    columns = {"velocity_x": np.full(2001, 12.0), "velocity_y": np.zeros(2001), "yaw": -course, "x": position.real,
               "y": position.imag}
    assert rotate_to_body_axes(columns) == ""


def test_odometry_without_velocity_is_refused(tmp_path: Path, drive_log: DriveLog) -> None:
    folder = write(tmp_path / "drive", drive_log, "/odom", "/steer", change={"/odom": lambda message, k: replace(
        message, twist=replace(message.twist, twist=make("geometry_msgs/msg/Twist", linear=vector(0, 0),
                                                         angular=vector(0, 0))))})
    with pytest.raises(RunError, match=r"velocity is 0 in all samples, although its positions extend over \d+ m; rec"):
        read(find_runs([folder])[0], CAR, STEER)


def test_odometry_without_orientation_is_refused(tmp_path: Path, drive_log: DriveLog) -> None:
    def forget(message: Any, k: int) -> Any:
        pose = replace(message.pose.pose, orientation=make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=0.0))
        return replace(message, pose=replace(message.pose, pose=pose))

    folder = write(tmp_path / "drive", drive_log, "/odom", "/steer", change={"/odom": forget})
    with pytest.raises(RunError, match=r"no usable value of yaw; .*; the orientation quaternion is 0 in all odo"):
        read(find_runs([folder])[0], CAR, STEER)


@pytest.mark.parametrize(("z_down", "drift", "note"), [
    (True, 1.0, "z of the body axes points down: the sign"), (False, 1.0, "x, y and yaw were converted"),
    (True, 0.0, "the data do not show whether z of the body axes points down, which was assumed")])
def test_odometry_in_north_east_down_without_a_yaw_rate(z_down: bool, drift: float, note: str) -> None:
    """The sideways displacement shows the sign of velocity_y. drift: the fraction of it that the positions contain."""
    time = np.linspace(0.0, 10.0, 501)
    yaw, lateral = 0.2 * time, 0.3 * np.sin(2.0 * time)
    position = np.cumsum((5.0 + 1j * drift * lateral) * np.exp(1j * yaw)) * 0.02
    values = {"x": position.imag, "y": position.real, "yaw": np.pi / 2 - yaw, "velocity_x": np.full(501, 5.0),
              "velocity_y": -lateral if z_down else lateral, "yaw_rate": np.zeros(501)}
    notes = convert_odometry(values, "odom_ned")
    np.testing.assert_allclose(values["velocity_y"], lateral)
    np.testing.assert_allclose(values["yaw"], yaw)
    assert note in notes[-1]


def test_velocities_over_ground_in_north_east_down() -> None:
    """Only the yaw rate changes its sign; velocity_y results from the rotation into body axes."""
    yaw = 0.2 * np.linspace(0.0, 10.0, 501)
    position = np.cumsum(5.0 * np.exp(1j * yaw)) * 0.02
    values = {"x": position.imag, "y": position.real, "yaw": np.pi / 2 - yaw, "velocity_x": 5.0 * np.sin(yaw),
              "velocity_y": 5.0 * np.cos(yaw), "yaw_rate": np.full(501, -0.2)}
    notes = convert_odometry(values, "odom_ned")
    np.testing.assert_allclose(values["yaw_rate"], 0.2)
    np.testing.assert_allclose(values["velocity_y"], 0.0, atol=1e-12)
    assert notes[1] == "z of the body axes points down: the sign of yaw_rate was changed"


@pytest.mark.parametrize("seed", range(5))
def test_noise_at_constant_heading_does_not_show_the_direction_of_z(seed: int) -> None:
    noise = 0.002 * np.random.default_rng(seed).normal(size=(3, 501))
    values = {"x": np.linspace(0.0, 50.0, 501), "y": np.zeros(501), "yaw": noise[0], "velocity_x": np.full(501, 5.0),
              "velocity_y": noise[1], "yaw_rate": noise[2]}
    assert "which was assumed" in convert_odometry(values, "odom_ned")[-1]


def test_odometry_without_a_yaw_rate(tmp_path: Path, drive_log: DriveLog) -> None:
    def forget(message: Any, k: int) -> Any:
        twist = replace(message.twist.twist, angular=vector(0, 0))
        return replace(message, twist=replace(message.twist, twist=twist))

    folder = write(tmp_path / "drive", drive_log, "/odom", "/steer", change={"/odom": forget})
    run = read(find_runs([folder])[0], CAR, STEER)
    np.testing.assert_allclose(run.log.yaw_rate, drive_log.yaw_rate, atol=0.05)  # a sweep
    assert_warned(run.warnings, "yaw_rate is 0 in all odometry messages; the derivative of yaw is used")


@pytest.mark.parametrize(("topic", "field", "is_command"), [
    ("/steering_controller/state", "data", False), ("/control/steering_feedback", "data", False),
    ("/steering_controller/state", "desired.positions.0", True), ("/vehicle/state/steering_cmd", "data", True),
    ("/state/ackermann_drive", "drive.steering_angle", True), ("/feedback_controller/control", "data", True),
    ("/steering_cmd_feedback", "data", False),
    ("/ackermann_status", "drive.steering_angle", False), ("/control/steering", "data", True),
    ("/rack", "data", False)])
def test_names_of_commands_and_measurements(topic: str, field: str, is_command: bool) -> None:
    assert _is_command(SteeringField(topic, field)) == is_command


@pytest.mark.parametrize("topic", ["/steering_cmd", "/drive"])
def test_command_in_place_of_the_steering_angle_is_reported(tmp_path: Path, drive_log: DriveLog, topic: str) -> None:
    folder = write(tmp_path / "drive", drive_log, "/odom", topic)
    field = {"/steering_cmd": "data", "/drive": "drive.steering_angle"}[topic]
    run = read(find_runs([folder])[0], CAR, ReadSettings(steering=SteeringField(topic, field)))
    assert_warned(run.warnings, f"{topic} or its field .* is named like a command")


@pytest.mark.parametrize("topics", [
    ("/vehicle/status/steering_status", "/drive"), ("/raptor/steering_report",),
    ("/pacmod/steer_rpt", "/pacmod/brake_rpt")])
def test_steering_report_of_a_known_type_is_found(tmp_path: Path, drive_log: DriveLog, topics: tuple[str, ...]) -> None:
    run = read(find_runs([write(tmp_path / "drive", drive_log, "/odom", *topics)])[0], CAR)
    assert_same(run.log, drive_log, max_lost=0, rotated=False)
    assert_warned(run.warnings, f"is .* of {topics[0]}, positive to the left as defined for its .*; --steering-topic")


def test_steering_report_of_a_known_type_is_found_for_a_replay(tmp_path: Path, drive_log: DriveLog, caplog) -> None:
    folder = write(tmp_path / "drive", drive_log, "/odom", "/raptor/steering_report")
    settings = add_steering(folder, ReadSettings())
    assert settings.steering == SteeringField("/raptor/steering_report", "steering_wheel_angle", "wheel", "deg")
    assert "steering_wheel_angle of /raptor/steering_report, positive to the left as defined for its" in caplog.text
    read_bag(folder, steering=settings.steering)  # as the replay does
    named = ReadSettings(steering=SteeringField("/steer"))
    assert add_steering(folder, named) == named


@pytest.mark.parametrize("name", ["/imu/data", "fix, imu/data"])
def test_topics_of_the_ins_can_be_named(tmp_path: Path, drive_log: DriveLog, name: str) -> None:
    def turn(message: Any, k: int) -> Any:
        return replace(message, angular_velocity=vector(0, 0, 1))

    folder = write(tmp_path / "drive", drive_log, "/imu/data", "/imu/second", "/fix", "/twist", "/steer",
                   change={"/imu/second": turn})
    run = read(find_runs([folder])[0], CAR, replace(STEER, odometry=name))
    assert_same(run.log, drive_log, max_lost=0, rotated=True)


@pytest.mark.parametrize(("name", "error"), [
    ("/fix,/typo", "--odometry-topic: /typo has no messages with channels of an INS; topics: /fix, /imu/data, /steer"),
    ("/steer", "--odometry-topic: /steer has no messages with channels"),
    ("/imu/data,/fix", "--odometry-topic: /imu/data,/fix contains no message of type nav_msgs/msg/Odometry, and ")])
def test_named_topics_of_the_ins_must_have_its_channels(tmp_path: Path, drive_log: DriveLog, name: str, error: str
                                                        ) -> None:
    folder = write(tmp_path / "drive", drive_log, "/imu/data", "/fix", "/odom", "/steer", rows=slice(300))
    with pytest.raises(RunError, match=error):
        read(find_runs([folder])[0], CAR, replace(STEER, odometry=name))


def test_fixes_with_the_status_of_no_fix_are_left_out(tmp_path: Path, drive_log: DriveLog) -> None:
    def spoil(message: Any, k: int) -> Any:
        return replace(message, latitude=51.9 + 1e-5 * k, status=replace(message.status, status=-1)) if (
            500 <= k < 900) else message

    folder = write(tmp_path / "drive", drive_log, "/imu/data", "/fix", "/twist", "/steer", change={"/fix": spoil})
    run = read(find_runs([folder])[0], CAR, STEER)
    assert_same(run.log, drive_log, max_lost=400, rotated=True)
    assert_warned(run.warnings, "400 of 2[0-9]+ rows .* have no number")


def test_orientation_that_the_driver_does_not_measure_is_not_read(tmp_path: Path, drive_log: DriveLog) -> None:
    """REP 145: the first element of its covariance is then -1."""
    def forget(message: Any, k: int) -> Any:
        return replace(message, orientation=make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
                       orientation_covariance=np.array([-1.0, *np.zeros(8)]))

    folder = write(tmp_path / "drive", drive_log, "/imu/data", "/fix", "/twist", "/steer", change={"/imu/data": forget})
    with pytest.raises(RunError, match="no column was recognised as yaw "):
        read(RunSource("drive", "bag", (folder,)), CAR, STEER)


def test_steering_angle_in_degrees_in_the_name_of_its_field(tmp_path: Path, drive_log: DriveLog) -> None:
    (source,) = find_runs([write(tmp_path / "drive", drive_log, "/pose", "/twist", "/wheel")])
    named = ReadSettings(steering=SteeringField("/wheel", "steering_wheel_angle_deg", "wheel"))
    for settings in (ReadSettings(), named):
        assert_same(read(source, CAR, settings).log, drive_log, max_lost=0)


def test_bag_with_stamps_of_another_clock_is_read_by_the_times_of_reception(tmp_path: Path,
                                                                            drive_log: DriveLog) -> None:
    """Stamps of a simulation, for example. A steering topic without stamps has only times of reception."""
    folder = write(tmp_path / "drive", drive_log, "/pose", "/twist", "/steer", stamp_offset_ns=-10**18)
    run = read(find_runs([folder])[0], CAR, STEER)
    assert_same(run.log, drive_log, max_lost=0)
    assert_warned(run.warnings, "stamps of /pose and /twist and /steer do not overlap in time; the times of reception")


def test_messages_stored_out_of_order_are_sorted_by_their_stamps(tmp_path: Path, drive_log: DriveLog) -> None:
    """Several threads that write one file store blocks of messages in any order."""
    order = np.random.default_rng(4).permuted(np.arange(len(drive_log.x) // 20 * 20).reshape(-1, 20), axis=1).ravel()
    messages = make_messages(drive_log, make_store(Stores.ROS2_JAZZY, DEFINITIONS))
    bag = write(tmp_path / "bag", drive_log, "/odom", "/vehicle/status/steering_status", rows=slice(len(order)),
                change={"/odom": lambda _, k: messages["/odom"](int(order[k]))})
    (source,) = find_runs([bag])
    run = read(source, CAR, ReadSettings(
        steering=SteeringField("/vehicle/status/steering_status", "steering_tire_angle")))
    assert_warned(run.warnings, "odometry messages are stored out of order; they were sorted by their stamps")
    assert np.array_equal(run.log.ins_time_ns, drive_log.ins_time_ns[:len(order)])
    assert np.allclose(run.log.x, drive_log.x[:len(order)])


@pytest.mark.parametrize("step", [0.3, 0.305, 5.0])
def test_clock_that_was_set_back_is_not_sorted(step: float) -> None:
    time_ns = np.arange(3000) * 10_000_000
    time_ns[1000:] -= round(step * 1e9)
    assert not are_stored_out_of_order(time_ns)


@pytest.mark.parametrize("topics", [("/odom", "/steer"), ("/pose", "/twist", "/steer")])
def test_steering_without_stamps_is_moved_to_the_clock_of_the_ins(tmp_path: Path, drive_log: DriveLog, topics) -> None:
    """The INS stamps with GPS time, the recorder with UTC."""
    folder = write(tmp_path / "drive", drive_log, *topics, stamp_offset_ns=18 * 10**9)
    run = read(find_runs([folder])[0], CAR, STEER)
    assert_same(run.log, drive_log, max_lost=0)
    assert run.log.ins_time_ns[0] == drive_log.ins_time_ns[0] + 18 * 10**9
    assert_warned(run.warnings, f"the clock of {topics[0]} is 18.000 s ahead of that of /steer; all stamps were moved")
    if "/odom" in topics:  # `st replay` would play the stamps as recorded
        assert "all stamps were moved" in read_bag(folder, steering=STEER.steering).conversions[0]


@pytest.mark.parametrize("topics", [("/odom", "/steer", "/clock"), ("/pose", "/twist", "/steer", "/clock")])
def test_simulation_at_half_speed_is_read_by_its_clock(tmp_path: Path, drive_log: DriveLog, topics) -> None:
    """Stamps begin at 0; the steering has none, and is received once in two times of its interval."""
    start = int(drive_log.ins_time_ns[0])
    folder = write(tmp_path / "drive", drive_log, *topics, stamp_offset_ns=-start, pace=2)
    run = read(find_runs([folder])[0], CAR, STEER)
    assert run.log.ins_time_ns[-1] == drive_log.ins_time_ns[-1] - start
    assert len(run.log.x) == len(drive_log.x) - 1  # a stamp of 0 means that there is none
    np.testing.assert_allclose(run.log.road_wheel_angle, np.interp(
        run.log.steering_time_ns, drive_log.steering_time_ns - start, drive_log.road_wheel_angle), atol=1e-5)


@pytest.mark.parametrize(("topics", "settings", "error"), [
    (("/imu/data", "/fix", "/steer"), STEER, "recognised as velocity_x, velocity_y; .*; record nav_msgs/msg/Odometry, "
     "for example from robot_localization, or export"),
    (("/pose", "/twist", "/steer"), ReadSettings(), "recognised as road_wheel_angle .*; name the topic of the steering "
     "angle with --steering-topic; or record"),
    (("/pose", "/vehicle/status/velocity_status", "/vehicle/status/steering_status", "/second/steering_status"),
     ReadSettings(), "may each contain the road_wheel_angle; name the right one with --steering-topic"),
    (("/imu/data", "/imu/second", "/fix", "/twist", "/steer"), STEER, "may each be orientation_x; name "
     "the topics of the INS with --odometry-topic, separated by commas; or record"),
    (("/steer",), STEER, "no message of type nav_msgs/msg/Odometry; recorded: /steer .*, or another of this type"),
    (("/odom", "/vehicle/status/steering_status", "/second/steering_status"), ReadSettings(),
     "no message of type st_msgs/msg/Steering; .*, or name the topic of the steering angle with --steering-topic")])
def test_bag_that_lacks_a_quantity_is_rejected(tmp_path: Path, drive_log: DriveLog, topics, settings: ReadSettings,
                                              error: str) -> None:
    (source,) = find_runs([write(tmp_path / "drive", drive_log, *topics)])
    with pytest.raises(RunError, match=error):
        read(source, CAR, settings)


def test_bag_without_odometry_is_found_next_to_other_runs(tmp_path: Path, drive_log: DriveLog) -> None:
    write(tmp_path / "ins_driver", drive_log, "/imu/data", "/fix", "/twist", "/steer")
    write(tmp_path / "odometry", drive_log, "/odom", "/steer")
    write(tmp_path / "imu_only", drive_log, "/imu/data", "/steer")
    assert [run.name for run in find_runs([tmp_path])] == ["ins_driver", "odometry"]


def test_split_bag_whose_first_file_has_no_odometry_is_read(tmp_path: Path, drive_log: DriveLog) -> None:
    """The INS was switched on after the recorder."""
    first, folder = slice(0, 500), tmp_path / "splits"
    folder.mkdir()
    for number, topics, rows in ((0, ("/steer",), first), (1, ("/odom", "/steer"), slice(first.stop, None))):
        bag = write(tmp_path / f"part_{number}", drive_log, *topics, rows=rows)
        (bag / f"{bag.name}.mcap").rename(folder / f"drive_{number}.mcap")
    for given in ([folder], sorted(folder.iterdir())):
        (source,) = find_runs(given)
        assert [file.name for file in source.files] == ["drive_0.mcap", "drive_1.mcap"]
        log = read(source, CAR, STEER).log
        np.testing.assert_allclose(log.velocity_x, drive_log.velocity_x[first.stop:], atol=2e-4)


@pytest.mark.slow
@pytest.mark.parametrize("topics", [("/odom", "/steer"), ("/imu/data", "/fix", "/twist", "/steer")])
def test_bag_of_ros_1_is_read(tmp_path: Path, drive_log: DriveLog, topics) -> None:
    file = write_ros1(tmp_path / "drive.bag", drive_log, *topics)
    (source,) = find_runs([tmp_path])
    run = read(source, CAR, STEER)
    assert_same(run.log, drive_log, max_lost=0, rotated="/fix" in topics)
    assert not run.warnings
    file.write_bytes(file.read_bytes()[:20000])
    with pytest.raises(RunError, match=r"cannot be read as a bag .*repair it with `rosbag reindex`"):
        read(source, CAR, STEER)
