"""The terminal: progress, running error table and health during a run, and the error table at its end."""

import math
import time
from typing import Any

from rich.console import Group, RenderableType
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text
from st_core.palette import MODEL_COLOUR
from st_recordings.results import band_lines

from .node import SuiteState

LEVELS = ("ok", "warning", "error", "stale")
STATISTICS = ("mean", "max", "rmse")


def progress_view(state: SuiteState, elapsed: float, duration: float | None, title: str) -> RenderableType:
    """The screen during a run. elapsed, duration in s; duration None: until stopped."""
    line = Table.grid(padding=(0, 1))
    if duration:
        bar = ProgressBar(total=duration, completed=min(elapsed, duration), width=40)
        line.add_row(title, bar, f"{elapsed:4.0f} / {duration:.0f} s")
    else:
        line.add_row(title, f"{elapsed:4.0f} s", "(Ctrl-C ends it)")
    return Group(line, motion(state), running_errors(state), *bands(state), ticks(state), health(state))


def motion(state: SuiteState) -> Text:
    """Motion of the car at the start of the newest prediction."""
    p = state.prediction
    if p is None or not len(p.velocity_x):
        return Text("no prediction yet", style="dim")
    side = "left" if p.road_wheel_angle > 0 else "right"
    return Text(f"{p.velocity_x[0]:.1f} m/s, wheels {abs(math.degrees(p.road_wheel_angle)):.1f} deg {side}, "
                f"v_x r {p.velocity_x[0] * p.yaw_rate[0]:+.1f} m/s², {p.model} took {p.compute_time * 1e3:.1f} ms")


def running_errors(state: SuiteState) -> RenderableType:
    """Mean | max | RMSE over the horizon means so far, one row per model and mode."""
    statistics = state.summary.statistics if state.summary else []
    if not any(s.n_starts for s in statistics):
        return Text("waiting for the first complete horizon", style="dim")
    table = Table(box=None, padding=(0, 1))
    for column in ("model", "mode", "starts", "longitudinal, m\nmean | max | RMSE", "lateral, m\nmean | max | RMSE"):
        table.add_column(column, justify="left" if column in ("model", "mode") else "right", no_wrap=True)
    for s in statistics:
        table.add_row(
            Text(s.model, style=MODEL_COLOUR.get(s.model, "")),
            s.mode,
            str(s.n_starts),
            _triple(s.longitudinal_mean, s.longitudinal_max, s.longitudinal_rmse),
            _triple(s.lateral_mean, s.lateral_max, s.lateral_rmse),
        )
    return table


def bands(state: SuiteState) -> list[Text]:
    """Coverage of the published bands; empty without bands."""
    return [Text(line) for line in band_lines(state.summary.statistics if state.summary else [])]


def ticks(state: SuiteState) -> Text:
    t = state.ticks
    if t is None:
        return Text("predictor: no status yet", style="dim")
    skipped = t.skipped_stale + t.skipped_overrun + t.skipped_slow
    text = Text(f"ticks {t.due}, predicted {t.predicted}, skipped {skipped}")
    if t.state_age > 0.0:
        text.append(f", from a state {t.state_age * 1e3:.0f} ms old")
    if t.reason:
        text.append(f"  ({t.reason})", style="yellow")
    return text


def health(state: SuiteState) -> Text:
    """Every status that is not ok, worst first; one line when all are."""
    now = time.monotonic()
    text = Text()
    for status in sorted(state.health.values(), key=lambda s: (-s.level, s.name)):
        silent = status.is_silent(now)
        if status.level == 0 and not silent:
            continue
        level = "silent" if silent else LEVELS[min(status.level, 3)]
        style = "red" if status.level >= 2 or silent else "yellow"
        text.append(f"{level}: {status.name}: {status.message}\n", style=style)
    return text if text else Text("all nodes OK" if state.health else "", style="green")


def _triple(*values: float) -> str:
    return " | ".join("-" if math.isnan(v) else f"{v:5.2f}" for v in values)


def error_table(summary: dict[str, Any], title: str) -> Table:
    """Mean | max | RMSE as in the paper, the smallest of each column and mode in bold.

    summary: as in summary.json; errors in m over the horizon means.
    """
    table = Table(title=title, title_justify="left", title_style="bold", box=None, padding=(0, 1))
    table.add_column("mode", no_wrap=True)
    table.add_column("model", no_wrap=True)
    table.add_column("starts", justify="right", no_wrap=True)
    table.add_column("longitudinal, m\nmean | max | RMSE", justify="right", no_wrap=True)
    table.add_column("lateral, m\nmean | max | RMSE", justify="right", no_wrap=True)
    models = summary["models"]
    for mode in ("hindsight", "forecast", "course", "plan"):
        for model, modes in models.items():
            if mode not in modes:
                continue
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
        others = [m[mode][axis][statistic] for m in models.values() if mode in m]
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
