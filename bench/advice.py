"""Cost and accuracy of models and steps (`st evaluate --advise`) on real drives, for docs/measurements/mpc.md."""

from collections.abc import Mapping

import matplotlib.pyplot as plt
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullFormatter
from st_core.log_evaluation import EvaluationSettings
from st_core.models import MODELS
from st_core.palette import MODEL_COLOUR
from st_offline.evaluation import advice as advice_report
from st_offline.evaluation.advice import measure_runs
from st_offline.evaluation.drawing import TEXT_COLOUR, WIDTH, FigureOutput, save_figure
from st_offline.evaluation.work import Task
from st_recordings.paths import project_root
from st_recordings.runs import find_runs

from ._drives import OTHER_DRIVES, SOUND_DRIVES, genesis
from ._pages import format_records, replace_part

TOLERANCE = 0.3  # m, lateral
UNSUITABLE_DRIVES = ("wrong_projection", "rear_ref")
"""Prefixes of drives with a wrong map projection, and of those with the INS at the rear axle."""
PAGE = project_root() / "docs" / "measurements" / "mpc.md"
MARKERS = ("o", "s", "^", "D", "v")


def draw_advice(costs: Mapping[advice_report.ModelStep, advice_report.Cost],
                accuracies: Mapping[advice_report.ModelStep, advice_report.Accuracy], tolerance: float,
                output: FigureOutput) -> None:
    """Plots lateral error and half-width of the band against processor time, one panel for each time ahead."""
    known = max((accuracy.seconds for accuracy in accuracies.values()), default=())
    seconds = [s for s in known if s in (1, 2, 3, 5)] or known[:1]
    steps = sorted({step for _, step in accuracies})
    figure, panels = plt.subplots(1, len(seconds), figsize=(WIDTH, 3.4), sharey=True, squeeze=False)
    for axes, second in zip(panels[0], seconds, strict=True):
        for (model, step), accuracy in accuracies.items():
            k, marker = accuracy.seconds.index(second), MARKERS[steps.index(step) % len(MARKERS)]
            cost = 1e6 * costs[model, step].get("compiled", costs[model, step]["interpreted"])
            colour = MODEL_COLOUR.get(model, TEXT_COLOUR)
            axes.plot(cost, accuracy.rms[k], marker, color=colour, ms=5)
            if accuracy.half_widths is not None:
                axes.plot([cost, cost], [accuracy.rms[k], accuracy.half_widths[k]], color=colour, lw=0.7)
                axes.plot(cost, accuracy.half_widths[k], marker, color=colour, ms=5, mfc="none")
        axes.axhline(tolerance, color=TEXT_COLOUR, lw=0.7, ls=(0, (4, 3)))
        axes.set(title=f"{second} s ahead", xscale="log", yscale="log", xlabel="µs per prediction")
        for scale in (axes.xaxis, axes.yaxis):
            scale.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            scale.set_major_formatter("{x:g}")
            scale.set_minor_formatter(NullFormatter())
    panels[0, 0].set_ylabel("lateral error, m")
    models = list(dict.fromkeys(model for model, _ in accuracies))
    handles = [Line2D([], [], ls="", marker="o", color=MODEL_COLOUR.get(m, TEXT_COLOUR), label=m) for m in models]
    handles += [Line2D([], [], ls="", marker=MARKERS[k % len(MARKERS)], color=TEXT_COLOUR, label=f"step {step:g} s")
                for k, step in enumerate(steps)]
    handles += [Line2D([], [], ls="", marker="D", color=TEXT_COLOUR, ms=5, label="error, rms"),
                Line2D([], [], ls="", marker="D", color=TEXT_COLOUR, ms=5, mfc="none",
                       label="half-width of the band"),
                Line2D([], [], color=TEXT_COLOUR, lw=0.7, ls=(0, (4, 3)), label=f"{tolerance:g} m")]
    figure.legend(handles=handles, loc="outside lower left", ncols=6)
    save_figure(figure, output, "advice", "Cost and accuracy of each model and step",
                       f"Filled: rms error; hollow: half-width of the band; dashed: {tolerance:g} m.")


def describe_columns(accuracies: dict) -> str:
    """Caption that explains the columns of the advice."""
    level = next((accuracy.level for accuracy in accuracies.values()), None)
    bands = "none, fewer than 3 runs" if level is None else (
        f"mean lateral half-width of the {level:.0%} simultaneous band, calibrated on these runs")
    return ("processor time per prediction, in brackets as a multiple of the lowest; error: lateral RMS error with "
            f"measured inputs; band: {bands}")


def run() -> dict:
    """Rows by model and step, and the cheapest choice for each speed; only a message without the shared drives."""
    folders = [SOUND_DRIVES, OTHER_DRIVES]
    if not all(folder.exists() for folder in folders):
        return {"Genesis": "the shared drives are missing"}
    sources = [source for source in find_runs(folders) if not source.name.startswith(UNSUITABLE_DRIVES)]
    task = Task(genesis(), dict.fromkeys(MODELS), EvaluationSettings())
    costs, accuracies, _ = measure_runs(sources, task)
    draw_advice(costs, accuracies, TOLERANCE, FigureOutput(project_root() / "docs" / "images", ("png",)))
    rows = advice_report.make_advice_rows(costs, accuracies)
    choice = advice_report.make_choice_rows(costs, accuracies, TOLERANCE)
    title = (f"Cheapest model and step with a lateral error within {TOLERANCE:g} m up to each second, in "
             f"{advice_report.REQUIRED_FRACTION:.0%} of the starts, with measured inputs")
    caption = describe_columns(accuracies)
    replace_part(PAGE, "advice", "\n".join([
        f"Genesis, {len(sources)} real drives. {caption[0].upper()}{caption[1:]}.", "", format_records(rows), "",
        f"{title}:", "", format_records(choice), "", "![Error and band against cost](../images/advice.png)"]))
    return {"Genesis": {f"{row['model']}, {row['step, s']} s": row for row in rows},
            title: {row["speed"]: row for row in choice}}
