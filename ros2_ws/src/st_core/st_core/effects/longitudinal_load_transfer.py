"""Load moves between the axles under acceleration, and the axle forces with it, in proportion.

    F_f = F_f0 (1 - height a_x / (g l_r)),   F_r = F_r0 (1 + height a_x / (g l_f)),   a_x = v_x_dot

height is what the base model lacks: all of it for linear tyres, the excess over the vehicle file for the Magic Formula.
"""

from typing import NamedTuple

from ..ops import maximum
from ..tyres import GRAVITY
from ._base import Effect, Parameter, register


class Car(NamedTuple):
    cg_to_front_axle: float
    cg_to_rear_axle: float


@register
class LongitudinalLoadTransfer(Effect):
    name = "longitudinal_load_transfer"
    physics = "axle force in proportion to its load m/l (g l_r - a_x h) in front, m/l (g l_f + a_x h) behind"
    excited_by = "braking and power in turns"
    prepared = ("scale_front", "scale_rear")
    order = 70
    parameters = (
        Parameter("height", "m", null=0.0, initial=0.4, bounds=(-0.6, 1.2),
                  meaning="of the CG, beyond the base model's", source="CG of passenger cars 0.4-0.8 m"),
    )

    @staticmethod
    def constants(vehicle):
        return Car(vehicle.cg_to_front_axle, vehicle.cg_to_rear_axle)

    @staticmethod
    def prepare(road_wheel_angle, velocity_x_dot, signals, theta):
        moved = theta.height * velocity_x_dot / GRAVITY
        return (maximum(1.0 - moved / theta.car.cg_to_rear_axle, 0.0),
                maximum(1.0 + moved / theta.car.cg_to_front_axle, 0.0))

    @staticmethod
    def axle_forces(forces, slip_front, slip_rear, at, given, theta):
        front, rear = forces(slip_front, slip_rear, at)
        return front * given[0], rear * given[1]
