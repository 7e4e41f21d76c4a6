"""Command line of the blind benchmark of proposals."""

import argparse
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from . import relation_score, relation_tables
from .compiled import DriveFailed
from .relation_cases import COUNTS, RelationCase, cases_of
from .relation_run import Record, run_case
from .run import read_files, run_all


def main(arguments: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(prog="st bench discovery --relations", description=(
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
        relation_tables.write(read_files(chosen.tables))
        return 0
    until = None if chosen.until is None else time.time() + 60 * chosen.until
    records = run_all(interleave_cases(chosen.set)[chosen.skip:], chosen.out, until,
                      partial(_try_case, whole=not chosen.plain), _print_record)
    for name, measured, *_ in relation_score.score_rows(records):
        print(f"{name}: {measured}")
    return 0


def interleave_cases(set_: str) -> list[RelationCase]:
    """All cases, in an order in which all blocks advance at the same rate."""
    cases = [((k + 0.5) / count, block, case) for block, count in COUNTS.items()
             for k, case in enumerate(cases_of(set_, block))]
    return [case for *_, case in sorted(cases, key=lambda c: c[:2])]


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
