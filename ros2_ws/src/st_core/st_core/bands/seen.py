"""Which conditions a band was calibrated under; elsewhere there is none, rather than a wrong one."""

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..binning import LATERAL_ACCELERATION, SPEED
from .conditions import CONDITIONS, UNITS

FEWEST_STARTS = 10
"""Of a run in a cell of speed and lateral acceleration: one second of driving."""
FEWEST_RUNS = 2
"""With so many starts in a cell: how much runs differ there cannot be told from one, whatever the number of starts."""
CELLED = {CONDITIONS.index("speed"): SPEED, CONDITIONS.index("lateral_acceleration"): LATERAL_ACCELERATION}
"""Edges by column of the conditions."""


def cells(conditions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Row and column (n,) of conditions (n, 4): numbers of their bins of speed and lateral acceleration."""
    row, column = (np.searchsorted(edges, conditions[:, k], side="right") - 1 for k, edges in CELLED.items())
    return row, column


@dataclass(frozen=True, eq=False)
class Seen:
    """starts: (speed bins, lateral acceleration bins), how many were calibrated with; 0 where fewer than FEWEST_RUNS
    runs had FEWEST_STARTS. most: the largest forward_acceleration [m/s^2] and steering_activity [rad/s] among them."""

    starts: np.ndarray
    most: tuple[float, float]

    @classmethod
    def of(cls, conditions: Sequence[np.ndarray]) -> "Seen":
        """What conditions (n, 4), one array a run, have seen."""
        starts = np.zeros((len(conditions), *(len(edges) for edges in CELLED.values())), int)
        for one, of_run in zip(conditions, starts, strict=True):
            np.add.at(of_run, cells(one), 1)
        enough = (starts >= FEWEST_STARTS).sum(axis=0) >= FEWEST_RUNS
        rows = np.concatenate(conditions)
        return cls(np.where(enough, starts.sum(axis=0), 0), (float(rows[:, 2].max()), float(rows[:, 3].max())))

    def __call__(self, conditions: np.ndarray) -> np.ndarray:
        """(n,) bool: whether conditions (n, 4) were calibrated; False where one is not known."""
        known = np.isfinite(conditions).all(axis=1)
        rows = np.where(known[:, None], conditions, 0.0)
        return known & (self.starts[cells(rows)] > 0) & (rows[:, 2:] <= self.most).all(axis=1)

    def one(self, condition: Sequence[float]) -> bool:
        """Whether one start's conditions, four numbers, were calibrated; False where one is not known."""
        if not all(map(math.isfinite, condition)):
            return False
        row, column = (bisect_right(edges, condition[k]) - 1 for k, edges in CELLED.items())
        return bool(self.starts[row, column] > 0) and condition[2] <= self.most[0] and condition[3] <= self.most[1]

    def why_not(self, condition: Sequence[float]) -> str:
        """For conditions, four numbers, without a band: why, in one line; empty where there is one."""
        if self.one(condition):
            return ""
        for name, value in zip(CONDITIONS, condition, strict=True):
            if not np.isfinite(value):
                return f"{name.replace('_', ' ')} not known"
        for name, value, most in zip(CONDITIONS[2:], condition[2:], self.most, strict=True):
            if value > most:
                return f"{name.replace('_', ' ')} {value:.3g} {UNITS[name]}, calibrated up to {most:.3g}"
        return (f"{condition[0]:.1f} m/s with {condition[1]:.1f} m/s^2 across was calibrated by fewer than "
                f"{FEWEST_RUNS} runs")
