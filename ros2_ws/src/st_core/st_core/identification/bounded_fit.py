"""Nonlinear least squares within bounds, and profile-likelihood intervals of each parameter.

    S(p) = sum r(p)^2,   s^2 = S_min / (n - k),   covariance = s^2 (J^T J)^-1 of the parameters inside their bounds

The 95 % interval of parameter i ends where fixing it increases the sum of squares significantly, all others refitted:

    min over the others of S = S_min + s^2 F_0.95(1, n - k)

If the parameter's bound is reached first, that end is open. Source: Bates and Watts, Nonlinear Regression Analysis,
ch. 6. Checked by: test_identification_result.py.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import OptimizeResult, least_squares
from scipy.stats import f as fisher

Residuals = Callable[[np.ndarray], np.ndarray]
"""Function of parameters (k,) or many sets of them (m, k): residuals (n,) or (m, n)."""

END_TOLERANCE = 0.03  # relative tolerance of an end of an interval
MAX_STEPS = 8
BOUND_TOLERANCE = 1e-6  # distance from a bound, as a fraction of the range between both bounds


@dataclass(frozen=True)
class CurveFit:
    """Fitted values (k,), covariance (k, k), zero for parameters at a bound; residuals (n,), scatter s, freedom n - k;
    bounds (k,) each."""

    values: np.ndarray
    covariance: np.ndarray
    residuals: np.ndarray
    scatter: float
    freedom: int
    lower: np.ndarray
    upper: np.ndarray

    @property
    def deviations(self) -> np.ndarray:
        return np.sqrt(np.diag(self.covariance))

    def at_bound(self, index: int) -> bool:
        margin = BOUND_TOLERANCE * (self.upper[index] - self.lower[index])
        return not self.lower[index] + margin < self.values[index] < self.upper[index] - margin


@dataclass(frozen=True)
class Interval:
    """95 % interval of one parameter. lower_open, upper_open: whether an end is the bound, not determined by the data.
    """

    low: float
    high: float
    lower_open: bool
    upper_open: bool


def fit_curve(residuals: Residuals, starts: Sequence[Sequence[float]], lower: Sequence[float],
              upper: Sequence[float]) -> CurveFit:
    """Least squares from the best of several starts, every parameter within its bounds."""
    low, high = np.asarray(lower, float), np.asarray(upper, float)
    rough = [_solve(residuals, start, low, high, 1e-3, 40) for start in starts] if len(starts) > 1 else []
    begin = min(rough, key=lambda result: result.cost).x if rough else starts[0]
    found = _solve(residuals, begin, low, high, 1e-10, 200)
    n, k = found.jac.shape
    freedom = n - k
    scatter = math.sqrt(2.0 * found.cost / freedom) if freedom > 0 else math.nan
    margin = BOUND_TOLERANCE * (high - low)
    free = (found.x > low + margin) & (found.x < high - margin)
    covariance = np.zeros((k, k))
    if free.any():
        jacobian = found.jac[:, free]
        covariance[np.ix_(free, free)] = scatter**2 * np.linalg.pinv(jacobian.T @ jacobian)
    return CurveFit(found.x, covariance, found.fun, scatter, freedom, low, high)


def _solve(residuals: Residuals, start: Sequence[float] | np.ndarray, low: np.ndarray, high: np.ndarray,
           tolerance: float, max_evaluations: int) -> OptimizeResult:
    inside = np.clip(start, low + 1e-9 * (high - low), high - 1e-9 * (high - low))
    return least_squares(residuals, inside, _jacobian(residuals, high), (low, high), x_scale="jac",
                         xtol=0.1 * tolerance, ftol=tolerance, gtol=1e-12, max_nfev=max_evaluations)


def profile_interval(residuals: Residuals, fit: CurveFit, index: int) -> Interval:
    """Profile-likelihood interval of parameter `index`, by the secant method on the square root of the increase of S.
    """
    low, low_open = _interval_end(residuals, fit, index, -1.0)
    high, high_open = _interval_end(residuals, fit, index, 1.0)
    return Interval(low, high, low_open, high_open)


def _interval_end(residuals: Residuals, fit: CurveFit, index: int, side: float) -> tuple[float, bool]:
    threshold = fit.scatter**2 * float(fisher.ppf(0.95, 1, fit.freedom))
    bound = float((fit.upper if side > 0.0 else fit.lower)[index])
    value, spread = float(fit.values[index]), float(fit.deviations[index])
    to_bound = abs(bound - value)
    if to_bound <= BOUND_TOLERANCE * float(fit.upper[index] - fit.lower[index]):
        return bound, True
    distance = min(math.sqrt(threshold) / fit.scatter * spread, to_bound) if spread > 0.0 else 0.1 * to_bound
    minimum = float(fit.residuals @ fit.residuals)
    others = np.arange(len(fit.values)) != index
    slope = fit.covariance[others, index] / spread**2 if spread > 0.0 else np.zeros(int(others.sum()))
    start = fit.values[others] + slope * side * distance
    known = (0.0, 0.0)
    for _ in range(MAX_STEPS):
        start, cost = _fit_with_fixed(residuals, fit, index, value + side * distance, start)
        root = math.sqrt(max(cost - minimum, 0.0) / threshold)
        if distance >= to_bound and root < 1.0:
            return bound, True
        if abs(root - 1.0) < END_TOLERANCE or distance == known[0]:
            break
        steepness = (root - known[1]) / (distance - known[0])
        known = (distance, root)
        step = (1.0 - root) / steepness if steepness > 0.0 else distance
        # Steps are limited: the distance stays positive and grows at most fourfold.
        distance = min(max(distance + step, 0.3 * distance), 4.0 * distance, to_bound)
    return value + side * distance, False


def _jacobian(residuals: Residuals, upper: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Forward differences, all columns in one call; backward where a step would cross the upper bound."""
    def jacobian(values: np.ndarray) -> np.ndarray:
        steps = 1e-7 * np.maximum(np.abs(values), 1e-3)
        steps = np.where(values + steps > upper, -steps, steps)
        rows = residuals(np.concatenate([values[None], values + np.diag(steps)]))
        return ((rows[1:] - rows[0]) / steps[:, None]).T

    return jacobian


def _fit_with_fixed(residuals: Residuals, fit: CurveFit, index: int, value: float,
                    start: np.ndarray) -> tuple[np.ndarray, float]:
    """(the other parameters fitted with one fixed, sum of squares)."""
    others = np.arange(len(fit.values)) != index
    low, high = fit.lower[others], fit.upper[others]

    def of_others(free: np.ndarray) -> np.ndarray:
        return residuals(np.insert(free, index, value, axis=-1))

    # The increase is about 5 % of the sum of squares; a tolerance of 0.01 % is sufficient.
    found = _solve(of_others, start, low, high, 1e-4, 60)
    return found.x, 2.0 * found.cost
