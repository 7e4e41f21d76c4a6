"""Reads CAN logs (MF4 of a CANedge2, candump, Vector, PEAK, CSV, bag, ...) and merges the logs of a run."""

import itertools
import re
from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import can
import numpy as np
from scipy.ndimage import median_filter

from . import frames as can_frames
from .bag import is_bag
from .bag_storage import open_bag
from .can_formats import AMBIGUOUS_IDS, DECIMAL_IDS, FORMATS, LINE_FORMAT, Format, check_format, find_restart, read_head
from .cdr import CAN_MSGS_FRAME
from .errors import RunError, check_readable, convert_errors
from .frames import ERROR, EXTENDED, FD, MAX_DATA_LENGTH, MAX_STANDARD_ID, REMOTE, SENT, CanLog, Frames
from .ins_log import LATEST_TIME
from .mf4 import MF4_EXTENSIONS, is_mdf, parse_session, read_mf4, reject_unreadable
from .table_times import count_rollovers

_BAG_FIELDS = ("header.stamp", "id", "is_rtr", "is_extended", "is_error", "dlc", "data")  # of can_msgs/Frame
BLOCK_SIZE = 65536  # messages converted to columns at a time
MAX_TIME_JUMPS_NS = 60 * 10**9, 86400 * 10**9
"""Largest deviation of a time from the median of itself and its neighbours: within a log, and at its ends. A time that
deviates more is wrong."""
FIRST_ABSOLUTE_TIME = 1_000_000_000  # s since 1970; smaller times are relative to the start of the log
MIN_DECREASING_FRACTION = 0.2
"""If the first time of a text log is 0, and more than this fraction of the later times is lower than the previous time,
or all later times are equal, the times are steps between frames."""


def read_can_logs(files: Sequence[Path], known_ids: Collection[int] = ()) -> CanLog:
    """Reads the files of one run (splits of a session, or several buses) and merges their frames by time.

    known_ids: identifiers in the DBC; they show whether those of a CSV are decimal or hexadecimal if both are possible.
    Raises RunError if no file can be used, or only some have UTC times. If some can be used, the others cause warnings.
    """
    logs: list[CanLog] = []
    errors: list[RunError] = []
    for file in sorted(files, key=lambda f: (*parse_session(f), str(f))):
        try:
            logs.append(_choose_id_base(_read_log(file), known_ids))
        except RunError as error:
            errors.append(error)
    if not logs:
        raise errors[0] if errors else RunError("CAN log", "no file given")
    used_files = tuple(log.files[0] for log in logs)
    relative_logs = [log.files[0].name for log in logs if not log.is_utc]
    if 0 < len(relative_logs) < len(logs):
        raise RunError(used_files[0], f"some logs of the run have UTC times, but those of {', '.join(relative_logs)} "
                       "are relative to the start", "list the logs of one clock in a run.yaml")
    warnings = [f"{log.files[0]}: {note}" for log in logs for note in log.warnings]
    frames, n_repeated = can_frames.remove_duplicates(can_frames.merge_by_time([log.frames for log in logs]))
    if n_repeated:
        warnings.append(f"{used_files[0]}: frames that are in the logs more than once: {n_repeated}; each is used once")
    sessions: dict[str, set[int]] = {}
    for session, split in map(parse_session, used_files):
        sessions.setdefault(session, set()).add(split)
    warnings += [*map(str, errors), *(
        f"{session}: the log has a gap because files of the session are missing: {', '.join(map(str, missing))}"
        for session, splits in sessions.items()
        if (missing := sorted({*range(min(splits), max(splits) + 1)} - splits)))]
    spans = tuple((int(log.frames.time_ns.min()), int(log.frames.time_ns.max())) for log in logs)
    return CanLog(frames, used_files, min(log.start_ns for log in logs), logs[0].is_utc, tuple(warnings), spans,
                  tuple(step for log in logs for step in log.steps))


