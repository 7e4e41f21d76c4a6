"""Error of the rear cornering stiffness in the vehicle file."""

from ._base import Effect, register
from .front_stiffness import make_stiffness_parameter, scale_axles


@register
class RearStiffness(Effect):
    physics = "C_r = factor * C_r of the file, peak force unchanged"
    excited_by = "cornering with measured sideslip, and steering sweeps (yaw damping)"
    kind, slot = "vehicle parameters", "rear axle"
    confounded_with = ("front_stiffness", "cg_position", "friction", "tyre_stiffness")
    combinations = ("rear cornering stiffness over axle load", "stability factor K", "steady-state yaw gain at 20 m/s")
    ratio_to = ("mass", "cg_to_front_axle")
    parameter = make_stiffness_parameter(0.85)
    vehicle = scale_axles("lambda_ky", "rear", entry="cornering_stiffness")
