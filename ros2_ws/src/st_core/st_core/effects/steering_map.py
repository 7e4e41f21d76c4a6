"""Steering ratio that depends on the angle: delta = delta' (1 + curvature delta'^2), delta' at constant ratio.

It acts after steering_ratio and steering_offset, so it is symmetric about straight ahead. For curvature < 0,
delta decreases beyond delta' = 1 / sqrt(-3 curvature), which is 0.6 rad at the lower bound of curvature.
"""

from ._base import ANY, Effect, Parameter, register


@register
class SteeringMap(Effect):
    physics = "delta = delta_measured (1 + curvature delta_measured^2); > 0: a more direct ratio at large angles"
    excited_by = "large and small angles, which requires slow tight turns; not observable below 0.1 rad"
    kind, slot = "physics", "steering"
    confounded_with = ("steering_ratio",)
    applies_to = ANY
    order = 70
    parameter = Parameter("curvature", "1/rad^2", null=0.0, initial=0.55, bounds=(-0.9, 3.0),
                          meaning="relative increase of the angle per squared angle; 0.55 is 5 % at 0.3 rad",
                          source="linkages 5 %, variable-ratio racks up to 25 % at 0.3 rad; model error: standard "
                                 "deviation of 14 estimates on simulated cars without a map", model_error=0.25)

    @staticmethod
    def inputs(road_wheel_angle, velocity_x_dot, signals, theta):
        return road_wheel_angle * (1.0 + theta.curvature * road_wheel_angle * road_wheel_angle), velocity_x_dot
