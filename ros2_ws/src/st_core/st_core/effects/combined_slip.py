"""Drive and brake force take lateral force away: friction ellipse per axle.

    F_y = F_y0 (1 - share + share sqrt(1 - (F_x / D)^2)),   F_x = m v_x_dot shared by the axles

D is the peak of the axle at its load. Drag is left out of F_x. |F_x| is held at 0.98 D.
"""

from typing import NamedTuple

from ..models.nonlinear_tyre import Parameters as TyreParameters
from ..models.nonlinear_tyre import axle_loads, parameters
from ..ops import maximum, minimum, sqrt
from ..tyres import magic_formula_coefficients
from ._base import Effect, Parameter, register

LARGEST = 0.98**2


class Car(NamedTuple):
    mass: float
    tyres: TyreParameters


def left(force, peak):
    """Share of the lateral force an axle keeps under a longitudinal force, both in N."""
    used = force / peak
    return sqrt(1.0 - minimum(used * used, LARGEST))


@register
class CombinedSlip(Effect):
    name = "combined_slip"
    physics = "F_y = F_y0 (1 - share + share sqrt(1 - (F_x / D)^2)) per axle, F_x = m v_x_dot"
    excited_by = "braking or power in a turn, 0.4 g; nothing else"
    prepared = ("left_front", "left_rear")
    order = 80
    parameters = (
        Parameter("share", "1", null=0.0, initial=1.0, bounds=(0.0, 1.0), meaning="1: the whole ellipse",
                  source="theory: 1"),
        Parameter("drive_front", "1", null=1.0, initial=1.0, bounds=(0.0, 1.0), fit=False,
                  meaning="share of the drive force on the front axle", source="Leaf; 0 for rear-wheel drive"),
        Parameter("brake_front", "1", null=0.65, initial=0.65, bounds=(0.0, 1.0), fit=False,
                  meaning="share of the brake force on the front axle", source="passenger cars 0.6-0.7"),
    )

    @staticmethod
    def constants(vehicle):
        return Car(vehicle.mass, parameters(vehicle))

    @staticmethod
    def prepare(road_wheel_angle, velocity_x_dot, signals, theta):
        tyres = theta.car.tyres
        force = theta.car.mass * velocity_x_dot
        push, brake = maximum(force, 0.0), minimum(force, 0.0)
        load_front, load_rear = axle_loads(velocity_x_dot, tyres)
        peak_front = 2.0 * magic_formula_coefficients(0.5 * load_front, tyres.tyre_front)[1]
        peak_rear = 2.0 * magic_formula_coefficients(0.5 * load_rear, tyres.tyre_rear)[1]
        front = left(theta.drive_front * push + theta.brake_front * brake, peak_front)
        rear = left((1.0 - theta.drive_front) * push + (1.0 - theta.brake_front) * brake, peak_rear)
        return 1.0 - theta.share + theta.share * front, 1.0 - theta.share + theta.share * rear

    @staticmethod
    def axle_forces(forces, slip_front, slip_rear, at, given, theta):
        front, rear = forces(slip_front, slip_rear, at)
        return front * given[0], rear * given[1]
