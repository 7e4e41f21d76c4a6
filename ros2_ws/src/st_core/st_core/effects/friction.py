"""Error of the friction in the tyre data, due to a wet or cold road or to different tyres."""

from ._base import Effect, Parameter, register
from .front_stiffness import scale_axles


@register
class Friction(Effect):
    physics = "peak force D = factor * D of the file on both axles, cornering stiffness unchanged"
    excited_by = "driving at the limit; not observable below 0.5 g"
    kind, slot = "vehicle parameters", "both axles"
    confounded_with = ("lateral_load_transfer", "front_stiffness", "rear_stiffness")
    at_peak_force = True
    applies_to = frozenset(("nonlinear",))  # a linear tyre has no peak
    parameter = Parameter("factor", "1", null=1.0, initial=0.8, bounds=(0.1, 1.6),
                          meaning="ratio of true friction to that of the tyre data",
                          source="ice 0.1, wet 0.6-0.8, dry asphalt relative to a test drum 1.0-1.3")
    vehicle = scale_axles("lambda_muy", "front", "rear")
