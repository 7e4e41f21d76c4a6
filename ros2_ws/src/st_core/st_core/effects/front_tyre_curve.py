"""Peak and curvature of the front axle's force curve, with an unchanged slope at the origin.

    D = peak * D_file,   1 - E = curvature * (1 - E_file) at every load,   slope K unchanged

curvature > 1 means an earlier and sharper peak, < 1 a later one. The tyre parameters are clipped to the limits of the
vehicle file. A fit determines the curve only within the slip angles of the drives; `identification.axle_forces`
estimates this part, with its confidence band. Source: Pacejka, Tire and Vehicle Dynamics, ch. 4.3.
"""

from dataclasses import replace

from ..vehicle import TYRE_QUANTITIES
from ._base import Effect, Parameter, register

PARAMETERS = (
    Parameter("peak", "1", null=1.0, initial=0.85, bounds=(0.3, 2.5), meaning="ratio of true peak force to the file's",
              source="wet road 0.6-0.8, dry asphalt relative to a test drum 1.0-1.3; bounds for unknown tyres",
              model_error=0.1),
    Parameter("curvature", "1", null=1.0, initial=1.6, bounds=(0.05, 8.0), meaning="ratio of true 1 - E to the file's",
              source="published passenger tyres: E -8 to 0.5, so 1 - E 0.5 to 9", shape_bounds=(0.05, 8.0)),
)


def reshape(axle):
    """The hook `vehicle` that changes peak and curvature of an axle, "front" or "rear", at every load."""
    def change(vehicle, theta):
        tyre = getattr(vehicle, f"tyre_{axle}")
        return replace(vehicle, **{f"tyre_{axle}": tyre._replace(
            lambda_muy=TYRE_QUANTITIES["lambda_muy"].clip(tyre.lambda_muy * theta.peak),
            p_ey1=TYRE_QUANTITIES["p_ey1"].clip(1.0 - theta.curvature * (1.0 - tyre.p_ey1)),
            p_ey2=TYRE_QUANTITIES["p_ey2"].clip(theta.curvature * tyre.p_ey2))})
    return staticmethod(change)


@register
class FrontTyreCurve(Effect):
    physics = "D_f = peak * D_f of the file, 1 - E_f = curvature * (1 - E_f of the file), cornering stiffness unchanged"
    excited_by = "cornering towards the limit of the front axle; not observable below 0.3 g"
    kind, slot = "vehicle parameters", "front axle"
    confounded_with = ("friction", "front_stiffness", "lateral_load_transfer", "steering_compliance")
    at_peak_force = True
    applies_to = frozenset(("nonlinear",))  # a linear tyre has no peak
    parameters = PARAMETERS
    vehicle = reshape("front")
