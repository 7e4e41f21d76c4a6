"""Reports the results of a run: summary.json, paths.png, the table in the terminal, and the exit status."""

import json
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from rich.console import Console
from rich.markup import escape
from st_core.palette import FIGURE_STYLE, MEASURED_COLOUR, MODEL_COLOUR, MODEL_LINE
from st_recordings.paths import replace_file
from st_recordings.results import Results, format_band_lines, read_results, summarise
from st_recordings.runs.errors import RunError

from . import session
from .nodes.monitor import TABLE_MODES, make_error_table, render_counts, render_errors

MAX_LINE_GAP = 1.0  # s between scored starts; no line is drawn across a longer gap
INPUTS_OF_MODE = {"hindsight": "measured inputs", "forecast": "inputs held"}


def report_results(folder: Path, outcome: session.Outcome, extra: dict[str, Any], console: Console) -> int:
    """Write and print the results of a run; returns the exit status: 0 if no process failed or was restarted, and a
    prediction was scored or the user stopped the run; 130 if the run was stopped before all nodes were up; else 1.
    extra: further entries of summary.json, including `title`."""
    if outcome.interrupted and not outcome.statuses:
        logs = session.set_aside(folder) / "logs"
        console.print(f"the run was stopped before all nodes were up; logs: {escape(str(logs))}", highlight=False,
                      soft_wrap=True)
        return 130
    _print_problems(folder, outcome, console)
    with console.status("reading the recordings, drawing"):
        try:
            results = read_results(folder)
        except RunError as error:
            console.out(error, style="red", highlight=False)
            console.print("errors published by the evaluator since its last start:")
            console.print(render_errors(outcome.state), render_counts(outcome.state.predictor_status), sep="\n")
            return 1
        summary = summarise(results, {**extra, "exit_statuses": outcome.statuses})
        title = f"{extra['title']}: mean error over each horizon, at the INS point"
        console.print(make_error_table(summary["models"], title))  # before anything is written: the disk may be full
        replace_file(folder / "summary.json", json.dumps(summary, indent=2, allow_nan=False) + "\n")
        draw_paths(results, f"{extra['title']}: {make_headline(summary)}", folder / "paths.png")
    for line in format_band_lines(results.bands):
        console.out(line, highlight=False)
    ticks = summary["ticks"]
    since = " since the last start of the predictor, as recorded in bag/" if "predictor" in outcome.restarts else ""
    console.print(f"predictions due {ticks['due']}, made {ticks['predicted']}, skipped {ticks['skipped']}{since}")
    if text := describe_incomplete(summary["models"]):
        console.print(f"predictions without a complete score, not in the table: {text}", highlight=False)
    scored = max((modes["forecast"]["n_starts"] + modes["forecast"]["n_incomplete"]
                  for modes in summary["models"].values()), default=0)
    if (unscored := ticks["predicted"] - scored) > 0 and not outcome.restarts:  # a restart resets the counts
        console.print(f"predictions that the evaluator did not receive, usually before it was ready: {unscored}")
    for name, content in (("bag", "measurements and predictions"), ("errors", "every score"),
                          ("summary.json", "this table"), ("paths.png", "the figure")):
        console.print(f"  {escape(str(folder / name))}  [dim]{content}[/dim]", highlight=False, soft_wrap=True)
    has_scores = any(modes["hindsight"]["n_starts"] for modes in summary["models"].values())
    if not has_scores:
        console.print("[yellow]no prediction was scored; possible causes: run too short, car at rest, input missing")
        console.print(escape(outcome.health.rstrip()), highlight=False, soft_wrap=not console.is_terminal)
    return 0 if outcome.ok and (has_scores or outcome.interrupted) else 1


def _print_problems(folder: Path, outcome: session.Outcome, console: Console) -> None:
    if outcome.problem:
        console.out(outcome.problem, style="red", highlight=False)
    if restarts := [f"{name} ({count})" for name, count in outcome.restarts.items()]:
        advice = ("; a recorder continues in bag_2, an evaluator in errors_2, which the table omits; repair truncated "
                  f"bags with `st recover {folder}`" if outcome.restarts.keys() & {"recorder", "evaluator"} else "")
        console.out(f"number of restarts: {', '.join(restarts)}{advice}", style="yellow", highlight=False)
    if failed := [f"{name} (status {status})" for name, status in outcome.statuses.items() if status]:
        console.out(f"ended with an error: {', '.join(failed)}; see {folder / 'logs'}", style="red", highlight=False)


