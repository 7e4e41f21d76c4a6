"""Working copy of a drive for the checks, its windows in time, and ratios between its channels."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ..log import DriveLog
from ..timeseries import NANOSECOND
from ..types import body_to_map
from .finding import AuxiliaryData

MAX_GAP = 0.25  # s; nothing is integrated across a longer interval between samples
MOVING = 1.0  # m/s; slower driving is not used
MIN_DRIVEN_WINDOWS = 5
MIN_COHERENCE = 0.5  # cosine of the angle between successive displacements: 1 on a straight, 0 for a random walk
MIN_SPEED_VARIATION = 0.1  # minimum standard deviation of the speed divided by its mean
MIN_SIGNAL_TO_NOISE = 10.0  # minimum forward velocity divided by the standard deviation of its noise


@dataclass(frozen=True, eq=False)
class Motion:
    """A drive with signals as in DriveLog, corrected for the findings so far; accelerations may be NaN.

    speeds: (time [s], values [m/s]) of other sources of the forward speed, by name.
    """

    time: np.ndarray  # s since the first INS measurement
    x: np.ndarray
    y: np.ndarray
    yaw: np.ndarray
    velocity_x: np.ndarray
    velocity_y: np.ndarray
    yaw_rate: np.ndarray
    steering_time: np.ndarray  # s since the first INS measurement
    steering: np.ndarray  # road wheel angle at steering_time [rad], left +
    acceleration_x: np.ndarray | None = None
    acceleration_y: np.ndarray | None = None
    speeds: Mapping[str, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)
    geographic: bool = False  # see `AuxiliaryData`

    @classmethod
    def of(cls, log: DriveLog, start: int, auxiliary: AuxiliaryData) -> "Motion":
        """Working copy of a drive. start: zero of the times [ns]."""
        series = {"wheel_speed": auxiliary.wheel_speed, "ins_speed": auxiliary.ins_speed}
        speeds = {name: ((signal.time_ns - start) * NANOSECOND, signal.values)
                  for name, signal in series.items() if signal and len(signal.time_ns) > 1}
        return cls((log.ins_time_ns - start) * NANOSECOND, log.x - log.x[:1], log.y - log.y[:1], log.yaw,
                   log.velocity_x, log.velocity_y, log.yaw_rate, (log.steering_time_ns - start) * NANOSECOND,
                   log.road_wheel_angle, log.acceleration_x, log.acceleration_y, speeds, auxiliary.geographic)

    def with_time_divided(self, factor: float) -> "Motion":
        """The motion with all times divided by a factor."""
        speeds = {name: (time / factor, values) for name, (time, values) in self.speeds.items()}
        return replace(self, time=self.time / factor, steering_time=self.steering_time / factor, speeds=speeds)

    def where(self, keep: np.ndarray) -> "Motion":
        """The motion with only the INS samples selected by a mask (n,)."""
        names = ("time", "x", "y", "yaw", "velocity_x", "velocity_y", "yaw_rate", "acceleration_x", "acceleration_y")
        kept = {name: value[keep] for name in names if (value := getattr(self, name)) is not None}
        return replace(self, **kept)

    @property
    def speed(self) -> np.ndarray:
        """Speed over ground [m/s]."""
        return np.hypot(self.velocity_x, self.velocity_y)

    @property
    def velocity_map(self) -> tuple[np.ndarray, np.ndarray]:
        """Velocity in the map frame, (east, north) [m/s]: R(yaw) v."""
        return body_to_map(self.velocity_x, self.velocity_y, self.yaw)

    @property
    def moves_sideways(self) -> bool:
        """Whether the velocity is mainly lateral, which means that its axes are wrong."""
        return float(np.sum(self.velocity_y**2)) > float(np.sum(self.velocity_x**2))

    def steering_at_ins(self) -> np.ndarray:
        """Road wheel angle at the instants of the INS, NaN outside the recorded time."""
        if not len(self.steering_time):
            return np.full(len(self.time), np.nan)
        return np.interp(self.time, self.steering_time, self.steering, left=np.nan, right=np.nan)


def is_driven(motion: Motion) -> bool:
    """Whether the car drives, in any units: the speed from positions or velocity exceeds MOVING, and the direction of
    travel persists or the forward velocity far exceeds its noise. Neither is true of a parked car with drift."""
    length = max(1.0, 5.0 * float(np.median(np.diff(motion.time))))
    over = windows(motion.time, length, max(MAX_GAP, 0.5 * length))
    if len(over) < MIN_DRIVEN_WINDOWS:
        return True  # too short to judge
    displacement = over.change(motion.x) + 1j * over.change(motion.y)
    product = (displacement[1:] * np.conj(displacement[:-1]))[over.last[:-1] == over.first[1:]]
    speed = over.mean(motion.time, motion.velocity_x)
    noise = float(np.median(np.abs(np.diff(motion.velocity_x)))) / (0.6745 * np.sqrt(2.0))
    fastest = np.maximum(np.abs(displacement) / over.change(motion.time), np.abs(speed))
    if np.sum(fastest > MOVING) < MIN_DRIVEN_WINDOWS:
        return False
    return bool(np.sum(product.real) > MIN_COHERENCE * np.sum(np.abs(product)) > 0.0
                or np.sum(np.abs(speed) > MIN_SIGNAL_TO_NOISE * max(noise, 1e-9)) >= MIN_DRIVEN_WINDOWS)


def has_varying_speed(speed: np.ndarray) -> bool:
    """Whether the speed varies enough to separate effects that depend on different powers of it."""
    return float(np.std(speed)) > MIN_SPEED_VARIATION * abs(float(np.mean(speed)))


def integral(time: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """Trapezoidal integral from the first sample on, (n,)."""
    return np.concatenate(([0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(time))))


@dataclass(frozen=True, eq=False)
class Windows:
    """Windows without gaps, in order of time."""

    first: np.ndarray  # index of the first sample
    last: np.ndarray  # index of the last sample
    time: np.ndarray  # of the first sample [s]

    def change(self, values: np.ndarray) -> np.ndarray:
        """Change from start to end of each window."""
        return values[self.last] - values[self.first]

    def mean(self, time: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Time average in each window."""
        return self.change(integral(time, values)) / self.change(time)

    def __len__(self) -> int:
        return len(self.first)


