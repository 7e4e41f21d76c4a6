"""Steady-state sideslip for drives without measured sideslip, whose yaw is the course over ground of a GNSS receiver.

The heading of a car differs from its course by the sideslip angle at the antenna. Without a correction, each prediction
would be rotated by this angle. Therefore the sideslip of steady cornering is computed with the vehicle file:

    v_y = r (l_r - m l_f v_x^2 / (l C_r) + d_x),    beta = atan(v_y / v_x),    heading = course - beta

r: yaw rate, d_x: distance of the antenna ahead of the CG. Stiffnesses, lever arm and misalignment cannot be identified
from this sideslip; `DriveLog.sideslip_measured` is then False. Checked by: test_sideslip.py.
"""

from dataclasses import replace

import numpy as np

from .handling import rear_slip_coefficient
from .log import DriveLog
from .timeseries import NANOSECOND, moving_average
from .types import wrap_angle
from .vehicle import VehicleParameters

MIN_SPEED = 2.0  # m/s; the course of a slower car is mostly noise
COURSE_TIME = 0.2  # s, over which the displacement defines the course
RATE_WIDTH_NS = 200_000_000  # averaging time [ns] of the yaw rate, which is noisy if derived from the course
MAX_DERIVATIVE_ERROR = 1e-6  # rad/s between yaw rate and derivative of yaw; a gyroscope differs by more, due to noise
MAX_COURSE_ERROR = 0.0015
"""Largest RMS [rad] of the part of (direction of the displacement - yaw) that depends on the yaw rate, if yaw is a
course. Genesis drives: 0.003 to 0.03 with the heading of the INS, up to 0.0004 with GNSS courses."""


def compute_steady_velocity_y(log: DriveLog, vehicle: VehicleParameters) -> np.ndarray:
    """v_y [m/s] at the INS point in steady cornering; see the module docstring."""
    slip = rear_slip_coefficient(vehicle)
    return log.yaw_rate * (vehicle.cg_to_rear_axle - slip * log.velocity_x**2 + vehicle.cg_to_ins_x)


def with_steady_sideslip(log: DriveLog, vehicle: VehicleParameters) -> DriveLog:
    """The drive with steady sideslip; unchanged if velocity_y or heading is measured, or sideslip or speed is small."""
    is_fast = log.velocity_x > MIN_SPEED
    if log.velocity_y.any() or len(log.ins_time_ns) < 3 or not is_fast.any():
        return log
    smoothed_log = replace(log, yaw_rate=moving_average(log.ins_time_ns, log.yaw_rate, RATE_WIDTH_NS))
    angle = np.arctan2(compute_steady_velocity_y(smoothed_log, vehicle), np.maximum(log.velocity_x, MIN_SPEED))
    angle = np.interp(log.ins_time_ns, log.ins_time_ns[is_fast], angle[is_fast])
    if np.std(angle) < MAX_COURSE_ERROR or not _is_course(log, smoothed_log.yaw_rate, is_fast):
        return log
    speed, yaw = log.velocity_x, log.yaw - angle
    rate = derive_yaw_rate(log.ins_time_ns, yaw) if has_derived_yaw_rate(log) else log.yaw_rate
    return replace(log, yaw=yaw, velocity_x=speed * np.cos(angle), velocity_y=speed * np.sin(angle), yaw_rate=rate,
                   sideslip_measured=False)


def with_course(log: DriveLog) -> DriveLog:
    """The inverse of `with_steady_sideslip`, except for a derived yaw rate: yaw becomes the course."""
    return replace(log, yaw=log.yaw + np.arctan2(log.velocity_y, log.velocity_x), sideslip_measured=True,
                   velocity_x=np.hypot(log.velocity_x, log.velocity_y), velocity_y=np.zeros_like(log.velocity_y))


def derive_yaw_rate(time_ns: np.ndarray, yaw: np.ndarray) -> np.ndarray:
    """Derivative of unwrapped yaw [rad/s], averaged over RATE_WIDTH_NS to reduce its noise."""
    return moving_average(time_ns, np.gradient(yaw, (time_ns - time_ns[0]) * NANOSECOND), RATE_WIDTH_NS)


def has_derived_yaw_rate(log: DriveLog) -> bool:
    """Whether the yaw rate of the moving car is only the derivative of yaw, because no gyroscope was recorded."""
    is_fast = log.velocity_x > MIN_SPEED
    error = np.abs(derive_yaw_rate(log.ins_time_ns, log.yaw) - log.yaw_rate)[is_fast]
    return bool(is_fast.any() and np.median(error) < MAX_DERIVATIVE_ERROR)


def _is_course(log: DriveLog, yaw_rate: np.ndarray, is_fast: np.ndarray) -> bool:
    """Whether yaw is the course: a heading differs from it by the sideslip, a r / v + b r v with constants a, b."""
    time = (log.ins_time_ns - log.ins_time_ns[0]) * NANOSECOND
    ends = time - 0.5 * COURSE_TIME, time + 0.5 * COURSE_TIME
    east, north = (np.subtract(*(np.interp(t, time, values) for t in ends[::-1])) for values in (log.x, log.y))
    is_inside = (ends[0] >= time[0]) & (ends[1] <= time[-1])
    is_usable = is_fast & is_inside & (np.hypot(east, north) > MIN_SPEED * COURSE_TIME)
    if not is_usable.any():
        return False
    difference = wrap_angle(np.arctan2(north, east) - log.yaw)[is_usable]
    rate, speed = yaw_rate[is_usable], log.velocity_x[is_usable]
    regressors = np.stack([rate / speed, rate * speed, np.ones_like(rate)], axis=1)
    return float(np.std(regressors @ np.linalg.lstsq(regressors, difference, rcond=None)[0])) < MAX_COURSE_ERROR
