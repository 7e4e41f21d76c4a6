"""Working copy of a drive for the checks: arrays in seconds, corrected by the findings so far, so that one fault gives
one finding."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np

from ..log import DriveLog
from ..timeseries import NANOSECOND
from .finding import AuxiliaryData

LONGEST_GAP = 0.25  # s between samples; nothing is integrated across a longer one
MOVING = 1.0  # m/s; slower driving is not used
FEWEST_WINDOWS = 5  # that must show the car driving
COHERENT = 0.5  # cosine between the ways of successive windows: 1 straight on, 0 for a random walk
SPEEDS = 0.1  # standard deviation of the speed over its mean
LEAST_SIGNAL = 10.0  # standard deviations of the velocity's noise


@dataclass(frozen=True, eq=False)
class Motion:
    """A drive in seconds after the first INS measurement, signals as DriveLog has them; accelerations may be NaN.

    steering_time [s], steering [rad]: at the road wheels, left +. speeds: other sources of the forward speed, by name
    (time [s], values [m/s]).
    """

    time: np.ndarray
    x: np.ndarray
    y: np.ndarray
    yaw: np.ndarray
    velocity_x: np.ndarray
    velocity_y: np.ndarray
    yaw_rate: np.ndarray
    steering_time: np.ndarray
    steering: np.ndarray
    acceleration_x: np.ndarray | None = None
    acceleration_y: np.ndarray | None = None
    speeds: Mapping[str, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)

    @classmethod
    def of(cls, log: DriveLog, start: int, auxiliary: AuxiliaryData) -> "Motion":
        """start: zero of the times [ns]."""
        series = {"wheel_speed": auxiliary.wheel_speed, "ins_speed": auxiliary.ins_speed}
        speeds = {name: ((one.time_ns - start) * NANOSECOND, one.values)
                  for name, one in series.items() if one and len(one.time_ns) > 1}
        return cls((log.ins_time_ns - start) * NANOSECOND, log.x - log.x[:1], log.y - log.y[:1], log.yaw,
                   log.velocity_x, log.velocity_y, log.yaw_rate, (log.steering_time_ns - start) * NANOSECOND,
                   log.road_wheel_angle, log.acceleration_x, log.acceleration_y, speeds)

    def with_(self, **changes: Any) -> "Motion":
        return replace(self, **changes)

    def slower(self, factor: float) -> "Motion":
        """With all times divided by a factor."""
        speeds = {name: (time / factor, values) for name, (time, values) in self.speeds.items()}
        return replace(self, time=self.time / factor, steering_time=self.steering_time / factor, speeds=speeds)

    def where(self, keep: np.ndarray) -> "Motion":
        """With these samples of the INS only, (n,) bool."""
        names = ("time", "x", "y", "yaw", "velocity_x", "velocity_y", "yaw_rate", "acceleration_x", "acceleration_y")
        kept = {name: value[keep] for name in names if (value := getattr(self, name)) is not None}
        return replace(self, **kept)

    @property
    def speed(self) -> np.ndarray:
        """Over ground [m/s]."""
        return np.hypot(self.velocity_x, self.velocity_y)

    @property
    def velocity_map(self) -> tuple[np.ndarray, np.ndarray]:
        """Body velocity turned into the map [m/s]: R(yaw) v."""
        cosine, sine = np.cos(self.yaw), np.sin(self.yaw)
        return (cosine * self.velocity_x - sine * self.velocity_y, sine * self.velocity_x + cosine * self.velocity_y)

    def steering_at_ins(self) -> np.ndarray:
        """Road wheel angle at the instants of the INS, NaN outside of what was recorded."""
        if not len(self.steering_time):
            return np.full(len(self.time), np.nan)
        return np.interp(self.time, self.steering_time, self.steering, left=np.nan, right=np.nan)


def is_driven(motion: Motion) -> bool:
    """Whether the car drives at all, in whatever units: positions keep their direction of travel, or the forward
    velocity is far beyond its own noise. Noise and a wandering receiver do neither."""
    length = max(1.0, 5.0 * float(np.median(np.diff(motion.time)))) if len(motion.time) > 1 else 1.0
    over = windows(motion.time, length, max(LONGEST_GAP, 0.5 * length))
    if len(over) < FEWEST_WINDOWS:
        return True  # too short to judge
    way = over.change(motion.x) + 1j * over.change(motion.y)
    product = (way[1:] * np.conj(way[:-1]))[over.last[:-1] == over.first[1:]]
    speed = over.mean(motion.time, motion.velocity_x)
    noise = float(np.median(np.abs(np.diff(motion.velocity_x)))) / (0.6745 * np.sqrt(2.0))
    return bool(np.sum(product.real) > COHERENT * np.sum(np.abs(product)) > 0.0
                or np.sum(np.abs(speed) > LEAST_SIGNAL * max(noise, 1e-9)) >= FEWEST_WINDOWS)


def several_speeds(speed: np.ndarray) -> bool:
    """Whether the speed varies enough to separate effects of different powers of it."""
    return float(np.std(speed)) > SPEEDS * abs(float(np.mean(speed)))


def sideways(motion: Motion) -> bool:
    """Whether the velocity points to the side more than ahead: then its axes are not those of a car."""
    return float(np.sum(motion.velocity_y**2)) > float(np.sum(motion.velocity_x**2))


def integral(time: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """Trapezoidal integral from the first sample on, (n,)."""
    return np.concatenate(([0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(time))))


@dataclass(frozen=True, eq=False)
class Windows:
    """Pairs of samples end to end, without a gap between: first, last are their indices, time that of the first [s]."""

    first: np.ndarray
    last: np.ndarray
    time: np.ndarray

    def change(self, values: np.ndarray) -> np.ndarray:
        return values[self.last] - values[self.first]

    def mean(self, time: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Time average over each window."""
        return self.change(integral(time, values)) / self.change(time)

    def __len__(self) -> int:
        return len(self.first)


