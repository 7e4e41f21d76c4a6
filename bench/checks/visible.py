"""Which drives can show what: a fault that no sample depends on is not a case.

Limits are about what a fault of the smaller size needs to stand out of the noise of a normal INS.
"""

from collections.abc import Callable

import numpy as np

from .faults import liveliest, standing
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
ONE_WAY = 0.2
"""Share of the way along the axis that is travelled less."""
STANDING = 3.0
"""s."""


def moves(r: Recording, size: float = 0.0) -> bool:
    return r.log.duration > 20.0 and float(np.mean(r.log.velocity_x)) > 1.0


def turns(r: Recording, size: float = 0.0) -> bool:
    return moves(r) and float(np.std(r.log.yaw_rate)) > TURNING


def goes_both_ways(r: Recording, size: float = 0.0) -> bool:
    ways = [np.abs(np.diff(r.log.x)).sum(), np.abs(np.diff(r.log.y)).sum()]
    return moves(r) and min(ways) > ONE_WAY * sum(ways)


def accelerates(r: Recording, size: float = 0.0) -> bool:
    return moves(r) and r.log.acceleration_x is not None and float(np.std(_slope(r, r.log.velocity_x))) > HARD


def turns_and_accelerates(r: Recording, size: float = 0.0) -> bool:
    return turns(r) and accelerates(r)


def slides(r: Recording, size: float = 0.0) -> bool:
    return turns(r) and float(np.sqrt(np.mean(r.log.velocity_y**2))) > SLIDING


def corners(r: Recording, size: float = 0.0) -> bool:
    return has_a_y(r) and float(np.std(r.log.yaw_rate * r.log.velocity_x)) > CORNERING


def has_a_y(r: Recording, size: float = 0.0) -> bool:
    return moves(r) and r.log.acceleration_y is not None


def has_a_x(r: Recording, size: float = 0.0) -> bool:
    return moves(r) and r.log.acceleration_x is not None


def steers(r: Recording, size: float = 0.0) -> bool:
    return turns(r) and float(np.std(r.log.road_wheel_angle)) > STEERED


def stands(r: Recording, size: float = 0.0) -> bool:
    return float(np.mean(standing(r))) * r.log.duration > STANDING


def long_enough(channel: str) -> Shows:
    """Has a stretch of that length in which the car moves, and much more than that."""
    return lambda r, seconds: r.log.duration > 2 * seconds and liveliest(r, channel, seconds) is not None


def _slope(r: Recording, values: np.ndarray) -> np.ndarray:
    """Over 0.5 s."""
    time = r.time
    grid = np.arange(0.0, time[-1], 0.5)
    return np.diff(np.interp(grid, time, values)) / 0.5
