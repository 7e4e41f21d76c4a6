"""Which drives can show what: a fault that no sample depends on is not a case.

Limits are about what a fault of the smaller size needs to stand out of the noise of a normal INS.
"""

from collections.abc import Callable

import numpy as np

from .faults import find_liveliest, is_standing
from .recording import Recording

Shows = Callable[[Recording, float], bool]
TURNING, STEERED = 0.05, 0.005
"""rad/s, rad: standard deviation over the drive. A steady circle has none, and hides every delay of its yaw rate."""
HARD = 0.25
"""m/s^2: standard deviation of dv_x/dt."""
CORNERING = 0.4
"""m/s^2: standard deviation of r v_x."""
SLIDING = 0.05
"""m/s: root mean square of v_y."""
BENDING = 0.005
"""1/m: standard deviation of the curvature. On a circle the point measured, the heading and the tyres look alike."""
STRAIGHT, STRAIGHT_SHARE = 0.005, 0.1
"""1/m, and the least share of the drive below it."""
SLOW, SLOW_TURNING = 8.0, 0.3
"""m/s, and rad^2/s of yaw rate squared below it: faster, tyre slip moves the point about which the car turns."""
SPEEDS = 0.1
"""Standard deviation of the speed over its mean. At one speed a point further ahead looks like an early sample."""
ONE_WAY = 0.2
"""Share of the way along the axis that is travelled less."""
LEVER = 1.5
"""m."""
STANDING = 3.0
"""s."""


def moves(r: Recording, size: float = 0.0) -> bool:
    return r.log.duration > 20.0 and float(np.mean(r.log.velocity_x)) > 1.0


def turns(r: Recording, size: float = 0.0) -> bool:
    return moves(r) and float(np.std(r.log.yaw_rate)) > TURNING


def bends(r: Recording, size: float = 0.0) -> bool:
    return turns(r) and float(np.std(_curvature(r))) > BENDING


def slides_and_bends(r: Recording, size: float = 0.0) -> bool:
    return bends(r) and float(np.sqrt(np.mean(r.log.velocity_y**2))) > SLIDING


def bends_and_straights(r: Recording, size: float = 0.0) -> bool:
    return bends(r) and float(np.mean(np.abs(_curvature(r)) < STRAIGHT)) > STRAIGHT_SHARE


def bends_at_several_speeds(r: Recording, size: float = 0.0) -> bool:
    return bends(r) and float(np.std(r.log.velocity_x)) > SPEEDS * float(np.mean(r.log.velocity_x))


def bends_slowly(r: Recording, size: float = 0.0) -> bool:
    slow = (r.log.velocity_x < SLOW)[1:]
    return bends(r) and float(np.sum((r.log.yaw_rate[1:] ** 2 * np.diff(r.time))[slow])) > SLOW_TURNING


def moves_in_x_and_y(r: Recording, size: float = 0.0) -> bool:
    ways = [np.abs(np.diff(r.log.x)).sum(), np.abs(np.diff(r.log.y)).sum()]
    return moves(r) and min(ways) > ONE_WAY * sum(ways)


def accelerates(r: Recording, size: float = 0.0) -> bool:
    return moves(r) and r.log.acceleration_x is not None and float(np.std(_slope(r, r.log.velocity_x))) > HARD


def turns_and_accelerates(r: Recording, size: float = 0.0) -> bool:
    return turns(r) and accelerates(r)


def corners(r: Recording, size: float = 0.0) -> bool:
    return has_a_y(r) and float(np.std(r.log.yaw_rate * r.log.velocity_x)) > CORNERING


def corners_fast(r: Recording, size: float = 0.0) -> bool:
    """An accelerometer LEVER away from the INS point shows a lag of LEVER / v of its own; a smaller one is none."""
    return corners(r) and size > 1.1 * LEVER / float(np.median(r.log.velocity_x))


def has_a_y(r: Recording, size: float = 0.0) -> bool:
    return moves(r) and r.log.acceleration_y is not None


def has_a_x(r: Recording, size: float = 0.0) -> bool:
    return moves(r) and r.log.acceleration_x is not None


def steers(r: Recording, size: float = 0.0) -> bool:
    return turns(r) and float(np.std(r.log.road_wheel_angle)) > STEERED


def steers_and_bends(r: Recording, size: float = 0.0) -> bool:
    return steers(r) and bends(r)


def stops(r: Recording, size: float = 0.0) -> bool:
    return float(np.mean(is_standing(r))) * r.log.duration > STANDING


def long_enough(channel: str) -> Shows:
    """Has a stretch of that length in which the car moves, and much more than that."""
    return lambda r, seconds: r.log.duration > 2 * seconds and find_liveliest(r, channel, seconds) is not None


def _curvature(r: Recording) -> np.ndarray:
    """1/m, over half a second, where the car is not slow."""
    count = max(1, round(0.5 / float(np.median(np.diff(r.time)))))
    rate = np.convolve(r.log.yaw_rate, np.ones(count) / count, "same")
    moving = r.log.velocity_x > 2.0
    return rate[moving] / r.log.velocity_x[moving]


def _slope(r: Recording, values: np.ndarray) -> np.ndarray:
    """Over 0.5 s."""
    time = r.time
    grid = np.arange(0.0, time[-1], 0.5)
    return np.diff(np.interp(grid, time, values)) / 0.5
