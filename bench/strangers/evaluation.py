"""Evaluates an answer of `st discover`: prediction errors on held-out drives, and the axle forces that it implies."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from st_core.augmented import AugmentedModel, augment
from st_core.log_evaluation import EvaluationSettings, evaluate_log
from st_core.model_file import ModelFile
from st_core.vehicle import VehicleParameters
from st_recordings.car import read_vehicle
from st_recordings.runs import find_runs, read

SPEED = 20.0  # m/s, at which axle forces in steady cornering are computed
INDEX_5S = 4  # index of 5 s in ModelErrors.at_seconds
INTERVAL = 0.25  # s between predictions


def held_out_errors(folder: Path, output: Path) -> dict[str, float | None]:
    """Mean position error after 5 s [m] on the held-out drives: with the owner's vehicle file, with vehicle.yaml alone
    (None if not written), and with model.yaml (as with vehicle.yaml if not written)."""
    original = read_vehicle(folder / "car" / "vehicle.yaml")
    new = read_vehicle(output / "vehicle.yaml") if (output / "vehicle.yaml").exists() else None
    model = _model(output)
    errors: dict[str, float | None] = {"original": _error(folder, "nonlinear", original)}
    errors["vehicle"] = _error(folder, "nonlinear", new) if new else None
    errors["model"] = _error(folder, model.model(), model.vehicle or original) if model else errors["vehicle"]
    return errors


def _model(output: Path) -> ModelFile | None:
    file = output / "model.yaml"
    return ModelFile.from_yaml(file.read_text(), str(file)) if file.exists() else None


def _error(folder: Path, model: Any, vehicle: VehicleParameters) -> float:
    settings, collected = EvaluationSettings(interval=INTERVAL), []
    for source in find_runs([folder / "held_out"]):
        log = read(source, vehicle).log
        errors = next(value for (_, mode), value in evaluate_log([model], vehicle, log, settings).errors.items()
                      if mode == "hindsight")
        collected.append(errors.at_seconds[errors.complete, INDEX_5S, :2])
    return float(np.mean(np.hypot(*np.concatenate(collected).T)))


def implied_forces(truth: Mapping[str, Any], folder: Path, output: Path,
                   answer: Mapping[str, Any]) -> dict[str, dict[str, list[float]]]:
    """By axle, in steady cornering over the measured slip angles: slip angle [rad] and lateral forces [N, against the
    slip].

    Forces of the car, of the owner's vehicle file, of the answer (its effects, also minor ones, at their stated
    values), and of model.yaml with all corrections.
    """
    original = read_vehicle(folder / "car" / "vehicle.yaml")
    stated = {one["name"]: {key: p["value"] for key, p in one["parameters"].items()}
              for one in (*answer.get("effects", ()), *answer.get("minor", ())) if not one.get("effective")}
    file = _model(output)
    new = read_vehicle(output / "vehicle.yaml") if (output / "vehicle.yaml").exists() else original
    models = {"file": (augment("nonlinear", {}), original), "answer": (augment("nonlinear", stated), original),
              "model": (file.model(), file.vehicle or new) if file else (augment("nonlinear", {}), new)}
    forces = {name: _forces(model.select_effects([e for e in model.effects if _is_in_the_car(e)]), vehicle, truth)
              for name, (model, vehicle) in models.items()}
    return {axle: {"slip": grid.tolist(), "true": true.tolist(),
                   **{name: by_axle[axle].tolist() for name, by_axle in forces.items()}}
            for axle, (grid, true) in _grids(truth).items()}


def _is_in_the_car(effect: type) -> bool:
    return effect.kind in ("vehicle parameters", "physics") and effect.slot != "steering"


def _grids(truth: Mapping[str, Any]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """By axle: ten slip angles, and the true forces; the k-th ones of both axles form a steady state."""
    grids = {}
    for axle, curve in truth["axles"].items():
        slip = np.linspace(curve["slip"][0], curve["slip"][-1], 10)
        grids[axle] = slip, np.interp(slip, curve["slip"], curve["force"])
    return grids


def _forces(model: AugmentedModel, vehicle: VehicleParameters, truth: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """By axle: force [N] of a model at these slip angles, from its accelerations, mass, inertia and lengths.

        F_f = (m a_y l_r + I r_dot) / L,  F_r = (m a_y l_f - I r_dot) / L,  a_y = v_y_dot + v_x r
    """
    grids, p, car = _grids(truth), model.parameters(vehicle), model.effective_vehicle(vehicle)
    (slip_f, force_f), (slip_r, force_r) = grids["front"], grids["rear"]
    forces: dict[str, list[float]] = {"front": [], "rear": []}
    for a, b, total in zip(slip_f, slip_r, force_f + force_r, strict=True):
        r = total / truth["body"]["mass"] / SPEED  # left turn: the wheels slide to the right
        vy = car.cg_to_rear_axle * r - SPEED * np.tan(b)
        angle = float(np.arctan((vy + car.cg_to_front_axle * r) / SPEED) + a)
        w = model.inputs(angle, 0.0, p)
        state = model.start_state((0.0, 0.0, SPEED, float(vy), 0.0, float(r)), w, p)
        rates = model.rhs(state, w, p)
        ay = rates[3] + SPEED * r
        forces["front"].append((car.mass * ay * car.cg_to_rear_axle + car.yaw_inertia * rates[5]) / car.wheelbase)
        forces["rear"].append((car.mass * ay * car.cg_to_front_axle - car.yaw_inertia * rates[5]) / car.wheelbase)
    return {axle: np.array(values, float) for axle, values in forces.items()}
