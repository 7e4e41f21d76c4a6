"""Options, the run of one case through the commands themselves, and the table."""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from datetime import date
from pathlib import Path

from st_recordings.paths import project_root, source_version

from .._markers import renew, table
from .cases import CASES, truths, write

RESULTS = Path(__file__).with_name("results.json")
PAGE = project_root() / "docs" / "measurements" / "strangers.md"
OTHERWISE = ("combined_slip", "lateral_load_transfer", "steered_drive_force")
"""Physics of these cars, in other equations than the library's: present, without a value to compare."""
SECONDS = 90.0  # of each of the four drives


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="st bench strangers", description=(
        "Three cars of other tyre models, driven, recorded as CSV with a fault or none, checked and discovered."))
    parser.add_argument("case", nargs="*", metavar="CASE", help=", ".join(CASES) + "; without one: all")
    parser.add_argument("--seconds", type=float, default=SECONDS, help="of each of the four drives; the page is made "
                        "anew only where it is not given")
    parser.add_argument("--keep", type=Path, help="folder for recordings and answers")
    chosen = parser.parse_args(arguments)
    known = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    for name in chosen.case or CASES:
        with tempfile.TemporaryDirectory(prefix="st-strangers-") as folder:
            home = (chosen.keep or Path(folder)) / name
            if home.exists():
                parser.error(f"--keep {home}: is there already, and nothing is overwritten")
            home.mkdir(parents=True)
            known[name] = answered(name, chosen.seconds, home)
        print(json.dumps({name: known[name]}, indent=1), flush=True)
        if chosen.seconds == SECONDS:
            RESULTS.write_text(json.dumps(known, indent=1) + "\n")
    if chosen.seconds == SECONDS:
        renew_page(known)
    return 0


def renew_page(known: dict) -> None:
    renew(PAGE, "strangers", "\n".join(table([_row(name, known[name]) for name in CASES if name in known])) + "\n")


def answered(name: str, seconds: float, folder: Path) -> dict:
    """What `st check` and `st discover` say of a case."""
    runs, car = write(name, seconds, folder)
    _st("check", runs, "--car", car, "--output", folder / "check")
    checks = json.loads((folder / "check" / "check.json").read_text())
    began = time.monotonic()
    _st("discover", runs, "--car", car, "--output", folder / "found", "--no-propose", "--no-report", "--jobs", "1",
        "--fresh")
    found = json.loads((folder / "found" / "discovery.json").read_text())
    gap = found["gap"]["position_5s"]
    return {
        "date": str(date.today()), "version": source_version(), "seconds": round(time.monotonic() - began),
        "drives": seconds, "outcome": found["outcome"],
        "checks": sorted({f"{one['name']} ({one['severity']})" for run in checks["runs"].values()
                          for one in run["findings"]}),
        "effects": {one["name"]: [_values(one), one["alternatives"]] for one in found["effects"]},
        "minor": {one["name"]: _values(one) for one in found["minor"]},
        "bound": [one["resembles"] for one in found["bound"]], "left": found["signature"],
        "before": gap["base"], "after": gap["augmented"], "floor": gap["floor"]}


def _values(effect: dict) -> dict[str, list[float]]:
    return {key: [one["value"], *one["interval"]] for key, one in effect["parameters"].items()}


def _st(*words: object) -> None:
    done = subprocess.run([sys.executable, "-m", "st_cli.cli", *map(str, words)], cwd=project_root(), check=False,
                          capture_output=True, text=True)
    if done.returncode > 1:
        raise RuntimeError(f"st {words[0]}: {done.stderr[-2000:]}")


def _row(name: str, said: dict) -> dict[str, str]:
    compliance = "steering_compliance" in {**said["effects"], **said["minor"]}
    there = truths(CASES[name], compliance)
    stated = [_judged(effect, values, there.get(effect)) for effect, (values, _) in said["effects"].items()]
    return {"case": name, "hidden": CASES[name].words, "checks": ", ".join(said["checks"]) or "-",
            "outcome": said["outcome"], "stated: value (95 %)": "<br>".join(stated) or "-",
            "minor": ", ".join(said["minor"]) or "-", "bound": ", ".join(said["bound"]) or "-",
            "5 s position before → after, m": f"{said['before']:.2f} → {said['after']:.2f}",
            "over the noise": f"{said['after'] / said['floor']:.1f}",
            "s": f"{said['seconds']}"}


def _judged(effect: str, values: dict[str, list[float]], truth: float | None) -> str:
    """The first parameter of an effect against what is in the car."""
    value, low, high = next(iter(values.values()))
    words = f"{effect} {value:.3g} ({low:.3g} to {high:.3g})"
    if effect in OTHERWISE:
        return f"{words}: in this car"
    if truth is None:
        return f"{words}: **not in this car**"
    return f"{words}: true {truth:.3g}, {'inside' if low <= truth <= high else '**outside**'}"
