"""A drive as columns, CSV, VBO and as a bag of another make, and comparisons with what was read of it."""

import json
import re
from pathlib import Path

import numpy as np
from mcap.writer import Writer as McapWriter
from raw_drives import LEAF
from rosbags.typesys import get_types_from_msg
from st_core.log import DriveLog
from st_core.vehicle import VehicleParameters
from st_recordings.runs.bag import definitions_folder
from st_recordings.runs.cdr import load_typestore

CAR = VehicleParameters.from_yaml(LEAF.read_text(), "leaf")
NAMES = ("t", "x", "y", "yaw", "vx", "vy", "yaw_rate", "steering_wheel_angle")
STORE = load_typestore(definitions_folder())


def columns(log: DriveLog) -> list[np.ndarray]:
    wheel = np.interp(log.ins_time_ns, log.steering_time_ns, log.steering_wheel_angle)
    return [log.ins_time_ns * 1e-9, log.x, log.y, log.yaw, log.velocity_x, log.velocity_y, log.yaw_rate, wheel]


def csv(cells: list[list[str]], header: str = ",".join(NAMES), delimiter: str = ",") -> str:
    return "\n".join([header, *(delimiter.join(row) for row in cells)]) + "\n"


def rows(log: DriveLog, form: str = "%.6f") -> list[list[str]]:
    return [[form % value for value in row] for row in zip(*columns(log), strict=True)]


def clock(seconds: float) -> str:
    return f"{int(seconds // 3600):02d}:{int(seconds // 60 % 60):02d}:{seconds % 60:09.6f}"


def to_degrees(log) -> tuple[np.ndarray, np.ndarray]:
    """Latitude and longitude of x and y about 52 N, 1.5 W, first order."""
    a, e2, origin = 6378137.0, 6.69437999014e-3, np.radians(52.0)
    n = a / np.sqrt(1 - e2 * np.sin(origin) ** 2)
    m = n * (1 - e2) / (1 - e2 * np.sin(origin) ** 2)
    return 52.0 + np.degrees(log.y / m), -1.5 + np.degrees(log.x / (n * np.cos(origin)))


def vbo(log, start: float = 43200.0, last_wrong: bool = True, seconds_of_day: bool = False) -> str:
    latitude, longitude = to_degrees(log)
    speed = np.hypot(log.velocity_x, log.velocity_y) * 3.6
    course = (90 - np.degrees(log.yaw + np.arctan2(log.velocity_y, log.velocity_x))) % 360
    wheel = np.degrees(columns(log)[7])
    lines = []
    for k, elapsed in enumerate((log.ins_time_ns - log.ins_time_ns[0]) * 1e-9):
        seconds = (start + elapsed) % 86400 + (180 if last_wrong and k == len(log.x) - 1 else 0)
        clock = f"{int(seconds // 3600):02d}{int(seconds // 60 % 60):02d}{seconds % 60:05.2f}"
        clock = f"{seconds:.2f}" if seconds_of_day else clock
        lines.append(f"010 {clock} {latitude[k] * 60:+014.8f} {-longitude[k] * 60:+014.8f} {speed[k]:07.3f} "
                     f"{course[k]:06.2f} {wheel[k]:+.4E}")
    return ("File created on 03/09/2025 @ 12:00:00\n\n[header]\nsatellites\ntime\nlatitude\nlongitude\nvelocity kmh\n"
            "heading\nSteer\n\n[channel units]\ndeg\n\n[comments]\nLog Rate (Hz) : 100\n\n[column names]\n"
            "sats time lat long velocity heading Steer\n\n[data]\n" + "\n".join(lines) + "\n")


