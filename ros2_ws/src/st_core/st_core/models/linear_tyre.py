"""Dynamic single-track model with linear tyres: F_y = -C alpha per axle. Source: paper, dynamic model.

Slip and road wheel angles are not linearised; only the tyre is linear.
"""

from typing import NamedTuple

from ..ops import cos, sin
from ..tyres import linear_force
from ..vehicle import VehicleParameters
from ._base import Model, make_rhs


class Parameters(NamedTuple):
    """mass [kg], yaw_inertia [kg m^2], lengths [m], stiffness per axle [N/rad, > 0], minimum_slip_speed [m/s]."""

    mass: float
    yaw_inertia: float
    cg_to_front_axle: float
    cg_to_rear_axle: float
    cornering_stiffness_front: float
    cornering_stiffness_rear: float
    minimum_slip_speed: float


def parameters(vehicle: VehicleParameters) -> Parameters:
    return Parameters(*(getattr(vehicle, name) for name in Parameters._fields))


def inputs(road_wheel_angle, velocity_x_dot, p: Parameters):
    """(sin delta, cos delta, velocity_x_dot [m/s^2])."""
    return sin(road_wheel_angle), cos(road_wheel_angle), velocity_x_dot


def axle_forces(slip_front, slip_rear, w, p: Parameters):
    """Lateral forces (front, rear) of the axles [N], positive to the left."""
    return linear_force(slip_front, p.cornering_stiffness_front), linear_force(slip_rear, p.cornering_stiffness_rear)


MODEL = Model("linear", parameters, inputs, make_rhs(axle_forces), axle_forces=axle_forces)
