"""Scale error of the yaw rate sensor."""

from ._base import Effect, Parameter, register


@register
class YawRateScale(Effect):
    physics = "measured r = factor * r; the heading of the INS is unchanged"
    excited_by = "turning, by comparison of r v_x with a_y, or with the heading over a whole lap"
    kind, slot = "sensors", "yaw rate"
    needs = ("yaw_rate",)
    confounded_with = ("steering_ratio", "speed_scale")
    order = 40
    parameter = Parameter("factor", "1", null=1.0, initial=1.02, bounds=(0.8, 1.25),
                          meaning="ratio of measured to true", source="gyroscopes: 2-5 %", identity="yaw_rate_scale")

    @staticmethod
    def observe(measured, theta):
        return measured._replace(yaw_rate=measured.yaw_rate * theta.factor,
                                 yaw_acceleration=measured.yaw_acceleration * theta.factor)
