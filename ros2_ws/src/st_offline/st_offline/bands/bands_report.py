"""Scores bands against the errors of runs (coverage, interval score, CRPS, half-width), and reports these scores and
the contributions of causes to the prediction error as tables and figures."""

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from st_core.bands import AdaptiveBand, Band, Bands, conditions_at
from st_core.bands.calibration import LEVELS, RELIABILITY_LEVELS, to_predicted_frame
from st_core.bands.error_budget import PARAMETERS, SENSORS, Intervals, sum_squared_contributions
from st_core.bands.file import make_times
from st_core.bands.scale import EDGES, UNITS, find_bins
from st_core.log import LogSignals
from st_core.log_evaluation import AXES, Block, EvaluationSettings, label_bin
from st_core.model_file import ModelFile
from st_core.models import Model
from st_core.palette import MEASURED_COLOUR
from st_core.prediction import PredictionSettings
from st_core.vehicle import VehicleParameters

from ..evaluation.drawing import WIDTH, FigureOutput, PageFigure, save_figure
from ..evaluation.run_figures import get_line_style
from ..terminal import console, make_table, print_line

Sums = dict[str, Any]
MIN_STARTS = 200  # of a reported cell; for independent starts, the standard error of a coverage of 90 % is 2 %
NO_BANDS = ("[dim]no bands were given: calibrate them on other runs of this car with `st calibrate RUN… --vehicle FILE "
            "--output bands.yaml`, and test them on these runs with `--bands bands.yaml`[/dim]")
_HALF_LEVELS = 0.5 * np.array(RELIABILITY_LEVELS)
_PROBABILITIES = np.concatenate([0.5 - _HALF_LEVELS[::-1], [0.5], 0.5 + _HALF_LEVELS])


class Scorer:
    """Accumulates the scores of bands on one run, with errors in the predicted frame.

    bands: calibrated bands, or None. adaptive: whether to count the coverage of adaptive bands, which start from
    `bands`. files: sha256 of each file of the run, by path. `sums` has an entry for each block, model and mode, and
    one with known_recordings, the files of the run that the calibration used; `pool_sums` adds all entries.
    """

    ADAPTATION_TIME = 120.0  # s; coverage of adaptive bands is also counted without the starts in this initial time

    def __init__(self, bands: Bands | None, adaptive: bool, signals: LogSignals, files: Mapping[str, str],
                 prediction: PredictionSettings):
        self._bands, self._is_adaptive, self._signals = bands, adaptive, signals
        self._time = make_times(prediction.horizon, prediction.step)
        self._adaptive: dict[tuple[str, str], AdaptiveBand] = {}
        self._first_start_ns: int | None = None
        hashes = set(bands.recordings.values()) if bands else set()
        self.sums: list[Sums] = [{"known_recordings": [name for name, digest in files.items() if digest in hashes]}]

    def add(self, starts_ns: np.ndarray, block: Block) -> None:
        """Add the starts of one block of an evaluation that have a complete horizon; starts outside the calibrated
        domain are only counted. Blocks must be added in time order."""
        if not len(starts_ns) or not (self._bands or self._is_adaptive):
            return
        self._first_start_ns = int(starts_ns[0]) if self._first_start_ns is None else self._first_start_ns
        conditions = conditions_at(self._signals, starts_ns)
        inside = np.isfinite(conditions).all(axis=1) if self._bands is None else self._bands.domain.contains(conditions)
        starts_ns, conditions = starts_ns[inside], conditions[inside]
        for (model, mode), errors in block.errors.items():
            band = None if self._bands is None else self._bands.bands.get((model, mode))
            complete = np.isfinite(errors).all(axis=(1, 2))
            rotated, scored = to_predicted_frame(errors[inside][:, 1:]), complete[inside]
            if band is not None:
                entry = sum_band_scores(band, conditions[scored], rotated[scored])
                entry["without_band"] = int((complete & ~inside).sum())
                self.sums.append({"models": {model: {mode: entry}}})
            if self._is_adaptive:
                adaptive = self._adaptive.setdefault((model, mode), AdaptiveBand(self._time, band))
                factors, scales = adaptive.replay(starts_ns, conditions, rotated)
                score = np.abs(rotated[scored] / scales[scored]).max(axis=(1, 2), initial=0.0)
                covered = {f"{nominal:g}": score <= factor[scored] for nominal, factor in factors.items()}
                late = (starts_ns[scored] - self._first_start_ns) * 1e-9 >= self.ADAPTATION_TIME
                entry = _count_coverage(np.ones(len(score), bool), covered)
                entry |= {f"late_{key}": value for key, value in _count_coverage(late, covered).items()}
                self.sums.append({"adaptive": {model: {mode: entry}}})


