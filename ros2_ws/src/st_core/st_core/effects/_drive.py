"""Drive and brake force on the axles, from the motion: no sensor of the suite measures them."""

from typing import NamedTuple

from ..ops import maximum, minimum, sin


class Drive(NamedTuple):
    """mass [kg]; drive_front, brake_front: share of the drive and of the brake force on the front axle [1]."""

    mass: float
    drive_front: float
    brake_front: float


def drive_of(vehicle) -> Drive:
    return Drive(vehicle.mass, vehicle.drive_front, vehicle.brake_front)


def axle_drive_forces(lateral_front, at, car: Drive):
    """Longitudinal forces (front, rear) [N] along the wheels that the forward motion requires; drag is left out.

        F_x = m (v_x_dot - v_y r) + F_f sin delta,   drive and brake each shared by the axles

    lateral_front: F_f [N].
    """
    force = car.mass * (at.velocity_x_dot - at.velocity_y * at.yaw_rate) + lateral_front * sin(at.road_wheel_angle)
    push, brake = maximum(force, 0.0), minimum(force, 0.0)
    return (car.drive_front * push + car.brake_front * brake,
            (1.0 - car.drive_front) * push + (1.0 - car.brake_front) * brake)
