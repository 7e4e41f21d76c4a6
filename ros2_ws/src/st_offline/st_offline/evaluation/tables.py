"""The error table: in the terminal, as CSV, and as LaTeX in the paper's form."""

import csv
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.table import Table
from rich.text import Text
from st_core.log_evaluation import AXES
from st_core.palette import MODEL_COLOUR

from .statistics import KINDS
from .work import RunReport

DIGITS = 2  # as the paper: centimetres
WIDE = 100  # characters that the table with its last column needs
SHOWN_AXES = ("longitudinal", "lateral")
NOTE = "mean | max | RMSE over {what}, m; bold: smallest magnitude of each run"
WHAT = {"means": "the horizon means", "samples": "all samples of all horizons"}

Models = Mapping[str, Any]  # {model: {mode: entry}}


def values(models: Models, model: str, mode: str, axis: str, over: str) -> Mapping[str, float | None]:
    """{mean, max, rmse} of an entry; over: means or samples."""
    entry = models[model][mode]
    return entry[axis] if over == "means" else entry["samples"][axis]


def best(models: Models, model: str, mode: str, axis: str, kind: str, over: str) -> bool:
    """Whether no model has a smaller magnitude, to the printed digits; several may share the place, as in the paper."""
    sizes = {m: _size(values(models, m, mode, axis, over)[kind]) for m in models}
    known = [s for s in sizes.values() if s is not None]
    return bool(known) and sizes[model] == min(known)


def _size(value: float | None) -> float | None:
    return None if value is None else round(abs(value), DIGITS)


def shown(value: float | None) -> str:
    """To the centimetre, without a negative zero."""
    if value is None:
        return "-"
    return f"{value:.{DIGITS}f}".replace(f"-{0:.{DIGITS}f}", f"{0:.{DIGITS}f}")


def terminal_table(reports: Sequence[RunReport], over: str, title: str, width: int) -> Table:
    """The paper's table (hindsight), and if the terminal is wide enough the RMSE of the forecasts."""
    wide = width >= WIDE
    ahead = list(dict.fromkeys(mode for r in reports for modes in r.models.values() for mode in modes
                               if mode != "hindsight"))
    heading = Text(f"{title}\n{NOTE.format(what=WHAT[over])}", style="bold")
    table = Table(title=heading, title_justify="left", box=None, padding=(0, 1))
    table.add_column("run", overflow="fold")
    table.add_column("model", no_wrap=True)
    table.add_column("starts", justify="right", no_wrap=True)
    for axis in SHOWN_AXES:
        table.add_column(axis, justify="right", no_wrap=True)
    if wide:
        for mode in ahead:
            table.add_column(f"{mode} RMSE\nlon | lat", justify="right", no_wrap=True)
    for report in reports:
        for number, model in enumerate(report.models):
            cells = [_triple(report.models, model, axis, over) for axis in SHOWN_AXES]
            forecasts = [" | ".join(f"{shown(values(report.models, model, mode, axis, over)['rmse']):>5}"
                                    for axis in SHOWN_AXES) if mode in report.models[model] else "" for mode in ahead]
            starts = str(report.models[model]["hindsight"]["n_starts"])
            table.add_row(Text("" if number else report.name), Text(model, style=MODEL_COLOUR.get(model, "")), starts,
                          *cells, *(forecasts if wide else []))
        table.add_section()
    return table


def _triple(models: Models, model: str, axis: str, over: str) -> Text:
    text = Text()
    for i, kind in enumerate(KINDS):
        text.append(" | " if i else "")
        style = "bold" if best(models, model, "hindsight", axis, kind, over) else ""
        text.append(f"{shown(values(models, model, 'hindsight', axis, over)[kind]):>5}", style=style)
    return text