def summarise_adaptive(sums: Sums) -> dict[str, Any]:
    """{model: {mode: starts, coverage, late_starts, late_coverage}}, coverage by level, None without starts."""
    return {model: {mode: {**counts, "coverage": _divide(counts["coverage"], counts["starts"]),
                           "late_coverage": _divide(counts["late_coverage"], counts["late_starts"])}
                    for mode, counts in modes.items()} for model, modes in sums.get("adaptive", {}).items()}


def sum_band_scores(band: Band, conditions: np.ndarray, errors: np.ndarray) -> Sums:
    """Scores of a band, summed over starts. conditions: (n, 4). errors: (n, points, 3) [m, m, rad], predicted frame.

    Counts for those of LEVELS that the band has, and for its highest level up to LEVELS[-1]: paths entirely inside
    (coverage), the same for each axis alone (axes) and by driving condition (conditions), paths inside throughout each
    second (seconds), the same by speed and lateral acceleration (cells). reliability: coverage for all levels of the
    band. By axis [m, m, rad]: mean over the horizon (interval_score), mean over the whole seconds (crps), half-width
    at each whole second (half_width).
    """
    import scoringrules  # slow to import, and needed only where bands are scored

    scale = band.scale(conditions)
    ratio = np.abs(errors) / scale
    time, available = band.scale.time, [level for level in band.factors if level <= LEVELS[-1]]
    levels = sorted({*(level for level in LEVELS if level in available), max(available)})
    # Rounded, because 297 steps of 1/99 s are 3.0000000000000004 s in floating point.
    second = np.ceil(np.round(time, 6)).astype(int)
    at_seconds = [k for k in range(len(time)) if abs(time[k] - round(time[k])) < 1e-6]
    by_point, by_axis = ratio.max(axis=2), ratio.max(axis=1)
    largest_ratio = by_point.max(axis=1, initial=0.0)
    is_inside = {f"{level:g}": largest_ratio <= band.factors[level] for level in levels}
    sums: Sums = {"starts": len(errors), "coverage": {}, "axes": {}, "interval_score": {}, "half_width": {},
                  "conditions": {}, "cells": {}, "crps": {},
                  "reliability": {f"{level:g}": int((largest_ratio <= c).sum()) for level, c in band.factors.items()}}
    for k, (axis, ratios) in enumerate(zip(AXES, band.ratios, strict=True)):  # a symmetric distribution is assumed
        quantiles = scale[:, at_seconds, k, None] * np.concatenate([-ratios[::-1], [0.0], ratios])
        score = scoringrules.crps_quantile(errors[:, at_seconds, k], quantiles, _PROBABILITIES, backend="numpy")
        sums["crps"][axis] = float(score.mean(axis=1).sum()) if score.size else 0.0
    for level in levels:
        key, c = f"{level:g}", band.factors[level]
        sums["coverage"][key] = int(is_inside[key].sum())
        sums["axes"][key] = _name_axes((by_axis <= c).sum(axis=0))
        score = scoringrules.interval_score(errors, -c * scale, c * scale, 1.0 - level, backend="numpy")
        sums["interval_score"][key] = _name_axes(score.mean(axis=1).sum(axis=0))
        sums["half_width"][key] = {f"{time[k]:g}": _name_axes(c * scale[:, k].sum(axis=0)) for k in at_seconds}
    largest_in_second = np.stack([by_point[:, second == s].max(axis=1) for s in np.unique(second)], axis=1)
    seconds_inside = {f"{level:g}": largest_in_second <= band.factors[level] for level in levels}
    sums["seconds"] = {key: {str(s): int(count) for s, count in zip(np.unique(second), inside.sum(axis=0), strict=True)}
                       for key, inside in seconds_inside.items()}
    cells = {name: find_bins(conditions, name) for name in EDGES}
    for name, cell in cells.items():
        sums["conditions"][name.replace("_", " ")] = {
            _label_bin(name, k): _count_coverage(cell == k, is_inside) for k in np.unique(cell).tolist()}
    for v, a in np.unique(np.stack([cells["speed"], cells["lateral_acceleration"]], axis=1), axis=0).tolist():
        mask = (cells["speed"] == v) & (cells["lateral_acceleration"] == a)
        for column, s in enumerate(np.unique(second)):
            name = f"{_label_bin('speed', v)}, {_label_bin('lateral_acceleration', a)}, second {s}"
            sums["cells"][name] = _count_coverage(
                mask, {key: inside[:, column] for key, inside in seconds_inside.items()})
    return sums


