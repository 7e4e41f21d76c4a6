"""Scores of answers: statements, hidden errors, values, predictions, axle forces, vehicle files and time."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

WORSE = 1.02  # ratio of held-out errors above which a file is worse; two short drives differ by up to that
ROUNDING = 1e-9  # tolerance of the ratio of force errors, for rounding
STIFFNESS_ERRORS = ("worn_front", "worn_rear", "compliance")
MEMBERS = {"tyre_stiffness": ("front_stiffness", "rear_stiffness")}


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
    return statements


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
    stated, combined = set(), set()
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
