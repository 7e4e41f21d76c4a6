"""One channel against the same quantity from other channels: lag, scale and bias.

    measured(t) = scale derived(t - lag) + bias

The lag is that of `st align` (clock_fit: joint fit of offset and gain behind a common low-pass), scale and bias a
regression at that lag, each with the interval of resampled blocks. A drive that repeats itself fits as well a period
later: of the lags that do not differ significantly the smallest is taken, and the others are named too.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import f as fisher

from ..clock_fit import STEP, Fit, Pair, Resampled, fit, mean_correlation, resample
from ..clock_types import LONGEST_SPAN
from ..regression import symmetric_interval
from .regression import Estimate, Regression

LONGEST = 1.5  # s of lag that is looked for
LEAST = 15.0  # s in common
NOTHING, UNITY = Estimate(0.0, 0.0, (0.0, 0.0)), Estimate(1.0, 0.0, (1.0, 1.0))
LATE = 0.95  # level of the test for a lag
SHIFT = 0.3  # s to both sides of a lag that must fit worse, or the drive carries none
CLEARLY = 1.25  # ratio of residuals, scale over bias, from which a bias is reported instead
CERTAIN = 0.98  # correlation from which on noise makes less than 4 % of a scale
RESAMPLED = 1e-4  # share of the variance; interpolation and filters leave 1 % of a signal, less is ignored
OFF_GRID = 0.1  # share of the variance by which a maximum is lower half a step away, at the cut-offs in use


@dataclass(frozen=True, eq=False)
class Agreement:
    """lag [s], scale [1] and bias [unit], measured against derived. correlation: at that lag. spread: standard
    deviation of the derived quantity. time, measured, derived: the filtered series at that lag, for the eye.
    alike: other lags [s] that fit as well but for chance, because the drive repeats itself. late: whether no lag (the
    usual one) fits significantly worse; a drive that changes slowly carries no lag, whatever the fit returns.
    correlation_now: without a lag. carries_lag: whether other lags fit significantly worse than this one.
    """

    lag: Estimate
    scale: Estimate
    bias: Estimate
    correlation: float
    spread: float
    time: np.ndarray
    measured: np.ndarray
    derived: np.ndarray
    alike: tuple[float, ...] = ()
    late: bool = True
    correlation_now: float = 0.0
    carries_lag: bool = True


def agreement(time: np.ndarray, derived: np.ndarray, measured_time: np.ndarray, measured: np.ndarray, cutoff: float,
              seed: int, derived_is_angle: bool = False, biased: bool = True, usual: float = 0.0) -> Agreement | None:
    """None where they are known together for less than LEAST seconds or do not vary.

    time, measured_time: rising [s]; values NaN where unknown. cutoff [Hz]: of the low-pass on both, so that it shifts
    neither. derived_is_angle: its rate is compared. biased: False where a bias is out of the question.
    usual: lag of a channel that is in order [s].
    """
    if max(float(np.ptp(t)) if len(t) else 0.0 for t in (time, measured_time)) > LONGEST_SPAN:
        return None
    reference = resample(time, derived, cutoff, derived_is_angle)
    other = resample(measured_time, measured, cutoff)
    if min(side.known.sum() for side in (reference, other)) * STEP < LEAST:
        return None
    pair = Pair("", reference, other)
    try:
        solution, *others = _solutions(pair, cutoff)
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
    return Agreement(lag, scale, bias, correlation, float(np.std(derived_there)), at, there, derived_there,
                     tuple(-one.offset for one in others), _is_late(pair, solution.offset, -usual, cutoff),
                     _correlation(pair, 0.0),
                     all(_is_late(pair, solution.offset, solution.offset + by, cutoff) for by in (-SHIFT, SHIFT)))


def _is_late(pair: Pair, offset: float, usual: float, cutoff: float) -> bool:
    """Whether the usual offset leaves significantly more unexplained than the best one (F test, 95 %)."""
    if abs(offset - usual) < 1e-6:
        return False
    (best, other), common = _rest(pair, [offset, usual])
    return other > _chance(common, cutoff, LATE) * best


def _correlation(pair: Pair, offset: float) -> float:
    rows, derived = _at(pair.reference, pair.other, offset)
    values = pair.other.values[rows]
    return float(np.corrcoef(derived, values)[0, 1]) if len(rows) > 2 and np.std(derived) * np.std(values) > 0 else 0.0


def _solutions(pair: Pair, cutoff: float) -> list[Fit]:
    """The best one and all that chance could have made better, the least offset first.

        (1 - r^2) / (1 - r_best^2) <= F(0.975; n, n),   n = 2 cutoff T   independent samples of what is left in T
    """
    curve = mean_correlation([pair], LEAST, (-LONGEST, LONGEST))
    if curve is None or not curve[1].max() > 0.0:
        return [fit([pair], 0.0, 0.0, free_drift=False)]
    lags, left = curve[0], 1.0 - np.maximum(curve[1], 0.0) ** 2
    best = int(np.argmin(left))
    peaks = 1 + np.flatnonzero((left[1:-1] < left[:-2]) & (left[1:-1] <= left[2:]))
    known = min(float(side.known.sum()) for side in (pair.reference, pair.other))
    found: list[Fit] = []
    for start in (best, *peaks[left[peaks] <= _chance(known, cutoff) * left[best] + OFF_GRID]):
        one = fit([pair], float(lags[start]), 0.0, free_drift=False)
        if all(abs(one.offset - other.offset) > STEP for other in found):
            found.append(one)
    if len(found) == 1:
        return found
    rest, common = _rest(pair, [one.offset for one in found])
    alike = [one for one, size in zip(found, rest, strict=True) if size <= _chance(common, cutoff) * min(rest)]
    return sorted(alike, key=lambda one: abs(one.offset))


def _chance(samples: float, cutoff: float, level: float = 0.975) -> float:
    """Ratio that two variances of one size differ by at most, with this probability."""
    freedom = max(2.0 * cutoff * STEP * samples, 1.0)
    return float(fisher.ppf(level, freedom, freedom))


def _rest(pair: Pair, offsets: Sequence[float]) -> tuple[list[float], int]:
    """(1 - r^2 at each offset, samples), over the same samples: the ends of a filtered derivative are its worst."""
    there = [_at(pair.reference, pair.other, offset) for offset in offsets]
    common = np.flatnonzero(np.bincount(np.concatenate([rows for rows, _ in there])) == len(there))
    values = pair.other.values[common]
    r = [float(np.corrcoef(derived[np.isin(rows, common)], values)[0, 1]) for rows, derived in there]
    return [max(1.0 - one**2, RESAMPLED) for one in r], len(common)


def _line(problem: Regression, derived: np.ndarray, correlation: float, biased: bool) -> tuple[Estimate, Estimate]:
    """(scale, bias). On one long bend a factor and a bias look alike, and noise makes the one of the other: then the
    one that explains more is findings, the other taken as right."""
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
