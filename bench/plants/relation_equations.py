"""Hidden relations as accelerations; both plants compile the same function into their loops.

    F_f / m = (l_r a_y + k^2 r_dot) / l,   F_r / m = (l_f a_y - k^2 r_dot) / l,   a_y = v_y_dot + v_x r,   k^2 = I_z / m

are the axle forces; a relation changes them by a fraction, or adds a force or a moment.
"""

from math import exp
from typing import NamedTuple

NOTHING, REAR_STEER, CAMBER, LIFT, AIR_MOMENT, TORQUE_STEER, WARM_UP, REAR_CURVE = range(8)
WARM_UP_TIME = 15.0  # s, time constant of the warm-up of tyres; shortened to the length of these runs


class Relation(NamedTuple):
    """A relation. kind: one of the constants above; size: in the unit of the kind, see `relations/hidden.py`."""

    kind: int = NOTHING
    size: float = 0.0


class Car(NamedTuple):
    """Parameters of a car. to_front, to_rear: from the CG to the axles [m]; radius_square: k^2 [m^2]; rear: cornering
    stiffness of the rear axle over mass [m/s^2/rad]."""

    to_front: float
    to_rear: float
    radius_square: float
    rear: float


def reshape_rear_tyre(tyre, relation):
    """The rear tyre; for the relation REAR_CURVE with another curve of the same initial slope and peak."""
    if relation.kind != REAR_CURVE:
        return tyre
    return tyre._replace(p_cy1=tyre.p_cy1 * (1.0 - relation.size), p_ey1=tyre.p_ey1 - 4.0 * relation.size)


def relation_accelerations(relation, car, time, vx, r, ax, vy_dot, r_dot):
    """(lateral [m/s^2], yaw [rad/s^2]) accelerations of a relation, left +. time: since the start of the run [s]."""
    kind, size = relation
    to_front, to_rear, square, rear = car
    a_y, wheelbase = vy_dot + vx * r, to_front + to_rear
    front_force = (to_rear * a_y + square * r_dot) / wheelbase
    rear_force = (to_front * a_y - square * r_dot) / wheelbase
    f, b, moment = 0.0, 0.0, 0.0
    if kind == REAR_STEER:
        b = rear * size * vx * r
    elif kind == CAMBER:
        f = -size * front_force
        b = -size * rear_force
    elif kind == LIFT:
        f = -size * vx * vx * front_force
    elif kind == AIR_MOMENT:
        moment = size * vx * vx
    elif kind == TORQUE_STEER:
        moment = size * ax
    elif kind == WARM_UP:
        f = -size * exp(-time / WARM_UP_TIME) * front_force
        b = -size * exp(-time / WARM_UP_TIME) * rear_force
    return f + b, (to_front * f - to_rear * b) / square + moment