def windows(time: np.ndarray, length: float, longest_gap: float = LONGEST_GAP) -> Windows:
    """Windows of `length` [s] over the stretches without a gap."""
    if len(time) < 2:
        empty = np.zeros(0, np.int64)
        return Windows(empty, empty, np.zeros(0))
    # The first sample of each; by the samples, not by the seconds: a gap may be of years.
    places = np.flatnonzero(np.diff(np.floor((time - time[0]) / length), prepend=-1.0))
    first, last = places[:-1], places[1:]
    gaps = np.concatenate(([0], np.cumsum(np.diff(time) > longest_gap)))
    whole = (gaps[first] == gaps[last]) & (np.abs(time[last] - time[first] - length) < 0.5 * length)
    first, last = first[whole], last[whole]
    return Windows(first, last, time[first])


def stretches(times: np.ndarray, apart: float) -> tuple[tuple[float, float], ...]:
    """Groups of instants [s] at most `apart` from each other, as (first, last)."""
    if not len(times):
        return ()
    edges = [0, *(np.flatnonzero(np.diff(times) > apart) + 1).tolist(), len(times)]
    return tuple((float(times[a]), float(times[b - 1])) for a, b in pairwise(edges))


def spans(mask: np.ndarray) -> list[tuple[int, int]]:
    """(first, last) of each stretch of a mask (n,)."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], mask.astype(np.int8), [0]))))
    return list(zip(edges[::2].tolist(), (edges[1::2] - 1).tolist(), strict=True))


LEAST_TURN, LEAST_WAY = 0.02, 0.5  # rad and m; windows with less motion are not used
LEAST_WINDOWS = 5
NOTHING = 1e-10  # a ratio of two channels below it: nanoseconds make 1e-9
ALIKE = 1.2  # two ratios that differ by less than this factor are one


@dataclass(frozen=True)
class Ratios:
    """Medians over the windows, NaN with too little motion. way: position over velocity. Turns: yaw over
    integrated yaw rate, yaw over course, yaw rate over course.
    """

    way: float
    yaw_rate: float
    yaw_course: float
    rate_course: float


def near(value: float, target: float, factor: float = ALIKE) -> bool:
    return bool(np.isfinite(value) and value * target > 0.0 and 1.0 / factor < value / target < factor)


def ratios(motion: Motion, length: float = 1.0) -> Ratios:
    over = windows(motion.time, length, max(0.25, 0.5 * length))
    way = np.hypot(over.change(motion.x), over.change(motion.y))
    run = over.change(integral(motion.time, motion.speed))
    turn, rate = over.change(motion.yaw), over.change(integral(motion.time, motion.yaw_rate))
    return Ratios(_way_ratio(way, run), _slope(turn, rate), *_against_course(motion, over, way))


def _way_ratio(way: np.ndarray, run: np.ndarray) -> float:
    enough = (way > LEAST_WAY) | (run > LEAST_WAY)
    if enough.sum() < LEAST_WINDOWS or not run[enough].any():
        return float("nan")
    ratio = way[enough] / np.maximum(run[enough], 1e-12)
    return _moving(float(np.quantile(ratio, 0.5, weights=run[enough], method="inverted_cdf")))


def _moving(ratio: float) -> float:
    """The ratio; NaN if one of the two channels is constant."""
    return ratio if NOTHING < abs(ratio) < 1.0 / NOTHING else float("nan")


def _slope(top: np.ndarray, bottom: np.ndarray) -> float:
    """Robust slope of top over bottom with a small constant: a bias of the yaw rate does not change its scale."""
    if len(top) < LEAST_WINDOWS or max(np.percentile(np.abs(c), 95) for c in (top, bottom)) < LEAST_TURN:
        return float("nan")
    less, more = sorted((top, bottom), key=lambda turns: float(np.percentile(np.abs(turns), 95)))
    if float(np.percentile(np.abs(less), 95)) < LEAST_TURN and float(np.std(more)) < 0.5 * abs(float(np.mean(more))):
        return float("nan")  # one hardly turns, the other is a bias
    weights, slope = np.ones(len(top)), float("nan")
    # Prior of the constant, equal to windows that turn by LEAST_TURN: a circle does not determine it.
    prior = (len(top) * LEAST_TURN**2) / max(float(np.square(bottom).mean()), 1e-300)
    for _ in range(8):
        rows = np.array([[weights @ bottom**2, weights @ bottom], [weights @ bottom, weights.sum() + prior]])
        slope, constant = np.linalg.lstsq(rows, [weights @ (bottom * top), weights @ top])[0]
        rest = np.abs(top - slope * bottom - constant)
        weights = 1.0 / np.maximum(1.0, rest / (3.0 * max(float(np.median(rest)), 1e-12)))
    return _moving(float(slope))


def _against_course(motion: Motion, over: Windows, way: np.ndarray) -> tuple[float, float]:
    """(yaw, yaw rate) over course: change from one window's middle to the next."""
    if len(over) < 2:
        return float("nan"), float("nan")
    course = np.unwrap(np.arctan2(over.change(motion.y), over.change(motion.x)))
    scale = float(np.median(way)) if len(way) else 0.0
    # Consecutive windows in which the car moves: else the course is noise.
    usable = (over.last[:-1] == over.first[1:]) & (np.minimum(way[1:], way[:-1]) > max(0.3 * scale, 1e-12))
    turn = np.diff(course)[usable]
    usable_turn = np.abs(turn) < 1.5
    yaw = np.diff(over.mean(motion.time, motion.yaw))[usable][usable_turn]
    rate = np.diff(over.mean(motion.time, integral(motion.time, motion.yaw_rate)))[usable][usable_turn]
    turn = turn[usable_turn]
    return _slope(yaw, turn), _slope(rate, turn)
