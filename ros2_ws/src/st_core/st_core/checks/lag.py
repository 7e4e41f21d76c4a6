"""One channel against the same quantity from other channels: how late, how large, how far off.

    measured(t) = scale derived(t - lag) + bias

The lag is that of `st align` (clock_fit: joint fit of offset and gain behind a common low-pass), scale and bias a
regression at that lag, each with the interval of resampled blocks.
"""

from dataclasses import dataclass

import numpy as np

from ..clock_correlation import STEP, Resampled, resample
from ..clock_fit import Pair, coarse_offset, fit
from ..clock_types import LONGEST_SPAN
from ..identification.result import symmetric_interval
from .regression import Estimate, Regression

LONGEST = 1.5  # s of lag that is looked for
LEAST = 15.0  # s in common
NOTHING, UNITY = Estimate(0.0, 0.0, (0.0, 0.0)), Estimate(1.0, 0.0, (1.0, 1.0))
CLEARLY = 1.25  # factor by which a bias must leave less than a scale before it is told instead
CERTAIN = 0.98  # correlation from which on noise makes less than 4 % of a scale


@dataclass(frozen=True, eq=False)
class Agreement:
    """lag [s], scale [1] and bias [unit], measured against derived. correlation: at that lag. spread: standard
    deviation of the derived quantity. time, measured, derived: the filtered series at that lag, for the eye.
    """

    lag: Estimate
    scale: Estimate
    bias: Estimate
    correlation: float
    spread: float
    time: np.ndarray
    measured: np.ndarray
    derived: np.ndarray


def agreement(time: np.ndarray, derived: np.ndarray, measured_time: np.ndarray, measured: np.ndarray, cutoff: float,
              seed: int, derived_is_angle: bool = False, biased: bool = True) -> Agreement | None:
    """None where they are known together for less than LEAST seconds or do not vary.

    time, measured_time: rising [s]; values NaN where unknown. cutoff [Hz]: of the low-pass on both, so that it shifts
    neither. derived_is_angle: its rate is compared. biased: False where a bias is out of the question.
    """
    if max(float(np.ptp(t)) if len(t) else 0.0 for t in (time, measured_time)) > LONGEST_SPAN:
        return None
    reference = resample(time, derived, cutoff, derived_is_angle)
    other = resample(measured_time, measured, cutoff)
    if min(side.known.sum() for side in (reference, other)) * STEP < LEAST:
        return None
    pair = Pair("", reference, other)
    try:
        coarse = coarse_offset([pair], LEAST, 0.0, (-LONGEST, LONGEST))
        solution = fit([pair], coarse[0][0] if coarse else 0.0, 0.0, free_drift=False)
    except (ValueError, np.linalg.LinAlgError):
        return None
    if not abs(solution.offset) <= LONGEST:
        return None
    lag = _lag(-solution.offset, solution.offset_deviation, len(reference.time) * STEP)
    rows, derived_there = _at(reference, other, -lag.value)
    if len(rows) * STEP < LEAST or not float(np.std(derived_there)) > 0.0:
        return None
    at, there = other.time[rows], other.values[rows]
    problem = Regression(at, there[:, None], {"scale": derived_there[:, None], "bias": np.ones((len(at), 1))}, seed)
    correlation = float(np.corrcoef(derived_there, there)[0, 1]) if float(np.std(there)) > 0.0 else 0.0
    scale, bias = _line(problem, derived_there, correlation, biased)
    return Agreement(lag, scale, bias, correlation, float(np.std(derived_there)), at, there, derived_there)


def _line(problem: Regression, derived: np.ndarray, correlation: float, biased: bool) -> tuple[Estimate, Estimate]:
    """(scale, bias). On one long bend a factor and a bias look alike, and noise makes the one of the other: then the
    one that explains more is told, the other taken as right."""
    alike = abs(float(derived.mean())) > float(derived.std()) and abs(correlation) < CERTAIN
    if biased and not alike:
        both = problem.estimates(("scale", "bias"))
        return both["scale"], both["bias"]
    scale = problem.estimates(("scale",))["scale"]
    if not biased:
        return scale, NOTHING
    shifted = Regression(problem.time, problem.y - derived[:, None], problem.columns, problem.seed)
    if problem.fit(("scale",))[1] <= CLEARLY * shifted.fit(("bias",))[1]:
        return scale, NOTHING
    return UNITY, shifted.estimates(("bias",))["bias"]


def _lag(value: float, deviation: float, seconds: float) -> Estimate:
    low, high = symmetric_interval(value, deviation, max(seconds / 10.0 - 1.0, 1.0))
    return Estimate(value, deviation, (low, high))


def _at(reference: Resampled, other: Resampled, offset: float) -> tuple[np.ndarray, np.ndarray]:
    """(rows of `other` known on both sides, `reference` there)."""
    place = (other.time + offset - reference.origin) / STEP
    index = np.clip(np.floor(place).astype(np.int64), 0, max(len(reference.values) - 2, 0))
    inside = (place >= 0) & (place <= len(reference.values) - 1) & other.known
    inside &= reference.known[index] & reference.known[np.minimum(index + 1, len(reference.known) - 1)]
    rows = np.flatnonzero(inside)
    return rows, np.interp(other.time[rows] + offset, reference.time, reference.values)