def draw_paths(results: Results, title: str, file: Path) -> None:
    """Draw a map of measured and predicted paths (hindsight) of the INS point, and horizon means of the errors versus
    start time; hindsight and forecast are separate, because their errors differ by an order of magnitude."""
    with plt.rc_context(FIGURE_STYLE):
        figure = plt.figure(figsize=(13, 5.4))
        grid = figure.add_gridspec(2, 3, width_ratios=(1.5, 1, 1))
        _draw_map(figure.add_subplot(grid[:, 0]), results)
        for column, (mode, inputs) in enumerate(INPUTS_OF_MODE.items(), start=1):
            upper = figure.add_subplot(grid[0, column])
            lower = figure.add_subplot(grid[1, column], sharex=upper)
            _draw_errors(upper, results, mode, "longitudinal")
            _draw_errors(lower, results, mode, "lateral")
            upper.set_title(f"{mode.capitalize()}: {inputs}", fontsize=9)
            upper.tick_params(labelbottom=False)
            lower.set_xlabel("start of the prediction, s")
            if column == 1:
                upper.set_ylabel("mean longitudinal error, m\n(+ = predicted ahead)")
                lower.set_ylabel("mean lateral error, m\n(+ = predicted left)")
        figure.align_ylabels()
        figure.suptitle(title, x=0.01, ha="left", fontweight="bold")
        temporary = file.with_name(f"new_{file.name}")
        try:
            figure.savefig(temporary, bbox_inches="tight")
            temporary.replace(file)
        finally:
            temporary.unlink(missing_ok=True)  # incomplete on a full disk
            plt.close(figure)


def _draw_map(axes: Axes, results: Results) -> None:
    track = results.track
    axes.plot(track.x, track.y, color=MEASURED_COLOUR, lw=3, alpha=0.45, solid_capstyle="round", zorder=1)
    for (model, _), segment in results.segments.items():
        x, y, yaw = (np.interp(segment.time_ns, track.time_ns, v) for v in (track.x, track.y, track.yaw))
        # The measured position plus the recorded error, rotated from the measured heading into the map.
        along, across = segment.longitudinal, segment.lateral
        axes.plot(x + along * np.cos(yaw) - across * np.sin(yaw), y + along * np.sin(yaw) + across * np.cos(yaw),
                  color=MODEL_COLOUR[model], ls=MODEL_LINE[model], zorder=3)
    starts = sorted({start_ns for _, start_ns in results.segments})
    for start_ns in starts:
        x, y = (np.interp(start_ns, track.time_ns, v) for v in (track.x, track.y))
        axes.plot(x, y, "o", ms=4, color="k", zorder=4)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel="east, m", ylabel="north, m")
    axes.set_title(f"Hindsight: measured track and predictions from {len(starts)} starts", fontsize=9)
    handles = [Line2D([], [], color=MEASURED_COLOUR, lw=3, alpha=0.45, label="measured")]
    handles += [Line2D([], [], color=MODEL_COLOUR[m], ls=MODEL_LINE[m], label=m) for m in results.models()]
    handles += [Line2D([], [], color="k", marker="o", ms=4, ls="", label="start")]
    axes.legend(handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=len(handles))


def _draw_errors(axes: Axes, results: Results, mode: str, quantity: str) -> None:
    origin_ns = results.track.time_ns[0] if len(results.track.time_ns) else 0
    axes.axhline(0, color="k", lw=0.6)
    for model in results.models():
        scores = results.scores.get((model, mode))
        if scores is None:
            continue
        time = (scores.start_ns[scores.complete] - origin_ns) * 1e-9
        error = getattr(scores, quantity)[scores.complete]
        breaks = np.nonzero(np.diff(time) > MAX_LINE_GAP)[0] + 1
        axes.plot(np.insert(time, breaks, np.nan), np.insert(error, breaks, np.nan), color=MODEL_COLOUR[model],
                  ls=MODEL_LINE[model])


def describe_incomplete(models: dict[str, Any]) -> str:
    """Predictions per model without a complete score, by mode; a range if models differ. models: see summary.json."""
    counts = {mode: sorted({modes[mode]["n_incomplete"] for modes in models.values() if mode in modes})
              for mode in TABLE_MODES}
    return ", ".join(f"{mode} {' to '.join(map(str, dict.fromkeys((numbers[0], numbers[-1]))))}"
                     for mode, numbers in counts.items() if any(numbers))


def make_headline(summary: dict[str, Any]) -> str:
    """Text of the figure's title: lateral hindsight RMSE of each model, the best first."""
    lateral = {model: modes["hindsight"]["lateral"]["rmse"] for model, modes in summary["models"].items()}
    ranking = sorted((rmse, model) for model, rmse in lateral.items() if rmse is not None)
    if not ranking:
        return "no complete score"
    return "hindsight, lateral RMSE " + ", ".join(f"{model} {rmse:.2f} m" for rmse, model in ranking)
