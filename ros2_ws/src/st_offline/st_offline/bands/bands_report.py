"""Reports the scores of bands, and the shares of causes in the prediction error, as tables and figures."""

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.lines import Line2D
from rich.console import Console
from st_core.bands.shares import PARAMETERS, SENSORS, Intervals, sum_squared_contributions
from st_core.log import LogSignals
from st_core.log_evaluation import AXES, EvaluationSettings
from st_core.model_file import ModelFile
from st_core.models import Model
from st_core.palette import MEASURED_COLOUR
from st_core.vehicle import VehicleParameters

from ..evaluation.drawing import WIDTH, FigureOutput, PageFigure, apply_style, save_figure
from ..evaluation.run_figures import get_line_style
from ..terminal import make_table, print_line
from .scoring import Sums, pool_sums, summarise_adaptive, summarise_bands

MODE_TITLES = {"hindsight": "hindsight (measured inputs)", "forecast": "forecast (inputs held)"}
NO_BANDS = ("[dim]no bands were given: calibrate them on other runs of this car with `st calibrate RUN… --vehicle FILE "
            "--output bands.yaml`, and test them on these runs with `--bands bands.yaml`[/dim]")
RESIDUAL = "what remains"  # key of the residual in evaluation.json
REPORTED_SECONDS = ("1", "3", "5")  # prediction times in the table


@apply_style()
def draw_bands(content: Mapping[str, Any], output: FigureOutput) -> list[PageFigure]:
    """Draw a reliability diagram from the result of `summarise_bands`; an empty list if no start had a band."""
    models = {model: modes for model, modes in content.get("models", {}).items()
              if any(scores["starts"] for scores in modes.values())}
    if not models:
        return []
    top = _find_top_level(content)
    deviations = [(abs(scores["coverage"][top] - float(top)), f"{100 * scores['coverage'][top]:.0f} %, {model}, {mode}")
                  for model, modes in models.items() for mode, scores in modes.items() if scores["starts"]]
    _, worst = max(deviations)
    figure, panels = plt.subplots(1, 2, figsize=(WIDTH, 4.2), sharey=True)
    for axes, (mode, title) in zip(panels, MODE_TITLES.items(), strict=True):
        axes.plot([0, 100], [0, 100], color=MEASURED_COLOUR, lw=0.8)
        for model, modes in models.items():
            points = {float(level): s for level, s in modes[mode]["reliability"].items() if s is not None}
            axes.plot([100 * level for level in points], [100 * share for share in points.values()], marker="o",
                      ms=3, **get_line_style(model))
        axes.set(title=title, xlabel="nominal coverage, %", xlim=(0, 100), ylim=(0, 100))
    panels[0].set_ylabel("paths entirely inside, %")
    handles = [Line2D([], [], **get_line_style(model), label=model) for model in models]
    figure.legend(handles=handles, loc="outside lower left", ncols=6)
    return [save_figure(figure, output, "bands_reliability",
                        f"Reliability of the bands; largest deviation from {_format_level(top)}: {worst}",
                        "Grey line: coverage equal to the nominal coverage. Below it, the band is too narrow.")]


def make_band_rows(content: Mapping[str, Any]) -> list[dict[str, str]]:
    """Table row by column title of each model and mode of `summarise_bands`; half-widths at the last whole second."""
    rows, top = [], _find_top_level(content)
    for model, modes in content.get("models", {}).items():
        for mode, scores in modes.items():
            worst, widths = scores["worst_cell"], list((scores["half_width"].get(top) or {}).values())
            interval_score, crps = scores["interval_score"].get(top), scores["crps"]
            rows.append({
                "model": model, "inputs": mode,
                "starts": str(scores["starts"]), "no band": str(scores["without_band"]),
                "50 % covers": _format_share(scores["coverage"].get("0.5")),
                f"{_format_level(top)} covers": _format_share(scores["coverage"].get(top)),
                "worst cell": f"{worst['coverage']:.0%} ({worst['cell']}, {worst['starts']} starts)" if worst else "-",
                f"interval score {_format_level(top)}, along | across, m": _format_pair(interval_score),
                "CRPS, along | across, m": _format_pair(crps),
                f"half-width {_format_level(top)}, along | across, m": _format_pair(widths[-1] if widths else None)})
    return rows


def _find_top_level(content: Mapping[str, Any]) -> str:
    """The highest scored level: "0.9", or lower for bands from too few runs."""
    levels = {level for modes in content.get("models", {}).values() for s in modes.values() for level in s["coverage"]}
    return max(levels, key=float, default="0.9")


def _format_level(level: str) -> str:
    return f"{100 * float(level):g} %"


def make_adaptive_rows(content: Mapping[str, Any]) -> list[dict[str, str]]:
    """Table row of each model and mode in the result of `summarise_adaptive`, by column title."""
    return [{"model": model, "inputs": mode, "starts": str(scores["starts"]),
             **{f"{_format_level(level)} covers": _format_share(share) for level, share in scores["coverage"].items()},
             **{f"{_format_level(level)} after 2 min": _format_share(share)
                for level, share in scores["late_coverage"].items()}}
            for model, modes in content.items() for mode, scores in modes.items()]