def _read_log(file: Path) -> CanLog:
    """Reads the log in one file. Its warnings do not name the file."""
    if is_bag(file):
        return _read_bag(file)
    check_readable(file)
    head = read_head(file)
    reject_unreadable(file, head)
    if is_mdf(head):
        return read_mf4(file)
    log_format = next((f for f in FORMATS if f.matches(head)), None)
    if log_format is None:
        if file.suffix.lower() in MF4_EXTENSIONS:
            raise RunError(file, "this is not an MF4 file (it does not start with MDF)",
                           "correct its extension, or remove it from the command")
        check_format(file, head)
        formats = ", ".join(["MF4", *(f.name for f in FORMATS)])
        raise RunError(file, f"this is not a CAN log of a known format ({formats})",
                       "remove it from the command, or convert it")
    notes = [] if file.suffix.lower() in log_format.extensions else [
        f"is a {log_format.name} log with the extension {file.suffix or '(none)'}; it was read as such"]
    return _read_with_python_can(file, log_format, notes)


def _choose_id_base(log: CanLog, known_ids: Collection[int]) -> CanLog:
    """The log; identifiers that may be decimal or hexadecimal are read in the base in which more of them are known."""
    if AMBIGUOUS_IDS not in log.warnings:
        return log
    ids, rows = np.unique(log.frames.id & ~np.uint32(EXTENDED), return_inverse=True)
    texts = [f"{number:x}" for number in ids.tolist()]
    notes = tuple(note for note in log.warnings if note != AMBIGUOUS_IDS)
    if not all(map(str.isdecimal, texts)):  # a later row shows that they are hexadecimal
        return replace(log, warnings=notes)
    decimal_ids = np.array([int(text) for text in texts], np.uint32)
    n_hexadecimal, n_decimal = (np.isin(numbers, list(known_ids)).sum() for numbers in (ids, decimal_ids))
    if n_decimal > n_hexadecimal:
        # If the log does not mark extended identifiers, they were identified by their hexadecimal values.
        extended = np.where((ids > MAX_STANDARD_ID) & (decimal_ids <= MAX_STANDARD_ID), 0, EXTENDED).astype(np.uint32)
        frames = replace(log.frames, id=decimal_ids[rows] | (log.frames.id & extended[rows]))
        return replace(log, frames=frames, warnings=(*notes, DECIMAL_IDS))
    return log if n_decimal == n_hexadecimal else replace(log, warnings=notes)


def _read_bag(path: Path) -> CanLog:
    """Reads the can_msgs/Frame messages of a bag; each of its topics is a bus. Raises RunError."""
    storage = open_bag(path)
    storage.use_definitions([CAN_MSGS_FRAME])
    topics = sorted((t for t in storage.topics if t.type_name == CAN_MSGS_FRAME), key=lambda t: t.name)
    if not topics:
        raise RunError(path, f"this bag contains no CAN frames ({CAN_MSGS_FRAME})", "remove it from the command")
    parts, notes = list[Frames](), list[str]()
    for bus, topic in enumerate(topics, start=1):
        columns = storage.read_fields(topic, _BAG_FIELDS)
        time_ns, length = columns["header.stamp"], columns["dlc"]
        if 2 * np.count_nonzero(time_ns) < len(time_ns):
            time_ns = storage.read_log_times(topic.name, time_ns)
            notes.append(f"most frames of {topic.name} have no stamp; the times of reception are used")
        if not (time_ns > 0).any():
            continue
        flags = REMOTE * columns["is_rtr"] + ERROR * columns["is_error"]
        frames = Frames(
            time_ns, columns["id"].astype(np.uint32) | np.uint32(EXTENDED) * columns["is_extended"],
            np.where(np.arange(8) < length[:, None], columns["data"], 0).astype(np.uint8),
            np.minimum(length, 8).astype(np.uint8), np.full(len(length), bus, np.uint8), flags.astype(np.uint8))
        parts.append(frames.select(time_ns > 0))
    if not parts:
        raise RunError(path, f"its CAN frames ({CAN_MSGS_FRAME}) have no times after 1970", "record it again")
    return can_frames.build_log(path, parts, notes)


