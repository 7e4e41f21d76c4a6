"""Error of the yaw inertia in the vehicle file."""

from ._base import Effect, Parameter, register, scale_entry


@register
class YawInertia(Effect):
    physics = "I_z = factor * I_z of the file"
    excited_by = "sweeps and sine with dwell; not observable in steady cornering"
    kind, slot = "vehicle parameters", "body"
    confounded_with = ("mass", "steering_lag", "tyre_relaxation")
    ratio_to = ("mass",)
    imitated_by = "a trailer, or speed-dependent rear-wheel steering"
    parameter = Parameter("factor", "1", null=1.0, initial=1.15, bounds=(0.4, 2.5),
                          meaning="ratio of true inertia to the file's",
                          source="estimates from mass and wheelbase are accurate to 20 %", model_error=0.16)
    vehicle = scale_entry("yaw_inertia")
