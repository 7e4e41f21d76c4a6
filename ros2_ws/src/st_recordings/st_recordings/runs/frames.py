"""CAN frames of a log, or of the messages st_msgs/CanFrames, as columns: a million frames are six arrays."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from struct import Struct

import numpy as np

EXTENDED = 0x8000_0000  # in an id, as in canedge_bridge.extraction and in Linux
SENT, REMOTE, ERROR, FD = 1, 2, 4, 8  # bits of Frames.flags


@dataclass(frozen=True)
class Frames:
    """Frames in order of time. One row per frame:

    time_ns: int64, UTC on the logger's clock. id: uint32, plus EXTENDED for 29-bit ones. length: uint8, bytes.
    payload: (n, 8) uint8, (n, 64) if there are longer ones; 0 behind the end of the frame. bus: uint8, 0 if not known.
    flags: uint8, SENT by the logger | REMOTE | ERROR | FD.
    """

    time_ns: np.ndarray
    id: np.ndarray
    payload: np.ndarray
    length: np.ndarray
    bus: np.ndarray
    flags: np.ndarray

    def __len__(self) -> int:
        return len(self.time_ns)

    def select(self, rows: np.ndarray | slice) -> "Frames":
        return Frames(**{f.name: getattr(self, f.name)[rows] for f in fields(self)})

    def shifted(self, time_ns: np.ndarray) -> "Frames":
        """The same frames with other times."""
        return replace(self, time_ns=time_ns)


def empty() -> Frames:
    return Frames(np.zeros(0, np.int64), np.zeros(0, np.uint32), np.zeros((0, 8), np.uint8),
                  *(np.zeros(0, np.uint8) for _ in range(3)))


def in_file_order(parts: Sequence[Frames], order: np.ndarray | slice = slice(None)) -> Frames:
    """All frames, one part behind the other, whatever their times; then in the given order."""
    if len(parts) == 1 and isinstance(order, slice):
        return parts[0]
    width = max(p.payload.shape[1] for p in parts)
    parts = [replace(p, payload=np.pad(p.payload, ((0, 0), (0, width - p.payload.shape[1])))) for p in parts]
    # Column by column: never more than one of them is there a third time.
    return Frames(**{f.name: np.concatenate([getattr(p, f.name) for p in parts])[order] for f in fields(Frames)})


def joined(parts: Sequence[Frames]) -> Frames:
    """All frames, in order of time; frames of equal time stay in the order of the parts."""
    parts = [p for p in parts if len(p)]
    if not parts:
        return empty()
    time_ns = np.concatenate([p.time_ns for p in parts])
    rising = not (time_ns[1:] < time_ns[:-1]).any()
    return in_file_order(parts, slice(None) if rising else np.argsort(time_ns, kind="stable"))


def without_duplicates(frames: Frames) -> tuple[Frames, int]:
    """Without frames that are the same as the one before in everything, time included; and how many they were."""
    if len(frames) < 2:
        return frames, 0
    same = (frames.time_ns[1:] == frames.time_ns[:-1]) & (frames.id[1:] == frames.id[:-1])
    same &= (frames.bus[1:] == frames.bus[:-1]) & (frames.length[1:] == frames.length[:-1])
    rows = np.nonzero(same)[0]
    rows = rows[(frames.payload[rows] == frames.payload[rows + 1]).all(axis=1)]
    if not len(rows):
        return frames, 0
    keep = np.ones(len(frames), dtype=bool)
    keep[rows + 1] = False
    return frames.select(keep), len(rows)


def continued(frames: Frames, smallest: float = 0.005) -> tuple[Frames, list[float]]:
    """Frames in the order they were written, with a clock that was set back on the way put forward again.

    A logger writes frames as they come, so time that runs backwards is its clock being set. The frames after the step
    go on where those before it ended; what is lost is the true gap between two frames, a millisecond on a busy bus.

    Returns the frames and the sizes of the steps [s], negative.
    """
    steps = np.diff(frames.time_ns)
    back = np.nonzero(steps < -smallest * 1e9)[0]
    if not len(back):
        return frames, []
    usual = int(np.median(steps[steps >= 0])) if (steps >= 0).any() else 0
    correction = np.zeros(len(frames), dtype=np.int64)
    correction[back + 1] = usual - steps[back]
    return frames.shifted(frames.time_ns + np.cumsum(correction)), (steps[back] * 1e-9).tolist()


def set_back(steps: Sequence[float]) -> list[str]:
    """What `continued` found, as a sentence."""
    if not steps:
        return []
    times = f"{len(steps)} times, first " if len(steps) > 1 else ""
    return [f"the logger's clock was set back {times}by {-steps[0]:.3f} s; what follows was put behind it"]


_HEAD = 20  # bytes of a frame before its data: stamp, id, four flags, length of the data
_LARGEST = 64
_LENGTH = Struct("<I")
_TEXT = 12  # where the length of frame_id lies


def read_frames(messages: Iterable[bytes]) -> Frames:
    """Frames in order of arrival. Raises ValueError for a message that is none, or is damaged.

    The k-th frame of all messages is read at once: each frame has its length, so within a message its place
    follows from the one before.
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
