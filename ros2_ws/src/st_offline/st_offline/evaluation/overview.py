"""All runs in one figure: which model is how far off where."""

from collections.abc import Sequence

import matplotlib.pyplot as plt
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from st_core.palette import MODEL_COLOUR

from .drawing import TEXT, WIDTH, Drawn, Place, finish, style
from .tables import SHOWN_AXES, shown, values
from .work import RunReport

MOST_RUNS = 40


def overview(reports: Sequence[RunReport], over: str, place: Place) -> Drawn | None:
    """RMSE in hindsight of every model and run; the runs with the largest lateral error if there are very many."""
    if not reports:
        return None
    models = list(dict.fromkeys(m for r in reports for m in r.models))

    def rmse(report: RunReport, model: str, axis: str) -> float:
        return (values(report.models, model, "hindsight", axis, over)["rmse"] or 0.0) if model in report.models else 0.0

    chosen = list(reports)
    if len(chosen) > MOST_RUNS:
        worst = sorted(chosen, key=lambda r: -max(rmse(r, m, "lateral") for m in models))[:MOST_RUNS]
        chosen = [r for r in chosen if r in worst]
    with style():
        figure, panels = plt.subplots(1, 2, figsize=(WIDTH, 1.4 + 0.24 * len(chosen)), sharey=True)
        layout = figure.get_layout_engine()
        assert isinstance(layout, ConstrainedLayoutEngine)  # by the style
        layout.set(w_pad=0.12)  # inch; the last label of one axis and the first of the next
        for axes, axis in zip(panels, SHOWN_AXES, strict=True):
            for row, report in enumerate(chosen):
                sizes = [rmse(report, model, axis) for model in models if model in report.models]
                axes.plot([min(sizes), max(sizes)], [row, row], color=TEXT, lw=0.6, alpha=0.5, zorder=1)
                for k, model in enumerate(m for m in models if m in report.models):
                    # The first of several that coincide must not be hidden: markers shrink.
                    axes.plot(sizes[k], row, "o", ms=8 - 2 * k, color=MODEL_COLOUR.get(model, TEXT), mew=0, zorder=2)
            axes.set_xlim(left=0)
            axes.set_xlabel(f"{axis} RMSE, m")
        panels[0].set_yticks(range(len(chosen)), [r.name for r in chosen])
        panels[0].set_ylim(len(chosen) - 0.5, -0.5)
        handles = [Line2D([], [], color=MODEL_COLOUR.get(m, TEXT), marker="o", ls="", label=m) for m in models]
        figure.legend(handles=handles, loc="outside lower left", ncols=6)
        caption = "Hindsight: measured inputs over the horizon."
        if len(chosen) < len(reports):
            caption += f" The {MOST_RUNS} of {len(reports)} runs with the largest lateral error."
        return finish(figure, place, "overview", finding(reports, over), caption)


def finding(reports: Sequence[RunReport], over: str) -> str:
    """Lateral RMSE of one run, best model first; of several, in how many each model has the smallest, to the cm."""
    sizes = [{m: shown(values(r.models, m, "hindsight", "lateral", over)["rmse"]) for m in r.models} for r in reports]
    if len(reports) == 1:
        ranked = sorted(sizes[0].items(), key=lambda item: _number(item[1]))
        return f"{reports[0].name}: lateral RMSE " + ", ".join(f"{model} {size} m" for model, size in ranked)
    wins = dict.fromkeys((m for r in reports for m in r.models), 0)
    for size in sizes:
        for model in (m for m in size if size[m] == min(size.values(), key=_number)):
            wins[model] += 1
    counts = ", ".join(f"{model} in {count}" for model, count in wins.items())
    ties = ", ties counted for each" if sum(wins.values()) > len(reports) else ""
    return f"Smallest lateral RMSE of {len(reports)} runs: {counts}{ties}"


def _number(text: str) -> float:
    return float("inf") if text == "-" else float(text)
