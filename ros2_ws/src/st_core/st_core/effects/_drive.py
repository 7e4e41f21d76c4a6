"""Drive and brake force on the axles, from the motion: no sensor of the suite measures them."""

from ..ops import maximum, minimum, sin
from ._base import Parameter

DRIVE_FRONT = Parameter("drive_front", "1", null=1.0, initial=1.0, bounds=(0.0, 1.0), fit=False,
                        meaning="share of the drive force on the front axle", source="Leaf; 0 for rear-wheel drive")
BRAKE_FRONT = Parameter("brake_front", "1", null=0.65, initial=0.65, bounds=(0.0, 1.0), fit=False,
                        meaning="share of the brake force on the front axle", source="passenger cars 0.6-0.7")


def axle_drive_forces(lateral_front, at, theta, mass):
    """Longitudinal forces (front, rear) [N] along the wheels that the forward motion asks for; drag is left out.

        F_x = m (v_x_dot - v_y r) + F_f sin delta,   drive and brake each shared by the axles

    lateral_front: F_f [N]. theta: drive_front, brake_front [1]. mass: m [kg].
    """
    force = mass * (at.velocity_x_dot - at.velocity_y * at.yaw_rate) + lateral_front * sin(at.road_wheel_angle)
    push, brake = maximum(force, 0.0), minimum(force, 0.0)
    return (theta.drive_front * push + theta.brake_front * brake,
            (1.0 - theta.drive_front) * push + (1.0 - theta.brake_front) * brake)
