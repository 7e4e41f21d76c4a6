"""Planar road inclined in the map frame, on which gravity pulls in the same map direction at any heading.

The component of gravity along the car is part of the measured v_x_dot. An accelerometer measures the specific force,
which does not contain gravity.
"""

from ..ops import cos, sin
from ..tyres import GRAVITY
from ._base import Effect, Parameter, register


def compute_slope(instant, theta):
    """Slope of the road in body axes (forward, to the left) [1], positive for a rising road."""
    cosine, sine = cos(instant.yaw), sin(instant.yaw)
    east, north = sin(theta.slope_x), sin(theta.slope_y)
    return east * cosine + north * sine, north * cosine - east * sine


@register
class RoadSlope(Effect):
    physics = "a_y = -g (sin(slope_y) cos(yaw) - sin(slope_x) sin(yaw)) on the car, not measured by an accelerometer"
    excited_by = "the same place in two directions, with an accelerometer, which measures wind force but not gravity"
    kind, slot = "environment", "body"
    confounded_with = ("crosswind", "road_bank", "steering_offset")
    parameters = (
        Parameter("slope_x", "rad", null=0.0, initial=0.01, bounds=(-0.2, 0.2), meaning="rises towards map x (east)",
                  source="proving grounds drain at 0.01-0.02, hillsides 0.1"),
        Parameter("slope_y", "rad", null=0.0, initial=0.02, bounds=(-0.2, 0.2), odd=True,
                  meaning="rises towards map y (north)", source="proving grounds drain at 0.01-0.02, hillsides 0.1"),
    )

    @staticmethod
    def acceleration(instant, prepared, theta):
        zero = 0.0 * instant.velocity_x
        return zero, zero - GRAVITY * compute_slope(instant, theta)[1], zero

    @staticmethod
    def specific_force(instant, prepared, theta):
        forward, left = compute_slope(instant, theta)
        return GRAVITY * forward, GRAVITY * left
