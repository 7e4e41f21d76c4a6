"""Peak and curvature of the rear axle's force curve, with the equations of `front_tyre_curve`."""

from ._base import Effect, register
from .front_tyre_curve import PARAMETERS, reshape


@register
class RearTyreCurve(Effect):
    physics = "D_r = peak * D_r of the file, 1 - E_r = curvature * (1 - E_r of the file), cornering stiffness unchanged"
    excited_by = "cornering towards the limit of the rear axle with measured sideslip; not observable below 0.3 g"
    kind, slot = "vehicle parameters", "rear axle"
    confounded_with = ("friction", "rear_stiffness", "lateral_load_transfer", "cg_position")
    at_peak_force = True
    applies_to = frozenset(("nonlinear",))  # a linear tyre has no peak
    parameters = PARAMETERS
    vehicle = reshape("rear")
