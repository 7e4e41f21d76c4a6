"""Raw frames serialised as CDR, against the middleware."""

import can
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")
pytest.importorskip("st_msgs", reason="needs the built workspace")

from canedge_bridge.node import serialise_frame, serialise_frames
from rclpy.serialization import deserialize_message, serialize_message
from st_msgs.msg import CanFrame, CanFrames

NS = 1_756_900_800_123_456_789
FRAMES = (can.Message(arbitration_id=0x002, is_extended_id=False, data=b"\1\2\3\4\5"),
          can.Message(arbitration_id=0x18FF1234, is_extended_id=True, data=b""),
          can.Message(arbitration_id=0x040, is_error_frame=True, is_extended_id=False, data=bytes(range(8))),
          can.Message(arbitration_id=0x7FF, is_remote_frame=True, is_extended_id=False, dlc=4),
          can.Message(arbitration_id=0x123, is_fd=True, is_extended_id=False, data=bytes(range(64))))


def as_message(frame: can.Message, time_ns: int) -> CanFrame:
    message = CanFrame(id=frame.arbitration_id, is_extended=frame.is_extended_id, is_error=frame.is_error_frame,
                       is_remote=frame.is_remote_frame, is_fd=frame.is_fd, data=bytes(frame.data))
    message.stamp.sec, message.stamp.nanosec = divmod(time_ns, 10**9)
    return message


@pytest.mark.parametrize("bus", ["socketcan:can0", "socketcan:vcan1", "a:bcd", "udp_multicast:239.74.163.2:43113"])
@pytest.mark.parametrize("count", range(1, len(FRAMES) + 1))
def test_serialised_frames_are_read_as_a_message(bus: str, count: int) -> None:
    serialised = serialise_frames([serialise_frame(frame, NS + k) for k, frame in enumerate(FRAMES[:count])], bus)
    expected = CanFrames(frames=[as_message(frame, NS + k) for k, frame in enumerate(FRAMES[:count])])
    expected.header.stamp, expected.header.frame_id = expected.frames[0].stamp, bus
    assert deserialize_message(serialised, CanFrames) == expected
    # Not compared byte by byte: the padding of the middleware is not initialised.
    assert 0 <= len(serialised) - len(serialize_message(expected)) < 4
