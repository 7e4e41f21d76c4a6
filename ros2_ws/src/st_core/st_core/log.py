"""One recorded drive, ready for evaluation and identification: INS and steering on one clock, in SI, with gaps."""

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from .errors import StCoreError
from .vehicle import VehicleParameters

INS_SIGNALS = ("x", "y", "yaw", "velocity_x", "velocity_y", "yaw_rate")
OPTIONAL_INS_SIGNALS = ("acceleration_x", "acceleration_y")
STEERING = ("road_wheel_angle", "steering_wheel_angle")
SLOPE_HALF_WIDTH = 0.025  # s; a longer time would attenuate 2.5 Hz by over 3 %, a shorter one would amplify noise


@dataclass(frozen=True, eq=False)
class DriveLog:
    """Measurements of one drive, INS and steering each on its own time base. Arrays are read-only.

    The INS channels are at the INS point, in body axes forward and left. Gaps are not filled. Only OPTIONAL_INS_SIGNALS
    may be NaN. Raises StCoreError, naming the log and the signal, if an array violates these rules.
    """

    name: str
    ins_time_ns: np.ndarray  # int64 UTC nanoseconds since the Unix epoch, strictly increasing
    x: np.ndarray  # map frame, east [m]
    y: np.ndarray  # map frame, north [m]
    yaw: np.ndarray  # from east counter-clockwise, unwrapped [rad]
    velocity_x: np.ndarray  # m/s, forward
    velocity_y: np.ndarray  # m/s, left
    yaw_rate: np.ndarray  # rad/s, left turn +
    steering_time_ns: np.ndarray  # as ins_time_ns, on the clock of the INS
    road_wheel_angle: np.ndarray  # mean of the front axle [rad], left +
    steering_wheel_angle: np.ndarray | None = None  # as measured, with its offset [rad], left +
    acceleration_x: np.ndarray | None = None  # as the source defines it [m/s^2], NaN at samples without a value
    acceleration_y: np.ndarray | None = None  # as acceleration_x
    sideslip_measured: bool = True  # False: velocity_y and yaw are from the vehicle file (`sideslip`)

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
    def overlap(self) -> float:
        """Duration of the common time of INS and steering [s]; 0 if there is none."""
        if not len(self.ins_time_ns) or not len(self.steering_time_ns):
            return 0.0
        start = max(int(self.ins_time_ns[0]), int(self.steering_time_ns[0]))
        end = min(int(self.ins_time_ns[-1]), int(self.steering_time_ns[-1]))
        return max(end - start, 0) * 1e-9

    def select_ins(self, rows: np.ndarray) -> "DriveLog":
        """The log with the INS samples `rows` (mask or indices) and all steering samples."""
        names = ("ins_time_ns", *INS_SIGNALS, *OPTIONAL_INS_SIGNALS)
        return replace(self, **{name: getattr(self, name)[rows] for name in names if getattr(self, name) is not None})

    def slice(self, start_ns: int, end_ns: int, name: str | None = None) -> "DriveLog":
        """The measurements with start_ns <= time <= end_ns, of both time bases. name: of the result; None: the same."""
        span = (start_ns, end_ns + 1)
        ins, steering = (slice(*np.searchsorted(t, span).tolist()) for t in (self.ins_time_ns, self.steering_time_ns))
        parts: dict[str, Any] = {}
        for key in (column.name for column in fields(self)):
            value = getattr(self, key)
            if isinstance(value, np.ndarray):
                parts[key] = value[steering if key in ("steering_time_ns", *STEERING) else ins]
        return replace(self, name=name or self.name, **parts)

    def with_steering(self, vehicle: VehicleParameters) -> "DriveLog":
        """The same drive with the road wheel angle by the steering ratio and offset of `vehicle`.

            road_wheel_angle = (steering_wheel_angle - steering_wheel_offset) / steering_ratio      [rad, left +]

        Raises StCoreError for a log without steering_wheel_angle.
        """
        if self.steering_wheel_angle is None:
            raise StCoreError(f"{self.name}: without a steering wheel angle the road wheel angle cannot be computed")
        return replace(self, road_wheel_angle=vehicle.road_wheel_angle(self.steering_wheel_angle))
