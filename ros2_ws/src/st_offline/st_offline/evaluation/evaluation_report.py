"""Writes the results of an evaluation: evaluation.json (docs/manual/evaluation.md), tables and page."""

import math
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from st_core.checks import Severity
from st_core.palette import MODEL_COLOUR
from st_recordings.paths import json_text
from st_recordings.results import collect_versions

from ..bands import bands_report
from ..checking.check_report import describe_clocks, describe_effect, findings_as_json, group_findings
from ..pages import load_template
from . import tables
from .drawing import TEXT_COLOUR, WIDTH, FigureOutput, PageFigure, apply_style, save_figure
from .tables import REPORTED_AXES, format_error, get_axis_statistics, pool_entries, pool_models
from .work import RunReport, Task, to_file_name

SCHEMA = 3
MAX_RUNS = 40  # in the overview figure
FORECAST_LABELS = {"forecast": "", "plan": "with the inputs of the plan ", "course": "with the inputs of the course "}


def describe_settings(task: Task) -> dict[str, str]:
    """Text of each setting, by name."""
    settings, prediction = task.settings, task.settings.prediction
    filters = {"causal": "causal, as in the car", "zero_phase": "zero-phase (forward and backward)"}
    inputs = {"interpolate": "interpolated within a step", "hold": "held over each step"}[settings.inputs]
    return {
        "vehicle": f"{task.vehicle.name} ({task.vehicle_file}, {task.vehicle.hash[:12]})",
        "predictions": f"every {settings.interval:g} s, at {prediction.minimum_speed:g} m/s or more",
        "horizon": f"{prediction.horizon:g} s in steps of {prediction.step * 1000:g} ms, Runge-Kutta 4",
        "forward acceleration": f"derivative of the INS speed after a {prediction.filter_cutoff:g} Hz low-pass filter, "
                                f"{filters[settings.acceleration]}",
        "measured inputs": f"{inputs}; unknown in gaps longer than {prediction.maximum_gap:g} s",
        **({"course": task.course[0]} if task.course else {}),
        "table": f"mean | max | RMSE over {tables.OVER_LABELS[task.over]}",
    }


def make_document(reports: Sequence[RunReport], task: Task) -> dict[str, Any]:
    """The content of evaluation.json."""
    evaluated_runs = [r for r in reports if not r.problem]
    parts = [part for r in evaluated_runs for part in r.manoeuvres if _count_starts(part)]
    sums, bands = bands_report.pool_sums([r.bands for r in evaluated_runs]), {}
    if task.bands:
        bands = {"bands": {r.name: bands_report.summarise_bands(r.bands) for r in evaluated_runs},
                 "bands_all_runs": {"file": task.bands[0], **bands_report.summarise_bands(sums),
                                    "shares": bands_report.summarise_contributions(sums)}}
    if task.adaptive:
        bands |= {"adaptive_bands": {r.name: bands_report.summarise_adaptive(r.bands) for r in evaluated_runs},
                  "adaptive_bands_all_runs": bands_report.summarise_adaptive(sums)}
    return {
        "schema": SCHEMA,
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "vehicle": {"name": task.vehicle.name, "file": task.vehicle_file, "hash": task.vehicle.hash},
        "settings": {**task.settings.as_dict(), "table_over": task.over},
        "versions": collect_versions(),
        "runs": {r.name: r.models for r in evaluated_runs},
        "all_runs": pool_models([r.models for r in evaluated_runs]),
        "seconds": {r.name: r.seconds_ahead for r in evaluated_runs},
        "bins": {r.name: r.bins for r in evaluated_runs},
        "bins_all_runs": pool_bins(evaluated_runs),
        "manoeuvres": {r.name: r.manoeuvres for r in evaluated_runs},
        "manoeuvres_all_runs": sorted(pool_entries(parts, "name"), key=lambda entry: -_count_starts(entry)),
        "about": {r.name: {**r.metadata, "findings": findings_as_json(r.findings)} for r in evaluated_runs},
        **bands,
        "failed": {r.name: r.problem for r in reports if r.problem},
        "refused": {r.name: findings_as_json(r.findings) for r in reports if r.problem and r.findings},
    }


def pool_bins(reports: Sequence[RunReport]) -> list[dict[str, Any]]:
    """Entries of the bins pooled over all runs, sorted by quantity and value."""
    entries = pool_entries([entry for r in reports for entry in r.bins], "quantity", "label")
    quantities = list(dict.fromkeys(e["quantity"] for e in entries))
    direction_order = {"left": 0, "straight": 1, "right": 2}
    return sorted(entries, key=lambda e: (quantities.index(e["quantity"]), direction_order.get(e["label"], -1),
                                          -math.inf if e["low"] is None else e["low"]))


def _count_starts(entry: dict[str, Any]) -> int:
    return max((modes["hindsight"]["n_starts"] for modes in entry["models"].values()), default=0)


