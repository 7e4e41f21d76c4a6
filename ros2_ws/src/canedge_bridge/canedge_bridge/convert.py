"""Decoded frames to ROS messages."""

import math
import struct

import can
from st_msgs.msg import InsOnCan, Steering, WheelSpeeds
from st_ros.stamps import from_nanoseconds
from std_msgs.msg import Header

from .decode import Decoded

_LITTLE_ENDIAN = b"\0\1\0\0"  # what CDR begins with
_FRAME = struct.Struct("<iII4?I")  # stamp, id, flags, length of the data
_STAMP = 8  # bytes of it
_WHEEL_SPEEDS = {
    "wheel_speed_front_left": "front_left", "wheel_speed_front_right": "front_right",
    "wheel_speed_rear_left": "rear_left", "wheel_speed_rear_right": "rear_right", "vehicle_speed": "vehicle_speed",
}
_INS = {
    "ins_velocity_x": "velocity_x", "ins_velocity_y": "velocity_y", "ins_yaw": "yaw", "ins_yaw_rate": "yaw_rate",
    "ins_unix_time": "unix_time",
}


def to_steering(measured_at_ns: int, steering_wheel_angle: float, road_wheel_angle: float, valid: bool) -> Steering:
    return Steering(header=_header(measured_at_ns), steering_wheel_angle=steering_wheel_angle,
                    road_wheel_angle=road_wheel_angle, valid=valid)


def to_wheel_speeds(decoded: Decoded) -> WheelSpeeds | None:
    """None if the frame has no speed."""
    fields = _picked(decoded, _WHEEL_SPEEDS)
    return WheelSpeeds(header=_header(decoded.time_ns), valid=decoded.valid, **fields) if fields else None


def to_ins_on_can(decoded: Decoded) -> InsOnCan | None:
    """None if the frame has no signal of the INS."""
    fields = _picked(decoded, _INS)
    return InsOnCan(header=_header(decoded.time_ns), **fields) if fields else None


def serialised_frame(frame: can.Message, time_ns: int) -> bytes:
    """st_msgs/CanFrame as CDR, aligned to four bytes: a tenth of what filling and serialising a message costs."""
    data, (seconds, nanoseconds) = bytes(frame.data), divmod(time_ns, 1_000_000_000)
    return _FRAME.pack(seconds, nanoseconds, frame.arbitration_id, frame.is_extended_id, frame.is_error_frame,
                       frame.is_remote_frame, frame.is_fd, len(data)) + data + bytes(-len(data) % 4)


def serialised_frames(frames: list[bytes], bus: str) -> bytes:
    """st_msgs/CanFrames as CDR. frames: of `serialised_frame`, at least one, in order of arrival. bus:
    interface:channel."""
    name = bus.encode() + b"\0"
    head = frames[0][:_STAMP] + struct.pack("<I", len(name)) + name + bytes(-len(name) % 4)
    return b"".join((_LITTLE_ENDIAN, head, struct.pack("<I", len(frames)), *frames))


def _header(time_ns: int) -> Header:
    return Header(stamp=from_nanoseconds(time_ns))


def _picked(decoded: Decoded, names: dict[str, str]) -> dict[str, float]:
    """The message fields this frame fills, the others NaN; empty if it fills none."""
    if not any(name in decoded.values for name in names):
        return {}
    return {field: decoded.values.get(name, math.nan) for name, field in names.items()}
