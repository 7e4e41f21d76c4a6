"""Load dependence of the cornering stiffness of both axles; the stiffness at static load is as in the vehicle file.

    K(F_z) = K_0 sin(p_ky4 atan(F_z / (factor p_ky2 F_z0))),   K_0 such that K at static tyre load is unchanged

With factor > 1 the maximum of K is at a higher load, so K is more nearly proportional to load. Source: paper, appendix.
"""

from dataclasses import replace

from ..tyres import magic_formula_stiffness
from ..vehicle import TYRE_QUANTITIES
from ._base import Effect, Parameter, register


def _scale_peak_stiffness_load(tyre, static_load, factor):
    """One tyre with the load of maximum stiffness times `factor`, clipped, and with K at static_load [N] unchanged."""
    changed = tyre._replace(p_ky2=TYRE_QUANTITIES["p_ky2"].clip(tyre.p_ky2 * factor))
    ratio = magic_formula_stiffness(static_load, tyre) / magic_formula_stiffness(static_load, changed)
    return changed._replace(lambda_ky=TYRE_QUANTITIES["lambda_ky"].clip(tyre.lambda_ky * ratio))


@register
class TyreLoadSensitivity(Effect):
    physics = "K(F_z) with p_ky2 times factor, K at static load unchanged, both axles; > 1: K more proportional to F_z"
    excited_by = "braking and accelerating in turns; a load transfer of at least 10 %"
    kind, slot = "vehicle parameters", "both axles"
    confounded_with = ("longitudinal_load_transfer", "lateral_load_transfer", "mass")
    applies_to = frozenset(("nonlinear",))  # a linear tyre has no dependence on load
    order = 40  # before mass and cg_position, because the file's stiffness applies at the file's load
    parameter = Parameter("factor", "1", null=1.0, initial=1.8, bounds=(0.5, 5.0),
                          meaning="ratio of the load at maximum stiffness to the file's",
                          source="published passenger tyres: p_ky2 1.0 to 2.8; at 5, K is proportional to load within "
                                 "5 %", shape_bounds=(5.0,))

    @staticmethod
    def vehicle(vehicle, theta):
        front = _scale_peak_stiffness_load(vehicle.tyre_front, vehicle.static_tyre_load_front, theta.factor)
        rear = _scale_peak_stiffness_load(vehicle.tyre_rear, vehicle.static_tyre_load_rear, theta.factor)
        return replace(vehicle, tyre_front=front, tyre_rear=rear)
