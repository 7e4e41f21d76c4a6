"""Options of the blind benchmark."""

import argparse
import json
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from . import figures, score, tables
from .run import ALL, Record, in_fair_order, run_all


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="st bench discovery", description=(
        "Hidden effects in the virtual car: what discovery says of them, against the truth. The sealed set is run once "
        "per release; look at the development set as often as you like."))
    parser.add_argument("--set", default="development",
                        help="development, sealed, or any other word: a set of its own")
    parser.add_argument("--kind", choices=sorted(ALL), action="append",
                        help="of the cases; may be repeated; default all")
    parser.add_argument("--cases", type=int, help="of each kind, at most")
    parser.add_argument("--first", type=int, default=0, help="index of the first case of each kind")
    parser.add_argument("--cache", type=Path, default=Path(tempfile.gettempdir()) / "st_bench_discovery",
                        help="folder for what was computed already")
    parser.add_argument("--minutes", type=float, help="begin no case after this time; 0: score what is there")
    parser.add_argument("--part", type=int, nargs=2, default=(0, 1), metavar=("K", "N"),
                        help="the share of process K = 0 ... N-1; score all with --minutes 0 in the end")
    parser.add_argument("--no-judge", action="store_true", help="leave out oracle, baselines and suggested drives")
    parser.add_argument("--output", type=Path, help="write the scores (results.json) to this folder")
    parser.add_argument("--page", type=Path,
                        help="put the scores between the marks of this page, the figure into images/ beside it")
    chosen = parser.parse_args(arguments)
    counts = {kind: min(ALL[kind], chosen.first + chosen.cases) if chosen.cases else ALL[kind]
              for kind in chosen.kind or ALL}
    until = None if chosen.minutes is None else time.time() + 60 * chosen.minutes
    cases = (case for case in in_fair_order(chosen.set, counts, chosen.part) if case.index >= chosen.first)
    folder = chosen.cache / f"{chosen.set}{'_unjudged' if chosen.no_judge else ''}"
    records = run_all(cases, folder / f"{chosen.part[0]}.jsonl", until, _say, not chosen.no_judge)
    document = score.scores(records)
    print(score.as_text(document))
    if chosen.output:
        chosen.output.mkdir(parents=True, exist_ok=True)
        version = {"set": chosen.set, "version": sorted({r["version"] for r in records}),
                   "date": time.strftime("%Y-%m-%d", time.gmtime())}
        (chosen.output / "results.json").write_text(json.dumps(
            {**version, **document, "cases": [score.short(r) for r in records]}, separators=(",", ":")) + "\n")
    if chosen.page:
        tables.put_into(chosen.page, tables.as_markdown(document, records))
        figures.confusion(records, chosen.page.parent / "images" / "discovery_confusion.png")
    return 0


def _say(case, record: Record) -> None:
    names = " + ".join("|".join(group) for group in record["names"]) or "-"
    visible = f"D {record['detectability']:.2f}" if "detectability" in record else ""
    print(f"{case.kind} {case.index}: {record['hidden']}{'' if case.with_vy else ' (no v_y)'} "
          f"[{', '.join(case.truth)}] -> {record['outcome']}: {names} {visible} {record.get('error', '')} "
          f"{record.get('cpu_s', 0):.1f} s; tried "
          + ", ".join(f"{name} {gain:.2f} (p {p:.3f})" for name, gain, p in record.get("candidates", [])), flush=True)