def latex_table(reports: Sequence[RunReport], over: str, what: str) -> str:
    """The table in the paper's form; needs the packages booktabs and multirow.

    what: settings and data, for the caption.
    """
    models = list(next((r.models for r in reports), {}))
    legend = ", ".join(f"m$_{{{k + 1}}}$ {_tex(model)}" for k, model in enumerate(models))
    lines = [
        r"\begin{table}[t]", r"\centering",
        rf"\caption{{Mean error, maximum absolute error and RMSE over {WHAT[over]}; {legend}. "
        rf"Bold: lowest magnitude. {_tex(what)}}}",
        r"\begin{tabular}{cccc}",
        r"& & \multicolumn{2}{c}{\textbf{Error (mean $\mid$ max $\mid$ RMSE) [m]}} \\", r"\cmidrule(lr){3-4}",
        r"& & \textbf{Longitudinal} & \textbf{Lateral} \\",
    ]
    for report in reports:
        lines.append(r"\midrule")
        for k, model in enumerate(report.models):
            head = rf"\multirow[c]{{{len(models)}}}{{*}}{{{_tex(report.name)}}} " if k == 0 else ""
            cells = [_tex_triple(report.models, model, axis, over) for axis in SHOWN_AXES]
            lines.append(rf"{head}& m$_{{{k + 1}}}$ & {' & '.join(cells)} \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", r"\end{table}", ""])


def _tex_triple(models: Models, model: str, axis: str, over: str) -> str:
    parts = []
    for kind in KINDS:
        text = shown(values(models, model, "hindsight", axis, over)[kind])
        bold = rf"\mathbf{{{text}}}" if best(models, model, "hindsight", axis, kind, over) else text
        parts.append(rf"\phantom{{-}}{bold}" if kind == "mean" and not text.startswith("-") else bold)
    return "$" + r" \mid ".join(parts) + "$"


def _tex(text: str) -> str:
    special = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
    return "".join(special.get(c, "\\" + c if c in "&%$#_{}" else c) for c in text)


Row = dict[str, Any]


def write_csv(file: Path, rows: Iterator[Row]) -> None:
    """Rows of equal keys; numbers unrounded, nothing where not known."""
    with file.open("w", newline="") as stream:
        writer: csv.DictWriter | None = None
        for row in rows:
            if writer is None:
                writer = csv.DictWriter(stream, list(row))
                writer.writeheader()
            writer.writerow(row)


def table_rows(reports: Sequence[RunReport]) -> Iterator[Row]:
    """One row for each run, model and mode."""
    for report in reports:
        yield from _model_rows({"run": report.name}, report.models)


def bin_rows(reports: Sequence[RunReport]) -> Iterator[Row]:
    """One row for each run, bin, model and mode."""
    for report in reports:
        for one in report.bins:
            head = {"run": report.name, "quantity": one["quantity"], "bin": one["label"], "low": one["low"],
                    "high": one["high"]}
            yield from _model_rows(head, one["models"])


def manoeuvre_rows(reports: Sequence[RunReport]) -> Iterator[Row]:
    """One row for each part of each drive, model and mode."""
    for report in reports:
        for one in report.manoeuvres:
            head = {"run": report.name, "manoeuvre": one["name"], "start_s": round(one["start"], 3),
                    "end_s": round(one["end"], 3), "heading_change_deg": round(one["heading_change_deg"], 2)}
            yield from _model_rows(head, one["models"])


def second_rows(reports: Sequence[RunReport]) -> Iterator[Row]:
    """One row for each run, model, mode and second of the horizon."""
    for report in reports:
        for model, modes in report.seconds_ahead.items():
            for mode, seconds in modes.items():
                for second, entry in seconds.items():
                    yield {"run": report.name, "model": model, "mode": mode, "horizon_s": second,
                           **_flat(entry)}


def _model_rows(head: Row, models: Models) -> Iterator[Row]:
    for model, modes in models.items():
        for mode, entry in modes.items():
            yield {**head, "model": model, "mode": mode, "n_starts": entry["n_starts"],
                   "n_incomplete": entry["n_incomplete"], **_flat(entry),
                   **{f"samples_{key}": value for key, value in _flat(entry["samples"]).items()}}


def _flat(of: Mapping[str, Any]) -> Row:
    units = {"longitudinal": "m", "lateral": "m", "yaw": "rad"}
    return {f"{axis}_{kind}_{units[axis]}": of[axis][kind] for axis in AXES for kind in KINDS}
