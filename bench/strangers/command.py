"""Tests `st discover` with cars whose equations differ from those of the project, and scores its statements."""

import argparse
import csv
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from datetime import date
from pathlib import Path
from typing import Any

from st_recordings.paths import project_root, source_version

from .._pages import format_records, replace_part
from . import ablation, score
from .cases import HALVES, NEW_USER, VDRIFT_ERRORS, Case, cases
from .recordings import write_case
from .vehicles import CARS, EQUATIONS

PAGE = project_root() / "docs" / "measurements" / "strangers.md"
STORED_KEYS = ("outcome", "effects", "minor", "effective", "combinations", "varying", "signature", "errors",
               "named_errors", "axle_curves", "assumed", "files", "warnings")
"""Keys of discovery.json that are stored for the score, and to explain wrong answers."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs and scores the chosen cases; exit status 1 if `st discover` failed for one of them."""
    parser = argparse.ArgumentParser(prog="st bench strangers", description=(
        "Runs st discover for CSV recordings of cars whose equations differ from those of the project, with the "
        "vehicle file of a typical owner, and scores its answers."))
    parser.add_argument("--cases", choices=[*HALVES, NEW_USER, *VDRIFT_ERRORS], default="development")
    parser.add_argument("--only", nargs="+", metavar="TEXT", help="names of cases, or parts of names")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="only every N-th of the chosen cases")
    parser.add_argument("--output", type=Path, help="folder of the answers, one JSON file per case; default "
                        ".st/strangers/<half>. A case that this version has answered is not run again")
    parser.add_argument("--fresh", action="store_true", help="run all chosen cases again")
    parser.add_argument("--keep", type=Path, help="folder for the recordings and all files of the answers")
    parser.add_argument("--list", action="store_true", help="list the cases and their hidden errors")
    parser.add_argument("--score", action="store_true", help="only score the existing answers, of any version")
    parser.add_argument("--page", action="store_true", help="also write the tables in docs/measurements/strangers.md, "
                        "or that of --ablation in discovery_limits.md")
    parser.add_argument("--ablation", action="store_true", help="repeat the decisions of development cases with each "
                        "limit halved and doubled; --only needs whole names, default are nine diverse cases")
    parser.add_argument("--limits", nargs="*", default=ablation.NUMBERS, choices=ablation.NUMBERS, metavar="NAME",
                        help="limits to change with --ablation")
    chosen = parser.parse_args(arguments)
    if chosen.ablation:
        ablation.run_variants(chosen.only or ablation.DIVERSE_CASES, chosen.limits, chosen.page)
        return 0
    known = cases(chosen.cases)
    names = [name for name in known if not chosen.only or any(
        name == text or (text in name and text not in known) for text in chosen.only)]
    selected = [known[name] for name in names[::chosen.every]]
    if chosen.list:
        print("\n".join(f"{case.name}: {_describe_hidden(case)}" for case in selected))
        return 0
    folder = chosen.output or project_root() / ".st" / "strangers" / chosen.cases
    folder.mkdir(parents=True, exist_ok=True)
    results = []
    for case in selected:
        file = folder / f"{case.name}.json"
        stored = json.loads(file.read_text()) if file.exists() else None
        if stored and (chosen.score or (not chosen.fresh and stored["version"] == source_version())):
            results.append(stored)
        elif not chosen.score:
            results.append(run_case(case, chosen.keep))
            file.write_text(json.dumps(results[-1], indent=1) + "\n")
            print("\n".join(case_lines(results[-1])), flush=True)
    figures = score.totals(results)
    print(json.dumps(figures, indent=1))
    if chosen.page:
        rows = list_cases(results)
        if chosen.cases in VDRIFT_ERRORS:
            tables = "\n\n".join(map(format_records, (score_rows(figures), list_chosen(results))))
        else:
            write_cases(rows, PAGE.with_name(f"strangers_{chosen.cases}.csv"))
            tables = page_tables(figures, rows)
        replace_part(PAGE, f"strangers_{chosen.cases}", tables)
    return int(any("answer" not in one for one in results))


def run_case(case: Case, keep: Path | None = None) -> dict[str, Any]:
    """Writes the recordings of a case and runs `st discover`; returns the answer, held-out errors and axle forces."""
    result: dict[str, Any] = {"case": case.name, "version": source_version(), "date": str(date.today())}
    with tempfile.TemporaryDirectory(prefix="st-strangers-") as temporary:
        folder = (keep or Path(temporary)) / case.name
        folder.mkdir(parents=True)
        result["truth"] = write_case(case, folder)
        output, start, cpu_start = folder / "found", time.monotonic(), _processor_time()
        done = subprocess.run(
            [sys.executable, "-m", "st_cli.cli", "discover", str(folder / "drives"), "--car", str(folder / "car"),
             "--output", str(output), "--no-propose", "--no-report", "--jobs", "1", "--fresh"],
            cwd=project_root(), check=False, capture_output=True, text=True)
        result |= {"seconds": round(_processor_time() - cpu_start, 1), "elapsed": round(time.monotonic() - start, 1)}
        if done.returncode > 1 or not (output / "discovery.json").exists():
            return result | {"failed": done.stderr[-2000:]}
        answer = json.loads((output / "discovery.json").read_text())
        result["answer"] = {key: answer[key] for key in STORED_KEYS if key in answer}
        result["held_out"] = score.held_out_errors(folder, output)
        result["forces"] = score.implied_forces(result["truth"], folder, output, answer)
    return result


