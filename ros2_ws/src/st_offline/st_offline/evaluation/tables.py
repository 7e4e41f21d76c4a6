"""Summarises the errors of evaluated runs for evaluation.json, and formats them for terminal, CSV and LaTeX.

Arguments named `reports` are the `work.RunReport` of each run.
"""

import csv
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table
from rich.text import Text
from st_core.log_evaluation import ALL_ROWS, AXES, LogEvaluation, ModelErrors, bin_starts
from st_core.palette import MODEL_COLOUR

from .drive_parts import DrivePart, assign_horizons

STATISTICS = ("mean", "max", "rmse")
Entry = dict[str, Any]
DECIMALS = 2  # centimetres, as in the paper
MIN_FORECAST_WIDTH = 100  # characters; a narrower terminal shows no forecasts
REPORTED_AXES = ("longitudinal", "lateral")
OVER_LABELS = {"means": "the horizon means", "samples": "all samples of all horizons"}
Models = Mapping[str, Any]  # {model: {mode: entry}}


def summarise_errors(errors: ModelErrors, rows: np.ndarray | slice = ALL_ROWS) -> Entry:
    """Statistics of the horizon means and, in `samples`, of all points; values are None if no start was scored."""
    complete = errors.complete[rows]
    count = int(complete.sum())
    means, samples = ({axis: _name_statistics(*values)
                       for axis, values in errors.statistics_by_axis(over, rows).items()}
                      for over in ("means", "samples"))
    return {"n_starts": count, "n_incomplete": len(complete) - count, **means,
            "samples": {"n_starts": count, **samples}}


def summarise_by_model(evaluation: LogEvaluation, rows: np.ndarray | slice = ALL_ROWS) -> dict[str, dict[str, Entry]]:
    """{model: {mode: entry}} for the starts that `rows` selects."""
    return {model: {mode: summarise_errors(evaluation.errors[model, mode], rows) for mode in evaluation.modes}
            for model in evaluation.models}


def summarise_by_second(evaluation: LogEvaluation) -> dict[str, dict[str, dict[str, Entry]]]:
    """{model: {mode: {second: {axis: {mean, max, rmse}}}}}: errors of the complete starts after 1, 2, ... s."""
    summary: dict[str, dict[str, dict[str, Entry]]] = {model: {} for model in evaluation.models}
    for (model, mode), errors in evaluation.errors.items():
        values = errors.at_seconds[errors.complete]
        summary[model][mode] = {} if not len(values) else {
            str(k + 1): {axis: _name_statistics(v.mean(), np.abs(v).max(), np.sqrt(np.square(v).mean()))
                         for axis, v in zip(AXES, values[:, k].T, strict=True)} for k in range(values.shape[1])}
    return summary


def summarise_by_bin(evaluation: LogEvaluation) -> list[Entry]:
    """One entry for each bin of driving conditions that contains a start; bins: `st_core.log_evaluation.bin_starts`."""
    return [{"quantity": b.quantity, "label": b.label, "low": b.low, "high": b.high,
             "models": summarise_by_model(evaluation, b.mask)} for b in bin_starts(evaluation)]


def summarise_by_manoeuvre(evaluation: LogEvaluation, parts: Sequence[DrivePart]) -> list[Entry]:
    """One entry for each part of the drive; a start belongs to the part that contains the middle of its horizon."""
    midpoints = evaluation.time + 0.5 * float(evaluation.horizon[-1])
    return [{"name": part.name, "start": part.start, "end": part.end,
             "heading_change_deg": math.degrees(part.heading_change), "models": summarise_by_model(evaluation, rows)}
            for part, rows in zip(parts, assign_horizons(parts, midpoints), strict=True)]


def pool_models(entries: Sequence[Mapping[str, Mapping[str, Entry]]]) -> dict[str, dict[str, Entry]]:
    """Pool several {model: {mode: entry}} as if all starts were in one run."""
    grouped: dict[str, dict[str, list[Entry]]] = {}
    for document in entries:
        for model, modes in document.items():
            for mode, entry in modes.items():
                grouped.setdefault(model, {}).setdefault(mode, []).append(entry)
    return {model: {mode: _pool_statistics(parts) for mode, parts in modes.items()} for model, modes in grouped.items()}


def pool_entries(entries: Sequence[Entry], *keys: str) -> list[Entry]:
    """Pool the entries that agree in `keys`, in the order of their first appearance."""
    groups: dict[tuple, list[Entry]] = {}
    for entry in entries:
        groups.setdefault(tuple(entry[key] for key in keys), []).append(entry)
    return [{**{k: v for k, v in group[0].items() if k in {*keys, "low", "high"}}, "count": len(group),
             "models": pool_models([entry["models"] for entry in group])} for group in groups.values()]


