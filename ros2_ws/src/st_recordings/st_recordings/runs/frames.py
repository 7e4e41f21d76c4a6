"""Stores CAN frames as columns, merges them, removes duplicates and clock steps, and reads st_msgs/CanFrames."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from itertools import chain, pairwise
from pathlib import Path
from struct import Struct

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

MAX_STANDARD_ID, MAX_EXTENDED_ID = 0x7FF, 0x1FFFFFFF
EXTENDED = 0x8000_0000  # flag of a 29-bit id, as in canedge_bridge.extraction and in Linux
SENT, REMOTE, ERROR, FD = 1, 2, 4, 8  # bits of Frames.flags
MIN_CLOCK_STEP = 0.005  # s; a smaller backward step is jitter of the time stamps
MAX_EARLY_FRAMES = 5
"""If more frames than this directly before a frame have later times, the clock was set back; else its stamps jitter."""
FRAME_HEAD_LENGTH = 20  # bytes in st_msgs/CanFrames before the data of a frame: stamp, id, four flags, length
MAX_DATA_LENGTH = 64
_FRAME_ID_OFFSET = 12  # byte of st_msgs/CanFrames at which the length of header.frame_id begins
_LENGTH = Struct("<I")


@dataclass(frozen=True)
class Frames:
    """CAN frames, one row per frame; in order of time after `merge_by_time`."""

    time_ns: np.ndarray  # int64, on the logger's clock
    id: np.ndarray  # uint32, with the flag EXTENDED for a 29-bit id
    payload: np.ndarray  # uint8, (n, 8), or (n, 64) if a frame is longer; undefined after the end of a frame
    length: np.ndarray  # uint8, bytes
    bus: np.ndarray  # uint8, 0 if unknown
    flags: np.ndarray  # uint8, SENT by the logger | REMOTE | ERROR | FD

    def __len__(self) -> int:
        return len(self.time_ns)

    def select(self, rows: np.ndarray | slice) -> "Frames":
        return Frames(**{f.name: getattr(self, f.name)[rows] for f in fields(self)})


@dataclass(frozen=True)
class CanLog:
    """One recording of one logger, in any number of files."""

    frames: Frames
    files: tuple[Path, ...]
    start_ns: int  # start of the first session from its header, or else time of the first frame
    is_utc: bool = True  # whether times are UTC by the logger's clock; otherwise since the start of the log
    warnings: tuple[str, ...] = ()
    spans: tuple[tuple[int, int], ...] = ()  # first and last time [ns] of each file, from `read_can_logs`
    steps: tuple[tuple[int, float], ...] = ()  # clock steps as returned by `remove_clock_steps`


def empty_frames() -> Frames:
    return Frames(np.zeros(0, np.int64), np.zeros(0, np.uint32), np.zeros((0, 8), np.uint8),
                  *(np.zeros(0, np.uint8) for _ in range(3)))


def concatenate(parts: Sequence[Frames], order: np.ndarray | slice = slice(None)) -> Frames:
    """Concatenates the frames of all parts and then applies `order`; times are not compared."""
    if len(parts) == 1 and isinstance(order, slice):
        return parts[0]
    width = max(p.payload.shape[1] for p in parts)
    parts = [replace(p, payload=np.pad(p.payload, ((0, 0), (0, width - p.payload.shape[1])))) for p in parts]
    # Column by column, so that only one unsorted copy of a column is in memory at a time.
    return Frames(**{f.name: np.concatenate([getattr(p, f.name) for p in parts])[order] for f in fields(Frames)})


def merge_by_time(parts: Sequence[Frames]) -> Frames:
    """Merges the frames of all parts in order of time; frames of equal time stay in the order of the parts."""
    parts = [p for p in parts if len(p)]
    if not parts:
        return empty_frames()
    time_ns = np.concatenate([p.time_ns for p in parts])
    is_ordered = not (time_ns[1:] < time_ns[:-1]).any()
    return concatenate(parts, slice(None) if is_ordered else np.argsort(time_ns, kind="stable"))


def remove_duplicates(frames: Frames) -> tuple[Frames, int]:
    """(frames without those that equal the previous one in time, id, bus, length and payload; number removed)."""
    is_repeated = (frames.time_ns[1:] == frames.time_ns[:-1]) & (frames.id[1:] == frames.id[:-1])
    is_repeated &= (frames.bus[1:] == frames.bus[:-1]) & (frames.length[1:] == frames.length[:-1])
    rows = np.nonzero(is_repeated)[0]
    rows = rows[(frames.payload[rows] == frames.payload[rows + 1]).all(axis=1)]
    if not len(rows):
        return frames, 0
    return frames.select(np.delete(np.arange(len(frames)), rows + 1)), len(rows)


def remove_clock_steps(frames: Frames) -> tuple[Frames, list[tuple[int, float]], list[str]]:
    """Removes backward steps of the logger's clock, and the forward steps that reverse them, from the times.

    A logger writes frames as they arrive, so a step back in time (see MAX_EARLY_FRAMES) means that its clock was set.
    The true interval across the step is lost (a millisecond on a busy bus); the median interval replaces it. Returns
    (frames in the order in which they were written, clock steps, notes on pairs of opposite steps). A clock step is
    (new time of the frame after the step [ns], negative size of the step [s]).
    """
    time_ns = frames.time_ns
    steps = np.diff(time_ns)
    backward_steps = np.nonzero(steps < -MIN_CLOCK_STEP * 1e9)[0]
    is_step = [not (time_ns[max(k - MAX_EARLY_FRAMES, 0) : k] <= time_ns[k + 1]).any() for k in backward_steps]
    backward_steps = backward_steps[np.array(is_step, bool)]
    if not len(backward_steps):
        return frames, [], []
    median_step = int(np.median(steps[steps >= 0])) if (steps >= 0).any() else 0
    correction = np.zeros(len(frames), dtype=np.int64)
    notes, single_steps, start = list[str](), list[int](), 0
    for row, end in pairwise([*backward_steps.tolist(), len(steps)]):
        first, last = row, _find_opposite_step(time_ns, row, start, end, median_step)
        if last is None:
            single_steps.append(row)
        else:
            first, last = sorted((row, last))
            correction[last + 1] -= median_step - steps[first]
            duration = (time_ns[last] - time_ns[first + 1]) * 1e-9
            notes.append(f"the logger's clock was wrong by {(steps[first] - median_step) * 1e-9:+.3f} s for "
                         f"{duration:.3f} s; these times were corrected (frames: {last - first})")
        correction[first + 1] += median_step - steps[first]
        start = (last or row) + 1
    time_ns = time_ns + np.cumsum(correction)
    return replace(frames, time_ns=time_ns), [
        (int(time_ns[row + 1]), float(steps[row] * 1e-9)) for row in single_steps], notes


def _find_opposite_step(time_ns: np.ndarray, row: int, start: int, end: int, median_step: int) -> int | None:
    """Row of the forward step, among those from `start` to `end`, that reverses the backward step after `row`; or None.

    It must be the only step larger than half of the backward step. Unless at most MAX_EARLY_FRAMES frames are between
    the two, the true duration between them, from the times before and after, must equal the recorded duration; if the
    recorded times are nearly equal, it may be longer.
    """
    steps = np.diff(time_ns[start:end + 1])
    large_steps = start + np.flatnonzero(steps > (time_ns[row] - time_ns[row + 1]) / 2)
    if len(large_steps) != 1:
        return None
    first, last = sorted((row, int(large_steps[0])))
    true_duration, recorded_duration = time_ns[last + 1] - time_ns[first], time_ns[last] - time_ns[first + 1]
    tolerance, count = 2 * median_step + MIN_CLOCK_STEP * 1e9, last - first
    median_duration = np.median(time_ns[count:] - time_ns[:-count])  # of `count` frames
    max_duration = tolerance + (recorded_duration if recorded_duration > median_duration / 2 else 2 * median_duration)
    is_short = count <= MAX_EARLY_FRAMES and true_duration >= 0
    return int(large_steps[0]) if is_short or recorded_duration - tolerance <= true_duration <= max_duration else None


def build_log(file: Path, parts: Sequence[Frames], warnings: Sequence[str], start_ns: int | None = None) -> CanLog:
    """The log of one file, clock steps removed. parts: frames, each part in the order of writing. start_ns: start of
    the session; None: time of the first frame."""
    corrected_parts, steps_of_parts, notes = zip(*map(remove_clock_steps, parts), strict=True)
    frames, steps = merge_by_time(corrected_parts), tuple(chain.from_iterable(steps_of_parts))
    warnings = [*warnings, *chain.from_iterable(notes)]
    if steps:
        times = f"{len(steps)} times, first " if len(steps) > 1 else ""
        warnings = [*warnings, f"the logger's clock was set back {times}by {-steps[0][1]:.3f} s; later times were "
                    "moved forward"]
    start_ns = int(frames.time_ns[0]) if start_ns is None else start_ns
    return CanLog(frames, (file,), start_ns, warnings=tuple(warnings), steps=steps)


def read_frames(messages: Iterable[bytes]) -> Frames:
    """Reads the frames of serialised st_msgs/CanFrames messages. Raises ValueError for a damaged message.

    The k-th frames of all messages are read at once: their offsets follow from the lengths of the frames before them.
    """
    serialised = list(messages)
    firsts, counts = zip(*map(_locate_first_frame, serialised), strict=True) if serialised else ((), ())
    sizes = np.array([len(message) for message in serialised], np.int64)
    ends = np.cumsum(sizes)
    buffer = np.frombuffer(b"".join(serialised) + bytes(FRAME_HEAD_LENGTH + MAX_DATA_LENGTH), np.uint8)
    offsets, remaining = np.array(firsts, np.int64) + ends - sizes, np.array(counts, np.int64)
    heads = sliding_window_view(buffer, FRAME_HEAD_LENGTH)
    frame_offsets: list[np.ndarray] = []
    message_numbers: list[np.ndarray] = []
    numbers = np.arange(len(serialised))
    while (has_more := remaining > 0).any():
        offsets, remaining, numbers = offsets[has_more], remaining[has_more], numbers[has_more]
        length = heads[offsets, 16:20].copy().view("<u4")[:, 0].astype(np.int64)
        if (length > MAX_DATA_LENGTH).any() or (offsets + FRAME_HEAD_LENGTH + length > ends[numbers]).any():
            raise ValueError("a frame extends beyond its message")
        frame_offsets.append(offsets)
        message_numbers.append(numbers)
        offsets, remaining = offsets + FRAME_HEAD_LENGTH + (length + 3) // 4 * 4, remaining - 1
    if not frame_offsets:
        return empty_frames()
    # The frames are ordered by k; the stable sort orders them by message and keeps the order within a message.
    sequence = np.argsort(np.concatenate(message_numbers), kind="stable")
    return _build_frames(buffer, np.concatenate(frame_offsets)[sequence])


def _locate_first_frame(message: bytes) -> tuple[int, int]:
    """(byte at which the first frame of a message begins, number of frames)."""
    if len(message) < _FRAME_ID_OFFSET + 4:
        raise ValueError("a message ends within its header")
    text_end = _FRAME_ID_OFFSET + 4 + _LENGTH.unpack_from(message, _FRAME_ID_OFFSET)[0]
    count_offset = -(-text_end // 4) * 4
    if len(message) < count_offset + 4:
        raise ValueError("a message ends within its header")
    count = _LENGTH.unpack_from(message, count_offset)[0]
    if count and len(message) < count_offset + 4 + count * FRAME_HEAD_LENGTH:
        raise ValueError("a message is too short for the number of its frames")
    return count_offset + 4, count


def _build_frames(buffer: np.ndarray, offsets: np.ndarray) -> Frames:
    heads = sliding_window_view(buffer, FRAME_HEAD_LENGTH)[offsets]
    words = heads[:, :12].copy().view("<i4")
    length = heads[:, 16]
    width = 8 if int(length.max()) <= 8 else MAX_DATA_LENGTH
    payload = sliding_window_view(buffer, width)[offsets + FRAME_HEAD_LENGTH]
    payload[np.arange(width) >= length[:, None]] = 0
    extended, error, remote, fd = ((heads[:, k] != 0).astype(np.uint8) for k in range(12, 16))
    return Frames(
        time_ns=words[:, 0].astype(np.int64) * 1_000_000_000 + words[:, 1].view(np.uint32).astype(np.int64),
        id=words[:, 2].view(np.uint32) | extended.astype(np.uint32) * np.uint32(EXTENDED),
        payload=payload, length=length, bus=np.zeros(len(offsets), np.uint8),
        flags=error * np.uint8(ERROR) | remote * np.uint8(REMOTE) | fd * np.uint8(FD))
