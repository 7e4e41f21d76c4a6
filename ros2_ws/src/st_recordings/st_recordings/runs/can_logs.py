"""CAN logs of every kind to one column set: MF4 of a CANedge2, candump, and Vector's and PEAK's files."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import can
import numpy as np

from .can_formats import FORMATS, MF4_EXTENSIONS, TIMELESS, Format
from .errors import RunError, check_readable, short
from .frames import (
    ERROR,
    EXTENDED,
    FD,
    REMOTE,
    SENT,
    Frames,
    continued,
    in_file_order,
    joined,
    set_back,
    without_duplicates,
)
from .mf4 import read_mf4, refuse_makers_container, session_of

BLOCK = 65536
# A wall clock, not seconds since the start of the log.
ABSOLUTE_FROM = 1_000_000_000
# Of the frames of a candump that begins at 0: with more that are older, the times are those since the frame before.
STEPS_SHARE = 0.2


@dataclass(frozen=True)
class CanLog:
    """One recording of one logger, in any number of files.

    start_ns: start of the first session by its header, else the first frame. absolute: whether times are UTC (as
    the logger's clock has it); else they count from the start of the log. warnings: whole sentences that name the file.
    """

    frames: Frames
    files: tuple[Path, ...]
    start_ns: int
    absolute: bool = True
    warnings: tuple[str, ...] = field(default=())


def read_can_logs(files: Sequence[Path]) -> CanLog:
    """All frames of the files of one run, merged by time; splits of a session are joined, two buses too.

    Raises RunError when none of them can be used. One bad file among several costs a warning.
    """
    parts: list[Frames] = []
    warnings: list[str] = []
    errors: list[RunError] = []
    absolute: set[bool] = set()
    good: list[Path] = []
    starts: list[int] = []
    for file in sorted(files, key=lambda f: (*session_of(f), str(f))):
        try:
            frames, start_ns, is_absolute, notes = _read_one(file)
        except RunError as error:
            errors.append(error)
            continue
        parts.append(frames)
        good.append(file)
        starts.append(start_ns)
        absolute.add(is_absolute)
        warnings += [f"{file}: {note}" for note in notes]
    if not parts:
        raise errors[0] if errors else RunError("CAN log", "no file given")
    if len(absolute) > 1:
        raise RunError(good[0], "one log counts in UTC, another from its own start", "give them one by one")
    frames, repeated = without_duplicates(joined(parts))
    if repeated:
        warnings.append(f"{good[0]}: {repeated} frames are in the log twice; one of each was kept")
    warnings += [str(error) for error in errors] + _missing_splits(good)
    return CanLog(frames, tuple(good), min(starts), absolute.pop(), tuple(warnings))


def _read_one(file: Path) -> tuple[Frames, int, bool, Sequence[str]]:
    check_readable(file)
    refuse_makers_container(file)
    with file.open("rb") as stream:
        head = stream.read(4096)
    if head[:4] in (b"MDF ", b"UnFi"):
        log = read_mf4(file)
        return log.frames, log.start_ns, True, log.warnings
    found = next((f for f in FORMATS if f.mark(head)), None)
    if found is None:
        if file.suffix.lower() in MF4_EXTENSIONS:
            read_mf4(file)  # raises the reason why it is not a valid MF4
        if TIMELESS.search(head):
            raise RunError(file, "this output of candump has no time stamps", "record with candump -l")
        known = ", ".join(["MF4", *(f.name for f in FORMATS)])
        raise RunError(file, f"this is not a CAN log of a known format ({known})",
                       "remove it from the command, or convert it")
    notes: list[str] = []
    if file.suffix.lower() not in found.extensions:
        notes.append(f"is a {found.name} log under the extension {file.suffix or '(none)'}; read as what it is")
    frames = _through_python_can(file, found, notes)
    start_ns = int(frames.time_ns[0])
    return frames, start_ns, start_ns >= ABSOLUTE_FROM * 10**9, notes


def _through_python_can(file: Path, kind: Format, notes: list[str]) -> Frames:
    parts, trouble = list[Frames](), list[str]()
    try:
        messages = kind.messages(file, trouble)
        while block := list(itertools.islice(messages, BLOCK)):
            parts.append(_columns(block))
    except Exception as error:  # the readers let anything through: a head that only looks like one, a missing file
        what = f"cannot be read as a {kind.name} log ({short(error)})"
        raise RunError(file, what, "copy or export it again") from None
    if not parts:
        what = f"no whole frame is in it ({'; '.join(trouble)})" if trouble else "no frames are in the log"
        raise RunError(file, what, "copy or export it again")
    frames = in_file_order(parts)
    steps = np.diff(frames.time_ns[1:])  # a coarse clock repeats its times; times since the frame before also fall
    if kind.name == "candump" and frames.time_ns[0] == 0 and len(steps) and (
            (steps < 0).mean() > STEPS_SHARE or not steps.any()):
        frames = frames.shifted(np.cumsum(frames.time_ns))
        trouble.append("its times are those since the frame before (candump -t d); they were added up")
    frames, set_backs = continued(frames)
    notes += [*trouble, *set_back(set_backs)]
    return joined([frames])


def _columns(messages: Sequence[can.Message]) -> Frames:
    width = 64 if any(len(m.data) > 8 for m in messages) else 8
    ids = [m.arbitration_id | (EXTENDED if m.is_extended_id else 0) for m in messages]
    flags = [(SENT if not m.is_rx else 0) | (REMOTE if m.is_remote_frame else 0) | (ERROR if m.is_error_frame else 0)
             | (FD if m.is_fd else 0) for m in messages]
    payload = b"".join([bytes(m.data).ljust(width, b"\0") for m in messages])
    seconds = np.array([m.timestamp for m in messages])
    return Frames(
        # Microseconds: the finest any of these formats writes, so float seconds come back as they were.
        time_ns=np.round(seconds * 1e6).astype(np.int64) * 1000,
        id=np.array(ids, np.uint32), payload=np.frombuffer(payload, np.uint8).reshape(-1, width),
        length=np.array([len(m.data) for m in messages], np.uint8),
        bus=np.array([_bus(m.channel) for m in messages], np.uint8), flags=np.array(flags, np.uint8),
    )


def _bus(channel: Any) -> int:
    """Number of a bus as in MF4, from 1: can0 -> 1, channel 0 -> 1; 0 if unknown."""
    if isinstance(channel, int):
        return (channel + 1) % 256
    digits = "".join(itertools.takewhile(str.isdigit, reversed(str(channel or ""))))[::-1]
    return (int(digits) + 1) % 256 if digits else 0


def _missing_splits(files: Sequence[Path]) -> list[str]:
    sessions: dict[str, list[int]] = {}
    for file in files:
        session, split = session_of(file)
        sessions.setdefault(session, []).append(split)
    missing = []
    for session, splits in sessions.items():
        absent = sorted(set(range(min(splits), max(splits) + 1)) - set(splits))
        if absent:
            numbers = ", ".join(map(str, absent))
            missing.append(f"{session}: split {numbers} of the session is missing: a gap in the log")
    return missing
