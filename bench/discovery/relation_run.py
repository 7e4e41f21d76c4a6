"""Runs a case of block L, M or N: answer, proposal, and their errors on held-out drives."""

import time
from typing import Any

from st_core.augmented import AugmentedModel, augment
from st_core.checks import check, pool_estimates
from st_core.discovery import Discovery, discover
from st_core.discovery.windows import Windows
from st_core.log import DriveLog
from st_core.relations import RelationSearch, find_relation, needs_search
from st_core.vehicle import VehicleParameters

from . import relation_baselines
from .effects import SCATTER, members
from .evaluation import plant_differences
from .oracle import Oracle, mean_distance
from .relation_cases import RelationCase, drives_of

Record = dict[str, Any]
NOT_IN_ORACLE = ("front_stiffness", "rear_stiffness")
"""Differences between plant and base model that the oracle does not fit; composite effects are left out as well."""


def run_case(case: RelationCase, whole: bool = True) -> Record:
    """The record of a case. whole: with the oracle and the two other methods. As in `st discover`, the search for a
    relation runs only if a large error is unexplained."""
    drives = drives_of(case)
    vehicle, settings = drives.vehicle, case.settings
    begin = time.process_time()
    sensors = pool_estimates([check(log, vehicle).estimates for log in drives.suspect])
    found = discover(drives.suspect, vehicle, "nonlinear", (), settings, sensor_estimates=sensors)
    middle = time.process_time()
    search = find_relation(found, drives.suspect, vehicle, settings) if needs_search(found) else RelationSearch(
        None, "not searched: the residual is near the noise", {})
    end = time.process_time()
    held_out = Windows(drives.held_out, vehicle, settings)
    answer = found.model or found.base
    proposed = proposed_model(search) or answer
    record = {"hidden": case.hidden.name if case.hidden else "nothing", "plant": case.car.plant, "scale": case.scale,
              "wrong": case.wrong, "seconds": [middle - begin, end - middle],
              "driven": float(sum(log.duration for log in drives.suspect)), **_answer_record(found, search),
              "position": {"base": position_error(held_out, found.base), "found": position_error(held_out, answer),
                           "proposed": position_error(held_out, proposed)}}
    if whole and case.hidden:
        record["position"]["oracle"] = _oracle_error(case, drives.healthy, drives.healthy_held_out, vehicle)
        record["baselines"] = relation_baselines.compare_methods(drives.suspect, drives.held_out, vehicle, answer,
                                                                 settings)
    return record


def proposed_model(search: RelationSearch) -> AugmentedModel | None:
    one = search.relation
    if one is None:
        return None
    coefficients = {f"c{k}": float(c) for k, c in enumerate(one.coefficients)}
    return augment(one.model, {one.candidate.effect: coefficients | one.candidate.constants})


def position_error(windows: Windows, model: AugmentedModel) -> float:
    """Mean position error after 5 s [m]."""
    last = windows.errors(model)[:, -1, windows.columns.index("position_lateral"):][:, :2]
    return mean_distance(last)


def _oracle_error(case: RelationCase, healthy: list[DriveLog], held_out: list[DriveLog],
                  vehicle: VehicleParameters) -> float:
    """Held-out error [m] of the effects of the plant, fitted to the same programmes driven by the healthy car."""
    names = {*SCATTER, *(n for n in plant_differences(case.car.plant) if members(n) == (n,))} - set(NOT_IN_ORACLE)
    best = Oracle(healthy, vehicle, names, {}, case.settings).best
    return position_error(Windows(held_out, vehicle, case.settings), best.model)


def _answer_record(found: Discovery, search: RelationSearch) -> Record:
    one = search.relation
    relation, redundant = None, ()
    if one is not None:
        redundant = tuple(one.redundant)
        relation = {"place": one.candidate.term, "quantity": one.candidate.quantity, "by": one.candidate.factor,
                    "others": dict(one.alternatives), "p_value": one.p_value, "gain": one.gain,
                    "shape": one.formulas[0].shape if one.formulas else "",
                    "reads": one.formulas[0].text if one.formulas else "", "promised": list(one.position_5s)}
    return {"outcome": found.outcome, "searched": needs_search(found), "why": search.reason, "law": relation,
            "alone": [e.name for e in found.effects if not e.alternatives], "redundant": list(redundant),
            "kept": [e.name for e in (*found.effects, *found.minor)]}
