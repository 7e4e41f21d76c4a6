"""The running table and what is not well, as Markdown for the page."""

import math
from collections.abc import Sequence
from typing import Protocol

from ..bands import counted


class Row(counted.Row, Protocol):
    """One model and mode of st_msgs/ErrorSummary."""

    n_starts: int
    longitudinal_rmse: float
    lateral_rmse: float


LEVELS = ("ok", "warning", "**error**", "stale")


def page(rows: Sequence[Row], ticks: str, health: Sequence[tuple[int, str, str]]) -> str:
    """rows: statistics so far. ticks: one line. health: (level, name, message) of everything that was heard."""
    lines = ["| model | inputs | starts | RMSE long., m | lat., m |", "|---|---|--:|--:|--:|"]
    for mode, meaning in (("forecast", "held"), ("hindsight", "measured")):
        for row in (r for r in rows if r.mode == mode and r.n_starts):
            errors = (row.longitudinal_rmse, row.lateral_rmse)
            numbers = " | ".join("-" if math.isnan(e) else f"{e:.2f}" for e in errors)
            lines.append(f"| {row.model} | {meaning} | {row.n_starts} | {numbers} |")
    if len(lines) == 2:
        lines = ["Waiting for the first complete horizon."]
    lines += ["", *(f"- {line}" for line in counted.lines(rows)), "", ticks, ""]
    wrong = [entry for entry in health if entry[0] > 0]
    lines += [f"- {LEVELS[min(level, 3)]}: {name}: {message}" for level, name, message in sorted(wrong, reverse=True)]
    if health and not wrong:
        lines.append("All nodes well.")
    return "\n".join(lines)

