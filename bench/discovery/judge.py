"""Compares an answer with the truth: held-out errors of base model, answer and oracle, benefit of each hidden effect,
and contributions to the error by kind."""

from typing import Any

import numpy as np
from st_core.discovery.result import PARTS, Discovery
from st_core.effects import get_effect

from .cars import LEAF
from .cases import Case
from .drives import Drives, settings_of
from .effects import PLANT_DIFFERENCES, SCATTER, members
from .oracle import Judge, Oracle, Point, null_model

Record = dict[str, Any]
DIGITS = 5


def plant_differences(plant: str) -> dict[str, str]:
    """Effects that the plant has, but not the base model -> reason."""
    return PLANT_DIFFERENCES["leaf" if plant == LEAF else "multibody"]


def true_effects(case: Case) -> set[str]:
    """All effects of the car: hidden ones, those with scatter, and those that only the plant has."""
    return {*case.hidden, *SCATTER, *(n for n in plant_differences(case.car.plant) if members(n) == (n,))}


def judge_answer(case: Case, drives: Drives, found: Discovery) -> Record:
    """Scores of an answer: position error [m] and loss of base model, answer and oracle.

    worth: hidden effect -> loss without it, relative to that of the oracle. shares: kind -> fraction of the position
    error of the base model (added last, added first). fitted: values of the oracle.
    """
    settings = settings_of(case)
    judge = Judge(drives.held_out, drives.vehicle, settings)
    base = Point(null_model().with_values(found.base.values), found.acceleration_gain)
    answer = base if found.model is None else Point(found.model, found.acceleration_gain)
    if case.block == "E":
        return _round(_judge_visibility(case, drives, judge, base, answer))
    if case.block == "D":
        healthy = Judge(drives.healthy_held_out, drives.vehicle, settings)
        judge.size = np.sqrt(np.nanmean(np.square(healthy.errors(base)), axis=0))
        start = {n: drives.truth[n] for n in case.hidden}
        oracle = Oracle(drives.suspect, drives.vehicle, case.hidden, start, settings, base)
        without = judge.square(oracle.without(case.hidden))
        record = _measure_points(judge, base=base, found=answer, oracle=oracle.best)
        return _round(record | {"detectability": 1.0 - judge.square(oracle.best) / without})
    names = set() if case.kind == "base" else true_effects(case)
    start = {n: drives.truth[n] for n in names if n in drives.truth}
    oracle = Oracle(drives.suspect, drives.vehicle, names, start, settings)
    judge.sized_by(oracle.best)
    record = _measure_points(judge, base=oracle.base, found=answer, oracle=oracle.best)
    best_loss = judge.loss(oracle.best)
    record["worth"] = {n: judge.loss(oracle.without([n])) / best_loss for n in case.hidden}
    record["shares"] = _shares(judge, oracle, names)
    record["fitted"] = {n: {p: v for p, v in oracle.best.model.values[n].items()} for n in case.hidden}
    return _round(record)


def _measure_points(judge: Judge, **points: Point) -> Record:
    return {"position": {k: judge.position(p) for k, p in points.items()},
            "loss": {k: judge.loss(p) for k, p in points.items()}}


def _judge_visibility(case: Case, drives: Drives, judge: Judge, base: Point, answer: Point) -> Record:
    """Position errors and losses, and loss ratio of the base model for the held-out drives of driven and healthy
    car."""
    healthy = Judge(drives.healthy_held_out, drives.vehicle, settings_of(case))
    healthy.sized_by(base)
    judge.size = healthy.size
    return _measure_points(judge, base=base, found=answer) | {"loss_ratio": judge.loss(base) / healthy.loss(base)}


def _shares(judge: Judge, oracle: Oracle, names: set[str]) -> Record:
    """By kind of effect, relative to the mean position error of the base model: increase without these effects, and
    decrease with them alone."""
    base, best = judge.position(oracle.base), judge.position(oracle.best)
    shares = {}
    for part in PARTS[:4]:
        effects = [n for n in names if get_effect(n).kind == part]
        if effects:
            shares[part] = [(judge.position(oracle.without(effects)) - best) / base,
                            (base - judge.position(oracle.only(effects))) / base]
    return shares


def _round(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _round(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_round(v) for v in value]
    return round(value, DIGITS) if isinstance(value, float) else value
