"""Runs cases: drives, the answer of `discover`, and its comparison with the truth.

An interrupted run can be continued.
"""

import json
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from st_core.checks import check, pool_estimates
from st_core.discovery import Discovery, DiscoverySettings, discover
from st_core.discovery.result import FoundEffect
from st_core.discovery.settings import Limits
from st_recordings.paths import source_version

from . import baselines, edits
from .cases import PER_CAR, Case, cases_of
from .drives import IDENTIFIED, drives_of, settings_of
from .edits import EditCase
from .effects import SCATTER
from .evaluation import evaluate_answer
from .next_drive import try_suggestion

BASELINE_INTERVAL = 3  # every third case of blocks A and B is also run with the other methods
Record = dict[str, Any]
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
    errors = found.errors.get("position_5s")
    return {
        "outcome": found.outcome,
        "effects": [*({"name": e.name, "kind": e.kind, "alternatives": list(e.alternatives),
                       "position_5s": round(e.position_5s_increase, 4), "values": _values(e)} for e in found.effects),
                    *({"name": c.effects[0], "kind": "combination", "alternatives": list(c.effects[1:]),
                       "position_5s": 0.0, "values": {}} for c in found.unseparated_combinations)],
        "kept": {e.name: _values(e) for e in found.minor},
        "on_top": {c.name: dict(c.parameters) for c in found.candidates},
        "varying": [[b.resembles, b.varies_with] for b in found.varying],
        "unexplained": bool(found.signature),
        "steps": [[s.effect, round(s.position_5s.base, 4), round(s.position_5s.augmented, 4)]
                  for s in found.steps],
        "budget": {b.part: [round(v, 4) for v in (b.share_added_last, b.share_added_first)] for b in found.budget},
        "errors": None if errors is None else [round(errors.base, 4), round(errors.augmented, 4)],
        "powers": [[p.effect, p.parameter, p.size, p.probability] for p in found.power_analysis.powers],
        "not_testable": [n.name for n in found.not_testable],
        "refused": [[c.name, round(c.gain, 4), c.verdict] for c in found.candidates[:5]
                    if c.verdict not in ("named", "alternative")],
    }


def _values(effect: FoundEffect) -> dict[str, list[float]]:
    return {n: [p.value, *p.interval] for n, p in effect.parameters.items()}


def interleave_cases(set_: str, counts: dict[str, int], part: tuple[int, int] = (0, 1)) -> Iterator[AnyCase]:
    """Yields the cases of all blocks in an order in which all blocks advance at the same rate.

    part: (k, n), every n-th group from the k-th on, for one of n processes. Cases with the same reference drives form a
    group; in block F, the drives as recorded are the first case.
    """
    groups = []
    for block, count in counts.items():
        if block == "F":
            cases: list[AnyCase] = list(edits.cases_of(set_, count)) if count else []
        else:
            cases = list(cases_of(set_, block, count))
        size = PER_CAR if block == "D" else 1
        parts = [cases[i:i + size] for i in range(0, len(cases), size)]
        groups += [((i + 0.5) / len(parts), block, group) for i, group in enumerate(parts)]
    first, step = part
    for _, _, group in sorted(groups, key=lambda g: g[:2])[first::step]:
        yield from group


def key_of(case: Any) -> tuple[str, str, int]:
    return case.set_, case.block, case.index


def read_records(file: Path) -> dict[tuple[str, str, int], Record]:
    """Records of a file of JSON lines, by set, block and index."""
    if not file.exists():
        return {}
    lines = map(json.loads, file.read_text().splitlines())
    return {(r["set"], r["block"], r["index"]): r for r in lines}


def read_files(files: Iterable[Path]) -> list[Record]:
    """Records of several files; if several contain a case with the same limit, the last counts."""
    records = {(*key, *r.get("limit", ())): r for file in files for key, r in read_records(file).items()}
    return list(records.values())


def run_all(cases: Iterable[Any], file: Path, until: float | None, run: Callable[[Any], Record | None],
            report: Callable[[Record], None]) -> list[Record]:
    """Records of all cases, which are appended to the file one by one; cases in the file are not run again.

    until: Unix time after which no case starts. run: runs a case; None for a case without a record.
    """
    done, records = read_records(file), []
    file.parent.mkdir(parents=True, exist_ok=True)
    for case in cases:
        key = key_of(case)
        if key not in done:
            if until is not None and time.time() >= until:
                break
            begin = time.process_time()
            record = run(case)
            if record is None:
                continue
            done[key] = {"set": key[0], "block": key[1], "index": key[2], "version": source_version(), **record,
                         "case_s": round(time.process_time() - begin, 2)}
            with file.open("a") as out:
                out.write(json.dumps(done[key]) + "\n")
            report(done[key])
        records.append(done[key])
    return records


def try_case(case: AnyCase, limits: Limits | None = None, whole: bool = True) -> Record:
    """The record of a case; an exception is scored as a wrong answer and does not end the benchmark."""
    try:
        return run_case(case, limits, whole)
    except Exception as error:
        return {**describe_case(case), "outcome": "error", "effects": [], "varying": [], "truth": {}, "scatter": {},
                "error": f"{type(error).__name__}: {error}"[:300]}
