"""Load transfer to the outer wheels, which reduces the axle force because tyre force is degressive in load.

    dF = share m a_y h / track, divided between the axles;   F_axle = F_right(F_z / 2 + dF) + F_left(F_z / 2 - dF)

a_y = (F_f + F_r) / m is computed without the transfer. The difference from two equally loaded tyres is added to the
axle force. The longitudinal components of the two front tyre forces cause a yaw moment against the turn,

    M_z = -track / 2 sin delta (F_right - F_left),

which is modelled by two opposite axle forces, since the single-track model has no width.
"""

from typing import NamedTuple

from ..models.nonlinear_tyre import Parameters as TyreParameters
from ..models.nonlinear_tyre import axle_loads
from ..models.nonlinear_tyre import parameters as tyre_parameters
from ..ops import sin, tan
from ..tyres import tyre_force
from ._base import Effect, Parameter, register


class Constants(NamedTuple):
    tyres: TyreParameters
    track_width: float  # m
    load_transfer_front: float  # fraction of the transfer on the front axle


def compute_tyre_forces(slip, load, transfer, tyre):
    """(right, left) tyre force [N]. load: of each tyre without the transfer [N]. transfer: from left to right [N]."""
    return tyre_force(slip, load + transfer, tyre), tyre_force(slip, load - transfer, tyre)


@register
class LateralLoadTransfer(Effect):
    physics = ("F_axle = F_right(F_z/2 + dF) + F_left(F_z/2 - dF), dF = share m a_y h / track; "
               "M_z = -track/2 sin(delta) (F_right - F_left) of the front axle")
    excited_by = "cornering at the limit, transients; not observable below 0.4 g"
    kind, slot = "physics", "both axles"
    confounded_with = ("friction", "front_stiffness", "rear_stiffness")
    applies_to = frozenset(("nonlinear",))  # a linear tyre has no dependence on load
    prepared = ("load_front", "load_rear")
    costly = True
    order = 20
    parameter = Parameter("share", "1", null=0.0, initial=1.0, bounds=(0.0, 2.0), meaning="ratio to m a_y h / track",
                          source="theory: 1")

    @staticmethod
    def constants(vehicle):
        return Constants(tyre_parameters(vehicle), vehicle.track_width, vehicle.load_transfer_front)

    @staticmethod
    def prepare(road_wheel_angle, velocity_x_dot, signals, theta):
        front, rear = axle_loads(velocity_x_dot, theta.constants.tyres)
        return 0.5 * front, 0.5 * rear

    @staticmethod
    def axle_forces(forces, slip_front, slip_rear, instant, prepared, theta):
        front, rear = forces(slip_front, slip_rear, instant)
        (load_front, load_rear), (car, track, fraction_front) = prepared, theta.constants
        transfer = theta.share * (front + rear) * car.cg_height / track
        right, left = compute_tyre_forces(slip_front, load_front, fraction_front * transfer, car.tyre_front)
        rear_right, rear_left = compute_tyre_forces(slip_rear, load_rear, (1.0 - fraction_front) * transfer,
                                                     car.tyre_rear)
        couple_force = 0.5 * track * (right - left) / (car.cg_to_front_axle + car.cg_to_rear_axle)
        # The tangent is used because the equations of motion multiply the front force by cos delta.
        return (front + right + left - 2.0 * tyre_force(slip_front, load_front, car.tyre_front)
                - couple_force * tan(instant.road_wheel_angle),
                rear + rear_right + rear_left - 2.0 * tyre_force(slip_rear, load_rear, car.tyre_rear)
                + couple_force * sin(instant.road_wheel_angle))
