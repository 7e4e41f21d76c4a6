"""Raw CAN frames of a recording as columns: as serialised by rosbags, and damaged."""

from itertools import pairwise

import numpy as np
import pytest
from ros_messages import header, make, serialise, stamp
from st_recordings.runs.frames import ERROR, EXTENDED, FD, REMOTE, read_frames

START = 1_756_900_800_123_456_789


def message(frames: list[tuple[int, int, bytes, int]], bus: str) -> bytes:
    """st_msgs/CanFrames by rosbags. frames: (time [ns], id with EXTENDED, data, flags)."""
    return serialise("st_msgs/msg/CanFrames", header=header(0, bus), frames=[make(
        "st_msgs/msg/CanFrame", stamp=stamp(time_ns), id=identifier & ~EXTENDED,
        is_extended=bool(identifier & EXTENDED), is_error=bool(flags & ERROR), is_remote=bool(flags & REMOTE),
        is_fd=bool(flags & FD), data=np.frombuffer(data, np.uint8)) for time_ns, identifier, data, flags in frames])


def random_frames(count: int, longest: int, seed: int) -> list[tuple[int, int, bytes, int]]:
    rng = np.random.default_rng(seed)
    return [(START + 1000 * k, int(rng.integers(0x800)) | (EXTENDED if k % 7 == 0 else 0),
             rng.bytes(int(rng.integers(longest + 1))), int(rng.choice([0, ERROR, REMOTE, FD])))
            for k in range(count)]


@pytest.mark.parametrize("longest", [8, 64])
@pytest.mark.parametrize("bus", ["socketcan:can0", "a:bcd", "udp_multicast:239.74.163.2:43113"])
def test_frames_equal_those_serialised(longest: int, bus: str) -> None:
    frames = random_frames(200, longest, 3)
    bounds = [0, 1, 1, 90, 143, 200]  # one message without a frame
    found = read_frames([message(frames[a:b], bus) for a, b in pairwise(bounds)])
    assert found.time_ns.tolist() == [frame[0] for frame in frames]
    assert found.id.tolist() == [frame[1] for frame in frames]
    assert found.flags.tolist() == [frame[3] for frame in frames]
    assert found.payload.shape[1] == longest
    for row, length, (_, _, data, _) in zip(found.payload, found.length, frames, strict=True):
        assert row.tobytes() == data + bytes(longest - len(data)) and length == len(data)


def test_no_messages_give_no_frames() -> None:
    assert len(read_frames([])) == len(read_frames([message([], "x")])) == 0


@pytest.mark.parametrize("length", [3, 15, 20, 40, 60, 250])
def test_truncated_message_is_rejected(length: int) -> None:
    complete = message(random_frames(10, 8, 4), "socketcan:can0")
    with pytest.raises(ValueError, match="message"):
        read_frames([complete, complete[:length]])


def test_impossible_payload_length_is_rejected() -> None:
    damaged = bytearray(message([(START, 2, bytes(8), 0)], "can0"))
    damaged[-12] = 65
    with pytest.raises(ValueError, match="beyond"):
        read_frames([bytes(damaged)])
