"""Compliance of the front suspension under lateral force: delta = delta_measured - compliance F_f.

a' = a + compliance F_f(a') is solved for the slip angle a' in two Newton steps from a' = a with the slope at zero slip;
this is exact for a linear tyre. At the limit of adhesion the error is about compliance F_f (1 - 1/slope)^2: at
1e-6 rad/N, 3e-5 rad for the Leaf and 2e-4 rad for the Genesis.
"""

from ._base import Effect, Parameter, register


@register
class SteeringCompliance(Effect):
    physics = "delta = delta_measured - compliance F_front; increases the understeer gradient by compliance m l_r / l"
    excited_by = "cornering near the limit; below 0.4 g not separable from a softer front axle"
    kind, slot = "physics", "front axle"
    confounded_with = ("front_stiffness", "roll_steer", "steering_ratio")
    combinations = ("front cornering stiffness over axle load", "stability factor K", "steady-state yaw gain at 20 m/s")
    costly = True
    order = 83  # before steered_drive_force, so that only the tyre force deflects the suspension
    parameter = Parameter("compliance", "rad/N", null=0.0, initial=1.0e-6, bounds=(0.0, 1.0e-5),
                          meaning="steer angle towards the outside of the turn per lateral force of the front axle",
                          source="kinematics and compliance tests: 0.05-0.2 deg/kN per axle")

    @staticmethod
    def constants(vehicle):
        return vehicle.cornering_stiffness_front

    @staticmethod
    def axle_forces(forces, slip_front, slip_rear, instant, prepared, theta):
        slope = 1.0 + theta.compliance * theta.constants
        front, _ = forces(slip_front, slip_rear, instant)
        first_iterate = slip_front + theta.compliance * front / slope
        front, _ = forces(first_iterate, slip_rear, instant)
        second_iterate = first_iterate - (first_iterate - slip_front - theta.compliance * front) / slope
        return forces(second_iterate, slip_rear, instant)