def _pool_statistics(entries: Sequence[Entry]) -> Entry:
    pooled: Entry = {key: sum(e[key] for e in entries) for key in ("n_starts", "n_incomplete") if key in entries[0]}
    for axis in AXES:
        scored = [(e["n_starts"], e[axis]) for e in entries if e["n_starts"]]
        total = sum(n for n, _ in scored)
        pooled[axis] = _name_statistics(
            sum(n * v["mean"] for n, v in scored) / total, max(v["max"] for _, v in scored),
            math.sqrt(sum(n * v["rmse"] ** 2 for n, v in scored) / total)) if total else dict.fromkeys(STATISTICS)
    if "samples" in entries[0]:
        pooled["samples"] = _pool_statistics([e["samples"] for e in entries])
    return pooled


def _name_statistics(*values: float) -> Entry:
    """Statistics by name; None in place of NaN, which JSON cannot represent."""
    return {kind: float(v) if math.isfinite(v) else None for kind, v in zip(STATISTICS, values, strict=True)}


def get_axis_statistics(models: Models, model: str, mode: str, axis: str, over: str) -> Mapping[str, float | None]:
    """{mean, max, rmse} of a model. over: "means" (of each horizon) or "samples"."""
    entry = models[model][mode]
    return entry[axis] if over == "means" else entry["samples"][axis]


def list_statistics(models: Models, model: str, axis: str, over: str) -> list[tuple[str, bool]]:
    """(text, whether its magnitude, as printed, is the smallest of all models) for each of STATISTICS in hindsight."""
    entries = {name: get_axis_statistics(models, name, "hindsight", axis, over) for name in models}
    result = []
    for kind in STATISTICS:
        sizes = {name: round(abs(x), DECIMALS) for name, entry in entries.items() if (x := entry[kind]) is not None}
        is_best = model in sizes and sizes[model] == min(sizes.values())
        result.append((format_error(entries[model][kind]), is_best))
    return result


def format_error(value: float | None) -> str:
    """Text of an error [m] with DECIMALS decimals and no unit; "-" for None, and never a negative zero."""
    return "-" if value is None else f"{value:z.{DECIMALS}f}"


def list_rmse(models: Models, over: str) -> tuple[list[str], list[list[str]]]:
    """(head, rows): number of predictions and RMSE [m] of each model, by mode."""
    rows = []
    for model, modes in models.items():
        for k, (mode, entry) in enumerate(modes.items()):
            sizes = (get_axis_statistics(models, model, mode, axis, over)["rmse"] for axis in REPORTED_AXES)
            rows.append(["" if k else model, mode, str(entry["n_starts"]), *map(format_error, sizes)])
    return ["model", "inputs", "predictions", *(f"{axis} RMSE, m" for axis in REPORTED_AXES)], rows


def compare_modes(reports: Sequence[Any], modes: Sequence[str], over: str) -> tuple[list[str], list[list[str]]]:
    """(head, rows): RMSE [m] of each run and model, by axis and mode."""
    columns, rows = [(axis, mode) for axis in REPORTED_AXES for mode in modes], []
    for report in reports:
        for k, (model, entries) in enumerate(report.models.items()):
            sizes = [get_axis_statistics(report.models, model, mode, axis, over)["rmse"] if mode in entries else None
                     for axis, mode in columns]
            rows.append(["" if k else report.name, model, *map(format_error, sizes)])
    return ["run", "model", *map(", ".join, columns)], rows


def list_rmse_by_second(reports: Sequence[Any]) -> tuple[list[str], list[list[str]]]:
    """(head, rows): longitudinal and lateral hindsight RMSE [m] of each run and model, by second ahead."""
    errors = [("" if k else report.name, model, modes["hindsight"]) for report in reports
              for k, (model, modes) in enumerate(report.seconds_ahead.items())]
    seconds = list(dict.fromkeys(second for *_, by_second in errors for second in by_second))
    return ["run", "model", *(f"{second} s" for second in seconds)], [
        [name, model, *(" | ".join(format_error(by_second[second][axis]["rmse"]) for axis in REPORTED_AXES)
                        if second in by_second else "-" for second in seconds)] for name, model, by_second in errors]


def make_terminal_table(reports: Sequence[Any], over: str, title: str, width: int) -> Table:
    """Table of the hindsight errors, as in the paper; in a wide terminal, also the RMSE of the forecasts."""
    is_wide = width >= MIN_FORECAST_WIDTH
    forecast_modes = list(dict.fromkeys(mode for r in reports for modes in r.models.values() for mode in modes
                                        if mode != "hindsight"))
    note = f"mean | max | RMSE over {OVER_LABELS[over]}, m; bold: smallest magnitude of each run"
    heading = Text(f"{title}\n{note}", style="bold")
    table = Table(title=heading, title_justify="left", box=None, padding=(0, 1))
    table.add_column("run", overflow="fold")
    table.add_column("model", no_wrap=True)
    for name in ("scored", *REPORTED_AXES, *(f"{mode} RMSE\nlon | lat" for mode in forecast_modes if is_wide)):
        table.add_column(name, justify="right", no_wrap=True)
    for report in reports:
        for number, model in enumerate(report.models):
            cells = [Text(" | ").join(Text(f"{text:>5}", style="bold" if is_best else "") for text, is_best in
                                      list_statistics(report.models, model, axis, over))
                     for axis in REPORTED_AXES]
            forecasts = [" | ".join(
                f"{format_error(get_axis_statistics(report.models, model, mode, axis, over)['rmse']):>5}"
                for axis in REPORTED_AXES) if mode in report.models[model] else "" for mode in forecast_modes]
            count = str(report.models[model]["hindsight"]["n_starts"])
            table.add_row(Text("" if number else report.name), Text(model, style=MODEL_COLOUR.get(model, "")), count,
                          *cells, *(forecasts if is_wide else []))
        table.add_section()
    return table


