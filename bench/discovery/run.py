"""Runs a case: drives, the answer of `discover`, its comparison with the truth, and the suggested drive."""

import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from st_core.checks import check, pool_estimates
from st_core.discovery import Discovery, DiscoverySettings, discover
from st_core.discovery.result import FoundEffect
from st_core.discovery.settings import Limits

from .._cases import Record
from ..plants import programmes
from ..plants.record import RunPlan
from . import baselines, edits
from .cases import Case
from .drives import IDENTIFIED, Drives, drives_of, record_more, settings_of
from .edits import EditCase
from .effects import SCATTER
from .evaluation import evaluate_answer
from .score import relevant_effects, stratum

BASELINE_INTERVAL = 3  # every third case of blocks A and B is also run with the other methods
AnyCase = Case | EditCase


def run_case(case: AnyCase, limits: Limits | None = None, whole: bool = True) -> Record:
    """The record of a case for the score. whole: with baselines and suggested drives."""
    limits = limits or Limits()
    if isinstance(case, EditCase):
        logs, vehicle = edits.drives_of(case)
        found, seconds = _discover(logs, vehicle, (), DiscoverySettings(locate_errors=False, limits=limits))
        return {**describe_case(case), "cpu_s": seconds, **describe_answer(found)}
    drives = drives_of(case)
    settings = replace(settings_of(case), limits=limits)
    found, seconds = _discover(drives.suspect, drives.vehicle, drives.reference, settings)
    known = (*SCATTER, *IDENTIFIED) if case.kind == "identified" else SCATTER
    record = {**describe_case(case), "cpu_s": seconds,
              "truth": {n: drives.truth[n] for n in case.hidden if n in drives.truth},
              "scatter": {n: drives.truth[n] for n in known}, "mistaken": list(drives.wrong_in_file),
              **describe_answer(found), **evaluate_answer(case, drives, found)}
    if whole:
        record |= try_suggestion(case, drives, found, settings, record)
        if case.block in "AB" and case.index % BASELINE_INTERVAL == 0:
            record["baselines"] = baselines.compare_methods(case, drives)
    return record


def describe_case(case: AnyCase) -> Record:
    """The part of a record that describes the case."""
    if isinstance(case, EditCase):
        return {"kind": case.name or "unedited", "size": case.size}
    return {"kind": case.kind, "plant": case.car.plant, "hidden": list(case.hidden), "words": case.description,
            "scales": list(case.scales), "with_vy": case.with_vy, "shifted": case.shifted}


def _discover(suspect, vehicle, reference, settings: DiscoverySettings) -> tuple[Discovery, float]:
    """Runs the discovery as `st discover` does, with the sensor estimates of the checks; also returns its time [s]."""
    begin = time.process_time()
    sensors = pool_estimates([check(log, vehicle).estimates for log in suspect])
    found = discover(suspect, vehicle, "nonlinear", reference, settings, sensor_estimates=sensors)
    return found, round(time.process_time() - begin, 2)


def describe_answer(found: Discovery) -> Record:
    """The part of a record that describes the answer."""
    return {
        "outcome": found.outcome,
        "effects": [*({"name": e.name, "kind": e.kind, "alternatives": list(e.alternatives),
                       "position_5s": round(e.position_5s_increase, 4), "values": _values(e)} for e in found.effects),
                    *({"name": c.effects[0], "kind": "combination", "alternatives": list(c.effects[1:]),
                       "position_5s": 0.0, "values": {}} for c in found.unseparated_combinations)],
        "on_top": {c.name: dict(c.parameters) for c in found.candidates},
        "varying": [[b.resembles, b.varies_with] for b in found.varying],
        "unexplained": bool(found.signature),
        "budget": {b.part: [round(v, 4) for v in (b.share_added_last, b.share_added_first)] for b in found.budget},
        "powers": [[p.effect, p.parameter, p.size, p.probability] for p in found.power_analysis.powers],
    }


def _values(effect: FoundEffect) -> dict[str, list[float]]:
    return {n: [p.value, *p.interval] for n, p in effect.parameters.items()}


def try_case(case: AnyCase, limits: Limits | None = None, whole: bool = True) -> Record:
    """The record of a case; an exception is scored as a wrong answer and does not end the benchmark."""
    try:
        return run_case(case, limits, whole)
    except Exception as error:
        return {**describe_case(case), "outcome": "error", "effects": [], "varying": [], "truth": {}, "scatter": {},
                "error": f"{type(error).__name__}: {error}"[:300]}


def try_suggestion(case: Case, drives: Drives, found: Discovery, settings: DiscoverySettings,
                   record: Mapping[str, Any]) -> dict[str, Any]:
    """Result with the suggested drive; the case is settled if the hidden effect is now stated without alternatives.

    {} unless the case has one relevant hidden effect, is not yet settled, and has a suggested drive.
    record: the record of the case without this result.
    """
    suggested = found.next_manoeuvre
    visible = relevant_effects(record) or stratum(record.get("detectability", 0.0)) != "invisible"
    if case.kind != "one" or not visible or _is_settled(case, found) or suggested is None:
        return {}
    part = programmes.suggested_part(suggested.name)
    plans = [RunPlan(f"next_{i + 1}", (case.seed, 300 + i), case.settings, (part,))
             for i in range(suggested.repetitions)]
    runs = record_more(case, drives.vehicle, plans)
    again = discover((*drives.suspect, *runs), drives.vehicle, "nonlinear", drives.reference, settings)
    return {"suggested": suggested.name, "separates": list(suggested.separates), "settled": _is_settled(case, again),
            "again": [[e.name, *e.alternatives] for e in again.effects]}


def _is_settled(case: Case, found: Discovery) -> bool:
    return any(e.name == case.hidden[0] and not e.alternatives for e in found.effects)