def odometry(log: DriveLog, k: int, stamp_ns: int) -> bytes:
    make = STORE.types
    vector = make["geometry_msgs/msg/Vector3"]
    header = make["std_msgs/msg/Header"](stamp=time(stamp_ns), frame_id="map")
    half = log.yaw[k] / 2
    pose = make["geometry_msgs/msg/Pose"](
        position=make["geometry_msgs/msg/Point"](x=float(log.x[k]), y=float(log.y[k]), z=0.0),
        orientation=make["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=float(np.sin(half)), w=float(np.cos(half))))
    twist = make["geometry_msgs/msg/Twist"](
        linear=vector(x=float(log.velocity_x[k]), y=float(log.velocity_y[k]), z=0.0),
        angular=vector(x=0.0, y=0.0, z=float(log.yaw_rate[k])))
    zero = np.zeros(36)
    return bytes(STORE.serialize_cdr(make["nav_msgs/msg/Odometry"](
        header=header, child_frame_id="ins",
        pose=make["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=zero),
        twist=make["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=zero)), "nav_msgs/msg/Odometry"))


def time(ns: int):
    return STORE.types["builtin_interfaces/msg/Time"](sec=ns // 10**9, nanosec=ns % 10**9)


OWN = "own_msgs/msg/Rack"
OWN_TEXT = "builtin_interfaces/Time stamp\nfloat32[2] spare\nfloat64 angle_deg\n"


def write_bag(file: Path, log: DriveLog, first: int = 0, last: int | None = None, stamps: str = "good",
              own: bool = False, encoding: str = "cdr", **options) -> Path:
    store = load_typestore(definitions_folder())
    types = get_types_from_msg(OWN_TEXT, OWN)
    if OWN not in store.fielddefs and own:
        from rosbags.typesys import Stores, get_typestore
        store = get_typestore(Stores.ROS2_JAZZY)
        store.register(types)
    cdr = encoding == "cdr"
    with file.open("wb") as stream:
        writer = McapWriter(stream, **options)
        writer.start("ros2", "test")
        form = "ros2msg" if cdr else "jsonschema"
        schema = {name: writer.register_schema(name, form, text.encode()) for name, text in (
            ("nav_msgs/msg/Odometry", store.generate_msgdef("nav_msgs/msg/Odometry", ros_version=2)[0]),
            (OWN if own else "st_msgs/msg/Steering", OWN_TEXT if own else
             store.generate_msgdef("st_msgs/msg/Steering", ros_version=2)[0]))}
        channels = [writer.register_channel(topic, encoding, number) for topic, number in
                    zip(("/odom", "/rack" if own else "/vehicle/steering"), schema.values(), strict=True)]
        wheel = columns(log)[7]
        for k in range(first, len(log.x) if last is None else last):
            ns = int(log.ins_time_ns[k])
            stamp = {"zero": 0, "seconds": ns // 10**9 * 10**9,
                     "boot": ns - int(log.ins_time_ns[0]) + 10**9}.get(stamps, ns)
            if own:
                message = store.types[OWN](stamp=time(ns), spare=np.zeros(2, np.float32),
                                           angle_deg=-float(np.degrees(wheel[k])))
                steering = bytes(store.serialize_cdr(message, OWN))
            else:
                header = store.types["std_msgs/msg/Header"](stamp=time(ns), frame_id="")
                message = store.types["st_msgs/msg/Steering"](
                    header=header, steering_wheel_angle=float(wheel[k]), valid=True,
                    road_wheel_angle=float(CAR.road_wheel_angle(wheel[k])))
                steering = bytes(store.serialize_cdr(message, "st_msgs/msg/Steering"))
            for channel, data in zip(channels, (odometry(log, k, stamp), steering), strict=True):
                writer.add_message(channel, ns, data if cdr else json.dumps({"k": k}).encode(), ns)
        writer.finish()
    return file


def assert_same(log: DriveLog, truth: DriveLog, lost: int, steering: float = 1e-5, turned: bool = False) -> None:
    """turned: x and y are in another map, turned by the convergence of meridians; only distances are the same."""
    assert len(truth.x) - len(log.x) <= lost
    at = (log.ins_time_ns - log.ins_time_ns[0]) * 1e-9
    expected = (truth.ins_time_ns - truth.ins_time_ns[0]) * 1e-9
    for name in ("velocity_x", "velocity_y", "yaw_rate", "yaw"):
        there = np.interp(at, expected, np.asarray(getattr(truth, name)))
        shift = round((getattr(log, name)[0] - there[0]) / (2 * np.pi)) * 2 * np.pi if name == "yaw" else 0.0
        np.testing.assert_allclose(getattr(log, name) - shift, there, atol=2e-4, err_msg=name)
    distance = [np.hypot(one.x - one.x[0], one.y - one.y[0]) for one in (log, truth)]
    np.testing.assert_allclose(distance[0], np.interp(at, expected, distance[1]), atol=0.05 if turned else 1e-3)
    wheel = np.interp(log.ins_time_ns - log.ins_time_ns[0], log.steering_time_ns - log.ins_time_ns[0],
                      log.road_wheel_angle)
    known = np.interp(truth.ins_time_ns - truth.ins_time_ns[0], truth.steering_time_ns - truth.ins_time_ns[0],
                      truth.road_wheel_angle)
    np.testing.assert_allclose(wheel, np.interp(at, expected, known), atol=steering)


def assert_warned(warnings, pattern: str) -> None:
    if not pattern:
        assert not warnings
    else:
        assert warnings and any(re.search(pattern, warning) for warning in warnings), warnings