def _count_coverage(mask: np.ndarray, is_inside: Mapping[str, np.ndarray]) -> Sums:
    return {"starts": int(mask.sum()), "coverage": {key: int(inside[mask].sum()) for key, inside in is_inside.items()}}


def _name_axes(values: np.ndarray) -> dict[str, float]:
    return dict(zip(AXES, np.asarray(values).tolist(), strict=True))


def _label_bin(name: str, k: int) -> str:
    return label_bin(EDGES[name], UNITS[name].replace("^2", "²"), k)


def pool_sums(entries: Sequence[Mapping[str, Any]]) -> Sums:
    """Add nested sums, key by key; lists are concatenated."""
    total: Sums = {}
    for key, value in (item for entry in entries for item in entry.items()):
        if isinstance(value, Mapping):
            total[key] = pool_sums([total.get(key, {}), value])
        else:
            total[key] = total.get(key, [] if isinstance(value, list) else 0) + value
    return total


def summarise_bands(sums: Sums) -> dict[str, Any]:
    """{known_recordings, models: {model: {mode: coverages and mean scores}}}; a value is None without starts."""
    return {"known_recordings": sums.get("known_recordings", []),
            "models": {model: {mode: _summarise_scores(scores) for mode, scores in modes.items()}
                       for model, modes in sums.get("models", {}).items()}}


def _summarise_scores(sums: Sums) -> dict[str, Any]:
    count = sums["starts"]
    means = _divide({key: sums[key] for key in ("coverage", "axes", "seconds", "interval_score", "crps", "half_width",
                                                "reliability")}, count)
    conditions = [{"quantity": quantity, "label": label, "starts": counts["starts"],
                   "coverage": _divide(counts["coverage"], counts["starts"])}
                  for quantity, labels in sums["conditions"].items() for label, counts in labels.items()]
    level = max(sums["coverage"], key=float)
    cells = [{"coverage": cell["coverage"][level] / cell["starts"], "cell": name, "starts": cell["starts"]}
             for name, cell in sums["cells"].items() if cell["starts"] >= MIN_STARTS]
    return {"starts": count, "without_band": sums["without_band"], **means, "conditions": conditions,
            "worst_cell": min(cells, key=lambda cell: tuple(cell.values()), default=None)}


def _divide(value: Any, count: int) -> Any:
    """Divide a number, or all numbers of a nested mapping, by `count`; None for a count of 0."""
    if isinstance(value, Mapping):
        return {key: _divide(part, count) for key, part in value.items()}
    return value / count if count else None


