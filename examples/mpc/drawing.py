"""Draws the figures of nmpc.py in the style of the suite."""

from collections.abc import Mapping
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.lines import Line2D
from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter
from st_core.palette import FIGURE_STYLE, MEASURED_COLOUR, MODEL_COLOUR, MODEL_LINE

SOLVER_MARKER = {"rti": "o", "ipopt": "s"}
SOLVER_NAME = {"rti": "real-time iteration (SQP, qrqp)", "ipopt": "IPOPT to convergence"}


def draw_trade_off(rows: list[dict], titles: Mapping[str, str], file: Path) -> None:
    """Draw tracking error versus processor time: a line for each model and solver, a point for each horizon."""
    with plt.rc_context(FIGURE_STYLE):
        figure, axes = plt.subplots(1, len(titles), figsize=(max(3.6 * len(titles) + 0.6, 6.5), 3.9), squeeze=False,
                                    sharex=True, sharey=True)
        for axis, (road, title) in zip(axes[0], titles.items(), strict=True):
            axis.loglog()
            on_road = [row for row in rows if row["road"] == road]
            for solver, model in dict.fromkeys((row["solver"], row["model"]) for row in on_road):
                _draw_line(axis, [r for r in on_road if (r["solver"], r["model"]) == (solver, model)], solver, model)
            axis.set(title=title, xlabel="processor time per solution, median [ms]")
        for scale in (axes[0][0].xaxis, axes[0][0].yaxis):
            scale.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            scale.set_major_formatter(FormatStrFormatter("%g"))
            scale.set_minor_formatter(NullFormatter())
        axes[0][0].set_ylabel("lateral deviation, rms [m]")
        _add_legend(figure, rows, min(len(titles), 3) + 2)
        figure.savefig(file)
        plt.close(figure)


def _draw_line(axis, rows: list[dict], solver: str, model: str) -> None:
    colour = MODEL_COLOUR.get(model, MEASURED_COLOUR)
    finished = [row for row in rows if row["finished"]]
    axis.plot([r["cpu_median"] for r in finished], [r["error_rms"] for r in finished], color=colour, linewidth=1.0,
              linestyle=MODEL_LINE.get(model, "solid"), zorder=2)
    for row in rows:
        size = 16.0 + 22.0 * row["horizon"]
        face = colour if row["finished"] else "white"
        shape = SOLVER_MARKER[solver] if row["finished"] else "X"
        axis.scatter(row["cpu_median"], row["error_rms"], s=size, marker=shape, facecolor=face, edgecolor=colour,
                     linewidth=1.0, alpha=0.9, zorder=3)


def _add_legend(figure, rows: list[dict], columns: int) -> None:
    entries = [Line2D([], [], color=MODEL_COLOUR.get(model, MEASURED_COLOUR), linestyle=MODEL_LINE.get(model, "solid"),
                      label=model) for model in dict.fromkeys(row["model"] for row in rows)]
    entries += [Line2D([], [], color=MEASURED_COLOUR, marker=SOLVER_MARKER[solver], linestyle="none",
                       label=SOLVER_NAME[solver]) for solver in dict.fromkeys(row["solver"] for row in rows)]
    entries += [Line2D([], [], color=MEASURED_COLOUR, marker="o", linestyle="none", markersize=(16 + 22 * h) ** 0.5,
                       label=f"horizon {h:g} s") for h in sorted({row["horizon"] for row in rows})]
    if any(not row["finished"] for row in rows):
        entries.append(Line2D([], [], color=MEASURED_COLOUR, marker="X", markerfacecolor="white", linestyle="none",
                              label="left the path"))
    figure.legend(handles=entries, loc="outside lower center", ncols=columns)


def draw_paths(tables: Mapping[tuple, np.ndarray], titles: Mapping[str, str], file: Path) -> None:
    """Draw the lateral deviation over time for the shortest and longest horizon; keys of tables: see nmpc.py."""
    horizons = sorted({key[3] for key in tables})
    extremes = list(dict.fromkeys((horizons[0], horizons[-1])))
    solver = next(key[1] for key in tables)  # the first one
    with plt.rc_context(FIGURE_STYLE):
        figure, axes = plt.subplots(len(titles), len(extremes), figsize=(8.4, 2.1 * len(titles) + 0.6), squeeze=False,
                                    sharex="row", sharey="row")
        for row, (road, title) in zip(axes, titles.items(), strict=True):
            for axis, horizon in zip(row, extremes, strict=True):
                for model, table in ((key[2], table) for key, table in tables.items()
                                     if (key[0], key[1], key[3]) == (road, solver, horizon)):
                    axis.plot(table[:, 0], table[:, 3], color=MODEL_COLOUR.get(model, MEASURED_COLOUR),
                              linestyle=MODEL_LINE.get(model, "solid"), label=model)
                axis.set_title(f"{title}; horizon {horizon:g} s")
            row[0].set_ylabel("lateral deviation, left > 0 [m]")
        for axis in axes[-1]:
            axis.set_xlabel("time [s]")
        axes[0][0].legend()
        figure.savefig(file)
        plt.close(figure)
