"""Lateral component of the drive and brake force of the steered wheels, F_x,front sin delta.

The base models, whose input is the forward acceleration, do not contain this component.
"""

from ..ops import tan
from ._base import Effect, Parameter, register
from .combined_slip import compute_drive_forces, get_force_distribution


@register
class SteeredDriveForce(Effect):
    physics = "F_y of the front axle + share F_x,front sin delta, F_x from the forward motion"
    excited_by = "braking or accelerating with the wheels turned: tight turns"
    kind, slot = "physics", "front axle"
    confounded_with = ("combined_slip", "longitudinal_load_transfer")
    order = 85
    parameter = Parameter("share", "1", null=0.0, initial=1.0, bounds=(0.0, 1.5), meaning="1: full force",
                          source="theory: 1")

    constants = staticmethod(get_force_distribution)

    @staticmethod
    def axle_forces(forces, slip_front, slip_rear, instant, prepared, theta):
        front, rear = forces(slip_front, slip_rear, instant)
        drive_front, _ = compute_drive_forces(front, instant, theta.constants)
        # The tangent is used because the equations of motion multiply the front force by cos delta.
        return front + theta.share * drive_front * tan(instant.road_wheel_angle), rear
