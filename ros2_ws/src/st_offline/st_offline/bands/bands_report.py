"""Figures of bands: the reliability diagram, and how wide they are."""

from collections.abc import Sequence
from typing import Any

import matplotlib.pyplot as plt
from matplotlib.lines import Line2D
from rich.table import Table
from st_core.palette import MEASURED_COLOUR, MODEL_COLOUR, MODEL_LINE

from ..evaluation.drawing import TEXT, WIDTH, Drawn, Place, finish, style
from ..terminal import rows_table
from .scoring import finished, finished_adaptive, pooled_sums

QUESTIONS = {"hindsight": "model (inputs as they were)", "forecast": "forecast (inputs held)"}


def band_figures(content: dict[str, Any] | None, place: Place) -> list[Drawn]:
    """Of a finished document; none where no start had a band."""
    models = {} if content is None else {
        model: modes for model, modes in content["models"].items() if any(one["starts"] for one in modes.values())}
    if not models:
        return []
    with style():
        return [_reliability(models, place), _sharpness(models, place)]


def _reliability(models: dict[str, Any], place: Place) -> Drawn:
    figure, panels = plt.subplots(1, 2, figsize=(WIDTH, 4.2), sharey=True)
    for axes, (mode, words) in zip(panels, QUESTIONS.items(), strict=True):
        axes.plot([0, 100], [0, 100], color=MEASURED_COLOUR, lw=0.8)
        for model, modes in models.items():
            points = {float(level): share for level, share in modes[mode]["reliability"].items() if share is not None}
            axes.plot([100 * level for level in points], [100 * share for share in points.values()], marker="o", ms=3,
                      color=MODEL_COLOUR.get(model, TEXT), ls=MODEL_LINE.get(model, "solid"))
        axes.set(title=words, xlabel="stated, %", xlim=(0, 100), ylim=(0, 100))
    panels[0].set_ylabel("whole paths inside, %")
    _legend(figure, models)
    worst = max((abs(one["coverage"]["0.9"] - 0.9), f"{100 * one['coverage']['0.9']:.0f} %, {model}, {mode}")
                for model, modes in models.items() for mode, one in modes.items() if one["coverage"].get("0.9"))[1] \
        if any(one["coverage"].get("0.9") for modes in models.values() for one in modes.values()) else "not stated"
    return finish(figure, place, "bands_reliability", f"Reliability of the bands; farthest from 90 %: {worst}",
                  "Grey: as stated. Below it the band covers less than stated.")


def _sharpness(models: dict[str, Any], place: Place) -> Drawn:
    figure, panels = plt.subplots(2, 2, figsize=(WIDTH, 5.0), sharex=True)
    for column, (mode, words) in enumerate(QUESTIONS.items()):
        for axes, axis, name in zip(panels[:, column], ("longitudinal", "lateral"), ("along", "across"), strict=True):
            for model, modes in models.items():
                for level, width in (("0.5", 0.7), ("0.9", 1.6)):
                    seconds = modes[mode]["half_width"].get(level, {})
                    axes.plot([0.0, *map(float, seconds)], [0.0, *(one[axis] or 0.0 for one in seconds.values())],
                              color=MODEL_COLOUR.get(model, TEXT), ls=MODEL_LINE.get(model, "solid"), lw=width)
            axes.set_ylim(bottom=0)
            axes.set_ylabel(f"half-width {name}, m")
        panels[0, column].set_title(words)
        panels[1, column].set_xlabel("time ahead, s")
    _legend(figure, models, [Line2D([], [], color=TEXT, lw=1.6, label="90 %"),
                             Line2D([], [], color=TEXT, lw=0.7, label="50 %")])
    return finish(figure, place, "bands_sharpness", "How wide the bands are, on average over the starts",
                  "Thick: 90 %; thin: 50 %. The whole path lies inside, along, across and in heading at once.")


def _legend(figure: plt.Figure, models: dict[str, Any], more: Sequence[Line2D] = ()) -> None:
    handles = [Line2D([], [], color=MODEL_COLOUR.get(m, TEXT), ls=MODEL_LINE.get(m, "solid"), label=m) for m in models]
    figure.legend(handles=[*handles, *more], loc="outside lower left", ncols=6)



HOW_TO_GET = ("[dim]bands: none given; `st calibrate RUN… --vehicle FILE --output bands.yaml` learns them from "
              "other runs of this car, `--bands bands.yaml` tests them on these[/dim]")


def band_rows(content: dict[str, Any] | None) -> list[dict[str, str]]:
    """One row for each model and question of a finished document; columns by their titles."""
    rows = []
    for model, modes in (content or {"models": {}})["models"].items():
        for mode, one in modes.items():
            worst, end = one["worst_cell"], _last(one["half_width"].get("0.9"))
            scores, crps = one["interval_score"].get("0.9"), one["crps"]
            rows.append({
                "model": model, "question": {"hindsight": "model", "forecast": "forecast"}[mode],
                "starts": str(one["starts"]), "no band": str(one["without_band"]),
                "50 % covers": _share(one["coverage"].get("0.5")), "90 % covers": _share(one["coverage"].get("0.9")),
                "worst cell": f"{worst['coverage']:.0%} ({worst['cell']}, {worst['starts']} starts)" if worst else "-",
                "interval score 90 %, along | across, m": _pair(scores), "CRPS, along | across, m": _pair(crps),
                "half-width 90 %, along | across, m": _pair(end)})
    return rows


def adaptive_rows(content: dict[str, Any] | None) -> list[dict[str, str]]:
    """One row for each model and mode of `finished_adaptive`; columns by their titles."""
    return [{"model": model, "inputs": mode, "starts": str(one["starts"]),
             **{f"{100 * float(level):g} % covers": _share(share) for level, share in one["coverage"].items()},
             **{f"{100 * float(level):g} % after 2 min": _share(share)
                for level, share in one["late_coverage"].items()}}
            for model, modes in (content or {}).items() for mode, one in modes.items()]


def bands_table(reports: Sequence[Any], width: int) -> Table | None:
    """Of all runs together; None where no bands were tested."""
    if not any(report.bands for report in reports):
        return None
    content = finished(pooled_sums([report.bands for report in reports]))
    known = content["known_recordings"]
    caption = f"{len(known)} of the files were used for calibration: not a test of the bands" if known else None
    return rows_table(band_rows(content), title="Bands: how often the whole path lies inside", caption=caption,
                      width=min(width, 200))


def adaptive_table(reports: Sequence[Any], width: int) -> Table:
    """Of all runs together."""
    pooled = finished_adaptive(pooled_sums([{"adaptive": report.bands["adaptive"]} for report in reports]))
    return rows_table(adaptive_rows(pooled), title="Adaptive bands: how often the whole path lies inside",
                      width=min(width, 140))


def _last(seconds: dict[str, dict[str, float]] | None) -> dict[str, float] | None:
    return list(seconds.values())[-1] if seconds else None


def _share(value: float | None) -> str:
    return "-" if value is None else f"{value:.1%}"


def _pair(axes: dict[str, float] | None) -> str:
    if not axes or axes["longitudinal"] is None:
        return "-"
    return f"{axes['longitudinal']:.2f} | {axes['lateral']:.2f}"
