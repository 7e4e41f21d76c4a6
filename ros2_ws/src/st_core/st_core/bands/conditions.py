"""The conditions at a start, on which the width of a band depends: known when the prediction is made, no later.

    speed                 |v_x|                                    [m/s]
    lateral_acceleration  |v_x r|                                  [m/s^2]
    forward_acceleration  |velocity_x_dot|                         [m/s^2]
    steering_activity     root mean square of d(delta)/dt over the ACTIVITY_SPAN before the start [rad/s]

All are magnitudes, at the INS point; delta is the road wheel angle. What the horizon will bring is not among them: a
band that needed it could not be drawn live. Checked by: test_bands_conditions.py.
"""

from typing import Any

import numpy as np

from ..filtering import NANOSECOND
from ..log_signals import LogSignals

CONDITIONS = ("speed", "lateral_acceleration", "forward_acceleration", "steering_activity")
UNITS = {"speed": "m/s", "lateral_acceleration": "m/s^2", "forward_acceleration": "m/s^2", "steering_activity": "rad/s"}
ACTIVITY_SPAN = 1.0
"""s. A driver's correction takes about so long; the live predictor remembers two seconds."""
ACTIVITY_STEP = 0.05
"""s. A wheel sensor of 0.1 deg and a ratio of 16 then round the rate to 0.002 rad/s."""
_INSTANTS_NS = np.round(np.arange(-ACTIVITY_SPAN, 0.5 * ACTIVITY_STEP, ACTIVITY_STEP) / NANOSECOND).astype(np.int64)


def activity_instants(start_ns: int | np.ndarray) -> np.ndarray:
    """Instants [ns] at which `steering_activity` wants the road wheel angle: (..., 21) for starts (...)."""
    return np.asarray(start_ns, np.int64)[..., None] + _INSTANTS_NS


def steering_activity(angle: np.ndarray) -> np.ndarray:
    """Root mean square steering rate [rad/s] of road wheel angles (..., 21) [rad] at `activity_instants`.

    NaN where one of them is: with a gap just before the start nothing is known of what the hands do.
    """
    rates = (angle[..., 1:] - angle[..., :-1]) / ACTIVITY_STEP
    return np.sqrt((rates * rates).mean(axis=-1))


def conditions(velocity_x: float | np.ndarray, yaw_rate: float | np.ndarray, velocity_x_dot: float | np.ndarray,
               activity: float | np.ndarray) -> np.ndarray:
    """(..., 4), columns as CONDITIONS. velocity_x [m/s], yaw_rate [rad/s]: at the INS point; velocity_x_dot [m/s^2];
    activity: of `steering_activity` [rad/s].
    """
    parts = np.broadcast_arrays(*magnitudes(*map(np.asarray, (velocity_x, yaw_rate, velocity_x_dot, activity))))
    return np.stack([np.asarray(part, float) for part in parts], axis=-1)


def magnitudes(velocity_x: Any, yaw_rate: Any, velocity_x_dot: Any, activity: Any) -> tuple[Any, ...]:
    """The four of `conditions`, one by one: of numbers, with which one start takes a tenth of the time, or arrays."""
    return abs(velocity_x), abs(velocity_x * yaw_rate), abs(velocity_x_dot), abs(activity)


def conditions_at(signals: LogSignals, starts_ns: np.ndarray) -> np.ndarray:
    """(n, 4), columns as CONDITIONS, at starts (n,) [ns] of a recorded drive; NaN where not known."""
    speed, yaw_rate, acceleration = signals.ins_at(starts_ns, "velocity_x", "yaw_rate", "velocity_x_dot")
    activity = steering_activity(signals.road_wheel_angle_at(activity_instants(starts_ns)))
    return conditions(speed, yaw_rate, acceleration, activity)
