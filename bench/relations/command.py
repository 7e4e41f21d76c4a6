"""Blind benchmark of `st discover --propose`: scores of proposals for relations that the library does not contain."""

import argparse
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from st_core.augmented import AugmentedModel, augment
from st_core.checks import check, pool_estimates
from st_core.discovery import Discovery, discover
from st_core.discovery.windows import Windows
from st_core.log import DriveLog
from st_core.relations import RelationSearch, find_relation, needs_search
from st_core.vehicle import VehicleParameters

from .._cases import Record, interleave, read_records, run_all
from ..discovery.effects import SCATTER, members
from ..discovery.evaluation import plant_differences
from ..discovery.oracle import Oracle, mean_distance
from ..plants.leaf import DriveFailed
from . import baselines, score
from .cases import COUNTS, RelationCase, cases_of, drives_of

NOT_IN_ORACLE = ("front_stiffness", "rear_stiffness")
"""Differences between plant and base model that the oracle does not fit; composite effects are left out as well."""


def main(arguments: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(prog="st bench relations", description=(
        "Compares proposals of st discover with the truth, for relations hidden in two plants. Block "
        "L: twelve relations, M: six effects removed from the library, N: no relation."))
    parser.add_argument("--set", default="development",
                        help="development, sealed, sealed-2, or the name of another set of cases")
    parser.add_argument("--until", type=float, metavar="MINUTES", help="start no case after this time")
    parser.add_argument("--skip", type=int, default=0, metavar="CASES", help="skip the first cases")
    parser.add_argument("--plain", action="store_true", help="without oracle and baselines")
    parser.add_argument("--out", type=Path, default=Path("relations.jsonl"),
                        help="file of JSON lines; cases that it contains are not run again")
    parser.add_argument("--tables", type=Path, nargs="+", metavar="FILE",
                        help="only write the scores into docs/measurements/proposals.md from these files")
    chosen = parser.parse_args(arguments)
    if chosen.tables:
        score.write(read_records(*chosen.tables))
        return 0
    until = None if chosen.until is None else time.time() + 60 * chosen.until
    cases = [case for case, in interleave({b: [(case,) for case in cases_of(chosen.set, b)] for b in COUNTS})]
    records = run_all(cases[chosen.skip:], chosen.out, until, partial(_try_case, whole=not chosen.plain), _print_record)
    for name, measured, *_ in score.score_rows(records):
        print(f"{name}: {measured}")
    return 0


def _try_case(case: RelationCase, whole: bool) -> Record | None:
    try:
        return run_case(case, whole)
    except DriveFailed as error:
        print(f"{case.block} {case.index}: cannot be driven: {error}", flush=True)
        return None


def _print_record(r: Record) -> None:
    relation = r["law"]
    answer = f"{relation['place']}({relation['quantity']}) {relation['reads']}" if relation else r["outcome"]
    errors = ", ".join(f"{k} {v:.2f}" for k, v in r["position"].items())
    print(f"{r['block']} {r['index']} [{r['plant']}, {r['hidden']} x {r['scale']:g}] -> {answer}; 5 s {errors} m; "
          f"{sum(r['seconds']):.0f} s", flush=True)


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
        record["baselines"] = baselines.compare_methods(drives.suspect, drives.held_out, vehicle, answer,
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
