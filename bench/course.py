"""Live predictions with a recorded course: the virtual Leaf drives S6 twice; the first drive is the course."""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from st_core.models import MODELS
from st_recordings.paths import project_root
from st_recordings.results import read_scores

from ._pages import format_records, replace_part

FIRST_DURATION, SECOND_DURATION = 60.0, 420.0  # s of the two drives
PAGE = project_root() / "docs" / "measurements" / "live_results.md"


def run() -> dict:
    """Errors and coverage by model, which are also written to the page of the live results."""
    with tempfile.TemporaryDirectory(prefix="st-bench-course-") as name:
        folder = Path(name)
        course = folder / "course.yaml"
        _st("demo", "--duration", FIRST_DURATION, "--output", folder / "first")
        _st("course", "build", folder / "first" / "bag", "-o", course)
        _st("demo", "--duration", SECOND_DURATION, "--seed", 5, "--course", course, "--output", folder / "second")
        rows = measure_course(folder / "second")
    cells = [{"model": model} | {key: f"{value:.2f}" if isinstance(value, float) else str(value)
                                 for key, value in row.items()} for model, row in rows.items()]
    replace_part(PAGE, "course", format_records(cells))
    return {"rows": rows}


def measure_course(run: Path) -> dict[str, dict]:
    """Mean position error at the end of the horizon [m] over the starts with a course, and coverage of whole paths."""
    scores = read_scores([run / "errors"])
    summary = json.loads((run / "summary.json").read_text())["models"]
    rows = {}
    for model in MODELS:
        ends = {}
        for mode in ("forecast", "course", "hindsight"):
            evaluated = scores[model, mode]
            ends[mode] = dict(zip(evaluated.starts_ns[evaluated.complete].tolist(),
                                  np.hypot(*evaluated.errors[evaluated.complete, -1, :2].T).tolist(), strict=True))
        common = sorted(set.intersection(*map(set, ends.values())))
        constant, course, hindsight = (float(np.mean([by_start[start] for start in common]))
                                       for by_start in ends.values())
        rows[model] = {
            "starts": len(common), "constant inputs, m": constant, "course, m": course, "ratio": course / constant,
            "hindsight, m": hindsight,
            **{f"{mode}, inside 90 | 50 %": " | ".join(f"{100.0 * summary[model][mode]['bands'][level]:.0f}"
                                                         for level in ("0.9", "0.5"))
               for mode in ("forecast", "hindsight", "course")},
        }
    return rows


def _st(*arguments: object) -> None:
    subprocess.run([sys.executable, "-m", "st_cli", *map(str, arguments)], check=True, stdout=subprocess.DEVNULL)