def print_tables(sums: Sequence[Sums], tested: bool, adaptive: bool, console: Console) -> None:
    """Print the tables for all runs pooled. sums: one entry for each run. tested, adaptive: whether bands and adaptive
    bands were scored."""
    pooled = pool_sums(sums)
    if tested:
        content = summarise_bands(pooled)
        rows, level = make_band_rows(content), _format_level(_find_top_level(content))
        # A single table would be wider than 80 characters.
        for title, columns in (
                ("Bands: share of paths entirely inside", ("starts", "no band", "50 % covers", f"{level} covers")),
                (f"Bands: conditions with the lowest coverage of the {level} band", ("worst cell",)),
                ("Bands: scores and size, along | across", (
                    f"interval score {level}, along | across, m", "CRPS, along | across, m",
                    f"half-width {level}, along | across, m"))):
            reported = [{column: row[column] for column in ("model", "inputs", *columns)} for row in rows]
            console.print(make_table(reported, title=title, width=min(console.width, 120)), highlight=False)
        if known := content["known_recordings"]:
            print_line(f"[yellow]the calibration used {len(known)} of these files: this is no independent test of the "
                       "bands; use other runs[/yellow]", console)
    elif not adaptive:
        console.print(NO_BANDS, highlight=False, soft_wrap=True)
    if adaptive:
        console.print(make_table(make_adaptive_rows(summarise_adaptive(pooled)), width=min(console.width, 140),
                                 title="Adaptive bands: share of paths entirely inside"))
    if rows := make_share_rows(summarise_shares(pooled)):
        console.print(make_table(rows, title="Decomposition of the error with measured inputs: shares of its mean "
                                 "square, along | across", width=min(console.width, 140)))


def _format_share(value: float | None) -> str:
    return "-" if value is None else f"{value:.1%}"


def _format_pair(axes: dict[str, float] | None) -> str:
    if not axes or axes["longitudinal"] is None:
        return "-"
    return f"{axes['longitudinal']:.2f} | {axes['lateral']:.2f}"


def collect_intervals(files: Sequence[ModelFile]) -> dict[str, Intervals]:
    """95 % intervals of the values in model files, by model and (effect, parameter)."""
    return {file.model().name: {(effect, name): estimate.interval for effect, parts in file.effects.items()
                                for name, estimate in parts.items() if estimate.interval is not None} for file in files}


def sum_shares(models: Sequence[Model], vehicle: VehicleParameters, signals: LogSignals, settings: EvaluationSettings,
               intervals: Mapping[str, Intervals]) -> Sums:
    """{"shares": {model: {starts, total, causes}}} of one run: number of starts; squared errors, and contributions by
    cause, summed over the starts, (seconds, axes) [m^2, m^2, rad^2]."""
    shares: Sums = {}
    for model in models:
        starts, total, parts = sum_squared_contributions(model, vehicle, signals, settings, intervals.get(model.name))
        causes = {f"{kind}: {name}": squares for (kind, name), squares in parts.items()}
        shares[model.name] = {"starts": starts, "total": total, "causes": causes}
    return {"shares": shares}


def _name_seconds(values: np.ndarray) -> dict[str, dict[str, float]]:
    return {str(k + 1): dict(zip(AXES, row.tolist(), strict=True)) for k, row in enumerate(values)}


def summarise_shares(sums: Sums) -> dict[str, Any]:
    """By model: number of starts, RMS of the error and of each cause [m, m, rad], fractions of the mean square error.
    The fractions of the kinds of causes (parameters, sensors) and of the residual add up to 1. stated: parameters with
    a known uncertainty."""
    summary = {}
    for model, sums_of_model in sums.get("shares", {}).items():
        count, total, causes = sums_of_model["starts"], sums_of_model["total"], sums_of_model["causes"]
        if not count:
            continue
        shares = {kind: sum((squares for name, squares in causes.items() if name.startswith(f"{kind}: ")),
                            np.zeros_like(total)) / total for kind in (PARAMETERS, SENSORS)}
        shares[RESIDUAL] = 1.0 - sum(shares.values())
        summary[model] = {
            "starts": count, "rms": _name_seconds(np.sqrt(total / count)),
            "rms_of_cause": {name: _name_seconds(np.sqrt(squares / count)) for name, squares in causes.items()},
            "stated": [name.split(": ", 1)[1] for name in causes if name.startswith(f"{PARAMETERS}: ")],
            "share": {kind: _name_seconds(values) for kind, values in shares.items()}}
    return summary


def make_share_rows(shares: Mapping[str, Any]) -> list[dict[str, str]]:
    """Table row of each model and reported second, by column title."""
    rows = []
    for model, summary in shares.items():
        for second in (s for s in REPORTED_SECONDS if s in summary["rms"]):
            rms = summary["rms"][second]
            row = {"model": model, "second": second,
                   "rms along | across, m": f"{rms['longitudinal']:.2f} | {rms['lateral']:.2f}"}
            for kind, values in summary["share"].items():
                text = f"{values[second]['longitudinal']:.0%} | {values[second]['lateral']:.0%}"
                row["residual" if kind == RESIDUAL else kind] = (
                    text if kind != PARAMETERS or summary["stated"] else "not stated")
            rows.append(row)
    return rows
