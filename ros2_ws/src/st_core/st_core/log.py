"""One recorded drive, with INS and steering on one clock in SI units, and its signals interpolated at any instant."""

from copy import copy
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np

from .errors import StCoreError
from .timeseries import NANOSECOND, Neighbours, filtered_derivative, find_neighbours
from .types import STATE_NAMES, InsSample, ins_to_cg
from .vehicle import VehicleParameters

INS_SIGNALS = ("x", "y", "yaw", "velocity_x", "velocity_y", "yaw_rate")
OPTIONAL_INS_SIGNALS = ("acceleration_x", "acceleration_y")
STEERING = ("road_wheel_angle", "steering_wheel_angle")  # signals on the time base of the steering
FilterMode = Literal["causal", "zero_phase"]
SLOPE_HALF_WIDTH = 0.025  # s; longer: 2.5 Hz attenuated by over 2.5 %, shorter: more noise


@dataclass(frozen=True, eq=False)
class DriveLog:
    """Measurements of one drive, INS and steering each on its own time base. Arrays are read-only.

    INS signals are those of the INS point, with velocity and acceleration in body axes. Gaps are not filled. Only
    OPTIONAL_INS_SIGNALS may be NaN. Raises StCoreError, naming log and signal, if an array violates these rules.
    """

    name: str
    ins_time_ns: np.ndarray  # int64 UTC nanoseconds since the Unix epoch, strictly increasing
    x: np.ndarray  # map frame, east [m]
    y: np.ndarray  # map frame, north [m]
    yaw: np.ndarray  # from east counter-clockwise, unwrapped [rad]
    velocity_x: np.ndarray  # m/s, forward
    velocity_y: np.ndarray  # m/s, left
    yaw_rate: np.ndarray  # rad/s, positive in left turns
    steering_time_ns: np.ndarray  # as ins_time_ns, on the clock of the INS
    road_wheel_angle: np.ndarray  # mean of the front axle [rad], positive to the left
    steering_wheel_angle: np.ndarray | None = None  # as measured, with its offset [rad], positive to the left
    acceleration_x: np.ndarray | None = None  # as recorded [m/s^2], NaN at samples without a value
    acceleration_y: np.ndarray | None = None  # as acceleration_x
    sideslip_measured: bool = True  # False: velocity_y and yaw are computed with the vehicle file (`sideslip`)

    def __post_init__(self) -> None:
        for base, signals in (("ins_time_ns", (*INS_SIGNALS, *OPTIONAL_INS_SIGNALS)), ("steering_time_ns", STEERING)):
            time = np.asarray(getattr(self, base))
            if time.ndim != 1 or time.dtype.kind != "i":
                raise StCoreError(f"{self.name}: {base} must be one-dimensional, in whole nanoseconds")
            if len(time) > 1 and not (np.diff(time) > 0).all():
                raise StCoreError(f"{self.name}: {base} is not strictly increasing")
            self._store_read_only(base, time, np.int64)
            for signal in signals:
                value = getattr(self, signal)
                if value is None and signal in (*OPTIONAL_INS_SIGNALS, "steering_wheel_angle"):
                    continue
                value = np.asarray(value, dtype=float)
                if value.shape != time.shape:
                    raise StCoreError(f"{self.name}: {signal} has {value.size} values, {base} has {len(time)}")
                if signal not in OPTIONAL_INS_SIGNALS and not np.isfinite(value).all():
                    raise StCoreError(f"{self.name}: {signal} has values that are not finite")
                self._store_read_only(signal, value, float)

    def _store_read_only(self, field: str, value: np.ndarray, dtype: type) -> None:
        view: np.ndarray = np.ascontiguousarray(value, dtype=dtype).view()
        view.flags.writeable = False
        object.__setattr__(self, field, view)

    @property
    def start_ns(self) -> int:
        """Time of the first measurement [ns]; 0 for an empty log."""
        return min((int(t[0]) for t in (self.ins_time_ns, self.steering_time_ns) if len(t)), default=0)

    @property
    def end_ns(self) -> int:
        """Time of the last measurement [ns]; 0 for an empty log."""
        return max((int(t[-1]) for t in (self.ins_time_ns, self.steering_time_ns) if len(t)), default=0)

    @property
    def duration(self) -> float:
        """Time from the first to the last INS measurement [s]; 0 with fewer than two."""
        return (int(self.ins_time_ns[-1]) - int(self.ins_time_ns[0])) * 1e-9 if len(self.ins_time_ns) else 0.0

    @cached_property
    def yaw_acceleration(self) -> np.ndarray:
        """Slope of the yaw rate about each INS sample, without delay [rad/s^2]; 0 with fewer than two samples."""
        seconds = (self.ins_time_ns - self.ins_time_ns[:1]) * 1e-9
        if len(seconds) < 2:
            return np.zeros(len(seconds))
        low = np.maximum(seconds - SLOPE_HALF_WIDTH, 0.0)
        high = np.minimum(seconds + SLOPE_HALF_WIDTH, seconds[-1])
        before, after = (np.interp(t, seconds, self.yaw_rate) for t in (low, high))
        return (after - before) / (high - low)

    @property
    def common_span_ns(self) -> tuple[int, int]:
        """First and last instant with INS and steering [ns]; first > last without overlap, (0, 0) if one is empty."""
        times = self.ins_time_ns, self.steering_time_ns
        if not all(map(len, times)):
            return 0, 0
        return max(int(t[0]) for t in times), min(int(t[-1]) for t in times)

    @property
    def overlap(self) -> float:
        """Duration of `common_span_ns` [s]; 0 if INS and steering do not overlap."""
        start, end = self.common_span_ns
        return max(end - start, 0) * 1e-9

    def select_ins(self, rows: np.ndarray) -> "DriveLog":
        """The log with the INS samples `rows` (mask or indices) and all steering samples."""
        names = ("ins_time_ns", *INS_SIGNALS, *OPTIONAL_INS_SIGNALS)
        return replace(self, **{name: getattr(self, name)[rows] for name in names if getattr(self, name) is not None})

    def slice(self, start_ns: int, end_ns: int, name: str | None = None) -> "DriveLog":
        """The measurements with start_ns <= time <= end_ns, of both time bases. name: by default that of this log."""
        span = (start_ns, end_ns + 1)
        ins, steering = (slice(*np.searchsorted(t, span).tolist()) for t in (self.ins_time_ns, self.steering_time_ns))
        slices = dict.fromkeys(("steering_time_ns", *STEERING), steering)
        parts: dict[str, Any] = {column.name: value[slices.get(column.name, ins)] for column in fields(self)
                                 if isinstance(value := getattr(self, column.name), np.ndarray)}
        return replace(self, name=name or self.name, **parts)

    def with_steering(self, vehicle: VehicleParameters) -> "DriveLog":
        """The same drive with the road wheel angle from the steering ratio and offset of `vehicle`.

            road_wheel_angle = (steering_wheel_angle - steering_wheel_offset) / steering_ratio      [rad]

        Raises StCoreError for a log without steering_wheel_angle.
        """
        if self.steering_wheel_angle is None:
            raise StCoreError(f"{self.name}: without a steering wheel angle the road wheel angle cannot be computed")
        return replace(self, road_wheel_angle=vehicle.road_wheel_angle(self.steering_wheel_angle))


