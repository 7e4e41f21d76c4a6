"""Kinematic single-track model: wheels roll without slip, so the curvature depends only on the steering.

    x_dot = v_x cos(psi + beta),  y_dot = v_x sin(psi + beta),  v_x_dot: input,  psi_dot = v_x / l cos(beta) tan(delta)
    beta = atan(l_r / l tan(delta))

v_x is the speed of the CG along its path. v_y and yaw_rate do not occur in the equations; their derivatives are zero,
so they keep their initial values. Source: paper, kinematic model.
"""

from typing import NamedTuple

from ..ops import atan, cos, sin, tan
from ..vehicle import VehicleParameters
from ._base import Model


class Parameters(NamedTuple):
    """Lengths [m]."""

    wheelbase: float
    cg_to_rear_axle: float


def parameters(vehicle: VehicleParameters) -> Parameters:
    return Parameters(vehicle.wheelbase, vehicle.cg_to_rear_axle)


def inputs(road_wheel_angle, velocity_x_dot, p: Parameters):
    """(beta [rad], curvature of the path psi_dot / v_x [1/m], velocity_x_dot [m/s^2])."""
    tangent = tan(road_wheel_angle)
    beta = atan(p.cg_to_rear_axle / p.wheelbase * tangent)
    return beta, cos(beta) * tangent / p.wheelbase, velocity_x_dot


def rhs(state, w, p: Parameters):
    _, _, velocity_x, _, yaw, _ = state
    beta, curvature, velocity_x_dot = w
    course = yaw + beta
    zero = 0.0 * velocity_x
    return (velocity_x * cos(course), velocity_x * sin(course), velocity_x_dot, zero, velocity_x * curvature, zero)


MODEL = Model("kinematic", parameters, inputs, rhs)
