"""Common scale error of both cornering stiffnesses in the vehicle file, as with different tyres."""

from ._base import Effect, register
from .front_stiffness import make_stiffness_parameter, scale_axles


@register
class TyreStiffness(Effect):
    physics = "C_f, C_r = factor times the values of the file, peak forces unchanged"
    excited_by = "cornering with measured sideslip, steering sweeps; observable only relative to mass and yaw_inertia"
    kind, slot = "vehicle parameters", "both axles"
    confounded_with = ("mass", "front_stiffness", "rear_stiffness", "cg_position")
    ratio_to = ("mass", "cg_to_front_axle")
    members = ("front_stiffness", "rear_stiffness")
    parameter = make_stiffness_parameter(0.85)
    vehicle = scale_axles("lambda_ky", "front", "rear", entry="cornering_stiffness")