def shares_memory(log: DriveLog, other: DriveLog, *names: str) -> bool:
    """Whether the named arrays of two drives are views of the same memory."""
    pairs = [(getattr(log, name), getattr(other, name)) for name in names]
    return all(a.size == b.size and a.ctypes.data == b.ctypes.data for a, b in pairs)


class LogSignals:
    """Measurements of a DriveLog interpolated at any instant; NaN in gaps. The vectorised counterpart of
    `MeasurementHistory`: causal results are identical, but position jumps are not detected. Checked by: test_batch.py.

    maximum_gap [s], filter_cutoff [Hz], mode: as maximum_gap, cutoff, mode of `timeseries.filtered_derivative`.
    """

    def __init__(self, log: DriveLog, maximum_gap: float = 0.1, filter_cutoff: float = 5.0,
                 mode: FilterMode = "causal"):
        self.log = log
        self.maximum_gap = maximum_gap
        self._gap_ns = round(maximum_gap / NANOSECOND)
        self._filter: tuple[float, FilterMode] = (filter_cutoff, mode)
        _, self.velocity_x_dot = filtered_derivative(
            log.ins_time_ns, log.velocity_x, filter_cutoff, maximum_gap, mode)

    def for_log(self, log: DriveLog) -> "LogSignals":
        """The signals of another drive with the same settings; they share the derivative if the logs share speeds."""
        if not shares_memory(log, self.log, "ins_time_ns", "velocity_x"):
            return LogSignals(log, self.maximum_gap, *self._filter)
        other = copy(self)
        other.log = log
        return other

    def ins_at(self, times_ns: np.ndarray, *names: str) -> list[np.ndarray]:
        """The named INS signals (fields of DriveLog, or velocity_x_dot) at instants of any shape [ns]."""
        columns = [self.velocity_x_dot if name == "velocity_x_dot" else getattr(self.log, name) for name in names]
        return self._at(self.log.ins_time_ns, columns, times_ns)

    def road_wheel_angle_at(self, times_ns: np.ndarray) -> np.ndarray:
        """Road wheel angle [rad], positive to the left, at instants of any shape [ns]."""
        return self.sample(self.log.steering_time_ns, self.log.road_wheel_angle, times_ns)

    def sample(self, time_ns: np.ndarray, values: np.ndarray, at_ns: np.ndarray) -> np.ndarray:
        """Any signal, sampled at time_ns [ns, ascending], at instants `at_ns` of any shape [ns]."""
        return self._at(time_ns, [values], at_ns)[0]

    def states_at(self, times_ns: np.ndarray, vehicle: VehicleParameters) -> np.ndarray:
        """States at the CG, (n, 6), columns as types.STATE_NAMES; see `types.ins_to_cg`."""
        sample = InsSample._make((0, *self.ins_at(times_ns, *INS_SIGNALS)))
        state = ins_to_cg(sample, vehicle.cg_to_ins_x, vehicle.cg_to_ins_y)
        return np.stack([getattr(state, name) for name in STATE_NAMES], axis=-1)

    def _at(self, times: np.ndarray, columns: list[np.ndarray], instants: np.ndarray) -> list[np.ndarray]:
        instants = np.asarray(instants, np.int64)
        if not len(times):
            return [np.full(instants.shape, np.nan) for _ in columns]
        neighbours = self._find_neighbours(times, instants)
        return [neighbours.interpolate(column) for column in columns]

    def _find_neighbours(self, times: np.ndarray, instants: np.ndarray) -> Neighbours:
        return find_neighbours(times, instants, self._gap_ns)
