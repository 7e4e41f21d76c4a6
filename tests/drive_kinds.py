"""A drive as columns, CSV, VBO and a bag of another recorder, and comparisons with the drive read from them."""

import json
import re
from functools import cache
from pathlib import Path

import numpy as np
from mcap.writer import Writer as McapWriter
from ros_messages import definition, header, odometry, serialise, stamp
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore
from st_core.log import DriveLog
from st_recordings.runs import LoadedRun, ReadSettings, find_runs, read
from st_recordings.runs.bag import ODOMETRY, STEERING
from st_recordings.runs.run_types import SteeringField
from support import read_car

CAR = read_car("leaf")
NAMES = ("t", "x", "y", "yaw", "vx", "vy", "yaw_rate", "steering_wheel_angle")
VBO_SETTINGS = ReadSettings(steering=SteeringField("", "Steer", "wheel", "deg"))
NOON = 43200.0  # time of day [s]


def read_text(file: Path, text: str, settings: ReadSettings | None = None) -> LoadedRun:
    """Writes a table or VBO file and reads it."""
    file.write_text(text)
    (source,) = find_runs([file])
    return read(source, CAR, VBO_SETTINGS if file.suffix == ".vbo" else settings)


def columns(log: DriveLog) -> list[np.ndarray]:
    """Columns of NAMES in SI units, at the times of the INS."""
    wheel = np.interp(log.ins_time_ns, log.steering_time_ns, log.steering_wheel_angle)
    return [log.ins_time_ns * 1e-9, log.x, log.y, log.yaw, log.velocity_x, log.velocity_y, log.yaw_rate, wheel]


def csv(cells: list[list[str]], header: str = ",".join(NAMES), delimiter: str = ",") -> str:
    return "\n".join([header, *(delimiter.join(row) for row in cells)]) + "\n"


def rows(log: DriveLog, number_format: str = "%.6f") -> list[list[str]]:
    return [[number_format % value for value in row] for row in zip(*columns(log), strict=True)]


def clock(seconds: float) -> str:
    """Time of day as HH:MM:SS.ffffff."""
    return f"{int(seconds // 3600):02d}:{int(seconds // 60 % 60):02d}:{seconds % 60:09.6f}"


def to_degrees(log) -> tuple[np.ndarray, np.ndarray]:
    """Latitude and longitude [deg] of x and y in a map at 52 N, 1.5 W, first order."""
    a, e2, origin = 6378137.0, 6.69437999014e-3, np.radians(52.0)
    n = a / np.sqrt(1 - e2 * np.sin(origin) ** 2)
    m = n * (1 - e2) / (1 - e2 * np.sin(origin) ** 2)
    return 52.0 + np.degrees(log.y / m), -1.5 + np.degrees(log.x / (n * np.cos(origin)))


def vbo(log, start: float = 43200.0, late_last_row: bool = True, seconds_of_day: bool = False) -> str:
    """A VBO file. start: time of day [s]; late_last_row: its last row is 180 s late; seconds_of_day: instead of
    HHMMSS.
    """
    latitude, longitude = to_degrees(log)
    speed = np.hypot(log.velocity_x, log.velocity_y) * 3.6
    course = (90 - np.degrees(log.yaw + np.arctan2(log.velocity_y, log.velocity_x))) % 360
    wheel = np.degrees(columns(log)[7])
    lines = []
    for k, elapsed in enumerate((log.ins_time_ns - log.ins_time_ns[0]) * 1e-9):
        seconds = (start + elapsed) % 86400 + (180 if late_last_row and k == len(log.x) - 1 else 0)
        clock = f"{int(seconds // 3600):02d}{int(seconds // 60 % 60):02d}{seconds % 60:05.2f}"
        clock = f"{seconds:.2f}" if seconds_of_day else clock
        lines.append(f"010 {clock} {latitude[k] * 60:+014.8f} {-longitude[k] * 60:+014.8f} {speed[k]:07.3f} "
                     f"{course[k]:06.2f} {wheel[k]:+.4E}")
    return ("File created on 03/09/2025 @ 12:00:00\n\n[header]\nsatellites\ntime\nlatitude\nlongitude\nvelocity kmh\n"
            "heading\nSteer\n\n[channel units]\ndeg\n\n[comments]\nLog Rate (Hz) : 100\n\n[column names]\n"
            "sats time lat long velocity heading Steer\n\n[data]\n" + "\n".join(lines) + "\n")


