"""How often published bands held, as the evaluator counted: one line a question, for the terminal and the end of a run.
"""

import math
from collections import deque
from collections.abc import Sequence
from typing import Any, Protocol

from .runs.bag import definitions
from .runs.bag_storage import Storage
from .runs.cdr import typestore

SUMMARY, TYPE = "/evaluator/summary", "st_msgs/msg/ErrorSummary"
QUESTIONS = {"forecast": "forecast", "hindsight": "model"}


class Row(Protocol):
    """One model and mode of st_msgs/ErrorSummary."""

    model: str
    mode: str
    n_bands: int
    coverage_50: float
    coverage_90: float


def lines(rows: Sequence[Row]) -> list[str]:
    """One line a question; none without a band."""
    found = []
    for mode, question in QUESTIONS.items():
        of_mode = [row for row in rows if row.mode == mode and row.n_bands]
        words = ", ".join(f"{row.model} {_share(row.coverage_90)} | {_share(row.coverage_50)}" for row in of_mode)
        if words:
            found.append(f"inside the 90 | 50 % band, {question}: {words} of {max(row.n_bands for row in of_mode)}")
    return found


def counted(errors: Storage) -> list[Row]:
    """The statistics of the last summary in a bag of scores; none without one."""
    last = deque(errors.messages(SUMMARY), maxlen=1)
    summary: Any = typestore(definitions()).deserialize_cdr(last[0], TYPE) if last else None
    return list(summary.statistics) if last else []


def as_dict(row: Row) -> dict[str, Any]:
    """For summary.json; shares are null where nothing was counted."""
    return {"n": int(row.n_bands)} | {name: None if math.isnan(value) else float(value) for name, value in
                                      (("0.5", row.coverage_50), ("0.9", row.coverage_90))}


def _share(value: float) -> str:
    return "-" if math.isnan(value) else f"{100 * value:.0f} %"
