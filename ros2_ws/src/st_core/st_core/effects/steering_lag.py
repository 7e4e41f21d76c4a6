"""First-order lag in the steering: time_constant delta_dot = delta_measured - delta.

Since delta depends only on the measured angle u, it is computed for the whole recording, without an extra state and
exactly for a piecewise linear u. At the first sample and after each gap, the steady state delta = u is assumed.

    delta_k = e delta_{k-1} + (m - e) u_{k-1} + (1 - m) u_k,   e = exp(-x),   m = (1 - e) / x,   x = dt / time_constant
"""

import numpy as np

from ._base import ANY, TOTAL_DELAY, Effect, Parameter, register
from .steering_backlash import compose_affine, scan


@register
class SteeringLag(Effect):
    physics = "time_constant delta_dot = delta_measured - delta: column, actuator, or low-pass filter of the sensor"
    excited_by = "sweeps to 2.5 Hz and step steers"
    kind, slot = "physics", "steering"
    confounded_with = ("steering_delay", "yaw_inertia", "tyre_relaxation")
    combinations = (TOTAL_DELAY,)
    applies_to = ANY
    order = 30
    parameter = Parameter("time_constant", "s", null=0.0, initial=0.06, bounds=(0.0, 0.5), model_error=0.004,
                          meaning="time to 63 % of a step",
                          source="power steering 0.03-0.1 s; the lag estimator of openpilot allows 0.5 s")

    @staticmethod
    def steering(time, angle, is_start, theta):
        spacing = np.diff(time, prepend=time[:1])
        previous = np.concatenate((angle[:1], angle[:-1]))
        with np.errstate(divide="ignore", invalid="ignore"):
            x = np.where(is_start, 1.0, spacing / theta.time_constant)
            m = -np.expm1(-x) / x
        factor = np.where(is_start, 0.0, np.exp(-x))
        offset = np.where(is_start, angle, (m - factor) * previous + (1.0 - m) * angle)
        return time, scan((factor, offset), compose_affine)[1]