RACK = "own_msgs/msg/Rack"
RACK_DEFINITION = "builtin_interfaces/Time stamp\nfloat32[2] spare\nfloat64 angle_deg\n"


@cache
def custom_store() -> Typestore:
    """ROS 2 with a steering message that this project does not define."""
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(RACK_DEFINITION, RACK))
    return store


def serialise_rack(time_ns: int, steering_wheel_angle: float) -> bytes:
    """The custom message: degrees, positive to the right. steering_wheel_angle [rad]: positive to the left."""
    store = custom_store()
    return bytes(store.serialize_cdr(store.types[RACK](
        stamp=stamp(time_ns), spare=np.zeros(2, np.float32), angle_deg=-float(np.degrees(steering_wheel_angle))), RACK))


def write_bag(file: Path, log: DriveLog, first: int = 0, last: int | None = None, stamps: str = "good",
              custom_steering: bool = False, encoding: str = "cdr", **options) -> Path:
    """Writes rows first to last as MCAP. stamps: of the odometry, good, zero, seconds (whole ones) or boot (since
    boot); encoding: other than "cdr" writes JSON; options: of the MCAP writer.
    """
    cdr = encoding == "cdr"
    topics = {"/odom": (ODOMETRY, definition(ODOMETRY)),
              **({"/rack": (RACK, RACK_DEFINITION)} if custom_steering else
                 {"/vehicle/steering": (STEERING, definition(STEERING))})}
    with file.open("wb") as stream:
        writer = McapWriter(stream, **options)
        writer.start("ros2", "test")
        schemas = [writer.register_schema(name, "ros2msg" if cdr else "jsonschema", text.encode())
                   for name, text in topics.values()]
        channels = [writer.register_channel(topic, encoding, number)
                    for topic, number in zip(topics, schemas, strict=True)]
        wheel = columns(log)[7]
        for k in range(first, len(log.x) if last is None else last):
            ns = int(log.ins_time_ns[k])
            stamp_ns = {"zero": 0, "seconds": ns // 10**9 * 10**9,
                        "boot": ns - int(log.ins_time_ns[0]) + 10**9}.get(stamps, ns)
            pose = odometry(stamp_ns, log.x[k], log.y[k], log.yaw[k], log.velocity_x[k], log.velocity_y[k],
                            log.yaw_rate[k], child_frame="ins")
            steering = serialise_rack(ns, wheel[k]) if custom_steering else serialise(
                STEERING, header=header(ns), steering_wheel_angle=float(wheel[k]), valid=True,
                road_wheel_angle=float(CAR.road_wheel_angle(wheel[k])))
            for channel, data in zip(channels, (pose, steering), strict=True):
                writer.add_message(channel, ns, data if cdr else json.dumps({"k": k}).encode(), ns)
        writer.finish()
    return file


def assert_same(log: DriveLog, truth: DriveLog, max_lost: int, steering: float = 1e-5, rotated: bool = False) -> None:
    """max_lost: INS samples that may be missing; steering: tolerance of the road wheel angle [rad]; rotated: x and y
    are in another map, rotated by the convergence of the meridians, so only distances are compared.
    """
    assert len(truth.x) - len(log.x) <= max_lost
    at = (log.ins_time_ns - log.ins_time_ns[0]) * 1e-9
    expected = (truth.ins_time_ns - truth.ins_time_ns[0]) * 1e-9
    for name in ("velocity_x", "velocity_y", "yaw_rate", "yaw"):
        true_values = np.interp(at, expected, np.asarray(getattr(truth, name)))
        shift = round((getattr(log, name)[0] - true_values[0]) / (2 * np.pi)) * 2 * np.pi if name == "yaw" else 0.0
        np.testing.assert_allclose(getattr(log, name) - shift, true_values, atol=2e-4, err_msg=name)
    distance, true_distance = (np.hypot(each.x - each.x[0], each.y - each.y[0]) for each in (log, truth))
    np.testing.assert_allclose(distance, np.interp(at, expected, true_distance), atol=0.05 if rotated else 1e-3)
    angle, true_angle = (np.interp(each.ins_time_ns - each.ins_time_ns[0],
                                   each.steering_time_ns - each.ins_time_ns[0], each.road_wheel_angle)
                         for each in (log, truth))
    np.testing.assert_allclose(angle, np.interp(at, expected, true_angle), atol=steering)


def assert_warned(warnings, pattern: str) -> None:
    """A warning matches the pattern; without a pattern there is no warning."""
    if not pattern:
        assert not warnings
    else:
        assert warnings and any(re.search(pattern, warning) for warning in warnings), warnings
