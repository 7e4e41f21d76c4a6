"""evaluation.json, and the folder of results around it. The schema: docs/manual/evaluation.md."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from st_core.vehicle import VehicleParameters
from st_recordings.results import versions

from ..bands.figures import band_figures
from ..bands.shares import finished_shares, share_figures
from ..bands.sums import finished, pooled_sums
from . import tables
from .drawing import Place
from .overview import overview
from .page import write_page
from .statistics import pooled, pooled_by
from .work import RunReport, Task

SCHEMA = 1


@dataclass(frozen=True)
class Choices:
    """What the paper leaves open and the report prints. over: means or samples, in the table."""

    task: Task
    over: str
    vehicle_file: str


def settings_in_words(choices: Choices) -> dict[str, str]:
    """Every setting with its value, as a reader wants it."""
    s, p = choices.task.settings, choices.task.settings.prediction
    filters = {"causal": "causal, as in the car", "zero_phase": "zero-phase (forward and backward)"}
    inputs = {"interpolate": "interpolated within a step", "hold": "held over each step"}[s.inputs]
    return {
        "vehicle": f"{choices.task.vehicle.name} ({choices.vehicle_file}, {choices.task.vehicle.hash[:12]})",
        "starts": f"every {s.interval:g} s, from {p.minimum_speed:g} m/s up",
        "horizon": f"{p.horizon:g} s in steps of {p.step * 1000:g} ms, Runge-Kutta 4",
        "forward acceleration": f"derivative of the INS speed after a {p.filter_cutoff:g} Hz low-pass filter, "
                                f"{filters[s.acceleration]}",
        "measured inputs": f"{inputs}; nothing across gaps above {p.maximum_gap:g} s",
        "table": f"mean | max | RMSE over {tables.WHAT[choices.over]}",
    }


def document(reports: Sequence[RunReport], choices: Choices) -> dict[str, Any]:
    """The content of evaluation.json."""
    good = [r for r in reports if not r.problem]
    vehicle: VehicleParameters = choices.task.vehicle
    return {
        "schema": SCHEMA,
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "vehicle": {"name": vehicle.name, "file": choices.vehicle_file, "hash": vehicle.hash},
        "settings": {**choices.task.settings.as_dict(), "table_over": choices.over},
        "versions": versions(),
        "runs": {r.name: r.models for r in good},
        "all_runs": pooled([r.models for r in good]),
        "seconds": {r.name: r.seconds_ahead for r in good},
        "bins": {r.name: r.bins for r in good},
        "bins_all_runs": pooled_bins(good),
        "manoeuvres": {r.name: r.manoeuvres for r in good},
        "manoeuvres_all_runs": pooled_manoeuvres(good),
        "about": {r.name: r.about for r in good},
        **_bands(good, choices.task),
        "failed": {r.name: r.problem for r in reports if r.problem},
        "refused": {r.name: r.about["findings"] for r in reports if r.problem and r.about},
    }


def _bands(good: Sequence[RunReport], task: Task) -> dict[str, Any]:
    if task.bands is None:
        return {}
    pooled = pooled_sums([r.bands for r in good])
    return {"bands": {r.name: finished(r.bands) for r in good},
            "bands_all_runs": {"file": task.bands[0], **finished(pooled), "shares": finished_shares(pooled)}}


def pooled_bins(reports: Sequence[RunReport]) -> list[dict[str, Any]]:
    """The bins of all runs together, in their own order."""
    entries = pooled_by([one for r in reports for one in r.bins], "quantity", "label")
    quantities = list(dict.fromkeys(e["quantity"] for e in entries))
    lowest = float("-inf")
    # Directions have no order of size: left, straight, right, as they are made.
    order = {"left": 0, "straight": 1, "right": 2}
    return sorted(entries, key=lambda e: (quantities.index(e["quantity"]), order.get(e["label"], -1),
                                          lowest if e["low"] is None else e["low"]))


def pooled_manoeuvres(reports: Sequence[RunReport]) -> list[dict[str, Any]]:
    """Parts of the same name of all runs together, the most frequent first; only those that hold a start."""
    entries = [one for r in reports for one in r.manoeuvres if _starts(one)]
    return sorted(pooled_by(entries, "name"), key=lambda e: -_starts(e))


def _starts(one: dict[str, Any]) -> int:
    return max((modes["hindsight"]["n_starts"] for modes in one["models"].values()), default=0)


def write_results(reports: Sequence[RunReport], choices: Choices, title: str) -> dict[str, Path]:
    """Everything but the runs' own folders; the files by what they are."""
    folder = choices.task.folder
    assert folder is not None  # of the verb
    good = [r for r in reports if not r.problem]
    content = document(reports, choices)
    files = {"json": folder / "evaluation.json", "page": folder / "report.html", "latex": folder / "table.tex"}
    files["json"].write_text(_readable(content))
    rows = {"table": tables.table_rows, "seconds": tables.second_rows, "bins": tables.bin_rows,
            "manoeuvres": tables.manoeuvre_rows}
    for name, make in rows.items():
        files[name] = folder / f"{name}.csv"
        tables.write_csv(files[name], make(good))
    words = settings_in_words(choices)
    about = f"{words['vehicle']}; starts {words['starts']}; horizon {words['horizon']}; {words['measured inputs']}."
    files["latex"].write_text(tables.latex_table(good, choices.over, about))
    drawn = overview(good, choices.over, Place(folder, choices.task.formats))
    tested, place = content.get("bands_all_runs"), Place(folder, choices.task.formats)
    of_bands = [*band_figures(tested, place), *share_figures((tested or {}).get("shares", {}), place)]
    write_page(files["page"], title, reports, content, words, drawn, of_bands, choices.over)
    return files


def _readable(content: dict[str, Any]) -> str:
    # A line for each key and for each entry of its lists: an indent would make the json module ten times slower.
    def line(value: Any) -> str:
        return json.dumps(value, allow_nan=False, ensure_ascii=False)

    lines = (f"{line(key)}: " + (f"[\n  {joined}\n ]" if isinstance(value, list) and (joined := ",\n  ".join(
        map(line, value))) else line(value)) for key, value in content.items())
    return "{\n " + ",\n ".join(lines) + "\n}\n"
