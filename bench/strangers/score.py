"""Evaluates answers of `st discover` with held-out drives and axle forces, and computes the scores."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from st_core.augmented import AugmentedModel, augment
from st_core.discovery.result import Combination, unseparated_combinations
from st_core.effects._base import REAR_STEERING
from st_core.log_evaluation import EvaluationSettings, evaluate_log
from st_core.model_file import ModelFile
from st_core.vehicle import VehicleParameters
from st_recordings.car import read_vehicle
from st_recordings.runs import find_runs, read

SPEED = 20.0  # m/s, at which axle forces in steady cornering are computed
INDEX_5S = 4  # index of 5 s in ModelErrors.at_seconds
INTERVAL = 0.25  # s between predictions
WORSE = 1.02  # ratio of held-out errors above which a file is worse; two short drives differ by up to that
ROUNDING = 1e-9  # tolerance of the ratio of force errors, for rounding
STIFFNESS_ERRORS = ("worn_front", "worn_rear", "compliance")
MEMBERS = {"tyre_stiffness": ("front_stiffness", "rear_stiffness")}


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


def list_statements(result: Mapping[str, Any]) -> list[dict[str, Any]]:
    """One dict for each stated effect: whether it is in the car, value, interval, true range, and whether the interval
    overlaps it (None without a value).

    Effective corrections and minor effects are not statements.
    """
    truth, statements = result["truth"], []
    for one in named_effects(result["answer"]):
        name, present = one["name"], truth["effects"]
        in_car = name in present or any(name in group and set(group) & set(present) for group in truth["confounded"])
        in_car = in_car or any(member in present for member in MEMBERS.get(name, ()))
        line = {"effect": name, "in_car": in_car, "set": sorted(alternatives(one)), "inside": None}
        if one.get("parameters"):
            key, value = next(iter(one["parameters"].items()))
            line |= {"parameter": key, "value": value.get("value"), "interval": value.get("interval")}
            line["true"] = true_range(name, result)
            if line["true"] and line["interval"] and None not in line["interval"]:
                low, high = line["interval"]
                line["inside"] = bool(low <= line["true"][1] and high >= line["true"][0])
        statements.append(line)
    return statements + list_combinations(result)


def list_combinations(result: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The same for stiffnesses over the axle load, divided by those of the file, that no named effect explains."""
    answer, lines = result["answer"], []
    named = [SimpleNamespace(name=one["name"], alternatives=alternatives(one)) for one in named_effects(answer)]
    known = [Combination(**one) for one in answer.get("combinations") or ()]
    for one in unseparated_combinations(known, named):
        true = result["truth"].get("stiffness_over_load", {}).get(one.name.split()[0])
        if "axle load" in one.name and true:
            low, high = (edge / one.file for edge in one.interval)
            lines.append({"effect": one.name, "in_car": True, "set": [], "value": one.value / one.file,
                          "interval": [low, high], "true": true, "inside": low <= true[1] and high >= true[0]})
    return lines


