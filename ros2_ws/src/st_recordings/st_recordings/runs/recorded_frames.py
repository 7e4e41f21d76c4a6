"""The raw CAN frames of a recording (st_msgs/CanFrames) as columns."""

from collections.abc import Iterable
from struct import Struct

import numpy as np

from .frames import ERROR, EXTENDED, FD, REMOTE, Frames, empty

_HEAD = 20  # bytes of a frame before its data: stamp, id, four flags, length of the data
_LARGEST = 64
_LENGTH = Struct("<I")
_TEXT = 12  # where the length of frame_id lies


def read_frames(messages: Iterable[bytes]) -> Frames:
    """Frames in order of arrival. Raises ValueError for a message that is none, or is damaged.

    The k-th frame of all messages is read at once: a frame says how long it is, so within a message one follows from
    the one before.
    """
    parts = list(messages)
    firsts, counts = zip(*map(_first, parts), strict=True) if parts else ((), ())
    sizes = np.array([len(part) for part in parts], np.int64)
    ends = np.cumsum(sizes)
    buffer = np.frombuffer(b"".join(parts) + bytes(_HEAD + _LARGEST), np.uint8)
    at, left = np.array(firsts, np.int64) + ends - sizes, np.array(counts, np.int64)
    heads = _windows(buffer, _HEAD)
    places: list[np.ndarray] = []
    order: list[np.ndarray] = []
    message = np.arange(len(parts))
    while (going := left > 0).any():
        at, left, message = at[going], left[going], message[going]
        length = heads[at, 16:20].copy().view("<u4")[:, 0].astype(np.int64)
        if (length > _LARGEST).any() or (at + _HEAD + length > ends[message]).any():
            raise ValueError("a frame reaches beyond its message")
        places.append(at)
        order.append(message)
        at, left = at + _HEAD + (length + 3) // 4 * 4, left - 1
    if not places:
        return empty()
    # Rounds to messages; within a message the rounds are in order.
    sequence = np.argsort(np.concatenate(order), kind="stable")
    return _columns(buffer, np.concatenate(places)[sequence])


def _first(message: bytes) -> tuple[int, int]:
    """(where its first frame begins, how many there are)"""
    if len(message) < _TEXT + 4:
        raise ValueError("a message is too short")
    behind = _TEXT + 4 + _LENGTH.unpack_from(message, _TEXT)[0]
    count_at = -(-behind // 4) * 4
    if len(message) < count_at + 4:
        raise ValueError("a message is too short")
    count = _LENGTH.unpack_from(message, count_at)[0]
    if count and len(message) < count_at + 4 + count * _HEAD:
        raise ValueError("a message is too short for its frames")
    return count_at + 4, count


def _columns(buffer: np.ndarray, at: np.ndarray) -> Frames:
    heads = _windows(buffer, _HEAD)[at]
    words = heads[:, :12].copy().view("<i4")
    length = heads[:, 16]
    width = 8 if int(length.max()) <= 8 else _LARGEST
    payload = _windows(buffer, width)[at + _HEAD]
    payload[np.arange(width) >= length[:, None]] = 0
    extended, *flags = (heads[:, k] != 0 for k in range(12, 16))
    return Frames(
        time_ns=words[:, 0].astype(np.int64) * 1_000_000_000 + words[:, 1].view(np.uint32).astype(np.int64),
        id=words[:, 2].view(np.uint32) | np.where(extended, np.uint32(EXTENDED), np.uint32(0)),
        payload=payload, length=length, bus=np.zeros(len(at), np.uint8),
        flags=sum((flag * np.uint8(bit) for flag, bit in zip(flags, (ERROR, REMOTE, FD), strict=True)),
                  np.zeros(len(at), np.uint8)))


def _windows(buffer: np.ndarray, width: int) -> np.ndarray:
    """Row k: the `width` bytes from k on; a view."""
    return np.ndarray((len(buffer) - width + 1, width), np.uint8, buffer.data, 0, (1, 1))
