"""Axle cornering stiffnesses from multi-step predictions of several drives at once.

Beside the two stiffnesses the offset of the steering and the misalignment of the INS are fitted, which would otherwise
pass for tyres. With the nonlinear model the stiffness is the slope at small slip at the static load, and the tyre's
curve is that of the vehicle file; with the linear one it is the slope that predicts best over the slips driven.
Checked by: test_identification_driving.py.
"""

from collections.abc import Sequence
from dataclasses import replace

from ..log import DriveLog
from ..models import Model
from ..vehicle import VehicleParameters
from .coverage import require
from .free_parameters import MISALIGNMENT
from .prediction_error import PredictionError, PredictionErrorSettings
from .prediction_estimates import described, driving_coverage, identification
from .profile import profile
from .result import Identification
from .run_samples import prepared

STIFFNESSES = ("cornering_stiffness_front", "cornering_stiffness_rear")
NUISANCE = ("steering_wheel_offset", MISALIGNMENT)
NEEDS = {"speed": (5.0, 1), "lateral acceleration": (2.0, 3)}


def predict_stiffness(logs: Sequence[DriveLog], vehicle: VehicleParameters, base: str | Model = "nonlinear",
                      settings: PredictionErrorSettings | None = None, *, also: Sequence[str] = (),
                      bootstrap: int = 200, seed: int = 0, profiles: bool = False) -> Identification:
    """Both stiffnesses with their uncertainty over runs.

    vehicle: everything else, and where the fit starts. base: linear, nonlinear, or either with effects that are known
    (`augment`: drive force on steered wheels, say). also: further parameters to fit and report, of
    `free_parameters.FREE` (steering_ratio needs low and high speeds, cg_to_ins_x tight bends). profiles: add profile
    likelihoods to the figure, ten more fits each. Raises IdentificationError for too thin driving.
    """
    settings = settings or PredictionErrorSettings()
    names = tuple(dict.fromkeys((*STIFFNESSES, *also, *NUISANCE)))
    logs, noticed = prepared(logs, vehicle)
    needs = NEEDS | ({"speed": (5.0, 2)} if "steering_ratio" in names else {})
    covered = driving_coverage(logs, needs, settings.minimum_speed)
    require(covered, "Drive bends to both sides, at two speeds or more, with 1 to 4 m/s^2 across.")
    problem = PredictionError(logs, vehicle, names, base, settings)
    fit = problem.fit()
    method = f"multi-step prediction, {described(base)}"
    result = identification("stiffness", problem, fit, method, (*STIFFNESSES, *also), covered, bootstrap, seed)
    result = replace(result, warnings=(*noticed, *result.warnings))
    if not profiles:
        return result
    found = tuple(profile(problem, fit, e.parameter, e.standard_uncertainty) for e in result.estimates)
    open_ended = tuple(f"{p.parameter}: the predictions hardly become worse beside the estimate; the data do not fix "
                       "it." for p in found if not all(map(_finite, p.interval95)))
    return replace(result, figure={**result.figure, "profiles": found}, warnings=(*result.warnings, *open_ended))


def _finite(end: float) -> bool:
    return abs(end) != float("inf")