def windows(time: np.ndarray, length: float, longest_gap: float = MAX_GAP) -> Windows:
    """Windows of `length` [s] in the stretches without a gap."""
    # The edges are found among the samples, not by counting windows, since a gap may last years.
    edges = np.flatnonzero(np.diff(np.floor((time - time[0]) / length), prepend=-1.0))
    first, last = edges[:-1], edges[1:]
    gaps = np.concatenate(([0], np.cumsum(np.diff(time) > longest_gap)))
    complete = (gaps[first] == gaps[last]) & (np.abs(time[last] - time[first] - length) < 0.5 * length)
    first, last = first[complete], last[complete]
    return Windows(first, last, time[first])


def stretches(times: np.ndarray, max_interval: float) -> tuple[tuple[float, float], ...]:
    """(first, last) instant [s] of each group of instants with intervals of at most `max_interval` [s]."""
    if not len(times):
        return ()
    edges = [0, *(np.flatnonzero(np.diff(times) > max_interval) + 1).tolist(), len(times)]
    return tuple((float(times[a]), float(times[b - 1])) for a, b in pairwise(edges))


def spans(mask: np.ndarray) -> list[tuple[int, int]]:
    """Indices (first, last) of each run of True in a mask (n,)."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], mask.astype(np.int8), [0]))))
    return list(zip(edges[::2].tolist(), (edges[1::2] - 1).tolist(), strict=True))


MIN_TURN, MIN_DISTANCE = 0.02, 0.5  # rad, m; minimum motion in a window
MIN_WINDOWS = 5
MIN_RATIO = 1e-10  # smallest ratio of two varying channels; nanoseconds read as seconds cause a ratio of 1e-9
SAME_RATIO_FACTOR = 1.2  # ratios that differ by less than this factor are taken as equal


class Ratios(NamedTuple):
    """Robust ratios between the changes of two channels in windows; NaN with too little motion."""

    distance: float  # positions to integrated velocity
    yaw_rate: float  # yaw to integrated yaw rate
    yaw_course: float  # yaw to course over ground
    rate_course: float  # integrated yaw rate to course over ground


def is_near(value: float, target: float, factor: float = SAME_RATIO_FACTOR) -> bool:
    """Whether two ratios have the same sign and differ by less than a factor."""
    return bool(np.isfinite(value) and value * target > 0.0 and 1.0 / factor < value / target < factor)


def ratios(motion: Motion, length: float = 1.0) -> Ratios:
    """Ratios of channels in windows of `length` [s]."""
    over = windows(motion.time, length, max(0.25, 0.5 * length))
    distance = np.hypot(over.change(motion.x), over.change(motion.y))
    integrated = over.change(integral(motion.time, motion.speed))
    integrated_rate = integral(motion.time, motion.yaw_rate)
    enough = (distance > MIN_DISTANCE) | (integrated > MIN_DISTANCE)
    weights, distance_ratio = integrated[enough], np.nan
    if len(weights) >= MIN_WINDOWS and weights.any():
        ratio = distance[enough] / np.maximum(weights, 1e-12)
        distance_ratio = _unless_constant(float(np.quantile(ratio, 0.5, weights=weights, method="inverted_cdf")))
    yaw_rate_ratio = _fit_slope(over.change(motion.yaw), over.change(integrated_rate))
    if len(over) < 2:
        return Ratios(distance_ratio, yaw_rate_ratio, np.nan, np.nan)
    # The course changes between the centres of adjacent windows.
    turn = np.diff(np.unwrap(np.arctan2(over.change(motion.y), over.change(motion.x))))
    # Only adjacent windows in which the car moves are used: at standstill the course is noise.
    moving = np.minimum(distance[1:], distance[:-1]) > max(0.3 * float(np.median(distance)), 1e-12)
    usable = (over.last[:-1] == over.first[1:]) & moving & (np.abs(turn) < 1.5)
    yaw, rate = (np.diff(over.mean(motion.time, values)) for values in (motion.yaw, integrated_rate))
    return Ratios(distance_ratio, yaw_rate_ratio, _fit_slope(yaw[usable], turn[usable]),
                  _fit_slope(rate[usable], turn[usable]))


def _unless_constant(ratio: float) -> float:
    """The ratio; NaN if one of the two channels is constant."""
    return ratio if MIN_RATIO < abs(ratio) < 1.0 / MIN_RATIO else float("nan")


def _fit_slope(top: np.ndarray, bottom: np.ndarray) -> float:
    """Robust slope of `top` versus `bottom`, with a small intercept that absorbs a bias of the yaw rate."""
    if len(top) < MIN_WINDOWS or max(np.percentile(np.abs(c), 95) for c in (top, bottom)) < MIN_TURN:
        return float("nan")
    smaller, larger = sorted((top, bottom), key=lambda turns: float(np.percentile(np.abs(turns), 95)))
    if float(np.percentile(np.abs(smaller), 95)) < MIN_TURN and (
            float(np.std(larger)) < 0.5 * abs(float(np.mean(larger)))):
        return float("nan")  # the smaller turn is only bias or noise
    weights, slope = np.ones(len(top)), float("nan")
    # The prior limits the intercept, which a drive on a circle does not determine.
    prior = (len(top) * MIN_TURN**2) / max(float(np.square(bottom).mean()), 1e-300)
    for _ in range(8):
        rows = np.array([[weights @ bottom**2, weights @ bottom], [weights @ bottom, weights.sum() + prior]])
        slope, intercept = np.linalg.lstsq(rows, [weights @ (bottom * top), weights @ top])[0]
        residual = np.abs(top - slope * bottom - intercept)
        weights = 1.0 / np.maximum(1.0, residual / (3.0 * max(float(np.median(residual)), 1e-12)))
    return _unless_constant(float(slope))
