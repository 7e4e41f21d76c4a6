"""Dynamic single-track model with Magic Formula tyres and quasi-static longitudinal load transfer.

    F_z,f = m / l (g l_r - a_x h),  F_z,r = m / l (g l_f + a_x h),  a_x = v_x_dot (the input)

The axle force is twice the force of one tyre at half the axle load. Source: paper, dynamic model, appendix.
"""

from typing import NamedTuple

from ..ops import cos, sin
from ..tyres import GRAVITY, MagicFormula, magic_formula_coefficients, magic_formula_force
from ..vehicle import VehicleParameters
from ._base import Model, make_rhs


class Parameters(NamedTuple):
    """mass [kg], yaw_inertia [kg m^2], lengths [m], minimum_slip_speed [m/s]; coefficients of one tyre per axle."""

    mass: float
    yaw_inertia: float
    cg_to_front_axle: float
    cg_to_rear_axle: float
    cg_height: float
    minimum_slip_speed: float
    tyre_front: MagicFormula
    tyre_rear: MagicFormula


def parameters(vehicle: VehicleParameters) -> Parameters:
    return Parameters(*(getattr(vehicle, name) for name in Parameters._fields))


def axle_loads(velocity_x_dot, p: Parameters):
    """Normal loads (front, rear) of the axles [N] at a forward acceleration [m/s^2]; they add up to m g."""
    per_length = p.mass / (p.cg_to_front_axle + p.cg_to_rear_axle)
    transfer = per_length * velocity_x_dot * p.cg_height
    return per_length * GRAVITY * p.cg_to_rear_axle - transfer, per_length * GRAVITY * p.cg_to_front_axle + transfer


def inputs(road_wheel_angle, velocity_x_dot, p: Parameters):
    """(sin delta, cos delta, velocity_x_dot, B, 2 D [N], E of the front tyre, B, 2 D [N], E of the rear tyre)."""
    load_front, load_rear = axle_loads(velocity_x_dot, p)
    b_front, d_front, e_front = magic_formula_coefficients(0.5 * load_front, p.tyre_front)
    b_rear, d_rear, e_rear = magic_formula_coefficients(0.5 * load_rear, p.tyre_rear)
    return (sin(road_wheel_angle), cos(road_wheel_angle), velocity_x_dot,
            b_front, 2.0 * d_front, e_front, b_rear, 2.0 * d_rear, e_rear)


def axle_forces(slip_front, slip_rear, w, p: Parameters):
    """Lateral forces (front, rear) of the axles [N], positive to the left."""
    _, _, _, b_front, d_front, e_front, b_rear, d_rear, e_rear = w
    return (magic_formula_force(slip_front, b_front, d_front, e_front, p.tyre_front),
            magic_formula_force(slip_rear, b_rear, d_rear, e_rear, p.tyre_rear))


MODEL = Model("nonlinear", parameters, inputs, make_rhs(axle_forces), axle_forces=axle_forces)