def _read_with_python_can(file: Path, log_format: Format, notes: Sequence[str]) -> CanLog:
    """Reads a log. notes: listed before those of the reader. Raises RunError if no frame is usable."""
    parts, format_notes, n_mistimed, n_too_long = list[Frames](), list[str](), 0, 0
    problem, advice = f"cannot be read as a {log_format.name} log", "copy or export it again"
    with convert_errors(file, problem, advice, Exception):  # any, from the parsers
        messages = log_format.messages(file, format_notes)
        while block := list(itertools.islice(messages, BLOCK_SIZE)):
            valid_messages = [message for message in block if 0.0 <= message.timestamp <= LATEST_TIME]
            n_mistimed += len(block) - len(valid_messages)
            usable_messages = [message for message in valid_messages if len(message.data) <= MAX_DATA_LENGTH]
            n_too_long += len(valid_messages) - len(usable_messages)
            if usable_messages:
                parts.append(_build_frames(usable_messages))
    frames = can_frames.concatenate(parts) if parts else can_frames.empty_frames()
    if len(frames) > 1:
        limit = np.full(len(frames), MAX_TIME_JUMPS_NS[0])
        limit[[0, -1]] = MAX_TIME_JUMPS_NS[1]
        is_outlier = np.abs(frames.time_ns - median_filter(frames.time_ns, 3, mode="mirror")) > limit
        frames, n_mistimed = frames.select(~is_outlier), n_mistimed + int(is_outlier.sum())
    skipped = {"an impossible time": n_mistimed, f"more than {MAX_DATA_LENGTH} bytes": n_too_long}
    format_notes += [f"frames with {reason} were skipped: {count}" for reason, count in skipped.items() if count]
    if not len(frames):
        reasons = f"no usable frames ({'; '.join(format_notes)})" if format_notes else "no frames"
        raise RunError(file, f"it contains {reasons}", "export its times in seconds, and identifiers and bytes as "
                       "hexadecimal numbers" if log_format.name != "Vector BLF" else advice)
    period, min_jump = find_restart(read_head(file))
    if frames.time_ns.max() <= period * 1e9:  # times that restart at midnight or at the full hour
        rollovers = count_rollovers(frames.time_ns * 1e-9, min_jump)
        frames = replace(frames, time_ns=frames.time_ns + rollovers * round(period * 1e9))
    steps = np.diff(frames.time_ns[1:])
    if log_format.name == LINE_FORMAT and frames.time_ns[0] == 0 and len(steps) and (
            (steps < 0).mean() > MIN_DECREASING_FRACTION or not steps.any()):
        frames = replace(frames, time_ns=np.cumsum(frames.time_ns))
        format_notes.append("its times are relative to the previous frame; they were summed")
    log = can_frames.build_log(file, [frames], [*notes, *format_notes])
    return replace(log, is_utc=log.start_ns >= FIRST_ABSOLUTE_TIME * 10**9)


def _build_frames(messages: Sequence[can.Message]) -> Frames:
    width = MAX_DATA_LENGTH if any(len(m.data) > 8 for m in messages) else 8
    ids = [m.arbitration_id | (EXTENDED if m.is_extended_id else 0) for m in messages]
    flags = [(SENT if not m.is_rx else 0) | (REMOTE if m.is_remote_frame else 0) | (ERROR if m.is_error_frame else 0)
             | (FD if m.is_fd else 0) for m in messages]
    payload = b"".join([bytes(m.data).ljust(width, b"\0") for m in messages])
    seconds = np.array([m.timestamp for m in messages])
    return Frames(
        # Rounding to microseconds removes the rounding error of float seconds since 1970, 0.1 us.
        time_ns=np.round(seconds * 1e6).astype(np.int64) * 1000,
        id=np.array(ids, np.uint32), payload=np.frombuffer(payload, np.uint8).reshape(-1, width),
        length=np.array([len(m.data) for m in messages], np.uint8),
        bus=np.array([_find_bus_number(m.channel) for m in messages], np.uint8), flags=np.array(flags, np.uint8))


def _find_bus_number(channel: Any) -> int:
    """Number of a bus from 1, as in MF4: can0 -> 1, channel 0 -> 1; 0 if it is unknown."""
    digits = re.search(r"(?:^-)?\d+$", str(channel))
    return (int(digits[0]) + 1) % 256 if digits else 0
