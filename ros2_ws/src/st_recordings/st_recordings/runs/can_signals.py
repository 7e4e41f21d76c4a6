"""From the frames of a log to the signals of the suite: what the live CAN bridge would have published, as columns."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from canedge_bridge.extraction import decode_log
from canedge_bridge.ins_time import with_unix_time
from canedge_bridge.signals import MessageSpec, SignalTable, load_table

from .can_checks import check_frames
from .errors import RunError, share
from .frames import ERROR, EXTENDED, REMOTE, Frames


@dataclass(frozen=True)
class Signal:
    """One signal of the table as one message carries it: SI, sign as in the table.

    time_ns: when the frame was logged, strictly increasing. valid: False where a counter or checksum set to `warn` was
    wrong. rows: the frames it came from, places in Frames.
    """

    name: str
    message: str
    time_ns: np.ndarray
    values: np.ndarray
    valid: np.ndarray
    rows: np.ndarray


@dataclass(frozen=True)
class CanSignals:
    """signals: by (our name, message). faults: message -> what was wrong and how often."""

    signals: Mapping[tuple[str, str], Signal]
    faults: Mapping[str, str]

    def all_of(self, name: str) -> list[Signal]:
        return [s for (our, _), s in self.signals.items() if our == name]

    def first_of(self, name: str) -> Signal | None:
        return next(iter(self.all_of(name)), None)


def decode_signals(frames: Frames, table: SignalTable) -> CanSignals:
    """Decode and check every message of the table; frames that a check set to `drop` refuses are left out.

    The same rules as the live decoder: length, checksum, counter, range and rate (canedge_bridge.decode). Where time
    does not rise (two buses with the same message), the first frame of each instant is kept.
    """
    signals: dict[tuple[str, str], Signal] = {}
    faults: dict[str, str] = {}
    # One message after the other: the signals of all at once would be the largest thing in memory.
    order = np.argsort(frames.id, kind="stable")
    sorted_ids = frames.id[order]
    for name, spec in table.messages.items():
        identifier, extended = spec.key
        key = identifier | (EXTENDED if extended else 0)
        rows = order[slice(*np.searchsorted(sorted_ids, (key, key + 1)).tolist())]
        rows = rows[frames.flags[rows] & (REMOTE | ERROR) == 0]
        if not len(rows):
            other = key ^ EXTENDED
            count = int(np.subtract(*np.searchsorted(sorted_ids, (other + 1, other))))
            if spec.needed and count:
                faults[name] = (f"its identifier 0x{identifier:X} has {29 if extended else 11} bits in the DBC, and "
                                f"{count} frames of the log have it with {11 if extended else 29} bits")
            continue
        payload, lengths = frames.payload[rows], frames.length[rows]
        decoded = decode_log(table.database, frames.id[rows], payload, lengths, [name]).get(name)
        wrong_length = _wrong_length(spec, lengths, 0 if decoded is None else len(decoded.rows))
        if decoded is None:
            faults[name] = wrong_length
            continue
        rows, payload = rows[decoded.rows], payload[decoded.rows, : max(spec.dbc.length, 8)]
        time_ns = frames.time_ns[rows]
        ours = {signal.name: signal.si(decoded.signals) for signal in spec.signals}
        keep, valid, fault = check_frames(spec, payload, time_ns, ours)
        if fault or wrong_length:
            faults[name] = "; ".join(filter(None, (wrong_length, fault)))
        keep &= np.diff(time_ns, prepend=time_ns[0] - 1) > 0
        for our, values in with_unix_time(ours).items():
            good = keep & np.isfinite(values)
            if good.any():
                signals[our, name] = Signal(our, name, time_ns[good], values[good], valid[good], rows[good])
    return CanSignals(signals, faults)


def _wrong_length(spec: MessageSpec, lengths: np.ndarray, decoded: int) -> str:
    """Frames of another length than in the DBC, in words; empty for none. decoded: number of frames that were."""
    found = [f"{share(int(count), len(lengths), 'frames')} have {size} bytes"
             for size, count in zip(*np.unique(lengths, return_counts=True), strict=True) if size != spec.dbc.length]
    if not found:
        return ""
    lost = len(lengths) - decoded
    what = f"{lost} are not used" if lost else "the bytes behind are padding and were ignored"
    return f"{', '.join(found)}, the DBC gives {spec.dbc.length}; {what}"


def steering_of(signals: CanSignals, file: Path | str, table: SignalTable) -> Signal:
    """The steering wheel angle. Raises RunError with the message expected and the messages found."""
    steering = signals.first_of("steering_wheel_angle")
    if steering is not None:
        return steering
    source = table.source_of("steering_wheel_angle")
    expected = f"{source[0].name} (0x{source[0].dbc.frame_id:03X})" if source else "with the steering angle"
    if source and (fault := signals.faults.get(source[0].name)):
        raise RunError(file, f"the steering message {expected} cannot be used: {fault}", "correct the DBC or the table")
    found = sorted({message for _, message in signals.signals})
    raise RunError(file, f"the steering message {expected} is not in the log; "
                   + (f"it has {', '.join(found)}" if found else "none of the known messages is"),
                   "log the bus that carries it (Car-CAN), or give the DBC and table of this car")


def load_signal_table(dbc: Path, table: Path) -> SignalTable:
    """Raises RunError for a DBC or table that does not hold together."""
    try:
        return load_table(dbc, table)
    except ValueError as error:
        raise RunError(table, str(error).removeprefix(f"{table}: ")) from None
