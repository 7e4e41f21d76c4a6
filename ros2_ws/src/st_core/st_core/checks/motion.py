"""A drive as corrected by the checks, its time windows, and ratios between its channels."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import cumulative_trapezoid

from ..corrections import COMPONENTS
from ..log import INS_SIGNALS, DriveLog
from ..timeseries import NANOSECOND
from .finding import AuxiliaryData

MAX_GAP = 0.25  # s; longest interval between samples within a window, unless stated otherwise
MAX_LISTED_TIMES = 20  # largest number of time intervals listed in most findings
MIN_MOVING_SPEED = 1.0  # m/s; slower driving is not used
MIN_DRIVEN_WINDOWS = 5
MIN_COHERENCE = 0.5  # cosine of the angle between successive displacements: 1 on a straight, 0 for a random walk
MIN_SPEED_VARIATION = 0.1  # minimum standard deviation of the speed divided by its mean
MIN_SIGNAL_TO_NOISE = 10.0  # minimum forward velocity divided by the standard deviation of its noise
MIN_TURN, MIN_DISTANCE = 0.02, 0.5  # rad, m; minimum motion in a window that is used
MIN_WINDOWS = 5
MAX_TURN = 1.5  # rad; largest change of the course between adjacent windows that is not ambiguous
MAX_MEDIAN_TURN, MIN_HALVED_LENGTH = 1.0, 0.2  # rad, s; longer windows with a larger median turn are halved
MIN_RATIO = 1e-10  # smallest ratio of two varying channels; nanoseconds read as seconds cause a ratio of 1e-9
SAME_RATIO_FACTOR = 1.2  # ratios that differ by less than this factor are taken as equal
SPACING_SAMPLES = 50  # number of averaged intervals: several bursts, a few seconds at most
EQUATORIAL_RADIUS = 6378137.0  # m, of WGS 84 and web Mercator
SLOPE_ITERATIONS = 8  # number of iterations of the robust fit of a slope


@dataclass(frozen=True, eq=False)
class Motion:
    """A drive corrected for the findings so far, with signals as in DriveLog; accelerations may be NaN."""

    time: np.ndarray  # s since the first INS measurement
    x: np.ndarray
    y: np.ndarray
    yaw: np.ndarray
    velocity_x: np.ndarray
    velocity_y: np.ndarray
    yaw_rate: np.ndarray
    steering_time: np.ndarray  # as `time`
    steering: np.ndarray  # road wheel angle at steering_time [rad], positive to the left
    acceleration_x: np.ndarray | None = None
    acceleration_y: np.ndarray | None = None
    # (time [s], values [m/s]) of other sources of the forward speed, by name
    speeds: Mapping[str, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)
    geographic: bool = False  # see `AuxiliaryData`
    mercator_scale: float = 1.0  # scale of web Mercator, 1 / cos(latitude), at the recorded y

    @classmethod
    def from_log(cls, log: DriveLog, start_ns: int, auxiliary: AuxiliaryData) -> "Motion":
        """The motion as recorded, with positions relative to the first. start_ns: zero of the times [ns]."""
        series = {"wheel_speed": auxiliary.wheel_speed, "ins_speed": auxiliary.ins_speed}
        speeds = {name: ((signal.time_ns - start_ns) * NANOSECOND, signal.values)
                  for name, signal in series.items() if signal and len(signal.time_ns) > 1}
        return cls((log.ins_time_ns - start_ns) * NANOSECOND, log.x - log.x[:1], log.y - log.y[:1], log.yaw,
                   log.velocity_x, log.velocity_y, log.yaw_rate, (log.steering_time_ns - start_ns) * NANOSECOND,
                   log.road_wheel_angle, log.acceleration_x, log.acceleration_y, speeds, auxiliary.geographic,
                   float(np.cosh(np.clip(log.y[:1].sum() / EQUATORIAL_RADIUS, -10.0, 10.0))))

    def with_time_divided(self, factor: float) -> "Motion":
        """The motion with all times divided by a factor."""
        speeds = {name: (time / factor, values) for name, (time, values) in self.speeds.items()}
        return replace(self, time=self.time / factor, steering_time=self.steering_time / factor, speeds=speeds)

    def apply_entry(self, entry: Mapping[str, Any]) -> "Motion":
        """The motion with an entry of run.yaml applied: `columns`, and scale and add of `correct`."""
        signals = {name: getattr(self, source) for name, source in entry.get("columns", {}).items()}
        for channel, values in entry.get("correct", {}).items():
            for name in COMPONENTS.get(channel, (channel,)):
                recorded = signals.get(name, getattr(self, name))
                signals[name] = values.get("scale", 1.0) * recorded + values.get("add", 0.0)
        return replace(self, **signals)

    def shifted_earlier(self, seconds: float, *names: str) -> "Motion":
        """The motion with INS channels shifted to earlier times; the first or last value is held beyond the drive."""
        return replace(self, **{name: np.interp(self.time + seconds, self.time, getattr(self, name)) for name in names})

    def select_ins(self, mask: np.ndarray) -> "Motion":
        """The motion with only the INS samples in a mask (n,)."""
        names = ("time", *INS_SIGNALS, "acceleration_x", "acceleration_y")
        return replace(self, **{name: value[mask] for name in names if (value := getattr(self, name)) is not None})

    def make_windows(self, length: float, longest_gap: float = MAX_GAP) -> "Windows":
        """Windows of `length` [s] without a gap longer than `longest_gap` [s]."""
        time = self.time
        # The edges are found among the samples, not by counting windows, since a gap may last years.
        edges = np.flatnonzero(np.diff(np.floor((time - time[0]) / length), prepend=-1.0))
        first, last = edges[:-1], edges[1:]
        gaps = np.concatenate(([0], np.cumsum(np.diff(time) > longest_gap)))
        is_complete = (gaps[first] == gaps[last]) & (np.abs(time[last] - time[first] - length) < 0.5 * length)
        return Windows(first[is_complete], last[is_complete], time)

    @cached_property
    def position(self) -> np.ndarray:
        """Position in the map frame as a complex number, x + i y = east + i north [m]."""
        return self.x + 1j * self.y

    @cached_property
    def velocity(self) -> np.ndarray:
        """Velocity in body axes as a complex number, forward + i left [m/s]."""
        return self.velocity_x + 1j * self.velocity_y

    @cached_property
    def velocity_map(self) -> np.ndarray:
        """Velocity in the map frame, R(yaw) v = v exp(i yaw), as east + i north [m/s]."""
        return self.velocity * np.exp(1j * self.yaw)

    @cached_property
    def speed(self) -> np.ndarray:
        """Speed over ground [m/s]."""
        return np.abs(self.velocity)

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
    """Whether the car is driven, even if positions or velocity have a wrong unit; True if the recording is too short.
    A parked car has neither a persistent direction of travel nor a forward velocity far above its noise."""
    length = max(1.0, 5.0 * float(np.median(np.diff(motion.time))))
    windows = motion.make_windows(length, max(MAX_GAP, 0.5 * length))
    if len(windows) < MIN_DRIVEN_WINDOWS:
        return True
    displacement = windows.change(motion.position)
    speed = windows.mean(motion.velocity_x)
    noise = float(np.median(np.abs(np.diff(motion.velocity_x)))) / (0.6745 * np.sqrt(2.0))
    larger_speed = np.maximum(np.abs(displacement) / windows.change(motion.time), np.abs(speed))
    if np.sum(larger_speed > MIN_MOVING_SPEED) < MIN_DRIVEN_WINDOWS:
        return False
    return bool(windows.are_coherent(displacement)
                or np.sum(np.abs(speed) > MIN_SIGNAL_TO_NOISE * max(noise, 1e-9)) >= MIN_DRIVEN_WINDOWS)


def has_varying_speed(speed: np.ndarray) -> bool:
    """Whether the speed varies enough to separate effects that depend on different powers of the speed."""
    return float(np.std(speed)) > MIN_SPEED_VARIATION * abs(float(np.mean(speed)))


def correlate(x: np.ndarray, y: np.ndarray) -> float:
    """Correlation coefficient of two series (n,); 0 if one of them is constant, or with fewer than three samples."""
    return float(np.corrcoef(x, y)[0, 1]) if len(x) > 2 and np.std(x) > 0.0 and np.std(y) > 0.0 else 0.0


@dataclass(frozen=True, eq=False)
class Windows:
    """Windows without gaps, ascending in time."""

    first: np.ndarray  # index of the first sample
    last: np.ndarray  # index of the last sample
    sample_times: np.ndarray  # of all samples of the drive [s]

    @property
    def time(self) -> np.ndarray:
        """Start of each window [s]."""
        return self.sample_times[self.first]

    def change(self, values: np.ndarray) -> np.ndarray:
        """Change from start to end of each window."""
        return values[self.last] - values[self.first]

    def integral(self, values: np.ndarray) -> np.ndarray:
        """Integral over the time of each window; NaN if a value in the window is unknown."""
        areas = 0.5 * np.diff(self.sample_times) * (values[1:] + values[:-1])
        if np.isfinite(areas.sum()):
            return self.change(np.append(0.0, np.cumsum(areas)))
        unknown = np.isnan(areas)
        sums, counts = (np.append(0.0, np.cumsum(each)) for each in (np.where(unknown, 0.0, areas), unknown))
        return np.where(self.change(counts) > 0.0, np.nan, self.change(sums))

    def mean(self, values: np.ndarray) -> np.ndarray:
        """Time average in each window."""
        return self.integral(values) / self.change(self.sample_times)

    @property
    def are_adjacent(self) -> np.ndarray:
        """Whether each window but the first begins where the previous one ends."""
        return self.last[:-1] == self.first[1:]

    def are_coherent(self, displacements: np.ndarray) -> bool:
        """Whether the direction of complex displacements persists from window to window, unlike that of noise."""
        product = (displacements[1:] * np.conj(displacements[:-1]))[self.are_adjacent]
        return bool(np.sum(product.real) > MIN_COHERENCE * np.sum(np.abs(product)) > 0.0)

    def __len__(self) -> int:
        return len(self.first)


def estimate_spacing(time: np.ndarray) -> float:
    """Median of the means of SPACING_SAMPLES intervals [s], robust to bursts. time: at least two instants."""
    count = min(SPACING_SAMPLES, len(time) - 1)
    return float(np.median(time[count:] - time[:-count])) / count


def even_out(time: np.ndarray, half: int = SPACING_SAMPLES, max_gap: float = MAX_GAP) -> np.ndarray:
    """The instants [s] without jitter: evenly spaced, each then shifted by the mean deviation of the 2 * half recorded
    instants around it, which should span several bursts. Intervals longer than `max_gap` [s] remain."""
    groups = []
    for first, last in zip(*find_groups(np.diff(time) > max_gap), strict=True):
        even = np.linspace(time[first], time[last], last - first + 1)
        sums, k = np.concatenate(([0.0], np.cumsum(time[first:last + 1] - even))), np.arange(len(even))
        begin = np.clip(k - half, 0, max(len(even) - 2 * half, 0))
        end = np.minimum(begin + 2 * half, len(even))
        groups.append(even + (sums[end] - sums[begin]) / (end - begin))
    return np.concatenate(groups)


def find_groups(is_last: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Indices (first, last) of the groups in n >= 1 samples. is_last: (n - 1,) whether a sample ends its group."""
    ends = np.flatnonzero(is_last)
    return np.concatenate(([0], ends + 1)), np.append(ends, len(is_last))


