"""Bias of the yaw rate sensor: its reading at standstill."""

from ._base import Effect, Parameter, register


@register
class YawRateBias(Effect):
    physics = "measured r = r + bias; the heading of the INS is unchanged"
    excited_by = "any driving, even straight, with measured heading"
    kind, slot = "sensors", "yaw rate"
    needs = ("yaw_rate",)
    confounded_with = ("steering_offset", "crosswind")
    order = 60
    parameter = Parameter("bias", "rad/s", null=0.0, initial=0.005, bounds=(-0.1, 0.1), odd=True,
                          meaning="bias of the reading, positive to the left",
                          source="automotive yaw rate sensors: 0.5-3 deg/s over temperature", identity="yaw_rate_bias")

    @staticmethod
    def observe(measured, theta):
        return measured._replace(yaw_rate=measured.yaw_rate + theta.bias)
