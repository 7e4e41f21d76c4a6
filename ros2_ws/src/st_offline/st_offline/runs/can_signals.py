"""From the frames of a log to the signals of the suite: what the live CAN bridge would have published, as columns."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from canedge_bridge import gps_time
from canedge_bridge.log_decode import MessageColumns, decode_log
from canedge_bridge.signals import ANGLES, MessageSpec, SignalTable, load_table

from .can_checks import check_frames
from .errors import RunError
from .frames import Frames


@dataclass(frozen=True)
class Signal:
    """One of our signals as one message brought it: SI, signs as in the table.

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
    data = np.nonzero(frames.is_data)[0]
    payload = np.ascontiguousarray(frames.payload[:, :8])
    everything = len(data) == len(frames)
    decoded = decode_log(table.database, *(a if everything else a[data] for a in (frames.id, payload, frames.length)),
                         messages=list(table.messages))
    signals: dict[tuple[str, str], Signal] = {}
    faults: dict[str, str] = {}
    for name, columns in decoded.items():
        spec = table.messages[name]
        rows = columns.rows if everything else data[columns.rows]
        time_ns = frames.time_ns[rows]
        ours = _ours(spec, columns)
        keep, valid, fault = check_frames(spec, payload[rows], time_ns, ours)
        if fault:
            faults[name] = fault
        keep &= np.diff(time_ns, prepend=time_ns[0] - 1) > 0
        for our, values in _with_unix_time(ours).items():
            good = keep & np.isfinite(values)
            if good.any():
                signals[our, name] = Signal(our, name, time_ns[good], values[good], valid[good], rows[good])
    return CanSignals(signals, faults)


def steering_of(signals: CanSignals, file: Path | str, table: SignalTable) -> Signal:
    """The steering wheel angle. Raises RunError that says which message was looked for and what is there instead."""
    steering = signals.first_of("steering_wheel_angle")
    if steering is not None:
        return steering
    source = table.source_of("steering_wheel_angle")
    wanted = f"{source[0].name} (0x{source[0].dbc.frame_id:03X})" if source else "a steering message"
    there = sorted({message for _, message in signals.signals})
    raise RunError(file, f"the steering message {wanted} is not in the log; "
                   + (f"it has {', '.join(there)}" if there else "none of the known messages is"),
                   "log the bus that carries it (Car-CAN), or give the DBC and table of this car")


def load_signal_table(dbc: Path, table: Path) -> SignalTable:
    """Raises RunError for a DBC or table that does not hold together."""
    try:
        return load_table(dbc, table)
    except ValueError as error:
        raise RunError(table, str(error)) from None


def _ours(spec: MessageSpec, columns: MessageColumns) -> dict[str, np.ndarray]:
    values = {}
    for signal in spec.signals:
        value = signal.gain * columns.signals[signal.dbc.name] + signal.bias
        values[signal.name] = (value + np.pi) % (2 * np.pi) - np.pi if signal.name in ANGLES else value
    return values


def _with_unix_time(values: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The parts of GPS time put together to UTC [s]."""
    to_unix = None
    if "gps_time" in values:
        to_unix, parts = gps_time.from_milli_time, gps_time.MILLI_TIME_PARTS
    elif "gps_century" in values:
        to_unix, parts = gps_time.from_date_time, gps_time.DATE_TIME_PARTS
    if to_unix is not None:
        rows = np.stack([values[p] for p in parts], axis=1).tolist()
        values = {**values, "ins_unix_time": np.array([to_unix(dict(zip(parts, row, strict=True))) for row in rows])}
    return {name: value for name, value in values.items() if not name.startswith("gps_")}


__all__ = ["CanSignals", "Signal", "decode_signals", "load_signal_table", "steering_of"]