def find_time_intervals(times: np.ndarray, max_interval: float) -> tuple[tuple[float, float], ...]:
    """(first, last) instant [s] of each group of ascending instants at intervals of at most `max_interval` [s]."""
    if not len(times):
        return ()
    first, last = find_groups(np.diff(times) > max_interval)
    return tuple(zip(times[first].tolist(), times[last].tolist(), strict=True))


def find_spans(mask: np.ndarray) -> list[tuple[int, int]]:
    """Indices (first, last) of each run of True in a mask (n,), n >= 1."""
    first, last = find_groups(np.diff(mask))
    return list(zip(first[mask[first]].tolist(), last[mask[first]].tolist(), strict=True))


class Ratios(NamedTuple):
    """Robust ratios between the changes of two channels in windows; NaN with too little motion."""

    position_to_speed: float  # distance between positions / integrated speed
    yaw_to_rate: float  # yaw / integrated yaw rate
    yaw_to_course: float  # yaw / course over ground
    rate_to_course: float  # integrated yaw rate / course over ground


def is_near(value: float, target: float, factor: float = SAME_RATIO_FACTOR) -> bool:
    """Whether two ratios have the same sign and differ by less than a factor."""
    return bool(np.isfinite(value) and value * target > 0.0 and 1.0 / factor < value / target < factor)