def named_effects(answer: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Effects that the answer states as properties of car or sensors."""
    return [one for one in answer.get("effects", ()) if not one.get("effective")]


def alternatives(effect: Mapping[str, Any]) -> set[str]:
    """Names that the answer does not distinguish from the effect."""
    return {name for key in ("alternatives", "joint") for name in effect.get(key) or ()}


def true_range(name: str, result: Mapping[str, Any]) -> list[float] | None:
    """True range of the first parameter; for the front stiffness including that of the tyres alone if compliance is
    reported."""
    truth = result["truth"]
    value = truth["effects"].get(name)
    if name == "front_stiffness" and value:
        stated = {one["name"] for one in (*result["answer"].get("effects", ()), *result["answer"].get("minor", ()))}
        if stated & {"steering_compliance", "roll_steer"}:
            tyres = truth["tyre_stiffness_front"]
            return [min(value[0], tyres), max(value[1], tyres)]
    return value


def named_errors(result: Mapping[str, Any]) -> dict[str, bool]:
    """Hidden error -> whether it is reported, alone or with alternatives.

    For errors of axle stiffness, a combination whose interval contradicts the vehicle file counts as well. For a load
    it does not, because the guessed stiffness of the file contradicts it in any case.
    """
    warnings = result["answer"].get("warnings") or ()
    stated: set[str] = {REAR_STEERING} if any("rear wheels that steer" in text for text in warnings) else set()
    combined: set[str] = set()
    for one in named_effects(result["answer"]):
        stated |= {one["name"], *alternatives(one)}
    stated |= {part for name in list(stated) for part in MEMBERS.get(name, ())}
    for one in result["answer"].get("combinations", ()) or ():
        low, high = one["interval"]
        combined |= set() if low <= one["file"] <= high else set(one["effects"])
    return {name: bool((stated | (combined if name in STIFFNESS_ERRORS else set())) & set(about["accepted"]))
            for name, about in result["truth"]["hidden"].items()}


def force_errors(result: Mapping[str, Any]) -> dict[str, float]:
    """By axle: rms error of the force that the answer implies relative to that of the file [1], over the measured slip;
    and `<axle>_file`, `<axle>_answer`, `<axle>_model`: rms errors over the largest true force [1]."""
    by_axle = {}
    for axle, curve in (result.get("forces") or {}).items():
        true, peak = np.array(curve["true"]), max(np.abs(curve["true"]))
        errors = {key: float(np.sqrt(np.mean((np.array(curve[key]) - true) ** 2)) / peak)
                  for key in ("file", "answer", "model") if key in curve}
        by_axle |= {axle: errors["answer"] / max(errors["file"], 1e-6), **{f"{axle}_{k}": v for k, v in errors.items()}}
    return by_axle


def count_in_band(result: Mapping[str, Any]) -> tuple[int, int]:
    """(points of the true axle curves inside the 90 % band of the answer, number of points)."""
    inside = count = 0
    for curve in result["answer"].get("axle_curves") or ():
        true = result["truth"]["axles"].get(curve["axle"])
        if not true or not curve.get("slip"):
            continue
        slip = np.abs(np.array(curve["slip"], float))
        order = np.argsort(slip)
        edges = np.array([curve["low"], curve["high"]], float)[:, order]
        for point, force in zip(true["slip"], true["force"], strict=True):
            if slip.min() <= point <= slip.max():
                low, high = (np.interp(point, slip[order], edge) for edge in edges)
                inside, count = inside + int(low <= force <= high), count + 1
    return inside, count


def totals(results: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The rows of the score, over all answered cases."""
    results = [one for one in results if "answer" in one]
    stated = [line for one in results for line in list_statements(one)]
    compared = [line for line in stated if line["inside"] is not None]
    is_named = [named for one in results for named in named_errors(one).values()]
    over = [one["answer"]["errors"]["position_5s"] for one in results if one["answer"].get("errors")]
    noise = [one["augmented"] / one["floor"] for one in over if one.get("floor")]
    inside = [count_in_band(one) for one in results]
    ratios = [force_errors(one)[axle] for one in results for axle in ("front", "rear") if axle in force_errors(one)]
    files = [one["held_out"] for one in results if one.get("held_out")]
    return {
        "cases": len(results), "statements": len(stated), "not in the car": sum(not one["in_car"] for one in stated),
        "false": [f"{one['case']}: {line['effect']}" for one in results for line in list_statements(one)
                  if not line["in_car"]],
        "hidden errors": len(is_named), "named": sum(is_named),
        "values compared": len(compared), "inside": sum(line["inside"] for line in compared),
        "over the noise, mean": float(np.mean(noise)) if noise else None,
        "over the noise, largest": max(noise, default=None),
        "band points": sum(b for _, b in inside), "inside the band": sum(a for a, _ in inside),
        "implied force over the file's, median": float(np.median(ratios)) if ratios else None,
        "implied force worse than the file's": sum(r > 1.0 + ROUNDING for r in ratios), "axles": len(ratios),
        "implied force, rms over peak: file's": _mean_force_error(results, "file"),
        "stated": _mean_force_error(results, "answer"), "model.yaml": _mean_force_error(results, "model"),
        "vehicle.yaml written": sum(f["vehicle"] is not None for f in files),
        "vehicle.yaml worse than the original": sum(
            f["vehicle"] is not None and f["vehicle"] > WORSE * f["original"] for f in files),
        "held-out error, original": float(np.mean([f["original"] for f in files])) if files else None,
        "held-out error, model.yaml": float(np.mean([f["model"] or f["original"] for f in files])) if files else None,
        "processor seconds per case": float(np.mean([one["seconds"] for one in results])) if results else None}


def _mean_force_error(results: Sequence[Mapping[str, Any]], source: str) -> float | None:
    """Mean over cases and axles of an implied-force error [1]."""
    values = [value for one in results for key, value in force_errors(one).items() if key.endswith(f"_{source}")]
    return float(np.mean(values)) if values else None
