"""Slip of the tyres: the dynamic model with linear tyres replaces the kinematic model.

`share` between 0 and 1 has no physical meaning, but a fitted value above 0 shows that the tyres slip.
"""

from ..models.linear_tyre import inputs as linear_inputs
from ..models.linear_tyre import parameters as linear_parameters
from ._base import Effect, Parameter, register


@register
class TyreSlip(Effect):
    physics = "state derivative = (1 - share) kinematic + share dynamic model with F_y = -C alpha"
    excited_by = "cornering above 2 m/s^2"
    kind, slot = "physics", "both axles"
    applies_to = frozenset(("kinematic",))
    converts = ("kinematic", "linear")
    prepared = ("sine", "cosine", "velocity_x_dot")
    parameter = Parameter("share", "1", null=0.0, initial=1.0, bounds=(0.0, 1.0),
                          meaning="1: tyres as in the vehicle file", source="theory", theory=1.0)

    constants = staticmethod(linear_parameters)

    @staticmethod
    def prepare(road_wheel_angle, velocity_x_dot, signals, theta):
        return linear_inputs(road_wheel_angle, velocity_x_dot, theta.constants)
