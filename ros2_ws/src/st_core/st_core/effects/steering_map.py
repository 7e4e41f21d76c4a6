"""Steering ratio that depends on the angle: delta = delta' (1 + curvature delta'^2), delta' at constant ratio.

Acts after steering_ratio and steering_offset, so that the map is centred where the wheels are straight. For
curvature < 0 it decreases beyond delta'^2 = -1 / (3 curvature); at the lower bound of curvature that is 0.6 rad.
"""

from ._base import ANY, Effect, Parameter, register


@register
class SteeringMap(Effect):
    name = "steering_map"
    physics = "delta = delta_measured (1 + curvature delta_measured^2): > 0 a more direct ratio at large angles"
    excited_by = "large angles, so slow and tight turns, next to small ones; not observable below 0.1 rad"
    kind, slot = "physics", "steering"
    confounded_with = ("steering_ratio",)
    applies_to = ANY
    order = 70
    parameters = (
        Parameter("curvature", "1/rad^2", null=0.0, initial=0.55, bounds=(-0.9, 3.0),
                  meaning="relative change of the ratio per squared road wheel angle; 0.55 is 5 % at 0.3 rad",
                  source="linkages 5 %, racks of variable pitch up to 25 % at 0.3 rad; model error: deviation of 14 "
                         "estimates on simulated cars without a map, method of moments", model_error=0.25),
    )

    @staticmethod
    def inputs(road_wheel_angle, velocity_x_dot, signals, theta):
        angle = road_wheel_angle
        return angle * (1.0 + theta.curvature * angle * angle), velocity_x_dot
