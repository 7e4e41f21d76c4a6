"""Figures of a run, in the one house style."""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.lines import Line2D

from .results import Results, Track
from .style import MEASURED_COLOUR, MODEL_COLOUR, MODEL_LINE, RC

SEGMENTS = 6  # predictions drawn on the map
MEANING = {"hindsight": "measured inputs", "forecast": "inputs held"}


def paths_figure(results: Results, title: str, file: Path) -> None:
    """Map of measured and predicted paths beside the horizon-mean errors over the start time.

    The predictions on the map are the hindsight ones (measured inputs over the horizon, as in the paper). Hindsight and
    forecast have error plots of their own, for their scales differ by an order of magnitude where the driver acts.
    Longitudinal + = predicted ahead, lateral + = predicted to the left.
    """
    with plt.rc_context(RC):
        figure = plt.figure(figsize=(13, 5.4))
        grid = figure.add_gridspec(2, 3, width_ratios=(1.5, 1, 1))
        _draw_map(figure.add_subplot(grid[:, 0]), results)
        for column, (mode, meaning) in enumerate(MEANING.items(), start=1):
            upper = figure.add_subplot(grid[0, column])
            lower = figure.add_subplot(grid[1, column], sharex=upper)
            _draw_errors(upper, results, mode, "longitudinal_mean")
            _draw_errors(lower, results, mode, "lateral_mean")
            upper.set_title(f"{mode.capitalize()}: {meaning}", fontsize=9)
            upper.tick_params(labelbottom=False)
            lower.set_xlabel("start of the prediction, s")
            if column == 1:
                upper.set_ylabel("mean longitudinal error, m\n(+ = predicted ahead)")
                lower.set_ylabel("mean lateral error, m\n(+ = predicted left)")
        figure.align_ylabels()
        figure.suptitle(title, x=0.01, ha="left", fontweight="bold")
        figure.savefig(file)
        plt.close(figure)


def _draw_map(axes: plt.Axes, results: Results) -> None:
    track = results.track
    axes.plot(track.x, track.y, color=MEASURED_COLOUR, lw=3, alpha=0.45, solid_capstyle="round", zorder=1)
    for start_ns in _chosen_starts(results):
        for model in results.models():
            path = _predicted_path(results, track, model, start_ns)
            if path is not None:
                axes.plot(*path, color=MODEL_COLOUR[model], ls=MODEL_LINE[model], zorder=3)
        x, y = (np.interp(start_ns, track.time_ns, v) for v in (track.x, track.y))
        axes.plot(x, y, "o", ms=4, color="k", zorder=4)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("east, m")
    axes.set_ylabel("north, m")
    axes.set_title(f"Measured track and 5 s predictions from {len(_chosen_starts(results))} starts", fontsize=9)
    handles = [Line2D([], [], color=MEASURED_COLOUR, lw=3, alpha=0.45, label="measured")]
    handles += [Line2D([], [], color=MODEL_COLOUR[m], ls=MODEL_LINE[m], label=m) for m in results.models()]
    handles += [Line2D([], [], color="k", marker="o", ms=4, ls="", label="start")]
    axes.legend(handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=len(handles))


def _draw_errors(axes: plt.Axes, results: Results, mode: str, quantity: str) -> None:
    origin = results.track.time_ns[0] if len(results.track.time_ns) else 0
    axes.axhline(0, color="k", lw=0.6)
    for model in results.models():
        scores = [s for s in results.select(model, mode) if s.complete]
        time = np.array([(s.start_ns - origin) * 1e-9 for s in scores])
        value = np.array([getattr(s, quantity) for s in scores])
        breaks = np.nonzero(np.diff(time) > 1.0)[0] + 1  # no line across starts that were not scored
        axes.plot(
            np.insert(time, breaks, np.nan),
            np.insert(value, breaks, np.nan),
            color=MODEL_COLOUR[model],
            ls=MODEL_LINE[model],
        )


def _chosen_starts(results: Results) -> list[int]:
    """Evenly spread starts that every model completed in hindsight."""
    complete = [{s.start_ns for s in results.select(m, "hindsight") if s.complete} for m in results.models()]
    common = sorted(set.intersection(*complete)) if complete else []
    if len(common) <= SEGMENTS:
        return common
    return [common[i] for i in np.linspace(0, len(common) - 1, SEGMENTS).round().astype(int)]


def _predicted_path(results: Results, track: Track, model: str, start_ns: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Measured position plus the recorded error, turned back from the measured heading into the map."""
    for score in results.select(model, "hindsight"):
        if score.start_ns == start_ns:
            time = start_ns + np.asarray(score.horizon) * 1e9
            x, y, yaw = (np.interp(time, track.time_ns, v) for v in (track.x, track.y, track.yaw))
            lon, lat = np.asarray(score.longitudinal), np.asarray(score.lateral)
            return x + lon * np.cos(yaw) - lat * np.sin(yaw), y + lon * np.sin(yaw) + lat * np.cos(yaw)
    return None
