"""Cornering stiffness of both axles other than the vehicle file's, by the same factor: another set of tyres."""

from ._base import Effect, Parameter, register
from .front_stiffness import FrontStiffness
from .rear_stiffness import RearStiffness


@register
class TyreStiffness(Effect):
    name = "tyre_stiffness"
    physics = "C_f = factor C_f, C_r = factor C_r of the file, the peak forces unchanged"
    excited_by = "cornering with the sideslip measured, and sweeps; next to mass and yaw_inertia only their ratio shows"
    kind, slot = "vehicle parameters", "both axles"
    twins = ("mass", "front_stiffness", "rear_stiffness", "cg_position")
    ratio_to = "mass"
    members = ("front_stiffness", "rear_stiffness")
    parameters = (
        Parameter("factor", "1", null=1.0, initial=0.85, bounds=(0.3, 3.0), meaning="true stiffness over the file's",
                  source="tyres of one size spread by 2; openpilot learns 0.2-5 for both axles together",
                  model_error=0.04),
    )

    @staticmethod
    def vehicle(vehicle, theta):
        return RearStiffness.vehicle(FrontStiffness.vehicle(vehicle, theta), theta)
