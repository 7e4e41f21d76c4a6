"""From the frames of a log to the signals of the suite: what the live CAN bridge would have published, as columns."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from canedge_bridge import gps_time
from canedge_bridge.log_decode import MessageColumns, decode_log
from canedge_bridge.signals import ANGLES, MessageSpec, SignalTable, load_table
from st_core.leap_seconds import GPS_EPOCH_UNIX, at_all_gps

from .can_checks import check_frames
from .errors import RunError
from .frames import ERROR, EXTENDED, REMOTE, Frames


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
        payload = np.ascontiguousarray(frames.payload[rows, :8])
        decoded = decode_log(table.database, frames.id[rows], payload, frames.length[rows], [name]).get(name)
        if decoded is None:
            continue
        rows, payload = rows[decoded.rows], payload[decoded.rows]
        time_ns = frames.time_ns[rows]
        ours = _ours(spec, decoded)
        keep, valid, fault = check_frames(spec, payload, time_ns, ours)
        if fault:
            faults[name] = fault
        keep &= np.diff(time_ns, prepend=time_ns[0] - 1) > 0
        for our, values in with_unix_time(ours).items():
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
        raise RunError(table, str(error).removeprefix(f"{table}: ")) from None


def _ours(spec: MessageSpec, columns: MessageColumns) -> dict[str, np.ndarray]:
    values = {}
    for signal in spec.signals:
        value = signal.gain * columns.signals[signal.dbc.name] + signal.bias
        values[signal.name] = (value + np.pi) % (2 * np.pi) - np.pi if signal.name in ANGLES else value
    return values


def with_unix_time(values: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The parts of GPS time put together to UTC [s], NaN where they make none: canedge_bridge.gps_time in columns."""
    if "gps_time" in values:
        gps, offset = values["gps_time"], np.abs(values["gps_utc_offset"])
        as_unix = np.where(gps > 0, gps + GPS_EPOCH_UNIX, np.nan)
        unix = np.where(offset > 0, as_unix - offset, _to_utc(as_unix))
    elif "gps_century" in values:
        part = {name: values[name].astype(np.int64) for name in gps_time.DATE_TIME_PARTS[:6]}
        day = _day_number(part["gps_century"] * 100 + part["gps_year_of_century"], part["gps_month"], part["gps_day"])
        clock = (part["gps_hour"] < 24) & (part["gps_minute"] < 60)
        seconds = day * 86400.0 + part["gps_hour"] * 3600 + part["gps_minute"] * 60
        fraction = values["gps_second"] + values["gps_second_fraction"]
        unix = _to_utc(np.where(clock, seconds + fraction, np.nan))
    else:
        return values
    return {**{name: v for name, v in values.items() if not name.startswith("gps_")}, "ins_unix_time": unix}


def _to_utc(gps_as_unix: np.ndarray) -> np.ndarray:
    """GPS seconds on the Unix scale to UTC."""
    return gps_as_unix - at_all_gps(gps_as_unix - GPS_EPOCH_UNIX)


def _day_number(year: np.ndarray, month: np.ndarray, day: np.ndarray) -> np.ndarray:
    """Days since 1970-01-01, NaN where there is no such day."""
    possible = (year >= 1) & (year <= 9999) & (month >= 1) & (month <= 12) & (day >= 1)
    months = (np.where(possible, year, 1970) - 1970) * 12 + np.where(possible, month, 1) - 1
    first = months.astype("datetime64[M]").astype("datetime64[D]").astype(np.int64)
    following = (months + 1).astype("datetime64[M]").astype("datetime64[D]").astype(np.int64)
    return np.where(possible & (day <= following - first), first + day - 1.0, np.nan)
