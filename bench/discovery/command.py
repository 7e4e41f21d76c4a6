"""Blind benchmark of `st discover`: scores for effects hidden in two plants, and for edits of real drives."""

import argparse
import json
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import fields
from functools import partial
from itertools import product
from pathlib import Path

from st_core.discovery.settings import Limits

from .._cases import FACTORS, Record, interleave, multiplied, read_records, run_all
from . import edits, score, tables
from .cases import COUNTS, PER_CAR, cases_of
from .run import AnyCase, try_case

FOLDER = Path(tempfile.gettempdir()) / "st_bench_discovery"


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="st bench discovery", description=(
        "Compares answers of st discover with the truth, for effects hidden in two plants and edits of real drives. "
        "Use the development set as often as you like, and the sealed set once, with a frozen version."))
    parser.add_argument("--set", default="development",
                        help="development, sealed, or the name of another set of cases")
    parser.add_argument("--counts", type=_counts, default=COUNTS, metavar="A=10,B=10",
                        help="maximum number of cases of each block; default all")
    parser.add_argument("--until", type=float, metavar="MINUTES", help="start no case after this time")
    parser.add_argument("--part", type=_part, default=(0, 1), metavar="K/N",
                        help="run the cases of process K of N; each process writes its own file")
    parser.add_argument("--out", type=Path, help="file of JSON lines; cases that it contains are not run again")
    parser.add_argument("--plain", action="store_true", help="without baselines and suggested drives")
    parser.add_argument("--ablation", action="store_true",
                        help="run the cases with each limit of the decision halved and doubled")
    parser.add_argument("--tables", type=Path, nargs="+", metavar="FILE",
                        help="only write docs/measurements/discovery_scores.md from these files; if several "
                             "contain a case, the last counts")
    chosen = parser.parse_args(arguments)
    if chosen.tables:
        records = read_records(*chosen.tables)
        tables.write(records)
        print(score.as_text(score.score_rows([r for r in records if "limit" not in r])))
        return 0
    k, n = chosen.part
    out = chosen.out or FOLDER / f"{chosen.set}_{k + 1}_of_{n}.jsonl"
    until = None if chosen.until is None else time.time() + 60 * chosen.until
    cases = list(interleave_cases(chosen.set, chosen.counts, chosen.part))
    if chosen.ablation:
        run_variants(cases, out, until)
        return 0
    records = run_all(cases, out, until, partial(try_case, whole=not chosen.plain), _print_record)
    print(score.as_text(score.score_rows(records)))
    print(f"{len(records)} of {len(cases)} cases, in {out}")
    return 0


def interleave_cases(set_: str, counts: dict[str, int], part: tuple[int, int] = (0, 1)) -> Iterator[AnyCase]:
    """Yields the cases of all blocks in an order in which all blocks advance at the same rate.

    part: (k, n), every n-th group from the k-th on, for one of n processes. Cases with the same reference drives form a
    group; in block F, the drives as recorded are the first case.
    """
    groups = {}
    for block, count in counts.items():
        cases = (edits.cases_of(set_, count) if count else []) if block == "F" else cases_of(set_, block, count)
        size = PER_CAR if block == "D" else 1
        groups[block] = [cases[i:i + size] for i in range(0, len(cases), size)]
    first, step = part
    for group in interleave(groups)[first::step]:
        yield from group


def run_variants(cases: Sequence[AnyCase], out: Path, until: float | None) -> None:
    """Runs all cases with unchanged limits and with each limit halved and doubled; writes a file of JSON lines for each
    variant, next to `out`, with the limit in each record."""
    for name, factor in [("", 1.0), *product([field.name for field in fields(Limits)], FACTORS)]:
        file, limits = out.with_name(f"{out.stem}_{name or 'unchanged'}_{factor:g}.jsonl"), Limits()
        with multiplied([(limits, name)] if name else [], factor):
            records = run_all(cases, file, until, partial(try_case, limits=limits, whole=False), _print_record)
        file.write_text("".join(json.dumps({**r, "limit": [name, factor]}) + "\n" for r in records))


def _counts(text: str) -> dict[str, int]:
    counts = {block: int(number) for block, _, number in (part.partition("=") for part in text.split(","))}
    if not set(counts) <= set(COUNTS):
        raise argparse.ArgumentTypeError(f"blocks are {', '.join(COUNTS)}")
    return counts


def _part(text: str) -> tuple[int, int]:
    k, _, n = text.partition("/")
    if not 1 <= int(k) <= int(n):
        raise argparse.ArgumentTypeError("must be K/N with K from 1 to N")
    return int(k) - 1, int(n)


def _print_record(r: Record) -> None:
    names = " + ".join("|".join(group) for group in score.list_statements(r)) or "-"
    varying = "".join(f" {name} varies with {partition}" for name, partition in r["varying"])
    position = r.get("position")
    errors = "" if not position else " 5 s " + ", ".join(f"{k} {v:.2f}" for k, v in position.items()) + " m;"
    hidden = f"{r['plant']}, {r['words']}" if "words" in r else f"{r['kind']} {r['size']:+.3g}"
    print(f"{r['block']} {r['index']} [{hidden}] -> {r['outcome']}: {names}{varying};{errors} {r.get('cpu_s', 0):.1f} "
          f"of {r['case_s']:.1f} s {r.get('error', '')}", flush=True)
