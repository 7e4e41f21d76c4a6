"""Evaluates an answer on held-out drives: errors of base model, answer and oracle, loss without each hidden effect, and
contributions to the error by kind of effect."""

from typing import Any

import numpy as np
from st_core.discovery.result import BUDGET_PARTS, Discovery
from st_core.effects import get_effect

from .._cases import Record
from ..plants.record import LEAF
from .cases import Case
from .drives import Drives, settings_of
from .effects import PLANT_DIFFERENCES, SCATTER, members
from .oracle import HeldOutErrors, Oracle, Point, null_model

DIGITS = 5


def plant_differences(plant: str) -> dict[str, str]:
    """Effects that the plant has, but not the base model -> reason."""
    return PLANT_DIFFERENCES["leaf" if plant == LEAF else "multibody"]


def true_effects(case: Case) -> set[str]:
    """All effects of the car: the hidden ones, those of every car, and differences between plant and base model."""
    return {*case.hidden, *SCATTER, *(n for n in plant_differences(case.car.plant) if members(n) == (n,))}


def evaluate_answer(case: Case, drives: Drives, found: Discovery) -> Record:
    """Scores of an answer: position error [m] and loss of base model, answer and, except in block E, oracle.

    Blocks A to C: worth: hidden effect -> loss without it, relative to that of the oracle; shares: kind -> fraction of
    the position error of the base model (added last, added first); fitted: values of the oracle. D: detectability:
    fraction of the squared errors that the oracle explains. E: loss_ratio: loss of the base model relative to that for
    the healthy car.
    """
    settings = settings_of(case)
    held_out = HeldOutErrors(drives.held_out, drives.vehicle, settings)
    base = Point(null_model().with_values(found.base.values), found.acceleration_gain)
    answer = base if found.model is None else Point(found.model, found.acceleration_gain)
    if case.block == "E":
        return _round(_measure_visibility(case, drives, held_out, base, answer))
    if case.block == "D":
        healthy = HeldOutErrors(drives.healthy_held_out, drives.vehicle, settings)
        held_out.size = np.sqrt(np.nanmean(np.square(healthy.errors(base)), axis=0))
        start = {n: drives.truth[n] for n in case.hidden}
        oracle = Oracle(drives.suspect, drives.vehicle, case.hidden, start, settings, base)
        without = held_out.square(oracle.without(case.hidden))
        record = _measure_points(held_out, base=base, found=answer, oracle=oracle.best)
        return _round(record | {"detectability": 1.0 - held_out.square(oracle.best) / without})
    names = set() if case.kind == "base" else true_effects(case)
    start = {n: drives.truth[n] for n in names if n in drives.truth}
    oracle = Oracle(drives.suspect, drives.vehicle, names, start, settings)
    held_out.scale_by(oracle.best)
    record = _measure_points(held_out, base=oracle.base, found=answer, oracle=oracle.best)
    best_loss = held_out.loss(oracle.best)
    record["worth"] = {n: held_out.loss(oracle.without([n])) / best_loss for n in case.hidden}
    record["shares"] = _shares(held_out, oracle, names)
    record["fitted"] = {n: {p: v for p, v in oracle.best.model.values[n].items()} for n in case.hidden}
    return _round(record)


def _measure_points(held_out: HeldOutErrors, **points: Point) -> Record:
    return {"position": {k: held_out.position(p) for k, p in points.items()},
            "loss": {k: held_out.loss(p) for k, p in points.items()}}


def _measure_visibility(case: Case, drives: Drives, held_out: HeldOutErrors, base: Point, answer: Point) -> Record:
    """Position errors and losses, and loss of the base model relative to that on the drives of the healthy car."""
    healthy = HeldOutErrors(drives.healthy_held_out, drives.vehicle, settings_of(case))
    healthy.scale_by(base)
    held_out.size = healthy.size
    return _measure_points(held_out, base=base, found=answer) | {"loss_ratio": held_out.loss(base) / healthy.loss(base)}


def _shares(held_out: HeldOutErrors, oracle: Oracle, names: set[str]) -> Record:
    """By kind of effect, relative to the mean position error of the base model: increase without these effects, and
    decrease with them alone."""
    base, best = held_out.position(oracle.base), held_out.position(oracle.best)
    shares = {}
    for part in BUDGET_PARTS[:4]:
        effects = [n for n in names if get_effect(n).kind == part]
        if effects:
            shares[part] = [(held_out.position(oracle.without(effects)) - best) / base,
                            (base - held_out.position(oracle.only(effects))) / base]
    return shares


def _round(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _round(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_round(v) for v in value]
    return round(value, DIGITS) if isinstance(value, float) else value
