"""Delay of the measured position of the INS point, to first order: (x, y)_measured = (x, y) - t R(yaw) (v_x, v_y).

With t (parameter `time`) > 0 the measured position lags. `observe` applies this effect first and `correct` reverses it
last, when yaw and velocity are already corrected, so `correct` is the exact inverse of `observe`.
"""

from ..ops import cos, sin
from ._base import ANY, Effect, Parameter, register


@register
class PositionLag(Effect):
    physics = "measured (x, y) = (x, y) - time * ground velocity; yaw and velocity are unaffected"
    excited_by = "turns and braking, with position measurements"
    kind, slot = "sensors", "position"
    needs = ("position",)
    applies_to = ANY
    order = 5
    parameter = Parameter("time", "s", null=0.0, initial=0.05, bounds=(-0.2, 0.5), identity="position_lag",
                          meaning="delay of the position, positive for a lag", source="GNSS receivers 0.05-0.2 s")

    @staticmethod
    def observe(measured, theta):
        cosine, sine = cos(measured.yaw), sin(measured.yaw)
        east = measured.velocity_x * cosine - measured.velocity_y * sine
        north = measured.velocity_x * sine + measured.velocity_y * cosine
        return measured._replace(x=measured.x - theta.time * east, y=measured.y - theta.time * north)
