"""Comparison of the estimates of several runs: a sensor fault is consistent, an effect of place or load varies."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.stats import binom, chi2

from ..regression import Z95, count_decimals, random_effects, symmetric_interval
from .finding import DriveCheck, neutral_value

MIN_COMPARED_RUNS = 3  # minimum number of runs with an estimate of a quantity for a comparison
CONFIDENCE = 0.95  # confidence level of the tests of consistency
PROJECTION_FINDINGS = ("x_scale", "y_scale", "position_scale", "map_shear")  # may be due to a wrong projection
MAX_RELATIVE_SPREAD = 0.25  # largest standard deviation between consistent runs, divided by |mean - neutral value|


@dataclass(frozen=True)
class RunComparison:
    """Comparison of one quantity [unit] between several runs."""

    name: str
    unit: str
    runs: int  # number of runs with an estimate
    reported: int  # number of runs with this finding
    mean: float  # by random effects (DerSimonian and Laird 1986)
    interval: tuple[float, float]  # 95 % interval of the mean, including the variance between runs
    between: float  # standard deviation between runs in excess of their uncertainties
    lowest: float  # lowest estimate of a run
    highest: float  # highest estimate of a run
    consistent: bool  # few intervals exclude the mean, and the spread is insignificant or below MAX_RELATIVE_SPREAD

    @property
    def text(self) -> str:
        """Sentence on the consistency of the runs."""
        half = 0.5 * (self.interval[1] - self.interval[0])
        digits = count_decimals(half)
        unit = "" if self.unit == "1" else f" {self.unit.replace('^2', '²')}"
        if self.consistent:
            return (f"{self.name} is consistent across all {self.runs} runs, "
                    f"{self.mean:.{digits}f} ± {half:.{digits}f}{unit}: the cause is the sensor, its mounting, "
                    f"{'the projection, ' if self.name in PROJECTION_FINDINGS else ''}the car or its vehicle file")
        return (f"{self.name} differs significantly between the {self.runs} runs, "
                f"{self.lowest:.{digits}f} to {self.highest:.{digits}f}{unit}: it depends on place, load or day, or "
                "some of the runs are faulty")

    def as_dict(self) -> dict[str, Any]:
        """The entry of this quantity in check.json."""
        return {**asdict(self), "text": self.text}


def compare_runs(runs: Sequence[DriveCheck]) -> list[RunComparison]:
    """Comparisons of the quantities that have a finding and estimates from at least MIN_COMPARED_RUNS runs, most often
    reported first; consistent quantities are left out if the interval of the mean contains the neutral value."""
    units = {finding.name: finding.unit for run in runs for finding in run.findings if finding.interval is not None}
    comparisons = []
    for name, unit in units.items():
        rows = _select_finite([run.estimates[name] for run in runs if name in run.estimates])
        if len(rows) < MIN_COMPARED_RUNS:
            continue
        reported = sum(any(finding.name == name for finding in run.findings) for run in runs)
        mean, interval, between, cochran_q = _random_effects(rows)
        exclusions = int(((rows[:, 1] > mean) | (rows[:, 2] < mean)).sum())  # intervals that exclude the mean
        is_homogeneous = cochran_q <= chi2.ppf(CONFIDENCE, len(rows) - 1)
        is_similar = between < MAX_RELATIVE_SPREAD * abs(mean - neutral_value(name))
        consistent = exclusions <= binom.ppf(CONFIDENCE, len(rows), 0.05) and (is_homogeneous or is_similar)
        if not consistent or not interval[0] <= neutral_value(name) <= interval[1]:
            comparisons.append(RunComparison(name, unit, len(rows), reported, mean, interval, between,
                                             float(rows[:, 0].min()), float(rows[:, 0].max()), bool(consistent)))
    return sorted(comparisons, key=lambda comparison: -comparison.reported)


def pool_estimates(runs: Sequence[Mapping[str, Sequence[float]]]) -> dict[str, tuple[float, float, float]]:
    """Estimate (value, ends of its 95 % interval) of each quantity, pooled over the runs by random effects. Quantities
    that only one of several runs determines are left out: nothing shows that the other runs have the same value."""
    result = {}
    for name in dict.fromkeys(name for run in runs for name in run):
        rows = _select_finite([run[name] for run in runs if name in run])
        if len(rows) > 1:
            mean, (low, high), _, _ = _random_effects(rows)
            result[name] = mean, low, high
        elif len(rows) and len(runs) == 1:
            result[name] = tuple(rows[0].tolist())
    return result


def _select_finite(estimates: Sequence[Sequence[float]]) -> np.ndarray:
    """Rows (n, 3) of the estimates (value, low, high) with a finite interval; the others contain no information."""
    rows = np.array(estimates, float).reshape(-1, 3)
    return rows[np.isfinite(rows).all(axis=1)]


def _random_effects(rows: np.ndarray) -> tuple[float, tuple[float, float], float, float]:
    """(mean, its 95 % interval, standard deviation between rows, Cochran's Q) of rows (value, low, high)."""
    standard_errors = np.maximum((rows[:, 2] - rows[:, 1]) / (2.0 * Z95), 1e-12)
    mean, mean_error, between, cochran_q = random_effects(rows[:, 0], np.square(standard_errors))
    return mean, symmetric_interval(mean, mean_error, max(len(rows) - 1, 1)), float(np.sqrt(between)), cochran_q
