"""Decoded frames to ROS messages."""

import math

import can
from st_msgs.msg import CanFrame, CanFrames, InsOnCan, Steering, WheelSpeeds
from st_ros.stamps import from_nanoseconds
from std_msgs.msg import Header

from .decode import Decoded

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


def to_can_frame(frame: can.Message, time_ns: int) -> CanFrame:
    return CanFrame(stamp=from_nanoseconds(time_ns), id=frame.arbitration_id, is_extended=frame.is_extended_id,
                    is_error=frame.is_error_frame, is_remote=frame.is_remote_frame, is_fd=frame.is_fd,
                    data=bytes(frame.data))


def to_can_frames(frames: list[CanFrame], bus: str) -> CanFrames:
    """frames: at least one, in order of arrival. bus: interface:channel."""
    return CanFrames(header=Header(stamp=frames[0].stamp, frame_id=bus), frames=frames)


def _header(time_ns: int) -> Header:
    return Header(stamp=from_nanoseconds(time_ns))


def _picked(decoded: Decoded, names: dict[str, str]) -> dict[str, float]:
    """The message fields this frame fills, the others NaN; empty if it fills none."""
    if not any(name in decoded.values for name in names):
        return {}
    return {field: decoded.values.get(name, math.nan) for name, field in names.items()}
