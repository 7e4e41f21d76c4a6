"""Decodes CAN frames to checked signals under canonical names in SI units, and encodes frames for a simulated car."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import can
from cantools.database.can import Signal as DbcSignal
from st_core import vehicle
from st_core.errors import ConfigurationError
from st_core.types import Number

from .checks import CounterCheck, Mode
from .extraction import raw_range, strip_padding
from .ins_time import split_unix_time
from .plausibility import Plausibility
from .signals import WRAPPED_SIGNALS, MessageSpec, SignalSpec, SignalTable, load_table


@dataclass(frozen=True)
class DecodedFrame:
    """One decoded frame, received at time_ns [ns since 1970]. values: by canonical name, in SI units; parts of
    GPS time as in `ins_time.replace_gps_time`. valid: false if a counter or checksum in mode `warn` was wrong."""

    message: str
    time_ns: int
    values: Mapping[str, float]
    valid: bool = True


@dataclass
class MessageStatistics:
    """Counts of the frames of one message."""

    good: int = 0  # decoded, even if a check in mode `warn` failed
    bad: int = 0  # with at least one fault
    wrong_length: int = 0
    wrong_checksum: int = 0
    wrong_counter: int = 0
    not_finite: int = 0
    implausible: int = 0  # with an implausible value; plausible frames that are withheld do not count
    dropped: int = 0  # failed a check in mode `drop`
    lost: int = 0  # missing according to the counter
    last_seen_ns: int | None = None  # time of the last good frame with values


class _MessageState:
    """State of the decoder for one message. plausibility: checks of signals with limits, by canonical name."""

    def __init__(self, spec: MessageSpec) -> None:
        self.spec, self.statistics = spec, MessageStatistics()
        self.counter = CounterCheck(spec.counter.field, spec.timeout_ns) if spec.counter else None
        self.plausibility = {s.name: Plausibility(s, spec) for s in spec.signals if s.is_limited}


class Decoder:
    """Decodes the messages of one signal table. The constructor raises ConfigurationError, like `load_table`.

    `decode` never raises: it counts faults, and rejects a frame with a wrong length, with a wrong counter or checksum
    in mode drop, or with a value that is not finite or not plausible. skipped: counts of frames that are not decoded,
    by reason: "error" frame, "remote" frame, "unknown" identifier.
    """

    def __init__(self, dbc_file: str | Path, signals_file: str | Path, needed: Sequence[str] = (),
                 checks: Mapping[str, str] | None = None):
        """checks: overrides of the table, `MESSAGE`, `MESSAGE.counter` or `MESSAGE.checksum` -> off, warn or drop."""
        self.table = _override_checks(load_table(dbc_file, signals_file, needed), checks or {})
        self.skipped: Counter[str] = Counter()
        self._states = {spec.key: _MessageState(spec) for spec in self.table.messages.values()}

    @property
    def keys(self) -> list[tuple[int, bool]]:
        """(arbitration id, whether it has 29 bits) of every message of the table, for a bus filter."""
        return list(self._states)

    def statistics(self, message: str) -> MessageStatistics:
        return self._states[self.table.messages[message].key].statistics

    def decode(self, frame: can.Message, time_ns: int, needed_only: bool = False) -> DecodedFrame | None:
        """The signals of a frame received at time_ns; None if skipped, rejected, withheld or without known signals.
        needed_only: skip optional messages, to catch up with a backlog of frames."""
        reason = "error" if frame.is_error_frame else "remote" if frame.is_remote_frame else "unknown"
        state = self._states.get((frame.arbitration_id, frame.is_extended_id)) if reason == "unknown" else None
        if state is None:
            self.skipped[reason] += 1
            return None
        spec, statistics = state.spec, state.statistics
        if needed_only and not spec.is_needed:
            if state.counter is not None:
                state.counter.skip(time_ns)
            return None
        data = strip_padding(bytes(frame.data), spec.dbc.length)
        if data is None:
            statistics.wrong_length += 1
            statistics.bad += 1
            return None
        reaction = self._check_integrity(state, data, time_ns)
        statistics.bad += reaction is not Mode.OFF
        if reaction is Mode.DROP:
            statistics.dropped += 1
            return None
        values = spec.to_si(data)
        if not all(map(math.isfinite, values.values())):
            statistics.not_finite += 1
            statistics.bad += reaction is Mode.OFF
            return None
        plausible = [state.plausibility[name].accepts(value, time_ns) for name, value in values.items()
                     if name in state.plausibility]
        if not all(plausible):
            statistics.implausible += 1
            statistics.bad += reaction is Mode.OFF
            return None
        if any(check.fault for check in state.plausibility.values()):  # then a value may be in range by chance
            return None
        statistics.good += 1
        if not values:  # a multiplexed frame without any signal of the table
            return None
        statistics.last_seen_ns = time_ns
        return DecodedFrame(spec.name, time_ns, values, reaction is Mode.OFF)

    def plausibility_faults(self) -> list[str]:
        """Faults of the signals with implausible values that currently cause messages to be withheld."""
        return [check.fault for state in self._states.values() for check in state.plausibility.values()
                if check.fault]

    def _check_integrity(self, state: _MessageState, data: bytes, time_ns: int) -> Mode:
        """Mode of the first check that the frame fails, in the order checksum, counter; OFF if it passes both."""
        spec, statistics = state.spec, state.statistics
        checksum, counter = spec.checksum, spec.counter
        if checksum and checksum.mode is not Mode.OFF and not checksum.is_correct(data, spec.dbc.frame_id):
            statistics.wrong_checksum += 1
            if state.counter is not None:
                state.counter.skip(time_ns)
            return checksum.mode
        if counter and state.counter is not None and counter.mode is not Mode.OFF:
            is_correct = state.counter.accepts(data, time_ns)
            statistics.lost = state.counter.lost
            if not is_correct:
                statistics.wrong_counter += 1
                return counter.mode
        return Mode.OFF

    def encode(self, message: str, values: Mapping[str, float], counter: int = 0) -> can.Message:
        """A frame with correct counter and checksum.

        message: any message of the DBC. values: by canonical name in SI units, or by DBC name in the DBC's unit; a
        message with GPS time takes `ins_unix_time`. Other signals get the `fill` value of the table, or raw 0. A value
        outside the range of its signal is clipped, as by a sensor; WRAPPED_SIGNALS are wrapped into the DBC's range.
        Raises KeyError for an unknown message or signal, ValueError for a value that is not finite.
        """
        dbc = self.table.database.get_message_by_name(message)
        spec = self.table.messages.get(message)
        canonical = {s.name: s for s in spec.signals} if spec else {}
        by_name = {s.name: s for s in dbc.signals}
        raw: dict[str, float] = {**dict.fromkeys(by_name, 0), **(spec.fill if spec else {})}
        given = dict(values)
        if spec and "ins_unix_time" in given and "ins_unix_time" not in canonical:
            given.update(split_unix_time(given.pop("ins_unix_time"), frozenset(canonical)))
        for name, value in given.items():
            if not math.isfinite(value):
                raise ValueError(f"{message}.{name}: {value} cannot be encoded: expected a finite number")
            if name in canonical:
                raw[canonical[name].dbc.name] = _si_to_raw(canonical[name], value)
                if (sign := canonical[name].sign) is not None:
                    raw[sign.signal.name] = int(canonical[name].to_physical(value) < 0)
            elif name in by_name:
                raw[name] = _physical_to_raw(by_name[name], value)
            else:
                raise KeyError(f"{message} has no signal {name}")
        if spec and spec.counter:
            raw[spec.counter.signal] = counter & spec.counter.field.mask
        data = dbc.encode(raw, scaling=False, strict=False)
        if spec and spec.checksum:
            raw[spec.checksum.signal] = spec.checksum.compute(data, dbc.frame_id)
            data = dbc.encode(raw, scaling=False, strict=False)
        return can.Message(arbitration_id=dbc.frame_id, is_extended_id=dbc.is_extended_frame, data=data)


def _si_to_raw(spec: SignalSpec, si: float) -> float:
    physical = spec.to_physical(si)
    if spec.sign is not None:
        physical = abs(physical)
    if spec.name in WRAPPED_SIGNALS and spec.dbc.minimum is not None:
        turn = 2 * math.pi / abs(spec.gain)
        step = abs(spec.dbc.scale)
        # Rounded first, so that 359.996 deg is sent as 0, not as 360.00.
        physical = spec.dbc.minimum + (round(physical / step) * step - spec.dbc.minimum + step / 4) % turn - step / 4
    return _physical_to_raw(spec.dbc, physical)


def _physical_to_raw(signal: DbcSignal, physical: float) -> float:
    if signal.is_float:
        return (physical - signal.offset) / signal.scale
    low, high = raw_range(signal)
    return min(max(round((physical - signal.offset) / signal.scale), low), high)


def _override_checks(table: SignalTable, overrides: Mapping[str, str]) -> SignalTable:
    """The table with the given modes for counters and checksums. Raises ConfigurationError for an invalid override."""
    messages = dict(table.messages)
    for key, text in overrides.items():
        message, _, kind = key.partition(".")
        if message not in messages or kind not in ("", "counter", "checksum"):
            raise ConfigurationError(f"check {key}: expected MESSAGE, MESSAGE.counter or MESSAGE.checksum; messages: "
                                     f"{', '.join(messages)}")
        if text not in list(Mode):
            raise ConfigurationError(f"check {key}: {text!r} is not one of {', '.join(Mode)}")
        for name in [kind] if kind else ["counter", "checksum"]:
            if check := getattr(messages[message], name):
                messages[message] = replace(messages[message], **{name: replace(check, mode=Mode(text))})
    return replace(table, messages=messages)


@dataclass(frozen=True)
class SteeringCalibration:
    """Conversion to road_wheel_angle [rad] = (steering_sign * sensor - steering_wheel_offset) / steering_ratio.

    steering_sign: +1 if the decoded sensor value is positive to the left, -1 if positive to the right.
    steering_wheel_offset: steering_sign * sensor when driving straight [rad]. steering_ratio [1].
    """

    steering_sign: int
    steering_wheel_offset: float
    steering_ratio: float

    def convert(self, sensor: Number) -> tuple[Number, Number]:
        """(steering-wheel angle with offset, mean road-wheel angle of the front axle) [rad], positive to the left."""
        angle = self.steering_sign * sensor
        return angle, vehicle.road_wheel_angle(angle, self.steering_wheel_offset, self.steering_ratio)

    def formula(self) -> str:
        """Formula of the conversion with the values of the car, as text for the log."""
        offset = math.degrees(self.steering_wheel_offset)
        return (f"road_wheel_angle = ({self.steering_sign:+d} * sensor - ({self.steering_wheel_offset:.6f} rad)) / "
                f"{self.steering_ratio:g}, positive to the left; steering_wheel_offset = {offset:.3f} deg, so sensor "
                f"value 0 gives {math.degrees(self.convert(0.0)[1]):.4f} deg")
