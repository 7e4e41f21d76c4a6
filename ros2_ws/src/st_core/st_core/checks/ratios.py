"""Ratios of turn angles and distances estimated from yaw, yaw rate, course, position and velocity."""

from dataclasses import dataclass

import numpy as np

from .motion import Motion, Windows, integral, weighted_median, windows

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
    if enough.sum() < LEAST_WINDOWS:
        return float("nan")
    return _moving(weighted_median(way[enough] / np.maximum(run[enough], 1e-12), run[enough]))


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