def make_latex_table(reports: Sequence[Any], over: str, note: str) -> str:
    """LaTeX table in the layout of the paper, for the packages booktabs and multirow. note: end of the caption."""
    models = list(next((r.models for r in reports), {}))
    legend = ", ".join(f"m$_{{{k + 1}}}$ {_escape_tex(model)}" for k, model in enumerate(models))
    lines = [
        r"\begin{table}[t]", r"\centering",
        rf"\caption{{Mean error, maximum absolute error and RMSE over {OVER_LABELS[over]}; {legend}. "
        rf"Bold: lowest magnitude. {_escape_tex(note)}}}",
        r"\begin{tabular}{cccc}",
        r"& & \multicolumn{2}{c}{\textbf{Error (mean $\mid$ max $\mid$ RMSE) [m]}} \\", r"\cmidrule(lr){3-4}",
        r"& & \textbf{Longitudinal} & \textbf{Lateral} \\",
    ]

    def format_triple(report: Any, model: str, axis: str) -> str:
        statistics = list_statistics(report.models, model, axis, over)
        parts = [rf"\mathbf{{{text}}}" if is_best else text for text, is_best in statistics]
        sign = "" if statistics[0][0].startswith("-") else r"\phantom{-}"  # only a mean may be negative
        return "$" + sign + r" \mid ".join(parts) + "$"

    for report in reports:
        lines.append(r"\midrule")
        for k, model in enumerate(report.models):
            head = rf"\multirow[c]{{{len(models)}}}{{*}}{{{_escape_tex(report.name)}}} " if k == 0 else ""
            cells = " & ".join(format_triple(report, model, axis) for axis in REPORTED_AXES)
            lines.append(rf"{head}& m$_{{{k + 1}}}$ & {cells} \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", r"\end{table}", ""])


def _escape_tex(text: str) -> str:
    special = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
    return "".join(special.get(c, "\\" + c if c in "&%$#_{}" else c) for c in text)


def write_csv(file: Path, rows: Iterator[Entry]) -> None:
    """Write rows that have the same keys; numbers are not rounded, and None is written as an empty cell."""
    with file.open("w", newline="") as stream:
        writer = csv.writer(stream)
        for number, row in enumerate(rows):
            writer.writerows([row, row.values()] if not number else [row.values()])


def make_csv_rows(reports: Sequence[Any]) -> dict[str, Iterator[Entry]]:
    """Rows of each CSV file by its name: errors by run, model and mode, overall and by second, bin and drive part."""
    bins = (({"run": r.name, "quantity": e["quantity"], "bin": e["label"], "low": e["low"], "high": e["high"]},
             e["models"]) for r in reports for e in r.bins)
    parts = (({"run": r.name, "manoeuvre": e["name"], "start_s": round(e["start"], 3),
               "end_s": round(e["end"], 3), "heading_change_deg": round(e["heading_change_deg"], 2)}, e["models"])
             for r in reports for e in r.manoeuvres)
    return {
        "table": (row for r in reports for row in _make_model_rows({"run": r.name}, r.models)),
        "seconds": ({"run": r.name, "model": model, "mode": mode, "horizon_s": second, **_flatten_statistics(entry)}
                    for r in reports for model, modes in r.seconds_ahead.items() for mode, seconds in modes.items()
                    for second, entry in seconds.items()),
        "bins": (row for head, models in bins for row in _make_model_rows(head, models)),
        "manoeuvres": (row for head, models in parts for row in _make_model_rows(head, models))}


def _make_model_rows(head: Entry, models: Models) -> Iterator[Entry]:
    for model, modes in models.items():
        for mode, entry in modes.items():
            yield {**head, "model": model, "mode": mode, "n_starts": entry["n_starts"],
                   "n_incomplete": entry["n_incomplete"], **_flatten_statistics(entry),
                   **{f"samples_{key}": value for key, value in _flatten_statistics(entry["samples"]).items()}}


def _flatten_statistics(entry: Mapping[str, Any]) -> Entry:
    units = {"longitudinal": "m", "lateral": "m", "yaw": "rad"}
    return {f"{axis}_{kind}_{units[axis]}": entry[axis][kind] for axis in AXES for kind in STATISTICS}
