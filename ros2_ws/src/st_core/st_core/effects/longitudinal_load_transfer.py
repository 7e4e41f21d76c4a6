"""Load transfer between the axles under acceleration, and its effect on the tyre forces.

    dF_z = m height v_x_dot / l from the front to the rear axle,   F' = F + F_MF(F_z -/+ dF_z) - F_MF(F_z)

height is added to the CG height of the base model, which is 0 with linear tyres, else that of the vehicle file. F_MF is
the Magic Formula of the vehicle file for the two tyres of an axle, F_z the axle load with the CG height of the file.
"""

from ..models.nonlinear_tyre import axle_loads
from ..models.nonlinear_tyre import parameters as tyre_parameters
from ..tyres import magic_formula_coefficients, magic_formula_force
from ._base import Effect, Parameter, register


def compute_force_change(slip, before, after, tyre):
    """Change of an axle force [N], twice that of a tyre. before, after: (B, D, E) without and with dF_z."""
    return 2.0 * (magic_formula_force(slip, after[0], after[1], after[2], tyre)
                  - magic_formula_force(slip, before[0], before[1], before[2], tyre))


@register
class LongitudinalLoadTransfer(Effect):
    physics = "load transfer m height v_x_dot / l from front to rear axle; the Magic Formula gives the change of force"
    excited_by = "braking and accelerating in turns"
    kind, slot = "physics", "both axles"
    confounded_with = ("combined_slip", "steered_drive_force")
    prepared = tuple(f"{coefficient}_{axle}_{load}" for load in ("before", "after") for axle in ("front", "rear")
                     for coefficient in "bde")
    costly = True
    order = 70
    parameter = Parameter("height", "m", null=0.0, initial=0.4, bounds=(-0.6, 1.2), quantity="cg_height",
                          meaning="CG height in excess of the base model's", source="CG of passenger cars 0.4-0.8 m")

    constants = staticmethod(tyre_parameters)

    @staticmethod
    def prepare(road_wheel_angle, velocity_x_dot, signals, theta):
        car = theta.constants
        front, rear = axle_loads(velocity_x_dot, car)
        transfer = car.mass * theta.height * velocity_x_dot / (car.cg_to_front_axle + car.cg_to_rear_axle)
        return (*magic_formula_coefficients(0.5 * front, car.tyre_front),
                *magic_formula_coefficients(0.5 * rear, car.tyre_rear),
                *magic_formula_coefficients(0.5 * (front - transfer), car.tyre_front),
                *magic_formula_coefficients(0.5 * (rear + transfer), car.tyre_rear))

    @staticmethod
    def axle_forces(forces, slip_front, slip_rear, instant, prepared, theta):
        front, rear = forces(slip_front, slip_rear, instant)
        front_before, rear_before, front_after, rear_after = prepared[:3], prepared[3:6], prepared[6:9], prepared[9:]
        return (front + compute_force_change(slip_front, front_before, front_after, theta.constants.tyre_front),
                rear + compute_force_change(slip_rear, rear_before, rear_after, theta.constants.tyre_rear))
