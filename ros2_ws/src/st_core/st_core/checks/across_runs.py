"""One quantity over several runs: consistent for a fault of the sensor, varying for an influence of the place."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.stats import binom, chi2

from ..regression import random_effects, symmetric_interval
from .finding import Checked

FEWEST = 3  # runs
SURE = 0.95
ALIKE = 0.25  # part of the mean by which runs may differ and still be called alike


@dataclass(frozen=True)
class AcrossRuns:
    """mean, interval: over the runs, between-run variance included (random effects, DerSimonian and Laird 1986), in
    `unit`. between: standard deviation between runs beyond their own intervals. reported: runs in which it is a
    finding.
    """

    name: str
    unit: str
    runs: int
    reported: int
    mean: float
    interval: tuple[float, float]
    between: float
    lowest: float
    highest: float
    alike: bool

    @property
    def text(self) -> str:
        half = 0.5 * (self.interval[1] - self.interval[0])
        digits = max(1 - math.floor(math.log10(max(half, 1e-9))), 0)
        unit = "" if self.unit == "1" else f" {self.unit}"
        if self.alike:
            return (f"{self.name} is consistent across all {self.runs} runs, {self.mean:.{digits}f} ± {half:.{digits}f}"
                    f"{unit}: it belongs to the sensor, its mounting, the projection or the car, and is reliable")
        return (f"{self.name} differs between the {self.runs} runs by more than their intervals allow, "
                f"{self.lowest:.{digits}f} to {self.highest:.{digits}f}{unit}: part of it belongs to the place, the "
                "load or the day, or to a fault of some of the runs")

    def as_dict(self) -> dict[str, Any]:
        values = asdict(self)
        return {**values, "told": values.pop("reported"), "text": self.text}


def across_runs(runs: Sequence[Checked]) -> list[AcrossRuns]:
    """Every quantity that is a finding in one run at least and was measured in FEWEST, the most frequent first."""
    units = {one.name: one.unit for run in runs for one in run.findings if one.interval is not None}
    found = []
    for name, unit in units.items():
        rows = np.array([run.estimates[name] for run in runs if name in run.estimates])
        if len(rows) < FEWEST:
            continue
        reported = sum(any(one.name == name for one in run.findings) for run in runs)
        mean, interval, between, excess = _random_effects(rows)
        missed = int(((rows[:, 1] > mean) | (rows[:, 2] < mean)).sum())
        alike = missed <= binom.ppf(SURE, len(rows), 0.05) and (
            excess <= chi2.ppf(SURE, len(rows) - 1) or between < ALIKE * abs(mean - null_of(name)))
        one = AcrossRuns(name, unit, len(rows), reported, mean, interval, between, float(rows[:, 0].min()),
                         float(rows[:, 0].max()), bool(alike))
        if not one.alike or not one.interval[0] <= null_of(name) <= one.interval[1]:
            found.append(one)
    return sorted(found, key=lambda one: -one.reported)


def pooled(runs: Sequence[Mapping[str, Sequence[float]]]) -> dict[str, tuple[float, float, float]]:
    """Estimates (value, low, high) of several runs as one, random effects; of a quantity one run has, as they are."""
    found = {}
    for name in dict.fromkeys(name for run in runs for name in run):
        rows = np.array([run[name] for run in runs if name in run], float)
        mean, interval, _, _ = _random_effects(rows)
        found[name] = (mean, *interval) if len(rows) > 1 else tuple(rows[0].tolist())
    return found


def null_of(name: str) -> float:
    """Value of a quantity that is in order."""
    return 1.0 if name.endswith("_scale") or name == "steering_sign" else 0.0


def _random_effects(rows: np.ndarray) -> tuple[float, tuple[float, float], float, float]:
    """(mean, its interval, standard deviation between rows, Cochran's Q) of rows (value, low, high)."""
    deviation = np.maximum((rows[:, 2] - rows[:, 1]) / (2 * 1.96), 1e-12)
    mean, error, between, excess = random_effects(rows[:, 0], np.square(deviation))
    return mean, symmetric_interval(mean, error, max(len(rows) - 1, 1)), float(np.sqrt(between)), excess
