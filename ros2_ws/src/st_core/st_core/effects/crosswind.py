"""Side force of a steady wind: the force in moving air minus the force in still air.

    F_y = rho / 2 side_area (|u| u_y - |u_0| u_y0),   M_z = side_force_arm F_y,
    u = wind - velocity in body axes, u_0 = -velocity

Drag is part of the measured v_x_dot.
"""

from typing import NamedTuple

from ..ops import cos, sin, sqrt
from ._base import Effect, Parameter, register

AIR_DENSITY = 1.2  # kg/m^3
SMALL_SQUARE = 1.0e-6  # (m/s)^2; keeps the derivative of the root finite


class Car(NamedTuple):
    mass: float  # kg
    yaw_inertia: float  # kg m^2
    side_area: float  # m^2
    side_force_arm: float  # m ahead of the CG


def compute_flow_term(along, across):
    """|u| u_y [m^2/s^2] of an air velocity u = (along, across) [m/s], relative to the car in body axes."""
    return sqrt(along * along + across * across + SMALL_SQUARE) * across


@register
class Crosswind(Effect):
    physics = "side force rho/2 side_area abs(u) u_y at side_force_arm ahead of the CG, u: air relative to the car"
    excited_by = "straight driving in two directions; two speeds separate it from a steering offset"
    kind, slot = "environment", "body"
    confounded_with = ("steering_offset", "road_slope", "road_bank", "lateral_acceleration_bias")
    parameters = (
        Parameter("wind_x", "m/s", null=0.0, initial=1.0, bounds=(-30.0, 30.0), source="a gale reaches 20 m/s",
                  meaning="wind towards east, if the file's side_area is right"),
        Parameter("wind_y", "m/s", null=0.0, initial=5.0, bounds=(-30.0, 30.0), odd=True,
                  meaning="wind towards north, if the file's side_area is right", source="a gale reaches 20 m/s"),
    )

    @staticmethod
    def constants(vehicle):
        return Car(vehicle.mass, vehicle.yaw_inertia, vehicle.side_area, vehicle.side_force_arm)

    @staticmethod
    def acceleration(instant, prepared, theta):
        car, cosine, sine = theta.constants, cos(instant.yaw), sin(instant.yaw)
        along = theta.wind_x * cosine + theta.wind_y * sine - instant.velocity_x
        across = theta.wind_y * cosine - theta.wind_x * sine - instant.velocity_y
        force = 0.5 * AIR_DENSITY * car.side_area * (
            compute_flow_term(along, across) - compute_flow_term(-instant.velocity_x, -instant.velocity_y))
        return 0.0 * force, force / car.mass, car.side_force_arm * force / car.yaw_inertia
