"""Saturation of a linear rear axle, with the equation of `front_saturation`."""

from ._base import register
from .front_saturation import FrontSaturation, saturate


@register
class RearSaturation(FrontSaturation):
    physics = "F_r = F / (1 + s u^2 + s^2 u^4)^(1/4), F = -C_r alpha, u = F / static load; limit F_z / sqrt(s)"
    excited_by = "cornering above 4 m/s^2 with measured sideslip"
    slot = "rear axle"
    confounded_with = ("tyre_saturation", "rear_stiffness", "cg_position")

    @staticmethod
    def constants(vehicle):
        return 2.0 * vehicle.static_tyre_load_rear

    @staticmethod
    def axle_forces(forces, slip_front, slip_rear, instant, prepared, theta):
        front, rear = forces(slip_front, slip_rear, instant)
        return front, saturate(rear, theta.constants, theta.saturation)
