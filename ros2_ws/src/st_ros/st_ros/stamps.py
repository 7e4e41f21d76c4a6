"""Nanoseconds since the Unix epoch as one integer, to and from ROS stamps."""

from builtin_interfaces.msg import Time


def to_nanoseconds(stamp: Time) -> int:
    """Nanoseconds since 1970 of a ROS stamp."""
    return stamp.sec * 1_000_000_000 + stamp.nanosec


def from_nanoseconds(nanoseconds: int) -> Time:
    """ROS stamp; raises OverflowError outside 1901..2038, the range of the message."""
    sec, nanosec = divmod(nanoseconds, 1_000_000_000)
    if not -(2**31) <= sec < 2**31:
        raise OverflowError(f"stamp {nanoseconds} ns does not fit a ROS time")
    return Time(sec=sec, nanosec=nanosec)