def draw_bands(content: Mapping[str, Any], output: FigureOutput) -> list[PageFigure]:
    """Draw a reliability diagram from the result of `summarise_bands`; no figure if no start had a band."""
    models = {model: modes for model, modes in content.get("models", {}).items()
              if any(scores["starts"] for scores in modes.values())}
    if not models:
        return []
    top = _find_top_level(content)
    deviations = [(abs(scores["coverage"][top] - float(top)), f"{100 * scores['coverage'][top]:.0f} %, {model}, {mode}")
                  for model, modes in models.items() for mode, scores in modes.items() if scores["starts"]]
    _, worst = max(deviations)
    figure, panels = plt.subplots(1, 2, figsize=(WIDTH, 4.2), sharey=True)
    for axes, mode, inputs in zip(panels, ("hindsight", "forecast"), ("measured inputs", "inputs held"), strict=True):
        axes.plot([0, 100], [0, 100], color=MEASURED_COLOUR, lw=0.8)
        for model, modes in models.items():
            points = {float(level): c for level, c in modes[mode]["reliability"].items() if c is not None}
            axes.plot([100 * level for level in points], [100 * coverage for coverage in points.values()], marker="o",
                      ms=3, **get_line_style(model))
        axes.set(title=f"{mode} ({inputs})", xlabel="nominal coverage, %", xlim=(0, 100), ylim=(0, 100))
    panels[0].set_ylabel("paths entirely inside, %")
    return [save_figure(figure, output, "bands_reliability",
                        f"Reliability of the bands; coverage furthest from {_format_level(top)}: {worst}",
                        "Grey line: coverage equal to the nominal coverage. Below it, the band is too narrow.")]


