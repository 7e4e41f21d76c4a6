"""The terminal during a run: a progress line, the running error table, and what is wrong at the moment."""

import math
import time

from rich.console import Group, RenderableType
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text
from st_core.palette import MODEL_COLOUR
from st_recordings.counted import lines

from .node import Heard

LEVELS = ("ok", "warning", "error", "stale")


def view(heard: Heard, elapsed: float, duration: float | None, title: str) -> RenderableType:
    """elapsed, duration in s; duration None: runs until stopped."""
    line = Table.grid(padding=(0, 1))
    if duration:
        line.add_row(
            title,
            ProgressBar(total=duration, completed=min(elapsed, duration), width=40),
            f"{elapsed:4.0f} / {duration:.0f} s",
        )
    else:
        line.add_row(title, f"{elapsed:4.0f} s", "(Ctrl-C ends it)")
    return Group(line, motion(heard), error_table(heard), *bands(heard), ticks(heard), health(heard))


def motion(heard: Heard) -> Text:
    """What the car does, as the newest prediction found it."""
    p = heard.prediction
    if p is None or not len(p.velocity_x):
        return Text("no prediction yet", style="dim")
    side = "left" if p.road_wheel_angle > 0 else "right"
    return Text(f"{p.velocity_x[0]:.1f} m/s, wheels {abs(math.degrees(p.road_wheel_angle)):.1f} deg {side}, "
                f"v_x r {p.velocity_x[0] * p.yaw_rate[0]:+.1f} m/s², {p.model} took {p.compute_time * 1e3:.1f} ms")


def error_table(heard: Heard) -> RenderableType:
    """Mean | max | RMSE over the horizon means so far, one row per model and mode."""
    statistics = heard.summary.statistics if heard.summary else []
    if not any(s.n_starts for s in statistics):
        return Text("waiting for the first complete horizon", style="dim")
    table = Table(box=None, padding=(0, 1))
    for column in (
        "model",
        "mode",
        "starts",
        "longitudinal, m\nmean | max | RMSE",
        "lateral, m\nmean | max | RMSE",
    ):
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


def bands(heard: Heard) -> list[Text]:
    """How often published bands held, where there are some."""
    return [Text(line) for line in lines(heard.summary.statistics if heard.summary else [])]


def ticks(heard: Heard) -> Text:
    t = heard.ticks
    if t is None:
        return Text("predictor: not heard yet", style="dim")
    skipped = t.skipped_stale + t.skipped_overrun + t.skipped_slow
    text = Text(f"ticks {t.due}, predicted {t.predicted}, skipped {skipped}")
    if t.state_age > 0.0:
        text.append(f", from a state {t.state_age * 1e3:.0f} ms old")
    if t.reason:
        text.append(f"  ({t.reason})", style="yellow")
    return text


def health(heard: Heard) -> Text:
    """Everything that is not ok, worst first; one word when all is well."""
    now = time.monotonic()
    text = Text()
    for status in sorted(heard.health.values(), key=lambda s: (-s.level, s.name)):
        silent = status.is_silent(now)
        if status.level == 0 and not silent:
            continue
        level = "silent" if silent else LEVELS[min(status.level, 3)]
        text.append(
            f"{level}: {status.name}: {status.message}\n", style="red" if status.level >= 2 or silent else "yellow"
        )
    return text if text else Text("all nodes well" if heard.health else "", style="green")


def _triple(*values: float) -> str:
    return " | ".join("-" if math.isnan(v) else f"{v:5.2f}" for v in values)
