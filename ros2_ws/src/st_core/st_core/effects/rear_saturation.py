"""Saturation of a linear rear axle, with the equation of `front_saturation`."""

from ._base import Effect, register
from .front_saturation import SATURATION, saturate


@register
class RearSaturation(Effect):
    physics = "F_r = F / (1 + s u^2 + s^2 u^4)^(1/4), F = -C_r alpha, u = F / static load; limit F_z / sqrt(s)"
    excited_by = "cornering above 4 m/s^2 with measured sideslip"
    kind, slot = "physics", "rear axle"
    confounded_with = ("tyre_saturation", "rear_stiffness", "cg_position")
    applies_to = frozenset(("linear",))
    order = 10
    parameter = SATURATION

    @staticmethod
    def constants(vehicle):
        return 2.0 * vehicle.static_tyre_load_rear

    @staticmethod
    def axle_forces(forces, slip_front, slip_rear, instant, prepared, theta):
        front, rear = forces(slip_front, slip_rear, instant)
        return front, saturate(rear, theta.constants, theta.saturation)
