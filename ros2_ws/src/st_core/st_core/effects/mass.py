"""Error of the mass in the vehicle file; CG position, yaw inertia and lengths are unchanged."""

from ._base import FORCE_COMBINATIONS, Effect, Parameter, register, scale_entry


@register
class Mass(Effect):
    physics = "m = factor * m of the file"
    excited_by = "cornering; observable only relative to yaw_inertia if forces are proportional to load: weigh the car"
    kind, slot = "vehicle parameters", "body"
    confounded_with = ("yaw_inertia", "tyre_stiffness", "front_stiffness", "rear_stiffness")
    combinations = FORCE_COMBINATIONS
    parameter = Parameter("factor", "1", null=1.0, initial=1.1, bounds=(0.6, 2.0),
                          meaning="ratio of true mass to the file's",
                          source="empty to fully laden: passenger cars 1.4, vans 2")
    vehicle = scale_entry("mass")
