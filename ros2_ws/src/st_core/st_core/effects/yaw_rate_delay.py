"""Delay of the measured yaw rate, to first order: r_measured(t) = r(t - time) ~ r - time r_dot; time > 0 for a lag.

The correction needs the yaw acceleration of a recording. A single live sample, which has none, is not corrected.
"""

from ._base import Effect, Parameter, register


@register
class YawRateDelay(Effect):
    physics = "measured r(t) = r(t - time) ~ r - time r_dot: sensor filter, or time stamps of a different clock"
    excited_by = "sweeps and step steers, with measured heading"
    kind, slot = "sensors", "yaw rate"
    needs = ("yaw_rate",)
    order = 20  # before scale and bias; as both are constant, the reading does not depend on the order
    parameter = Parameter("time", "s", null=0.0, initial=0.03, bounds=(-0.1, 0.2), identity="yaw_rate_lag",
                          meaning="delay of the yaw rate, positive for a lag",
                          source="filters of yaw rate sensors, 10-50 Hz: 5-30 ms; stamping on arrival adds as much")

    @staticmethod
    def observe(measured, theta):
        return measured._replace(yaw_rate=measured.yaw_rate - theta.time * measured.yaw_acceleration)