def write_results(reports: Sequence[RunReport], task: Task, title: str) -> dict[str, Path]:
    """Write all files except those in the folders of the runs; returns their paths by kind."""
    folder = task.folder
    assert folder is not None  # set by the command
    evaluated_runs = [r for r in reports if not r.problem]
    content = make_document(reports, task)
    files = {"json": folder / "evaluation.json", "page": folder / "report.html", "latex": folder / "table.tex"}
    files["json"].write_text(json_text(content), encoding="utf-8")
    for name, rows in tables.make_csv_rows(evaluated_runs).items():
        files[name] = folder / f"{name}.csv"
        tables.write_csv(files[name], rows)
    settings = describe_settings(task)
    note = (f"{settings['vehicle']}; predictions {settings['predictions']}; horizon {settings['horizon']}; "
             f"{settings['measured inputs']}.")
    files["latex"].write_text(tables.make_latex_table(evaluated_runs, task.over, note))
    output = FigureOutput(folder, task.formats)
    overview = draw_overview(evaluated_runs, task.over, output)
    top_figures = [overview] if len(evaluated_runs) > 1 else [f for r in evaluated_runs for f in r.figures[1:2]]
    # The page shows the figures of the first run; the figures of other runs are only written to files.
    run_figures = [f for f in evaluated_runs[0].figures if f not in top_figures]
    modes = list(dict.fromkeys(mode for by_mode in content["all_runs"].values() for mode in by_mode))
    pooled_bands = content.get("bands_all_runs", {})
    text = load_template("evaluation/page.html.jinja").render(
        title=title, summary=make_summary(evaluated_runs, task), reports=evaluated_runs, content=content,
        problems=content["failed"], settings=settings, findings={r.name: r.findings for r in reports},
        top_figures=top_figures, band_figures=bands_report.draw_bands(pooled_bands, output),
        band_rows=bands_report.make_band_rows(pooled_bands),
        adaptive_rows=bands_report.make_adaptive_rows(content.get("adaptive_bands_all_runs", {})),
        contribution_rows=bands_report.make_contribution_rows(pooled_bands.get("shares", {})),
        over=task.over, tables=tables, modes=modes, run_figures=run_figures, formats=task.formats,
        slug=to_file_name)
    files["page"].write_text(text, encoding="utf-8")
    return files


@apply_style()
def draw_overview(reports: Sequence[RunReport], over: str, output: FigureOutput) -> PageFigure:
    """Draw the hindsight RMSE of each model for the MAX_RUNS runs with the largest lateral RMSE."""
    models = list(reports[0].models)
    rmse = {axis: np.array([[get_axis_statistics(r.models, m, "hindsight", axis, over)["rmse"] for m in models]
                            for r in reports], float) for axis in REPORTED_AXES}  # NaN without a score
    order = np.argsort(-np.fmax.reduce(rmse["lateral"], axis=1), kind="stable")
    selection = np.sort(order[:MAX_RUNS])
    figure, panels = plt.subplots(1, 2, figsize=(WIDTH, 1.4 + 0.24 * len(selection)), sharey=True)
    figure.set_layout_engine("constrained", w_pad=0.12)  # inch, between the labels of both axes
    for axes, (axis, sizes) in zip(panels, rmse.items(), strict=True):
        for row, run in enumerate(selection):
            axes.plot(sizes[run], np.full(len(models), row), color=TEXT_COLOUR, lw=0.6, alpha=0.5, zorder=1)
        for k, model in enumerate(models):
            # The marker size decreases from model to model, so that equal values remain visible.
            axes.plot(sizes[selection, k], range(len(selection)), "o", ms=8 - 2 * k, mew=0, zorder=2,
                      color=MODEL_COLOUR.get(model, TEXT_COLOUR), label=model)
        axes.set_xlim(0.0, 1.05 * axes.get_xlim()[1])  # if values are similar, the default margin cuts their markers
        axes.set_xlabel(f"{axis} RMSE, m")
    panels[0].set_yticks(range(len(selection)), [reports[run].name for run in selection])
    panels[0].set_ylim(len(selection) - 0.5, -0.5)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower left", ncols=6)
    caption = "Hindsight: measured inputs over the horizon."
    if len(selection) < len(reports):
        caption += f" Only the {MAX_RUNS} of {len(reports)} runs with the largest lateral RMSE are shown."
    return save_figure(figure, output, "overview", "RMSE of each run and model", caption)


def make_headline(reports: Sequence[RunReport], over: str) -> str:
    """Lateral hindsight RMSE of each model over all runs, smallest first."""
    models = pool_models([r.models for r in reports])
    sizes = [(get_axis_statistics(models, m, "hindsight", "lateral", over)["rmse"], m) for m in models]
    ranked = sorted((size, m) for size, m in sizes if size is not None)
    name = reports[0].name if len(reports) == 1 else f"{len(reports)} runs"
    return f"{name}: lateral RMSE " + ", ".join(f"{model} {format_error(size)} m" for size, model in ranked)


def make_summary(reports: Sequence[RunReport], task: Task) -> list[str]:
    """At most three paragraphs: the errors, the findings of the checks, the steering clock."""
    models, over = pool_models([r.models for r in reports]), task.over
    best = min(models, key=lambda m: get_axis_statistics(models, m, "hindsight", "lateral", over)["rmse"] or math.inf)
    errors = ", ".join(f"{label}{format_error(get_axis_statistics(models, best, mode, 'lateral', over)['rmse'])} m"
                       for mode, label in FORECAST_LABELS.items() if mode in models[best])
    minutes = sum(r.metadata["duration"] for r in reports) / 60.0
    groups = group_findings({r.name: r.findings for r in reports})
    faults = "; ".join(f"{finding.name} in {', '.join(names)} ({describe_effect(finding) or finding.text})"
                       for finding, names in groups
                       if finding.severity is not Severity.NOTE and not finding.concerns_only_acceleration)
    steering = describe_clocks({report.name: report.metadata["alignment"] for report in reports})
    return [f"{minutes:.1f} minutes of driving, predictions over {task.settings.prediction.horizon:g} s. With "
            "measured inputs (hindsight), the error is due to model, parameters and sensors; with inputs held as at "
            f"the start (forecast), also to the driver's later inputs: the lateral RMSE of {best} is then {errors}.",
            f"Faults in the recordings bias these errors: {faults}." if faults else
            "The checks found nothing that biases these errors.",
            *([f"{steering}."] if steering else [])]