def compute_ratios(motion: Motion, length: float = 1.0, min_distance: float = MIN_DISTANCE) -> Ratios:
    """Ratios of channels in windows of `length` [s], halved while the median change of the course
    between windows exceeds MAX_MEDIAN_TURN, as for a 1:10 car. min_distance: least motion in a used window [m]."""
    windows = motion.make_windows(length, max(MAX_GAP, 0.5 * length))
    displacement = windows.change(motion.position)
    distance, integrated_speed = np.abs(displacement), windows.integral(motion.speed)
    integrated_rate = cumulative_trapezoid(motion.yaw_rate, motion.time, initial=0.0)
    moving = (distance > min_distance) | (integrated_speed > min_distance)
    turn = np.diff(np.unwrap(np.angle(displacement)))
    turning = moving[1:] & moving[:-1] & windows.are_adjacent
    if length > MIN_HALVED_LENGTH and turning.any() and float(np.median(np.abs(turn[turning]))) > MAX_MEDIAN_TURN:
        return compute_ratios(motion, 0.5 * length, 0.5 * min_distance)
    weights, distance_ratio = integrated_speed[moving], np.nan
    if len(weights) >= MIN_WINDOWS and weights.any():
        ratio = distance[moving] / np.maximum(weights, 1e-12)
        order = np.argsort(ratio)  # weighted median; np.quantile has no weights in numpy 1, which ROS 2 Jazzy contains
        cumulative = np.cumsum(weights[order])
        distance_ratio = _reject_constant(float(ratio[order][np.searchsorted(cumulative, 0.5 * cumulative[-1])]))
    yaw_rate_ratio = _fit_slope(windows.change(motion.yaw), windows.change(integrated_rate))
    if len(windows) < 2:
        return Ratios(distance_ratio, yaw_rate_ratio, np.nan, np.nan)
    # The course changes between the centres of adjacent windows; at standstill it is noise.
    both_moving = np.minimum(distance[1:], distance[:-1]) > max(0.3 * float(np.median(distance)), 1e-12)
    usable = windows.are_adjacent & both_moving & (np.abs(turn) < MAX_TURN)
    yaw, rate = (np.diff(windows.mean(values)) for values in (motion.yaw, integrated_rate))
    return Ratios(distance_ratio, yaw_rate_ratio, _fit_slope(yaw[usable], turn[usable]),
                  _fit_slope(rate[usable], turn[usable]))


