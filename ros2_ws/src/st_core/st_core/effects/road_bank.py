"""Bank angle of the road, constant relative to the car: a_y = -g sin(angle).

The angle is a parameter, because no sensor of the suite separates bank from body roll. An accelerometer measures the
specific force, which exceeds the lateral acceleration by g sin(angle).
"""

from ..ops import sin
from ..tyres import GRAVITY
from ._base import Effect, Parameter, register


@register
class RoadBank(Effect):
    physics = "a_y = -g sin(angle) on the car, not measured by an accelerometer"
    excited_by = "straight driving with an accelerometer; the same road in both directions"
    kind, slot = "environment", "body"
    confounded_with = ("crosswind", "road_slope", "lateral_acceleration_bias", "steering_offset")
    parameter = Parameter("angle", "rad", null=0.0, initial=0.02, bounds=(-0.3, 0.3), odd=True,
                          meaning="road rises to the left of the car",
                          source="crossfall 0.025, motorway curves 0.07, tracks 0.3")

    @staticmethod
    def acceleration(instant, prepared, theta):
        zero = 0.0 * instant.velocity_x
        return zero, zero - GRAVITY * sin(theta.angle), zero

    @staticmethod
    def specific_force(instant, prepared, theta):
        zero = 0.0 * instant.velocity_x
        return zero, zero + GRAVITY * sin(theta.angle)
