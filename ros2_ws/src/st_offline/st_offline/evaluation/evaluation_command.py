"""The command `st evaluate`: evaluates runs, prints the results, and writes evaluation.json, tables and a page."""

import contextlib
import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from rich.markup import escape
from st_core.checks import Severity
from st_core.errors import ConfigurationError
from st_core.palette import MODEL_COLOUR
from st_recordings.paths import json_text, new_folder
from st_recordings.results import collect_versions
from st_recordings.runs import RunError, RunSource, find_runs
from st_recordings.runs.errors import join_problems

from ..bands import bands_report
from ..bands.bands_report import print_tables
from ..checking import check_report
from ..pages import load_template
from ..terminal import console, format_count, list_files, make_progress_bars, print_line, report_problem
from . import tables
from .drawing import TEXT_COLOUR, WIDTH, FigureOutput, PageFigure, check_formats, save_figure
from .tables import REPORTED_AXES, format_error, get_axis_statistics, make_terminal_table, pool_entries, pool_models
from .work import RunReport, Task, evaluate_run, to_file_name

FILE_DESCRIPTIONS = {
    "page": "the complete report, in one file", "json": "all numbers; keys in docs/manual/evaluation.md",
    "table": "the first table above", "latex": "the first table above, in the layout of the paper",
    "seconds": "errors by second of the horizon", "bins": "errors by driving condition",
    "manoeuvres": "errors by part of the drive"}
MEMORY_PER_WORKER = "1500MB"  # a worker that needs more is restarted, and its run fails
SCHEMA = 3
MAX_RUNS = 40  # in the overview figure
FORECAST_LABELS = {"forecast": "", "plan": "with the inputs of the plan ", "course": "with the inputs of the course "}


def run_command(paths: Sequence[Path], task: Task, output: Path | None, workers: int, scheduler: str | None,
                tolerance: float | None = None) -> int:
    """Run the command; returns the exit status: 0 if every run was evaluated, else 1. tolerance: lateral error [m] for
    the advice on models; None for no advice. Raises ConfigurationError, OutputError."""
    check_formats(task.formats)
    start_time = time.perf_counter()
    sources = find_runs(paths)
    _raise_if_all_failed([source.problem for source in sources])
    task = replace(task, folder=new_folder(output, "evaluate"))
    reports = evaluate_all(sources, task, workers, scheduler)
    _raise_if_all_failed([report.problem for report in reports])
    evaluated_runs = [report for report in reports if not report.problem]
    title = make_headline(evaluated_runs, task.over)
    with console.status("writing the report"):
        files = write_results(reports, task, title)
    console.print(make_terminal_table(evaluated_runs, task.over, title, console.width))
    print_line(make_summary(evaluated_runs, task)[0])
    for key, value in describe_settings(task).items():
        print_line(f"[dim]{key}: {escape(value)}[/dim]")
    print_tables([report.bands for report in evaluated_runs], task.bands is not None, task.adaptive)
    if tolerance is not None:
        from .advice import print_advice  # the import takes half a second

        print_advice([s for s, r in zip(sources, reports, strict=True) if not r.problem], task, tolerance)
    for report in evaluated_runs:
        if text := check_report.describe_clock(report.metadata["alignment"]):
            print_line(f"{escape(report.name)}: {escape(text)}")
    check_report.print_findings({report.name: report.findings for report in reports})
    list_files({files[key]: description for key, description in FILE_DESCRIPTIONS.items()})
    failed_reports = [report for report in reports if report.problem]
    for report in failed_reports:
        report_problem(report.name, report.problem)
    times = ", ".join(f"{part} {sum(r.seconds.get(part, 0.0) for r in evaluated_runs):.1f} s"
                      for part in ("read", "predict", "draw"))
    hours = sum(r.metadata["duration"] for r in evaluated_runs) / 3600.0
    console.print(f"[dim]{format_count(len(evaluated_runs), 'run')}, {hours:.2f} h of driving in "
                  f"{time.perf_counter() - start_time:.1f} s ({times})[/dim]", highlight=False)
    return 1 if failed_reports else 0


def _raise_if_all_failed(problems: Sequence[RunError | str | None]) -> None:
    if all(problems):
        raise ConfigurationError("no run can be used: " + join_problems(map(str, problems)))


def evaluate_all(sources: Sequence[RunSource], task: Task, workers: int, scheduler: str | None) -> list[RunReport]:
    """Evaluate all runs with a progress display; returns the reports in the order of the sources."""
    with make_progress_bars() as progress:
        run_bar, start_bar = progress.add_task("runs"), progress.add_task("", visible=False)

        def evaluate(source: RunSource) -> RunReport:
            progress.update(start_bar, description=escape(f"{source.name}: reading"), total=None, completed=0,
                            visible=True)
            return evaluate_run(source, task, lambda done, total: progress.update(
                start_bar, description=escape(source.name), total=total, completed=done))

        reports = (_evaluate_in_workers(sources, task, workers, scheduler) if workers > 1 or scheduler else
                   map(evaluate, sources))
        by_name = {report.name: report for report in progress.track(reports, len(sources), task_id=run_bar)}
    return [by_name[source.name] for source in sources]


