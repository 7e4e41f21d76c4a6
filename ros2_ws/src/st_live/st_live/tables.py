"""The error table as the paper prints it: mean | max | RMSE, the smallest of each column and mode in bold."""

from typing import Any

from rich.table import Table
from rich.text import Text
from st_core.palette import MODEL_COLOUR

STATISTICS = ("mean", "max", "rmse")


def error_table(summary: dict[str, Any], title: str) -> Table:
    """summary: as in summary.json; errors in m over the horizon means."""
    table = Table(title=title, title_justify="left", title_style="bold", box=None, padding=(0, 1))
    table.add_column("mode", no_wrap=True)
    table.add_column("model", no_wrap=True)
    table.add_column("starts", justify="right", no_wrap=True)
    table.add_column("longitudinal, m\nmean | max | RMSE", justify="right", no_wrap=True)
    table.add_column("lateral, m\nmean | max | RMSE", justify="right", no_wrap=True)
    models = summary["models"]
    for mode in ("hindsight", "forecast"):
        for model, modes in models.items():
            row = modes[mode]
            cells = [_cell(models, mode, axis, row) for axis in ("longitudinal", "lateral")]
            table.add_row(mode, Text(model, style=MODEL_COLOUR.get(model, "")), str(row["n_starts"]), *cells)
        table.add_section()
    return table


def _cell(models: dict[str, Any], mode: str, axis: str, row: dict[str, Any]) -> Text:
    text = Text()
    for i, statistic in enumerate(STATISTICS):
        value = row[axis][statistic]
        if value is None:
            text.append(" | -" if i else "-")
            continue
        others = [m[mode][axis][statistic] for m in models.values()]
        best = abs(value) <= min(abs(v) for v in others if v is not None) + 5e-4
        text.append(" | " if i else "")
        text.append(f"{value:.3f}", style="bold" if best else "")
    return text


def finding(summary: dict[str, Any]) -> str:
    """One sentence for a title: the lateral RMSE in hindsight, best model first."""
    lateral = {m: v["hindsight"]["lateral"]["rmse"] for m, v in summary["models"].items()}
    known = sorted((value, model) for model, value in lateral.items() if value is not None)
    if not known:
        return "no complete horizon"
    return "in hindsight, lateral RMSE " + ", ".join(f"{model} {value:.2f} m" for value, model in known)
