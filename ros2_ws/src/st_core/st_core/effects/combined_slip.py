"""Reduction of the lateral force of an axle by drive and brake forces (friction ellipse).

F_x is the force that the forward motion requires, D the peak force of the axle at its load; |F_x| is limited to 0.98 D.
"""

from typing import NamedTuple

from ..models.nonlinear_tyre import Parameters as TyreParameters
from ..models.nonlinear_tyre import axle_loads, parameters
from ..ops import maximum, minimum, sin, sqrt
from ..tyres import magic_formula_peak
from ._base import Effect, Parameter, register

MAX_SQUARE_RATIO = 0.98**2  # limit of (F_x / D)^2 that keeps the derivative of the root finite


class ForceDistribution(NamedTuple):
    mass: float  # kg
    drive_front: float  # fraction of the drive force on the front axle
    brake_front: float  # fraction of the brake force on the front axle


class Constants(NamedTuple):
    distribution: ForceDistribution
    tyres: TyreParameters


def get_force_distribution(vehicle) -> ForceDistribution:
    return ForceDistribution(vehicle.mass, vehicle.drive_front, vehicle.brake_front)


def compute_drive_forces(lateral_front, instant, car: ForceDistribution):
    """Longitudinal forces (front, rear) along the wheels [N] that the forward motion requires, without drag.

        F_x = m (v_x_dot - v_y r) + F_f sin delta,   divided between the axles as drive or brake force

    lateral_front: F_f [N].
    """
    acceleration = instant.velocity_x_dot - instant.velocity_y * instant.yaw_rate
    force = car.mass * acceleration + lateral_front * sin(instant.road_wheel_angle)
    drive, brake = maximum(force, 0.0), minimum(force, 0.0)
    return (car.drive_front * drive + car.brake_front * brake,
            (1.0 - car.drive_front) * drive + (1.0 - car.brake_front) * brake)


def compute_lateral_factor(force, peak, share):
    """Factor by which a longitudinal force [N] reduces the lateral force of an axle. peak: largest axle force [N]."""
    ratio = force / peak
    return 1.0 - share + share * sqrt(1.0 - minimum(ratio * ratio, MAX_SQUARE_RATIO))


@register
class CombinedSlip(Effect):
    physics = "F_y = F_y0 (1 - share + share sqrt(1 - (F_x / D)^2)) per axle, F_x from the forward motion"
    excited_by = "braking or accelerating in turns; not observable below 0.4 g"
    kind, slot = "physics", "both axles"
    confounded_with = ("steered_drive_force", "longitudinal_load_transfer")
    prepared = ("peak_front", "peak_rear")
    order = 80
    parameter = Parameter("share", "1", null=0.0, initial=1.0, bounds=(0.0, 1.0), meaning="1: the full ellipse",
                          source="theory", theory=1.0)

    @staticmethod
    def constants(vehicle):
        return Constants(get_force_distribution(vehicle), parameters(vehicle))

    @staticmethod
    def prepare(road_wheel_angle, velocity_x_dot, signals, theta):
        tyres = theta.constants.tyres
        load_front, load_rear = axle_loads(velocity_x_dot, tyres)
        return (2.0 * magic_formula_peak(0.5 * load_front, tyres.tyre_front),
                2.0 * magic_formula_peak(0.5 * load_rear, tyres.tyre_rear))

    @staticmethod
    def axle_forces(forces, slip_front, slip_rear, instant, prepared, theta):
        front, rear = forces(slip_front, slip_rear, instant)
        longitudinal_front, longitudinal_rear = compute_drive_forces(front, instant, theta.constants.distribution)
        return (front * compute_lateral_factor(longitudinal_front, prepared[0], theta.share),
                rear * compute_lateral_factor(longitudinal_rear, prepared[1], theta.share))
