"""A drive with its auxiliary signals, and edits that several faults use."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from st_core.checks import AuxiliaryData, InsQuality, Series
from st_core.log import DriveLog
from st_core.vehicle import VehicleParameters

RTK_INTEGER, LOCKED = 6, 4  # NCOM position mode, navigation status
WHEEL_NOISE = 0.02  # m/s
STEERING = ("road_wheel_angle", "steering_wheel_angle")


@dataclass(frozen=True, eq=False)
class Recording:
    """A drive with its vehicle file. real: a real drive, which may have unknown faults.

    baseline: for a virtual drive, finding -> true value without a fault, if that is not 1 (scales) or 0 (offsets).
    """

    log: DriveLog
    vehicle: VehicleParameters
    real: bool
    auxiliary: AuxiliaryData = field(default_factory=AuxiliaryData)
    baseline: Mapping[str, float] = field(default_factory=dict)

    @property
    def name(self) -> str:
        return self.log.name

    @property
    def time(self) -> np.ndarray:
        """Times of the INS rows since the first one [s]."""
        return (self.log.ins_time_ns - self.log.ins_time_ns[0]) * 1e-9

    def with_log(self, **fields) -> "Recording":
        return replace(self, log=replace(self.log, **fields))

    def with_auxiliary(self, **fields) -> "Recording":
        return replace(self, auxiliary=replace(self.auxiliary, **fields))

    def between(self, start_ns: int, end_ns: int) -> "Recording":
        """The part of the recording between two times [ns], without `stamps`, which belong to the whole recording."""
        auxiliary = {name: None if (part := getattr(self.auxiliary, name)) is None else _rows(
            part, (part.time_ns >= start_ns) & (part.time_ns <= end_ns)) for name in TIMED}
        return replace(self, log=self.log.slice(start_ns, end_ns),
                       auxiliary=replace(self.auxiliary, stamps={}, **auxiliary))


TIMED = ("wheel_speed", "ins_speed", "quality")
"""Parts of AuxiliaryData with time stamps."""


def _rows(part: Series | InsQuality, rows: np.ndarray) -> Series | InsQuality:
    return replace(part, **{name: getattr(part, name)[rows] for name in part.__dataclass_fields__})


def middle_half(recording: Recording) -> Recording:
    """The middle half of a recording."""
    start, end = int(recording.log.ins_time_ns[0]), int(recording.log.ins_time_ns[-1])
    quarter = (end - start) // 4
    return recording.between(start + quarter, end - quarter)


def select_rows(recording: Recording, ins: np.ndarray, steering: np.ndarray) -> Recording:
    """The recording with only those rows of the log that the masks select."""
    log = recording.log
    fields = {name: value[steering if "steering" in name or "wheel" in name else ins]
              for name in log.__dataclass_fields__ if isinstance(value := getattr(log, name), np.ndarray)}
    return replace(recording, log=replace(log, **fields))


def delay_channels(recording: Recording, seconds: float, *channels: str) -> Recording:
    """Delays channels by `seconds`; the ends, where their values become unknown, are removed."""
    log, fields = recording.log, {}
    for channel in channels:
        if (values := getattr(log, channel)) is not None:
            time = log.steering_time_ns if channel in STEERING else log.ins_time_ns
            fields[channel] = _delay(time, values, seconds)
    cut = round(abs(seconds) * 1e9)
    return recording.with_log(**fields).between(log.start_ns + cut, log.end_ns - cut)


def delay_series(series: Series, seconds: float) -> Series:
    return replace(series, values=_delay(series.time_ns, series.values, seconds))


def _delay(time_ns: np.ndarray, values: np.ndarray, seconds: float) -> np.ndarray:
    time = (time_ns - time_ns[0]) * 1e-9
    return np.interp(time - seconds, time, values)


def with_good_quality(recording: Recording) -> Recording:
    """Adds the status of a unit with uninterrupted RTK."""
    time = recording.log.ins_time_ns
    level = np.ones(len(time))
    return recording.with_auxiliary(quality=InsQuality(time, LOCKED * level, RTK_INTEGER * level, 0.01 * level))


def with_wheel_speed(recording: Recording) -> Recording:
    """Adds a correct wheel speed: the forward velocity of every second INS row, with a little noise."""
    return recording.with_auxiliary(wheel_speed=_noisy_speed(recording, WHEEL_NOISE))


def with_ins_speed(recording: Recording) -> Recording:
    return recording.with_auxiliary(ins_speed=_noisy_speed(recording, 0.002))


def _noisy_speed(recording: Recording, noise: float) -> Series:
    speed = recording.log.velocity_x[::2]
    return Series(recording.log.ins_time_ns[::2], speed + noise * np.random.default_rng(5).standard_normal(len(speed)))


def with_stamps(recording: Recording) -> Recording:
    """Adds time stamps without a fault."""
    log = recording.log
    return recording.with_auxiliary(stamps={"INS": log.ins_time_ns, "steering": log.steering_time_ns})
