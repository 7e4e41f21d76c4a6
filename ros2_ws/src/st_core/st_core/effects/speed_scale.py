"""Scale error of both components of the velocity; positions are unchanged."""

from ._base import ANY, Effect, Parameter, register


@register
class SpeedScale(Effect):
    physics = "measured v_x, v_y = factor * v_x, factor * v_y; positions unchanged"
    excited_by = "any driving with position fixes: distance versus speed"
    kind, slot = "sensors", "velocity"
    needs = ("position",)
    confounded_with = ("steering_ratio", "yaw_rate_scale")
    applies_to = ANY
    order = 40
    parameter = Parameter("factor", "1", null=1.0, initial=1.02, bounds=(0.8, 1.25), identity="velocity_scale",
                          meaning="ratio of measured to true", source="wheel speeds with worn tyres: 2-4 %")

    @staticmethod
    def observe(measured, theta):
        return measured._replace(velocity_x=measured.velocity_x * theta.factor,
                                 velocity_y=measured.velocity_y * theta.factor)
