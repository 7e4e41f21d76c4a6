"""Effect of each evaluation setting that the paper does not specify, on virtual Leaf and Genesis drives."""

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from st_core.log_evaluation import EvaluationSettings, LogEvaluation, evaluate_log
from st_core.models import MODELS
from st_core.prediction import PredictionSettings
from st_core.vehicle import VehicleParameters

from ._drives import SOUND_DRIVES, genesis, leaf, read_runs, write_scenarios

REFERENCE = EvaluationSettings()
CHOICES = {
    "as in the car": REFERENCE,
    "zero-phase filter": replace(REFERENCE, acceleration="zero_phase"),
    "inputs held over each step": replace(REFERENCE, inputs="hold"),
    "both": replace(REFERENCE, acceleration="zero_phase", inputs="hold"),
    "step of 10 ms": replace(REFERENCE, prediction=PredictionSettings(step=0.01)),
    "starts from 3 m/s": replace(REFERENCE, prediction=PredictionSettings(minimum_speed=3.0)),
}


def run() -> dict:
    """Longitudinal and lateral RMSE [m] in hindsight over all starts of a data set."""
    tables = {}
    with tempfile.TemporaryDirectory(prefix="st-protocol-") as folder:
        tables["virtual Leaf"] = _table(read_runs(write_scenarios(Path(folder)), leaf()), leaf())
    if SOUND_DRIVES.exists():
        tables["Genesis"] = _table(read_runs(SOUND_DRIVES, genesis()), genesis())
    return tables


def _table(drives: dict, vehicle: VehicleParameters) -> dict:
    rows = {}
    reference: list[LogEvaluation] = []
    for name, settings in CHOICES.items():
        evaluations = [evaluate_log(tuple(MODELS), vehicle, log, settings) for log in drives.values()]
        reference = reference or evaluations
        rows[name] = _rmse(evaluations, "means") | {"largest change": _largest_change(evaluations, reference, "means")}
        if settings is REFERENCE:
            rows["all samples of the horizons"] = _rmse(evaluations, "samples") | {
                "largest change": _largest_change(evaluations, reference, "samples")}
    return rows


def _largest_change(evaluations: list[LogEvaluation], reference: list[LogEvaluation], over: str) -> str:
    """Largest change of the RMSE of a run, and its run, model and axis."""
    changes = []
    for now, before in zip(evaluations, reference, strict=True):
        for model in MODELS:
            for axis in ("longitudinal", "lateral"):
                new = now.errors[model, "hindsight"].statistics(axis, over)[2]
                old = before.errors[model, "hindsight"].statistics(axis, "means")[2]
                changes.append((abs(new - old), f"{now.name}, {model}, {axis}: {old:.3f} to {new:.3f}"))
    return max(changes)[1]


def _rmse(evaluations: list[LogEvaluation], over: str) -> dict:
    result = {}
    for model in MODELS:
        errors = [e.errors[model, "hindsight"] for e in evaluations]
        counts = np.array([error.n_starts for error in errors])
        for axis in ("longitudinal", "lateral"):
            squares = np.square([error.statistics(axis, over)[2] for error in errors])
            result[f"{model} {axis}"] = round(float(np.sqrt(np.average(squares, weights=counts))), 3)
    return result
