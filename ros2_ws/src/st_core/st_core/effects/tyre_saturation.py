"""Saturation of the tyres: the Magic Formula, with longitudinal load transfer, replaces linear tyres."""

from ..models.nonlinear_tyre import inputs as tyre_inputs
from ..models.nonlinear_tyre import parameters as tyre_parameters
from ..tyres import magic_formula_force
from ._base import Effect, Parameter, register


@register
class TyreSaturation(Effect):
    physics = "F_y = (1 - share) (-C alpha) + share F_MF(alpha), F_MF: Magic Formula of the vehicle file"
    excited_by = "cornering above 4 m/s^2"
    kind, slot = "physics", "both axles"
    confounded_with = ("front_stiffness", "rear_stiffness")
    applies_to = frozenset(("linear",))
    converts = ("linear", "nonlinear")
    prepared = ("b_front", "d_front", "e_front", "b_rear", "d_rear", "e_rear")
    costly = True
    order = 10
    parameter = Parameter("share", "1", null=0.0, initial=1.0, bounds=(0.0, 1.0),
                          meaning="1: tyres as in the vehicle file", source="theory", theory=1.0)

    constants = staticmethod(tyre_parameters)

    @staticmethod
    def prepare(road_wheel_angle, velocity_x_dot, signals, theta):
        return tyre_inputs(road_wheel_angle, velocity_x_dot, theta.constants)[3:]

    @staticmethod
    def axle_forces(forces, slip_front, slip_rear, instant, prepared, theta):
        front, rear = forces(slip_front, slip_rear, instant)
        b_front, d_front, e_front, b_rear, d_rear, e_rear = prepared
        mf_front = magic_formula_force(slip_front, b_front, d_front, e_front, theta.constants.tyre_front)
        mf_rear = magic_formula_force(slip_rear, b_rear, d_rear, e_rear, theta.constants.tyre_rear)
        linear = 1.0 - theta.share
        return linear * front + theta.share * mf_front, linear * rear + theta.share * mf_rear
