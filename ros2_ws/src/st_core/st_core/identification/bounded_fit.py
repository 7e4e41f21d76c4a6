"""Nonlinear least squares within bounds, and a profile-likelihood interval for each parameter.

    S(p) = sum r(p)^2,   s^2 = S_min / (n - k),   covariance = s^2 (J^T J)^-1 of the parameters inside their bounds
    ends of the 95 % interval:    min over the other parameters of S = S_min + s^2 F_0.95(1, n - k)

An end is open if the bound of the parameter is reached first. Source: Bates and Watts, Nonlinear Regression Analysis,
ch. 6. Checked by: test_identification_result.py.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import OptimizeResult, least_squares
from scipy.stats import f as fisher

Residuals = Callable[[np.ndarray], np.ndarray]  # from parameters (k,) to residuals (n,)
END_TOLERANCE = 0.03  # relative tolerance of the distance from the value to an end of its interval
MAX_END_STEPS = 8  # largest number of secant steps to an end
BOUND_TOLERANCE = 1e-6  # largest distance from a bound that counts as at the bound, divided by the range of the bounds


@dataclass(frozen=True)
class BoundedFit:
    """Result of `fit_within_bounds`."""

    values: np.ndarray  # (k,)
    covariance: np.ndarray  # (k, k), zero for parameters at a bound
    residuals: np.ndarray  # (n,)
    residual_deviation: float  # residual standard deviation s
    degrees_of_freedom: int  # n - k
    lower: np.ndarray  # bounds (k,)
    upper: np.ndarray

    @property
    def standard_errors(self) -> np.ndarray:
        return np.sqrt(np.diag(self.covariance))

    def is_at_bound(self, index: int) -> bool:
        return not _is_inside(self.values, self.lower, self.upper)[index]


def _is_inside(values: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    margin = BOUND_TOLERANCE * (upper - lower)
    return (values > lower + margin) & (values < upper - margin)


def fit_within_bounds(residuals: Residuals, starts: Sequence[Sequence[float]], lower: Sequence[float],
                      upper: Sequence[float]) -> BoundedFit:
    """Least-squares fit within bounds, from the best of several starts."""
    low, high = np.asarray(lower, float), np.asarray(upper, float)
    rough = [_solve(residuals, start, low, high, 1e-3, 40) for start in starts] if len(starts) > 1 else []
    best_start = min(rough, key=lambda result: result.cost).x if rough else starts[0]
    result = _solve(residuals, best_start, low, high, 1e-10, 200)
    n, k = result.jac.shape
    deviation = math.sqrt(2.0 * result.cost / (n - k)) if n > k else math.nan
    free = _is_inside(result.x, low, high)
    covariance = np.zeros((k, k))
    if free.any():
        jacobian = result.jac[:, free]
        covariance[np.ix_(free, free)] = deviation**2 * np.linalg.pinv(jacobian.T @ jacobian)
    return BoundedFit(result.x, covariance, result.fun, deviation, n - k, low, high)


def _solve(residuals: Residuals, start: Sequence[float] | np.ndarray, low: np.ndarray, high: np.ndarray,
           tolerance: float, max_evaluations: int) -> OptimizeResult:
    inside = np.clip(start, low + 1e-9 * (high - low), high - 1e-9 * (high - low))
    return least_squares(residuals, inside, bounds=(low, high), x_scale="jac", xtol=0.1 * tolerance, ftol=tolerance,
                         gtol=1e-12, max_nfev=max_evaluations)


def find_interval_end(residuals: Residuals, fit: BoundedFit, index: int, side: float) -> tuple[float, bool]:
    """(lower or upper end of the interval of a parameter, whether the end is open). side: -1 lower, 1 upper.

    The secant method is applied to the square root of the increase of S.
    """
    threshold = fit.residual_deviation**2 * float(fisher.ppf(0.95, 1, fit.degrees_of_freedom))
    bound = float((fit.upper if side > 0.0 else fit.lower)[index])
    value, error = float(fit.values[index]), float(fit.standard_errors[index])
    to_bound = abs(bound - value)
    if to_bound <= BOUND_TOLERANCE * float(fit.upper[index] - fit.lower[index]):
        return bound, True
    distance = min(math.sqrt(threshold) / fit.residual_deviation * error, to_bound) if error > 0.0 else 0.1 * to_bound
    minimum = float(fit.residuals @ fit.residuals)
    others = np.arange(len(fit.values)) != index
    slope = fit.covariance[others, index] / error**2 if error > 0.0 else np.zeros(int(others.sum()))
    start = fit.values[others] + slope * side * distance
    last_distance = last_root = 0.0  # root: square root of the increase of S divided by the threshold
    for _ in range(MAX_END_STEPS):
        def compute_residuals(free: np.ndarray, fixed: float = value + side * distance) -> np.ndarray:
            return residuals(np.insert(free, index, fixed))

        # At an end of the interval S exceeds S_min by the fraction F / (n - k), 5 % for n - k = 80; 0.01 % is enough.
        result = _solve(compute_residuals, start, fit.lower[others], fit.upper[others], 1e-4, 60)
        start = result.x
        root = math.sqrt(max(2.0 * result.cost - minimum, 0.0) / threshold)
        if distance >= to_bound and root < 1.0:
            return bound, True
        if abs(root - 1.0) < END_TOLERANCE or distance == last_distance:
            break
        steepness = (root - last_root) / (distance - last_distance)
        last_distance, last_root = distance, root
        step = (1.0 - root) / steepness if steepness > 0.0 else distance
        # The distance stays positive and grows at most fourfold per step.
        distance = min(max(distance + step, 0.3 * distance), 4.0 * distance, to_bound)
    return value + side * distance, False
