"""Saturation of a linear front axle, without a tyre curve from the vehicle file.

s = 1 / mu^2; s = 0 is linear. At the slip where the linear force F equals the limit, the saturated force is 0.76 F. Up
to twice this slip, the equation fits brush and Magic Formula curves with an error below 2 % of their peak (4 % for
C = 1.3, E = -3).
"""

from ..ops import sqrt
from ._base import Effect, Parameter, register


def saturate(force, load, saturation):
    """Saturated axle force [N] from the linear force [N] and the static load [N] of the axle."""
    u = force / load
    v = saturation * u * u
    return force / sqrt(sqrt(1.0 + v + v * v))


@register
class FrontSaturation(Effect):
    physics = "F_f = F / (1 + s u^2 + s^2 u^4)^(1/4), F = -C_f alpha, u = F / static load; limit F_z / sqrt(s)"
    excited_by = "cornering above 4 m/s^2"
    kind, slot = "physics", "front axle"
    confounded_with = ("tyre_saturation", "front_stiffness", "steering_compliance")
    applies_to = frozenset(("linear",))
    order = 10
    parameter = Parameter("saturation", "1", null=0.0, initial=1.0, bounds=(0.0, 16.0),
                          meaning="squared ratio of static load to the axle's largest force: 1 / mu^2",
                          source="mu from 0.25 to infinity; dry asphalt: mu 0.8-1.2, s 0.7-1.6")

    @staticmethod
    def constants(vehicle):
        return 2.0 * vehicle.static_tyre_load_front

    @staticmethod
    def axle_forces(forces, slip_front, slip_rear, instant, prepared, theta):
        front, rear = forces(slip_front, slip_rear, instant)
        return saturate(front, theta.constants, theta.saturation), rear
