"""The paper's chain on virtual S1 to S7: offset, stiffnesses by regression, then the evaluation with what was found."""

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from _virtual import leaf, read_runs, write_scenarios
from st_core.identification.cornering_stiffness import identify_stiffness
from st_core.identification.free_parameters import identified_vehicle, with_stiffness
from st_core.identification.result import Identification
from st_core.identification.steering_offset import identify_steering_offset
from st_core.identification.stiffness_prediction import predict_stiffness
from st_core.log_evaluation import evaluate_log
from st_core.vehicle import VehicleParameters

MODELS = ("kinematic", "linear", "nonlinear")


def chain() -> dict:
    """Horizon-mean errors, root mean square over the starts [m] of each scenario, with four vehicle files."""
    car = leaf()
    unknown = with_stiffness(replace(car, steering_wheel_offset=0.0), 0.8 * car.cornering_stiffness_front,
                             0.8 * car.cornering_stiffness_rear)
    with tempfile.TemporaryDirectory(prefix="st-bench-") as folder:
        runs = read_runs(write_scenarios(Path(folder)), car)
    logs = list(runs.values())
    offset = identify_steering_offset(logs, unknown)
    offset_known = replace(unknown, steering_wheel_offset=offset["steering_wheel_offset"].value)
    paper = identify_stiffness(logs, offset_known)
    better = predict_stiffness(logs, offset_known)
    files = {"not identified": unknown, "offset identified": offset_known,
             "stiffness by the paper's regression": _with(offset_known, paper),
             "stiffness by prediction": _with(offset_known, better), "the paper's table": car}
    found = {"offset, deg": _text(offset, np.rad2deg(1.0)), "paper": _text(paper), "prediction": _text(better)}
    return {"found": found, "errors": {name: errors(logs, file) for name, file in files.items()}}


def errors(logs: list, car: VehicleParameters) -> dict:
    """{model: {scenario: longitudinal / lateral}} root mean square of the horizon means, hindsight [m]."""
    table: dict[str, dict[str, str]] = {model: {} for model in MODELS}
    total: dict[str, list] = {model: [] for model in MODELS}
    for log in logs:
        evaluation = evaluate_log(MODELS, car, log.with_steering(car))
        for model in MODELS:
            found = evaluation.errors[model, "hindsight"]
            both = [found.statistics(axis)[2] for axis in ("longitudinal", "lateral")]
            table[model][log.name] = " / ".join(f"{value:.2f}" for value in both)
            total[model].append(found.mean[found.complete, :2])
    for model in MODELS:
        both = np.sqrt(np.square(np.concatenate(total[model])).mean(axis=0))
        table[model]["all"] = f"{both[0]:.2f} / {both[1]:.2f}"
    return table


def _with(car: VehicleParameters, found: Identification) -> VehicleParameters:
    return identified_vehicle(car, {e.parameter: e.value for e in found.estimates})


def _text(found: Identification, factor: float = 1.0) -> dict:
    return {e.parameter: f"{e.value * factor:.5g} +/- {e.standard_uncertainty * factor:.2g}" for e in found.estimates}
