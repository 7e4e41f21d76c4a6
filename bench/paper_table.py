"""Compares the error table of the paper with that of the virtual Leaf: S1 to S7, three models, hindsight."""

import tempfile
from pathlib import Path

from st_core.log_evaluation import evaluate_log
from st_core.models import MODELS

from ._drives import leaf, read_runs, write_scenarios

AXES = ("longitudinal", "lateral")
# Table 2 of the paper: for each model (mean, max, RMSE) [m] of the longitudinal and of the lateral error.
PAPER = {
    "S1": (((0.10, 0.19, 0.12), (-0.09, 0.49, 0.33)), ((0.02, 0.07, 0.04), (-0.06, 0.26, 0.13)),
           ((0.01, 0.07, 0.04), (-0.06, 0.26, 0.13))),
    "S2": (((0.17, 0.32, 0.18), (0.38, 0.63, 0.41)), ((0.00, 0.09, 0.02), (0.01, 0.34, 0.06)),
           ((0.00, 0.09, 0.02), (0.00, 0.34, 0.06))),
    "S3": (((0.85, 1.02, 0.87), (1.20, 1.41, 1.21)), ((-0.21, 0.30, 0.22), (-0.30, 0.37, 0.30)),
           ((-0.25, 0.35, 0.25), (-0.33, 0.41, 0.34))),
    "S4": (((2.49, 3.05, 2.56), (2.88, 3.41, 2.94)), ((-0.45, 0.61, 0.46), (-0.46, 0.59, 0.46)),
           ((-0.77, 0.98, 0.79), (-0.67, 0.77, 0.68))),
    "S5": (((0.17, 0.47, 0.23), (0.05, 0.94, 0.52)), ((-0.04, 0.27, 0.09), (-0.09, 0.50, 0.20)),
           ((-0.05, 0.28, 0.09), (-0.09, 0.49, 0.20))),
    "S6": (((0.21, 0.26, 0.22), (-0.48, 0.54, 0.48)), ((0.07, 0.10, 0.07), (-0.16, 0.19, 0.16)),
           ((0.07, 0.10, 0.07), (-0.16, 0.19, 0.16))),
    "S7": (((0.09, 0.63, 0.20), (-0.03, 2.63, 0.83)), ((-0.02, 0.11, 0.04), (0.03, 0.59, 0.14)),
           ((-0.02, 0.12, 0.04), (0.03, 0.60, 0.15))),
}


def run() -> dict:
    """Scenario -> number of starts, "mean | max | RMSE [m] (those of the paper)" by model and axis, and RMSE ratio
    kinematic / linear."""
    rows: dict = {}
    with tempfile.TemporaryDirectory(prefix="st-paper-") as folder:
        drives = read_runs(write_scenarios(Path(folder)), leaf())
    for name, paper in PAPER.items():
        evaluation = evaluate_log(tuple(MODELS), leaf(), drives[name])
        rows[name] = {"starts": evaluation.errors["linear", "hindsight"].n_starts}
        simulated = {model: [evaluation.errors[model, "hindsight"].statistics(axis) for axis in AXES]
                     for model in MODELS}
        for model, published in zip(MODELS, paper, strict=True):
            for k, axis in enumerate(AXES):
                rows[name][f"{model} {axis}"] = f"{_text(simulated[model][k])} ({_text(published[k])})"
        for k, axis in enumerate(AXES):
            ratio = simulated["kinematic"][k][2] / simulated["linear"][k][2]
            rows[name][f"kinematic / linear RMSE, {axis}"] = f"{ratio:.1f} ({paper[0][k][2] / paper[1][k][2]:.1f})"
    return rows


def _text(values: tuple[float, float, float]) -> str:
    return " | ".join(f"{v:.2f}" for v in values)
