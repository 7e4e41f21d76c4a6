"""The procedure of the paper with virtual drives S1 to S7: steering offset, cornering stiffnesses, evaluation."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from st_core.identification.axle_forces import identify_stiffness
from st_core.identification.driving_prediction import fit_stiffness
from st_core.identification.result import Identification
from st_core.identification.steering import identify_steering_offset
from st_core.log import DriveLog
from st_core.log_evaluation import evaluate_log
from st_core.models import MODELS
from st_core.vehicle import VehicleParameters

from .._drives import leaf
from ..checks.drives import virtual_drive
from .drives import apply_estimates, with_stiffness

# Duration of each scenario [s]; only S6 and S7 have straights above 5 m/s, which the steering offset requires.
SECONDS = {"S1": 20, "S2": 15, "S3": 15, "S4": 15, "S5": 25, "S6": 90, "S7": 90}


def run_procedure() -> dict:
    """Estimates, and rms over the starts of the horizon means of the errors [m] by vehicle file and scenario."""
    car = leaf()
    unknown = with_stiffness(replace(car, steering_wheel_offset=0.0), 0.8 * car.cornering_stiffness_front,
                             0.8 * car.cornering_stiffness_rear)
    logs = [replace(virtual_drive(name, 1, seconds).log, name=name) for name, seconds in SECONDS.items()]
    offset = identify_steering_offset(logs, unknown)
    offset_known = replace(unknown, steering_wheel_offset=offset["steering_wheel_offset"].value)
    by_regression = identify_stiffness(logs, offset_known)
    by_prediction = fit_stiffness(logs, offset_known)
    files = {"not identified": unknown, "offset identified": offset_known,
             "stiffness by the paper's regression": apply_estimates(offset_known, by_regression.estimates),
             "stiffness by prediction": apply_estimates(offset_known, by_prediction.estimates),
             "the paper's table": car}
    estimates = {"offset, deg": _format_estimates(offset, np.rad2deg(1.0)), "paper": _format_estimates(by_regression),
                 "prediction": _format_estimates(by_prediction)}
    return {"found": estimates, "errors": {name: prediction_errors(logs, file) for name, file in files.items()}}


def prediction_errors(logs: Sequence[DriveLog], car: VehicleParameters) -> dict:
    """RMS of the horizon means in hindsight, longitudinal / lateral [m], by model and scenario, as in st evaluate."""
    evaluations = [evaluate_log(tuple(MODELS), car, log.with_steering(car)) for log in logs]
    table = {}
    for model in MODELS:
        errors = [evaluation.errors[model, "hindsight"] for evaluation in evaluations]
        squares = np.square([[one.statistics(axis)[2] for axis in ("longitudinal", "lateral")] for one in errors])
        pooled = np.average(squares, axis=0, weights=[one.n_starts for one in errors])
        table[model] = {name: " / ".join(f"{value:.2f}" for value in np.sqrt(row)) for name, row in zip(
            [*(log.name for log in logs), "all"], [*squares, pooled], strict=True)}
    return table


def _format_estimates(found: Identification, factor: float = 1.0) -> dict:
    return {e.parameter: f"{e.value * factor:.5g} +/- {e.standard_uncertainty * factor:.2g}" for e in found.estimates}