def _processor_time() -> float:
    """Processor time of ended child processes [s]."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def case_lines(result: Mapping[str, Any]) -> list[str]:
    """Lines for a terminal: hidden errors, statements, and errors of prediction and forces."""
    if "answer" not in result:
        return [f"{result['case']}: FAILED: {result['failed'].strip().splitlines()[-1:]}"]
    errors, held = result["answer"]["errors"]["position_5s"], result["held_out"]
    lines = [f"{result['case']} ({result['seconds']} s): "
             + ", ".join(f"{name} {'reported' if ok else 'MISSED'}" for name, ok in score.named_errors(result).items())]
    lines += [f"   {format_statement(line)}" for line in score.list_statements(result)]
    ratios = ", ".join(f"{axle} {value:.2f}" for axle, value in score.force_errors(result).items() if "_" not in axle)
    inside, count = score.count_in_band(result)
    lines.append(f"   5 s error {errors['base']:.2f} -> {errors['augmented']:.3f} m, noise {errors['floor']:.3f} m; "
                 "held-out " + ", ".join(f"{key} {value:.2f}" for key, value in held.items() if value is not None)
                 + f" m; axle force error relative to the vehicle file: {ratios}; true curve inside the 90 % band at "
                 f"{inside} of {count} points")
    return lines


def format_statement(line: Mapping[str, Any]) -> str:
    """Text of a statement, and whether it is correct for the car."""
    if line.get("value") is None:
        return f"{line['effect']}: {'in the car' if line['in_car'] else 'NOT IN THE CAR'}"
    low, high = line["interval"] or (None, None)
    interval = "" if low is None or high is None else f" ({low:.4g} to {high:.4g})"
    text = f"{line['effect']} {line['value']:.4g}{interval}"
    if not line["in_car"]:
        return f"{text}: NOT IN THE CAR"
    if line["inside"] is None:
        return f"{text}: in the car"
    first, last = line["true"]
    true = f"{first:.4g}" if first == last else f"{first:.4g} to {last:.4g}"
    return f"{text}: true {true}, {'inside' if line['inside'] else 'OUTSIDE'}"


def _describe_hidden(case: Case) -> str:
    text = ", ".join(f"{name} {size:.4g}" for name, size in case.hidden.items()) or "no error except guesses"
    return f"{text}; {EQUATIONS[CARS[case.car].equations]}"


def list_cases(results: Sequence[Mapping[str, Any]]) -> list[dict[str, str]]:
    """A row for each answered case; statements are separated by semicolons."""
    return [{"case": one["case"], "hidden": ", ".join(one["truth"]["hidden"]) or "-",
             "stated": "; ".join(format_statement(line) for line in score.list_statements(one)) or "-",
             "5 s error [m]": f"{one['answer']['errors']['position_5s']['base']:.2f}",
             "after discovery [m]": f"{one['answer']['errors']['position_5s']['augmented']:.2f}",
             "processor time [s]": f"{one['seconds']:.0f}"} for one in results if "answer" in one]


def write_cases(rows: Sequence[Mapping[str, str]], file: Path) -> None:
    with file.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def list_chosen(results: Sequence[Mapping[str, Any]]) -> list[dict[str, str]]:
    """A row for each answered case: size of the error, statements, mean position error after 5 s of held-out drives."""
    rows = []
    for one in results:
        sizes = ", ".join(f"{name} {about['size']:.3g}" for name, about in one["truth"]["hidden"].items())
        before, after = one["held_out"]["original"], one["held_out"]["model"]
        found = "; ".join(name for name, ok in score.named_errors(one).items() if ok)
        rows.append({"car": one["truth"]["car"], "error": sizes or "none", "named": found or "-",
                     "stated": "; ".join(format_statement(line) for line in score.list_statements(one)) or "-",
                     "held-out error, m": f"{before:.2f} → {before if after is None else after:.2f}"})
    return rows


def score_rows(figures: Mapping[str, Any]) -> list[dict[str, str]]:
    number = "{:.2f}".format
    return [{"score": key, "value": number(value) if isinstance(value, float) else str(value)}
            for key, value in figures.items() if key != "false" and value is not None]


def page_tables(figures: Mapping[str, Any], cases: Sequence[Mapping[str, str]]) -> str:
    """Tables of the score and of the wrong statements."""
    rows = score_rows(figures)
    wrong = [{"case": one["case"], "hidden": one["hidden"], "wrong statement": statement}
             for one in cases for statement in one["stated"].split("; ") if statement.endswith(("OUTSIDE", "THE CAR"))]
    return "\n\n".join(map(format_records, filter(None, (rows, wrong))))
