"""Dead time in the steering: delta(t) = delta_measured(t - time).

An error of the time stamps has the same equation: time > 0 if the steering is stamped too early relative to the INS.
"""

from ._base import ANY, TOTAL_DELAY, Effect, Parameter, register


@register
class SteeringDelay(Effect):
    physics = "delta(t) = delta_measured(t - time): dead time, or an error of the time stamps"
    excited_by = "sweeps to 2.5 Hz and step steers; frequencies above 1 / (2 pi time) separate it from a lag"
    kind, slot = "physics", "steering"
    confounded_with = ("steering_lag", "tyre_relaxation", "yaw_inertia")
    combinations = (TOTAL_DELAY,)
    applies_to = ANY
    order = 10
    parameter = Parameter("time", "s", null=0.0, initial=0.04, bounds=(-0.2, 0.5), model_error=0.004,
                          meaning="delay of the wheels behind the measured angle",
                          source="buses and filters cause up to 0.2 s; no steering has a delay of 0.5 s")

    @staticmethod
    def steering(time, angle, is_start, theta):
        return time + theta.time, angle
