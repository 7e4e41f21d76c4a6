"""One case: drives, what `discover` says of them, and what the truth says of that. Many cases: in an order that stays
fair when time runs out, resumable."""

import json
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from st_core.discovery import Discovery, DiscoverySettings, discover
from st_offline.paths import source_version

from . import baselines, real
from .cases import COUNTS, PER_CAR, Case, Drives, cases_of, drives_of, named
from .next_drive import driven_again
from .oracle import Judge, oracle

JUDGED_EVERY = 0.5
"""s between the starts the judge looks at; the oracle fits to half as many."""
COMPARED = 3
"""Every so many-th case is given to the other methods as well."""

Record = dict[str, Any]


def settings_of(case: Case) -> DiscoverySettings:
    # One seed for all: what the reference teaches is kept for settings that are equal.
    return DiscoverySettings(channels=case.channels, effects=case.effects, where=False)


def run_case(case: Case, judged: bool = True) -> Record:
    """Everything the score needs to know of a case, as plain data."""
    drives = real.drives_of(case) if case.kind == "real" else drives_of(case)
    settings = settings_of(case)
    begin = time.process_time()
    found = discover(drives.suspect, drives.vehicle, "nonlinear", drives.reference, settings)
    seconds = time.process_time() - begin
    record: Record = {
        "set": case.set_, "kind": case.kind, "index": case.index, "truth": list(case.truth),
        "hidden": named([case])[0], "with_vy": case.with_vy, "shifted": case.shifted, "note": case.note,
        "scale": [scale for _, scale, _ in case.hidden], "cpu_s": round(seconds, 2), **answer(found),
        "not_testable": [n.name for n in found.not_testable],
    }
    if judged:
        record |= judged_by(case, drives, found)
        record |= driven_again(case, drives, found, settings)
    return record


def answer(found: Discovery) -> Record:
    """outcome, and for each effect its name followed by its alternatives."""
    return {"outcome": found.outcome, "p": round(found.p, 4),
            "candidates": [[c.name, round(c.gain, 3), round(c.p, 4)] for c in found.candidates[:4]],
            "names": [[e.name, *e.alternatives] for e in found.effects],
            "values": [{n: [p.value, *p.interval] for n, p in e.parameters.items()} for e in found.effects]}


def judged_by(case: Case, drives: Drives, found: Discovery) -> Record:
    """Losses on held-out drives: of the base, of what was found, of the oracle, of tyres tuned again."""
    settings = DiscoverySettings(channels=case.channels, interval=JUDGED_EVERY)
    gain = found.acceleration_gain
    judge = Judge(drives.held_out, drives.twin, drives.vehicle, settings, found.base, gain)
    record: Record = {"base": judge.base, "found": judge.base if found.model is None else judge.loss(found.model)}

    coarse = replace(settings, interval=2 * JUDGED_EVERY)

    def fitted(names: Iterable[str]) -> float:
        return judge.loss(oracle(drives.suspect, tuple(names), drives.vehicle, coarse, found.base, gain, judge.floor))
    known = [n for n in case.truth if any(e == n for e, _ in found.base.free)]
    if known:
        record["oracle"] = fitted(known)
        record["detectability"] = 1.0 - record["oracle"] / judge.base
    compared = case.kind in ("single", "healthy") and case.index % COMPARED == 0
    if compared:
        record["tyres"] = fitted(baselines.TYRES)
    record = {name: round(value, 4) for name, value in record.items()}
    if compared and case.with_vy:
        record |= baselines.regressed(drives, found.base)
    return record


def in_fair_order(set_: str, counts: dict[str, int], part: tuple[int, int] = (0, 1)) -> Iterator[Case]:
    """All kinds side by side, car by car: wherever it is stopped, each kind is about equally far.

    part: (k, n), every n-th car from the k-th on, for one of n processes.
    """
    blocks = []
    for kind, count in counts.items():
        cases = real.cases_of(set_, count) if kind == "real" else cases_of(set_, kind, count)
        parts = [cases[i:i + PER_CAR] for i in range(0, len(cases), PER_CAR)]
        blocks += [((i + 0.5) / len(parts), kind, part) for i, part in enumerate(parts)]
    first, step = part
    for _, _, cases in sorted(blocks, key=lambda block: block[:2])[first::step]:
        yield from cases


def run_all(cases: Iterable[Case], cache: Path, until: float | None, say: Callable[[Case, Record], None],
            judged: bool = True) -> list[Record]:
    """Records of all cases; those in files (JSON lines) of the cache's folder are not computed again. until: no case
    begins after this Unix time."""
    done, records = {}, []
    cache.parent.mkdir(parents=True, exist_ok=True)
    for file in sorted(cache.parent.glob("*.jsonl")):
        for line in file.read_text().splitlines():
            record = json.loads(line)
            done[record["set"], record["kind"], record["index"]] = record
    for case in cases:
        key = case.set_, case.kind, case.index
        if key not in done:
            if until is not None and time.time() >= until:
                continue
            done[key] = {"version": source_version(), **_guarded(case, judged)}
            with cache.open("a") as file:
                file.write(json.dumps(done[key]) + "\n")
            say(case, done[key])
        records.append(done[key])
    return records


def _guarded(case: Case, judged: bool) -> Record:
    # A discovery that raises is a wrong answer of the product, not the end of the benchmark.
    try:
        return run_case(case, judged)
    except Exception as error:
        return {"set": case.set_, "kind": case.kind, "index": case.index, "truth": list(case.truth),
                "hidden": named([case])[0], "with_vy": case.with_vy, "shifted": case.shifted, "note": case.note,
                "scale": [scale for _, scale, _ in case.hidden], "outcome": "error", "names": [], "not_testable": [],
                "error": f"{type(error).__name__}: {error}"[:300]}


ALL = dict(COUNTS)
