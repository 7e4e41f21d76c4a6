"""Conditions under which a fault is visible in a drive; others are not tested.

At these limits, the effect of the smaller size of a fault is about the noise of a normal INS.
"""

from collections.abc import Callable

import numpy as np

from .faults import find_busiest_span, is_at_standstill
from .recording import Recording

Condition = Callable[[Recording, float], bool]
MIN_YAW_RATE_DEVIATION, MIN_STEERING_DEVIATION = 0.05, 0.005
"""Standard deviations over the drive [rad/s, rad]. In a steady circle they are 0, and a delay is not visible."""
MIN_ACCELERATION_DEVIATION = 0.25  # m/s^2, standard deviation of dv_x/dt
MIN_CORNERING_DEVIATION = 0.4  # m/s^2, standard deviation of r v_x
MIN_LATERAL_VELOCITY = 0.05  # m/s, root mean square of v_y
MIN_CURVATURE_DEVIATION = 0.005
"""Standard deviation of the curvature [1/m]. In a circle, errors of INS point, heading and tyres are confounded."""
MAX_STRAIGHT_CURVATURE, MIN_STRAIGHT_FRACTION = 0.005, 0.1
"""Curvature of a straight [1/m], and minimum fraction of straights in the drive."""
MAX_SLOW_SPEED, MIN_SLOW_TURNING = 8.0, 0.3
"""[m/s], and integral of the squared yaw rate below this speed [rad^2/s]. At higher speed, tyre slip moves the point
about which the car turns."""
MIN_SPEED_VARIATION = 0.1
"""Standard deviation of the speed over its mean. At one speed, a point further ahead acts like an earlier sample."""
MIN_AXIS_FRACTION = 0.2  # minimum fraction of the distance along x, and along y
MAX_LEVER_ARM = 1.5  # m, of an accelerometer from the INS point
MIN_STANDSTILL = 3.0  # s


def moves(r: Recording, size: float = 0.0) -> bool:
    return r.log.duration > 20.0 and float(np.mean(r.log.velocity_x)) > 1.0


def turns(r: Recording, size: float = 0.0) -> bool:
    return moves(r) and float(np.std(r.log.yaw_rate)) > MIN_YAW_RATE_DEVIATION


def has_varying_curvature(r: Recording, size: float = 0.0) -> bool:
    return turns(r) and float(np.std(_curvature(r))) > MIN_CURVATURE_DEVIATION


def curves_with_sideslip(r: Recording, size: float = 0.0) -> bool:
    return has_varying_curvature(r) and float(np.sqrt(np.mean(r.log.velocity_y**2))) > MIN_LATERAL_VELOCITY


def curves_and_straights(r: Recording, size: float = 0.0) -> bool:
    straight = np.abs(_curvature(r)) < MAX_STRAIGHT_CURVATURE
    return has_varying_curvature(r) and float(np.mean(straight)) > MIN_STRAIGHT_FRACTION


def curves_at_several_speeds(r: Recording, size: float = 0.0) -> bool:
    speed = r.log.velocity_x
    return has_varying_curvature(r) and float(np.std(speed)) > MIN_SPEED_VARIATION * float(np.mean(speed))


def curves_at_low_speed(r: Recording, size: float = 0.0) -> bool:
    slow = (r.log.velocity_x < MAX_SLOW_SPEED)[1:]
    turning = float(np.sum((r.log.yaw_rate[1:] ** 2 * np.diff(r.time))[slow]))
    return has_varying_curvature(r) and turning > MIN_SLOW_TURNING


def moves_in_x_and_y(r: Recording, size: float = 0.0) -> bool:
    distances = [np.abs(np.diff(r.log.x)).sum(), np.abs(np.diff(r.log.y)).sum()]
    return moves(r) and min(distances) > MIN_AXIS_FRACTION * sum(distances)


def accelerates(r: Recording, size: float = 0.0) -> bool:
    return has_a_x(r) and float(np.std(_slope(r, r.log.velocity_x))) > MIN_ACCELERATION_DEVIATION


def turns_and_accelerates(r: Recording, size: float = 0.0) -> bool:
    return turns(r) and accelerates(r)


def corners(r: Recording, size: float = 0.0) -> bool:
    return has_a_y(r) and float(np.std(r.log.yaw_rate * r.log.velocity_x)) > MIN_CORNERING_DEVIATION


def corners_fast(r: Recording, size: float = 0.0) -> bool:
    """Whether a lag of `size` [s] exceeds MAX_LEVER_ARM / v, the apparent lag due to an accelerometer's lever arm."""
    return corners(r) and size > 1.1 * MAX_LEVER_ARM / float(np.median(r.log.velocity_x))


def has_a_y(r: Recording, size: float = 0.0) -> bool:
    return moves(r) and r.log.acceleration_y is not None


def has_a_x(r: Recording, size: float = 0.0) -> bool:
    return moves(r) and r.log.acceleration_x is not None


def steers(r: Recording, size: float = 0.0) -> bool:
    return turns(r) and float(np.std(r.log.road_wheel_angle)) > MIN_STEERING_DEVIATION


def steers_in_curves(r: Recording, size: float = 0.0) -> bool:
    return steers(r) and has_varying_curvature(r)


def stops(r: Recording, size: float = 0.0) -> bool:
    return float(np.mean(is_at_standstill(r))) * r.log.duration > MIN_STANDSTILL


def long_enough(channel: str) -> Condition:
    """Condition: the car moves for the duration of the fault, and the drive is more than twice as long."""
    return lambda r, seconds: r.log.duration > 2 * seconds and find_busiest_span(r, channel, seconds) is not None


def _curvature(r: Recording) -> np.ndarray:
    """Curvature [1/m] at speeds above 2 m/s, averaged over half a second."""
    count = max(1, round(0.5 / float(np.median(np.diff(r.time)))))
    rate = np.convolve(r.log.yaw_rate, np.ones(count) / count, "same")
    moving = r.log.velocity_x > 2.0
    return rate[moving] / r.log.velocity_x[moving]


def _slope(r: Recording, values: np.ndarray) -> np.ndarray:
    """Derivative of a signal, over steps of 0.5 s."""
    time = r.time
    grid = np.arange(0.0, time[-1], 0.5)
    return np.diff(np.interp(grid, time, values)) / 0.5
