"""Lag, scale and bias of a measured quantity relative to the same quantity derived from other channels."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import f as fisher

from ..clock_fit import STEP, Fit, Pair, fit, mean_correlation, resample, select_common_samples
from ..clock_types import MAX_SPAN
from ..regression import symmetric_interval
from .finding import LIMITS
from .motion import correlate
from .regression import Estimate, Regression

MAX_LAG = 1.5  # s, in both directions
MIN_COMMON_TIME = 15.0  # s
NO_BIAS, UNIT_SCALE = Estimate(0.0, 0.0, 0.0), Estimate(1.0, 0.0, 0.0)
LAG_TEST_LEVEL = 0.95
LAG_TEST_SHIFT = 0.3  # s; a drive determines a lag if lags smaller and larger by this both fit worse
BIAS_RESIDUAL_RATIO = 1.25  # ratio of the residuals with a scale and with a bias above which a bias is reported
MIN_SCALE_CORRELATION = 0.98  # at a higher correlation, noise reduces a scale by less than 4 %
MIN_RESIDUAL_SHARE = 1e-4  # fraction of the variance; interpolation and filters cause a residual of 1 % of a signal
GRID_ERROR = 0.1  # fraction of the variance by which the residual at a lag of the grid exceeds a minimum beside it
DECORRELATION_TIME = 10.0  # s between independent values of the lag


@dataclass(frozen=True, eq=False)
class Agreement:
    """Lag [s], scale [1] and bias [unit] of a measured quantity relative to a derived one."""

    lag: Estimate
    scale: Estimate
    bias: Estimate
    correlation: float  # at this lag
    spread: float  # standard deviation of the derived quantity [unit]
    time: np.ndarray  # (n,) of the filtered series at this lag, for a figure [s]
    measured: np.ndarray  # (n,) [unit]
    derived: np.ndarray  # (n,) [unit]
    other_lags: tuple[float, ...] = ()  # lags [s] that fit equally well, because the motion is periodic
    expected_lag_rejected: bool = True  # whether the lag expected without a fault fits significantly worse
    correlation_without_lag: float = 0.0  # at zero lag
    determines_lag: bool = True  # whether lags that differ by LAG_TEST_SHIFT fit significantly worse

    @property
    def correlates(self) -> bool:
        """Whether the correlation, of either sign, is high enough to compare the two."""
        return abs(self.correlation) >= LIMITS.min_correlation

    @property
    def has_lag(self) -> bool:
        """Whether the lag is significant, and fits significantly better than the lag expected without a fault."""
        return self.lag.significant and self.expected_lag_rejected


def compare_series(time: np.ndarray, derived: np.ndarray, measured_time: np.ndarray, measured: np.ndarray,
                   cutoff: float, *, derived_is_angle: bool = False, fit_bias: bool = True,
                   expected_lag: float = 0.0, max_fitted_lag: float = MAX_LAG) -> Agreement | None:
    """Agreement of two estimates of a quantity. None if `derived` is constant, if they overlap by less than
    MIN_COMMON_TIME, if one of them spans more than MAX_SPAN, or if |lag| exceeds max_fitted_lag.

    time, measured_time: ascending [s]; values NaN where unknown. cutoff: of the low-pass filter [Hz]. derived_is_angle:
    whether to compare the rate of `derived`. expected_lag: lag without a fault [s]. max_fitted_lag: limit of the result
    of the fit [s], which may be outside the searched range.
    """
    if max(float(np.ptp(t)) if len(t) else 0.0 for t in (time, measured_time)) > MAX_SPAN:
        return None
    reference = resample(time, derived, cutoff, derived_is_angle)
    other = resample(measured_time, measured, cutoff)
    if min(side.known.sum() for side in (reference, other)) * STEP < MIN_COMMON_TIME:
        return None
    pair = Pair("", reference, other)
    try:
        solution, *others = _find_best_offsets(pair, cutoff)
    except (ValueError, np.linalg.LinAlgError):
        return None
    if not abs(solution.offset) <= max_fitted_lag:
        return None
    degrees_of_freedom = max(len(reference.time) * STEP / DECORRELATION_TIME - 1.0, 1.0)
    _, half_width = symmetric_interval(0.0, solution.offset_deviation, degrees_of_freedom)
    lag = Estimate(-solution.offset, solution.offset_deviation, half_width)
    rows, x = _select_common_samples(pair, solution.offset)
    if len(rows) * STEP < MIN_COMMON_TIME or not float(np.std(x)) > 0.0:
        return None
    common_time, y = other.time[rows], other.values[rows]
    problem = Regression(common_time, y[:, None], {"scale": x[:, None], "bias": np.ones((len(rows), 1))})
    correlation = correlate(x, y)
    scale, bias = _fit_line(problem, x, correlation, fit_bias)
    neighbours = solution.offset - LAG_TEST_SHIFT, solution.offset + LAG_TEST_SHIFT
    rows, unshifted = _select_common_samples(pair, 0.0)
    return Agreement(lag, scale, bias, correlation, float(np.std(x)), common_time, y, x,
                     tuple(-alternative.offset for alternative in others),
                     _fits_worse(pair, -expected_lag, solution.offset, cutoff),
                     correlate(unshifted, other.values[rows]),
                     all(_fits_worse(pair, offset, solution.offset, cutoff) for offset in neighbours))


def _fits_worse(pair: Pair, offset: float, best_offset: float, cutoff: float) -> bool:
    """Whether the residual with an offset is significantly larger than with the best offset (F test, 95 %)."""
    (smallest, residual), common = _compute_residual_shares(pair, [best_offset, offset])
    return residual > _compute_f_limit(common, cutoff, LAG_TEST_LEVEL) * smallest


def _find_best_offsets(pair: Pair, cutoff: float) -> list[Fit]:
    """Fits of the best offset and of all offsets that are not significantly worse, the smallest first.

        (1 - r^2) / (1 - r_best^2) <= F(0.975; n, n),   n = 2 cutoff T: independent samples of the residual in time T
    """
    lags, correlation = mean_correlation([pair], MIN_COMMON_TIME, (-MAX_LAG, MAX_LAG)) or (np.zeros(0), np.zeros(0))
    if not correlation.max(initial=0.0) > 0.0:
        return [fit([pair], offset=0.0, middle=0.0, free_drift=False)]
    residual = 1.0 - np.maximum(correlation, 0.0) ** 2
    best = int(np.argmin(residual))
    peaks = 1 + np.flatnonzero((residual[1:-1] < residual[:-2]) & (residual[1:-1] <= residual[2:]))
    known = min(float(side.known.sum()) for side in (pair.reference, pair.other))
    fits: list[Fit] = []
    for start in (best, *peaks[residual[peaks] <= _compute_f_limit(known, cutoff) * residual[best] + GRID_ERROR]):
        solution = fit([pair], float(lags[start]), middle=0.0, free_drift=False)
        if all(abs(solution.offset - other.offset) > STEP for other in fits):
            fits.append(solution)
    shares, common = _compute_residual_shares(pair, [solution.offset for solution in fits])
    limit = _compute_f_limit(common, cutoff) * min(shares)
    return sorted((solution for solution, share in zip(fits, shares, strict=True) if share <= limit),
                  key=lambda solution: abs(solution.offset))


def _compute_f_limit(samples: float, cutoff: float, level: float = 0.975) -> float:
    """Quantile of the ratio of two estimates of equal variances, at probability `level`."""
    degrees_of_freedom = max(2.0 * cutoff * STEP * samples, 1.0)
    return float(fisher.ppf(level, degrees_of_freedom, degrees_of_freedom))


def _compute_residual_shares(pair: Pair, offsets: Sequence[float]) -> tuple[list[float], int]:
    """(1 - r^2 at each offset, number of samples), from the samples common to all offsets. Different samples would bias
    the comparison, since a filtered derivative is least accurate at its ends."""
    series = [_select_common_samples(pair, offset) for offset in offsets]
    common = np.flatnonzero(np.bincount(np.concatenate([rows for rows, _ in series])) == len(series))
    values = pair.other.values[common]
    r = [correlate(derived[np.isin(rows, common)], values) for rows, derived in series]
    return [max(1.0 - correlation**2, MIN_RESIDUAL_SHARE) for correlation in r], len(common)


def _fit_line(problem: Regression, derived: np.ndarray, correlation: float,
              fit_bias: bool) -> tuple[Estimate, Estimate]:
    """(scale, bias). If they are confounded, as in one long bend, only one is estimated: the bias if its residual is
    clearly smaller (BIAS_RESIDUAL_RATIO), else the scale. The other is assumed to be faultless."""
    confounded = abs(float(derived.mean())) > float(derived.std()) and abs(correlation) < MIN_SCALE_CORRELATION
    if fit_bias and not confounded:
        both = problem.estimate(("scale", "bias"))
        return both["scale"], both["bias"]
    scale = problem.estimate(("scale",))["scale"]
    if not fit_bias:
        return scale, NO_BIAS
    shifted = Regression(problem.time, problem.y - derived[:, None], problem.columns)
    if problem.fit(("scale",))[1] <= BIAS_RESIDUAL_RATIO * shifted.fit(("bias",))[1]:
        return scale, NO_BIAS
    return UNIT_SCALE, shifted.estimate(("bias",))["bias"]


def _select_common_samples(pair: Pair, offset: float) -> tuple[np.ndarray, np.ndarray]:
    """(rows of `other` for which both series are known at this offset [s], the reference values there)."""
    rows, time = select_common_samples(pair, (offset, 0.0))
    return rows, np.interp(time, pair.reference.time, pair.reference.values)