def make_band_rows(content: Mapping[str, Any]) -> list[dict[str, str]]:
    """Table row of each model and mode in the result of `summarise_bands`, by column title."""
    rows, top = [], _find_top_level(content)
    for model, modes in content.get("models", {}).items():
        for mode, scores in modes.items():
            worst, widths = scores["worst_cell"], list((scores["half_width"].get(top) or {}).values())
            interval_score, crps = scores["interval_score"].get(top), scores["crps"]
            rows.append({
                "model": model, "inputs": mode,
                "predictions": str(scores["starts"]), "no band": str(scores["without_band"]),
                "50 % band": _format_percent(scores["coverage"].get("0.5")),
                f"{_format_level(top)} band": _format_percent(scores["coverage"].get(top)),
                "worst cell": (f"{100 * worst['coverage']:.0f} % ({worst['cell']}, {worst['starts']} predictions)"
                               if worst else "-"),
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
    return [{"model": model, "inputs": mode, "scored": str(scores["starts"]),
             **{f"{_format_level(level)} band": _format_percent(c) for level, c in scores["coverage"].items()},
             **{f"{_format_level(level)} band after 2 min": _format_percent(c)
                for level, c in scores["late_coverage"].items()}}
            for model, modes in content.items() for mode, scores in modes.items()]


def print_tables(sums: Sequence[Sums], calibrated: bool, adaptive: bool) -> None:
    """Print the tables for all runs pooled. sums: by run. calibrated, adaptive: which bands were scored."""
    pooled = pool_sums(sums)
    if calibrated:
        content = summarise_bands(pooled)
        rows, level = make_band_rows(content), _format_level(_find_top_level(content))
        # A single table would be wider than 80 characters; each of these begins with the columns model and inputs.
        for title, columns in (("Bands: fraction of paths entirely inside", slice(2, 6)),
                               (f"Bands: conditions with the lowest coverage of the {level} band", slice(6, 7)),
                               ("Bands: scores and half-width, along | across", slice(7, None))):
            cells = [list(row.items()) for row in rows]
            if any(text != "-" for row in cells for _, text in row[columns]):
                console.print(make_table([dict(row[:2] + row[columns]) for row in cells], title), highlight=False)
        if known := content["known_recordings"]:
            print_line(f"[yellow]the calibration used {len(known)} of these files, so this is not an independent test "
                       "of the bands; use other runs[/yellow]")
    elif not adaptive:
        console.print(NO_BANDS, highlight=False, soft_wrap=True)
    if adaptive:
        console.print(make_table(make_adaptive_rows(summarise_adaptive(pooled)),
                                 "Adaptive bands: fraction of paths entirely inside"))
    if rows := make_contribution_rows(summarise_contributions(pooled)):
        console.print(make_table(rows, "Decomposition of the error with measured inputs: fractions of the mean squared "
                                       "error, along | across"))


def _format_percent(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.1f} %"


def _format_pair(axes: dict[str, float] | None) -> str:
    if not axes or axes["longitudinal"] is None:
        return "-"
    return f"{axes['longitudinal']:.2f} | {axes['lateral']:.2f}"


def collect_intervals(files: Sequence[ModelFile]) -> dict[str, Intervals]:
    """95 % intervals of the values in model files, by model and (effect, parameter)."""
    return {file.model().name: {(effect, name): estimate.interval for effect, parts in file.effects.items()
                                for name, estimate in parts.items() if estimate.interval is not None} for file in files}


def sum_contributions(models: Sequence[Model], vehicle: VehicleParameters, signals: LogSignals,
                      settings: EvaluationSettings, intervals: Mapping[str, Intervals]) -> Sums:
    """{"shares": {model: {starts, total, causes}}} of one run. starts: number of starts. total: squared errors, causes:
    squared contributions by cause, summed over the starts; each (seconds, axes) [m^2, m^2, rad^2]."""
    by_model: Sums = {}
    for model in models:
        starts, total, parts = sum_squared_contributions(model, vehicle, signals, settings, intervals.get(model.name))
        causes = {f"{kind}: {name}": squares for (kind, name), squares in parts.items()}
        by_model[model.name] = {"starts": starts, "total": total, "causes": causes}
    return {"shares": by_model}


def _name_seconds(values: np.ndarray) -> dict[str, dict[str, float]]:
    return {str(k + 1): _name_axes(row) for k, row in enumerate(values)}


def summarise_contributions(sums: Sums) -> dict[str, Any]:
    """By model: number of starts; RMS of the error and of the contribution of each cause [m, m, rad]; parameters with a
    stated uncertainty (stated); fractions of the mean squared error due to parameters, sensors and the residual, which
    add up to 1 (share)."""
    summary = {}
    for model, sums_of_model in sums.get("shares", {}).items():
        count, total, causes = sums_of_model["starts"], sums_of_model["total"], sums_of_model["causes"]
        if not count:
            continue
        fractions = {kind: sum((squares for name, squares in causes.items() if name.startswith(f"{kind}: ")),
                               np.zeros_like(total)) / total for kind in (PARAMETERS, SENSORS)}
        fractions["residual"] = 1.0 - sum(fractions.values())
        summary[model] = {
            "starts": count, "rms": _name_seconds(np.sqrt(total / count)),
            "rms_of_cause": {name: _name_seconds(np.sqrt(squares / count)) for name, squares in causes.items()},
            "stated": [name.split(": ", 1)[1] for name in causes if name.startswith(f"{PARAMETERS}: ")],
            "share": {kind: _name_seconds(values) for kind, values in fractions.items()}}
    return summary


def make_contribution_rows(content: Mapping[str, Any]) -> list[dict[str, str]]:
    """Table row of each model at 1, 3 and 5 s in the result of `summarise_contributions`, by column title."""
    rows = []
    for model, summary in content.items():
        for second in (s for s in ("1", "3", "5") if s in summary["rms"]):
            rms = summary["rms"][second]
            row = {"model": model, "time, s": second,
                   "rms along | across, m": f"{rms['longitudinal']:.2f} | {rms['lateral']:.2f}"}
            for kind, values in summary["share"].items():
                text = f"{100 * values[second]['longitudinal']:.0f} % | {100 * values[second]['lateral']:.0f} %"
                row[kind] = text if kind != PARAMETERS or summary["stated"] else "not stated"
            rows.append(row)
    return rows