def _reject_constant(ratio: float) -> float:
    return ratio if MIN_RATIO < abs(ratio) < 1.0 / MIN_RATIO else float("nan")


def _fit_slope(y: np.ndarray, x: np.ndarray) -> float:
    """Robust slope of turns y versus turns x [rad], with a small intercept that absorbs a bias of the yaw rate; NaN
    with fewer than MIN_WINDOWS turns, if both are small, or if one is small and the other mainly a bias."""
    if len(y) < MIN_WINDOWS:
        return float("nan")
    (small_size, _), (large_size, larger) = sorted(
        ((float(np.percentile(np.abs(turns), 95)), turns) for turns in (y, x)), key=lambda pair: pair[0])
    if large_size < MIN_TURN or (small_size < MIN_TURN and np.std(larger) < 0.5 * abs(np.mean(larger))):
        return float("nan")
    weights, slope = np.ones(len(y)), float("nan")
    # The prior limits the intercept, which a drive on a circle does not determine.
    prior = (len(y) * MIN_TURN**2) / max(float(np.square(x).mean()), 1e-300)
    for _ in range(SLOPE_ITERATIONS):
        normal = np.array([[weights @ x**2, weights @ x], [weights @ x, weights.sum() + prior]])
        slope, intercept = np.linalg.lstsq(normal, [weights @ (x * y), weights @ y], rcond=None)[0]
        residual = np.abs(y - slope * x - intercept)
        weights = 1.0 / np.maximum(1.0, residual / (3.0 * max(float(np.median(residual)), 1e-12)))
    return _reject_constant(float(slope))
