"""Decodes the CAN frames of a log to signals (one column each), with the same checks as the live CAN bridge."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from operator import itemgetter
from pathlib import Path

import numpy as np
from canedge_bridge.checks import Mode, find_counter_faults
from canedge_bridge.extraction import has_length, stack_bytes
from canedge_bridge.ins_time import replace_gps_time
from canedge_bridge.plausibility import find_plausible_frames
from canedge_bridge.signals import MessageSpec, SignalTable, load_table
from st_core.checks import Series

from .errors import RunError, format_count
from .frames import ERROR, EXTENDED, REMOTE, Frames
from .ins_log import SPEEDS, compute_car_speed, make_series

J1939_GROUP = EXTENDED | 0x03FFFF00
"""Mask of the J1939 parameter group number (PGN) in an identifier, and of the 29-bit flag."""


@dataclass(frozen=True)
class Signal:
    """One signal of the signal table in one message."""

    name: str
    message: str
    time_ns: np.ndarray  # log times of its frames, strictly increasing
    values: np.ndarray  # SI, sign as in the signal table
    valid: np.ndarray  # False where a counter or checksum set to `warn` is wrong
    rows: np.ndarray  # indices of its frames in Frames


@dataclass(frozen=True)
class CanSignals:
    signals: Mapping[tuple[str, str], Signal]  # by signal name and message name
    faults: Mapping[str, str]  # message -> description of its faults, with their counts
    rejected_times_ns: Mapping[str, np.ndarray] = field(default_factory=dict)  # by message, of rejected frames

    def find_all(self, name: str) -> list[Signal]:
        return [signal for signal in self.signals.values() if signal.name == name]

    def select_interval(self, start_ns: int, end_ns: int) -> "CanSignals":
        """The signals with start_ns <= time < end_ns."""
        selected = {}
        for key, signal in self.signals.items():
            rows = slice(*np.searchsorted(signal.time_ns, (start_ns, end_ns)).tolist())
            if rows.start < rows.stop:
                selected[key] = replace(signal, **{name: getattr(signal, name)[rows]
                                                   for name in ("time_ns", "values", "valid", "rows")})
        rejected_times_ns = {name: t[(t >= start_ns) & (t < end_ns)] for name, t in self.rejected_times_ns.items()}
        return CanSignals(selected, self.faults, rejected_times_ns)

    def find_first(self, name: str) -> Signal | None:
        return next(iter(self.find_all(name)), None)


def decode_signals(frames: Frames, table: SignalTable) -> CanSignals:
    """Decodes and checks every message of the table.

    Frames are checked as by the live decoder: length, checksum, counter, range and rate. Of several frames with the
    same time, only the first can be used. If several buses carry the identifier of a message and its frames fail a
    check when taken together, only the bus with the most valid frames is used, unless all together have more.
    """
    signals: dict[tuple[str, str], Signal] = {}
    faults: dict[str, str] = {}
    rejected_times_ns: dict[str, np.ndarray] = {}
    # One message at a time, because decoding all signals at once would dominate memory use.
    order = np.argsort(frames.id, kind="stable")
    sorted_ids = frames.id[order]
    for message, spec in table.messages.items():
        key = spec.key[0] | (EXTENDED if spec.key[1] else 0)
        rows = order[slice(*np.searchsorted(sorted_ids, (key, key + 1)).tolist())]
        rows = rows[frames.flags[rows] & (REMOTE | ERROR) == 0]
        if not len(rows):
            if spec.is_needed and (fault := _describe_similar_id(frames.id, key)):
                faults[message] = fault
            continue
        decoded, n_valid = _decode_message(frames, rows, spec)
        buses, counts = np.unique(frames.bus[rows], return_counts=True)
        if decoded.faults and len(buses) > 1:
            by_bus = [(*_decode_message(frames, rows[frames.bus[rows] == bus], spec), int(count))
                      for bus, count in zip(buses, counts, strict=True)]
            on_best_bus, n_best, n_frames = max(by_bus, key=itemgetter(1))
            if n_best >= n_valid:
                note = f"{len(rows) - n_frames} frames of this identifier on other buses are not used"
                decoded = replace(on_best_bus, faults={message: "; ".join((*on_best_bus.faults.values(), note))})
        signals |= decoded.signals
        faults |= decoded.faults
        rejected_times_ns |= decoded.rejected_times_ns
    return CanSignals(signals, faults, rejected_times_ns)


def _describe_similar_id(ids: np.ndarray, key: int) -> str:
    """Describes frames with an identifier that differs from `key` only in length, or in J1939 priority and source."""
    identifier, bits = key & ~EXTENDED, 29 if key & EXTENDED else 11
    if count := int((ids == key ^ EXTENDED).sum()):
        return (f"its identifier 0x{identifier:X} has {bits} bits in the DBC, but {40 - bits} bits in {count} frames "
                "of the log")
    same_group, counts = np.unique(ids[(ids ^ key) & J1939_GROUP == 0], return_counts=True)
    if bits == 11 or not len(same_group):
        return ""
    identifiers = ", ".join(f"0x{other & ~EXTENDED:X} ({count} frames)" for other, count in
                            zip(same_group.tolist(), counts.tolist(), strict=True))
    return f"the log has {identifiers} instead, where only the J1939 priority and source address differ"


def _decode_message(frames: Frames, rows: np.ndarray, spec: MessageSpec) -> tuple[CanSignals, int]:
    """(signals and faults of one message, number of its usable and valid frames)."""
    n_frames, payload, lengths = len(rows), frames.payload[rows], frames.length[rows]
    has_dbc_length = has_length(payload, lengths, spec.dbc.length)
    rows = rows[has_dbc_length]
    n_unused = n_frames - len(rows)
    consequence = f"{n_unused} frames are not used" if n_unused else "the additional bytes are padding and were ignored"
    sizes = zip(*np.unique(lengths, return_counts=True), strict=True)
    wrong_lengths = ", ".join(f"{format_count(int(count), n_frames, 'frames')} have {size} bytes"
                              for size, count in sizes if size != spec.dbc.length)
    faults = [f"{wrong_lengths} instead of {spec.dbc.length} as in the DBC; {consequence}"] if wrong_lengths else []
    if not len(rows):
        return CanSignals({}, {spec.name: faults[0]}), 0
    data, time_ns = stack_bytes(payload[has_dbc_length], spec.dbc.length), frames.time_ns[rows]
    columns = spec.to_si(data)
    is_kept, valid, fault = check_frames(spec, data, time_ns, columns)
    steering = columns.get("steering_wheel_angle")
    if not fault and steering is not None and not np.isfinite(steering).any():
        fault = f"none of {len(rows)} frames contains an angle; values named in the DBC, such as SNA, are not angles"
    faults += [fault] if fault else []
    rejected_times_ns = time_ns[~is_kept]
    is_kept &= np.diff(time_ns, prepend=time_ns[0] - 1) > 0
    signals = {(name, spec.name): Signal(name, spec.name, time_ns[is_usable], values[is_usable], valid[is_usable],
                                         rows[is_usable])
               for name, values in replace_gps_time(columns).items()
               if (is_usable := is_kept & np.isfinite(values)).any()}
    return CanSignals(signals, {spec.name: "; ".join(faults)} if faults else {},
                      {spec.name: rejected_times_ns} if len(rejected_times_ns) else {}), int((is_kept & valid).sum())


def find_steering(signals: CanSignals, file: Path | str, table: SignalTable, notes: Sequence[str] = ()) -> Signal:
    """Finds the signal of the steering wheel angle. Raises RunError if it is not in the log, or if more of its frames
    were rejected than accepted, as with a wrong DBC. notes: warnings about the log."""
    steering = signals.find_first("steering_wheel_angle")
    if steering is not None and len(signals.rejected_times_ns.get(steering.message, ())) <= len(steering.time_ns):
        return steering
    source = table.find_steering()
    if source is None:
        raise RunError(file, "the signal table has no steering_wheel_angle", "add it, or name the car with --car DIR")
    expected = f"{source[0].name} (0x{source[0].dbc.frame_id:03X})"
    if (fault := signals.faults.get(source[0].name)):
        raise RunError(file, f"the steering message {expected} cannot be used: {fault}",
                       "correct the DBC (identifier, length, byte order, factor) or the signal table")
    messages = "; ".join([", ".join(sorted({message for _, message in signals.signals})) or "none",
                          *(note.removeprefix(f"{file}: ") for note in notes)])
    raise RunError(file, f"the steering message {expected} is not in the log; known messages in the log: {messages}",
                   "name the car of this log with --car DIR, or log the bus that carries the message")


def collect_speeds(signals: CanSignals, to_reference: Callable[[np.ndarray], np.ndarray] = np.asarray
                   ) -> tuple[Series | None, Series | None]:
    """(speed of the car from wheel speeds or a speed signal, forward speed of the INS on CAN) [m/s]; None if missing.

    to_reference: converts log times [ns] to the clock of the result [ns].
    """
    speeds = {name: (to_reference(signal.time_ns[signal.valid]), signal.values[signal.valid])
              for name in SPEEDS if (signal := signals.find_first(name)) is not None}
    ins = signals.find_all("ins_velocity_x")  # the two axis conventions have different messages
    if not ins:
        return compute_car_speed(speeds), None
    order = np.argsort(np.concatenate([signal.rows[signal.valid] for signal in ins]), kind="stable")
    time_ns, values = (np.concatenate([getattr(signal, name)[signal.valid] for signal in ins])[order]
                       for name in ("time_ns", "values"))
    return compute_car_speed(speeds), make_series(to_reference(time_ns), values)


def load_signal_table(dbc: Path, table: Path) -> SignalTable:
    """Loads a DBC and its signal table. Raises RunError if a file is missing or invalid, or they do not match."""
    for file, option in ((table, "--signals"), (dbc, "--dbc")):
        if not file.is_file():
            raise RunError(file, "the file does not exist, and a CAN log cannot be decoded without it",
                           f"name it with {option}, or name a car that has one with --car")
    try:
        return load_table(dbc, table)
    except ValueError as error:
        raise RunError(table, str(error).removeprefix(f"{table}: ")) from None


def check_frames(spec: MessageSpec, data: np.ndarray, time_ns: np.ndarray,
                 values: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray, str]:
    """(whether to use each frame of a message, whether each frame is valid, description of the faults).

    data: bytes of the frames from `stack_bytes`. time_ns: log times (n,). values: SI values (n,) by canonical name.
    """
    n = len(time_ns)
    is_kept, valid, wrong_checksum = np.ones(n, bool), np.ones(n, bool), np.zeros(n, bool)
    faults = []
    for name, check in (("checksum", spec.checksum), ("counter", spec.counter)):
        if check is None or check.mode is Mode.OFF:
            continue
        if check.rule:
            is_wrong = wrong_checksum = ~check.is_correct(data, spec.dbc.frame_id)
        else:
            is_wrong = find_counter_faults(check.field, data, time_ns, wrong_checksum, spec.timeout_ns)
        (is_kept if check.mode is Mode.DROP else valid)[is_wrong] = False
        if is_wrong.any():
            faults.append(f"{name} wrong in {is_wrong.sum()}")
    is_accepted = is_kept.copy()
    for signal in spec.signals:
        if signal.is_limited:
            is_present = is_kept & np.isfinite(values[signal.name]) if signal.extractor.selectors else is_kept
            is_plausible = find_plausible_frames(signal, spec, time_ns[is_present], values[signal.name][is_present])
            is_accepted[is_present] &= is_plausible
            if len(implausible := values[signal.name][is_present][~is_plausible] / signal.factor):
                worst = float(implausible[np.argmax(np.nan_to_num(np.abs(implausible), nan=-1.0))])
                size = f"up to {worst:.6g} {signal.unit}" if np.isfinite(worst) else "not a number, or named in the DBC"
                faults.append(f"{signal.dbc.name} implausible ({size}) in {len(implausible)}")
    return is_accepted, valid & is_accepted, f"{', '.join(faults)} of {n} frames" if faults else ""