def _evaluate_in_workers(sources: Sequence[RunSource], task: Task, workers: int,
                         scheduler: str | None) -> Iterator[RunReport]:
    """Yield the report of each run in the order of completion. scheduler: address of a Dask scheduler; its workers
    read the files under the same paths. Raises ConfigurationError if the workers are not available."""
    try:
        from distributed import Client, LocalCluster, as_completed
    except ImportError:
        raise ConfigurationError("Dask is not installed: leave out --workers and --scheduler") from None
    with contextlib.ExitStack() as stack:
        try:
            cluster = scheduler or stack.enter_context(LocalCluster(
                n_workers=workers, threads_per_worker=1, memory_limit=MEMORY_PER_WORKER, dashboard_address=None,
                host="127.0.0.1", silence_logs=50))
            client = stack.enter_context(Client(cluster, timeout="10s"))
        except (OSError, TimeoutError) as error:
            problem = f"no Dask scheduler at {scheduler}" if scheduler else "Dask workers cannot be started"
            raise ConfigurationError(f"{problem}: {error}") from None
        futures = {client.submit(evaluate_run, source, task, pure=False, retries=0): source for source in sources}
        for future in as_completed(futures):
            failure = future.exception()
            source = futures[future]
            yield future.result() if failure is None else RunReport(
                source.name, problem=f"{source.path}: the worker failed: {' '.join(str(failure).split())[:200]}")
            future.release()


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
        "about": {r.name: {**r.metadata, "findings": check_report.findings_as_json(r.findings)}
                  for r in evaluated_runs},
        **bands,
        "failed": {r.name: r.problem for r in reports if r.problem},
        "refused": {r.name: check_report.findings_as_json(r.findings) for r in reports if r.problem and r.findings},
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
            f"inputs {settings['measured inputs']}.")
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


def draw_overview(reports: Sequence[RunReport], over: str, output: FigureOutput) -> PageFigure:
    """Draw the hindsight RMSE of each model for the MAX_RUNS runs with the largest lateral RMSE."""
    models = list(reports[0].models)
    rmse = {axis: np.array([[get_axis_statistics(r.models, m, "hindsight", axis, over)["rmse"] for m in models]
                            for r in reports], float) for axis in REPORTED_AXES}  # NaN without a score
    order = np.argsort(-np.fmax.reduce(rmse["lateral"], axis=1), kind="stable")
    selection = np.sort(order[:MAX_RUNS])
    figure, panels = plt.subplots(1, 2, figsize=(WIDTH, 1.4 + 0.24 * len(selection)), sharey=True)
    figure.set_layout_engine("constrained", w_pad=0.12)  # inch, between the labels of both axes
    for axes, (axis, values) in zip(panels, rmse.items(), strict=True):
        for row, run in enumerate(selection):
            axes.plot(values[run], np.full(len(models), row), color=TEXT_COLOUR, lw=0.6, alpha=0.5, zorder=1)
        for k, model in enumerate(models):
            # The marker size decreases from model to model, so that equal values remain visible.
            axes.plot(values[selection, k], range(len(selection)), "o", ms=8 - 2 * k, mew=0, zorder=2,
                      color=MODEL_COLOUR.get(model, TEXT_COLOUR), label=model)
        axes.set_xlim(0.0, 1.05 * axes.get_xlim()[1])  # if values are similar, the default margin cuts their markers
        axes.set_xlabel(f"{axis} RMSE, m")
    panels[0].set_yticks(range(len(selection)), [reports[run].name for run in selection])
    panels[0].set_ylim(len(selection) - 0.5, -0.5)
    caption = "Hindsight: measured inputs over the horizon."
    if len(selection) < len(reports):
        caption += f" Only the {MAX_RUNS} of {len(reports)} runs with the largest lateral RMSE are shown."
    return save_figure(figure, output, "overview", "RMSE of each run and model", caption)


def make_headline(reports: Sequence[RunReport], over: str) -> str:
    """Lateral hindsight RMSE of each model over all runs, smallest first."""
    models = pool_models([r.models for r in reports])
    rmse = [(get_axis_statistics(models, m, "hindsight", "lateral", over)["rmse"], m) for m in models]
    ranked = sorted((value, m) for value, m in rmse if value is not None)
    name = reports[0].name if len(reports) == 1 else f"{len(reports)} runs"
    return f"{name}: lateral RMSE " + ", ".join(f"{model} {format_error(value)} m" for value, model in ranked)


def make_summary(reports: Sequence[RunReport], task: Task) -> list[str]:
    """At most three paragraphs: the errors, the findings of the checks, the steering clock."""
    models, over = pool_models([r.models for r in reports]), task.over
    best = min(models, key=lambda m: get_axis_statistics(models, m, "hindsight", "lateral", over)["rmse"] or math.inf)
    errors = ", ".join(f"{label}{format_error(get_axis_statistics(models, best, mode, 'lateral', over)['rmse'])} m"
                       for mode, label in FORECAST_LABELS.items() if mode in models[best])
    minutes = sum(r.metadata["duration"] for r in reports) / 60.0
    groups = check_report.group_findings({r.name: r.findings for r in reports})
    faults = "; ".join(f"{finding.name} in {', '.join(names)} ({check_report.describe_effect(finding) or finding.text})"
                       for finding, names in groups
                       if finding.severity is not Severity.NOTE and not finding.concerns_only_acceleration)
    steering = check_report.describe_clocks({report.name: report.metadata["alignment"] for report in reports})
    return [f"{minutes:.1f} minutes of driving, predictions over {task.settings.prediction.horizon:g} s. With "
            "measured inputs (hindsight), the error is due to model, parameters and sensors; with inputs held as at "
            f"the start (forecast), also to the driver's later inputs: the lateral RMSE of {best} is then {errors}.",
            f"Faults in the recordings bias these errors: {faults}." if faults else
            "The checks found nothing that biases these errors.",
            *([f"{steering}."] if steering else [])]
