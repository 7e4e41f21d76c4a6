"""Statistics for regressions: covariance from blocks of driving, confidence intervals, pooling of runs.

Neighbouring samples share slowly varying errors of the INS and the road, so treating them as independent would
underestimate the uncertainty considerably. With influence psi_c, Jacobian J_c and residuals e_c of each of k blocks,

    covariance = k / (k - 1) sum_c d_c d_c^T * sqrt(f f^T),    d_c = psi_c - mean of psi
    least squares:  psi_c = (k - 1) / k (A - A_c)^-1 g_c,   A_c = J_c^T J_c,   A = sum_c A_c,   g_c = J_c^T e_c
    f = sum_ij rho^|i - j| / k,    i, j: blocks of the same run

Leaving out block c changes the estimate by -psi_c k / (k - 1). The covariance is the limit of a block bootstrap, which
`Blocks.bootstrap` draws for strongly nonlinear estimators. f accounts for the correlation between blocks of one run:
rho is the correlation of psi between adjacent blocks, pooled over the runs, corrected for its bias -(1 + 3 rho) / k
(Marriott and Pope, 1954), limited to 0 to 0.9. Student's t has max(k / f - 1, 1) degrees of freedom. Source: Cameron
and Miller, A practitioner's guide to cluster-robust inference, 2015 (the jackknife CR3). Checked by: test_blocks.py.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

MIN_RUN_BLOCKS = 8  # with at least this many runs, each run is a block
BLOCK_LENGTH = 10.0  # s, length of a block if there are fewer runs
WEIGHT_INCREMENT = 1e-4  # increment of a block's weight for the numerical derivative of an estimator
Z95 = 1.959963984540054  # 97.5 % quantile of the standard normal distribution
SIGMA_PER_MAD = 1.4826  # standard deviation / median absolute deviation (MAD) of a normal distribution


def symmetric_interval(value: float, standard_uncertainty: float,
                       degrees_of_freedom: float = math.inf) -> tuple[float, float]:
    """95 % confidence interval value -/+ t u, with Student's t (1.96 for infinitely many degrees of freedom)."""
    from scipy.special import stdtrit  # imported here: it takes 0.2 s, and nodes do not need it

    half_width = float(stdtrit(degrees_of_freedom, 0.975)) * standard_uncertainty
    return value - half_width, value + half_width


def count_decimals(half_width: float) -> int:
    """Number of decimals, 0 to 6, that shows two significant digits of a half-width > 0; 3 if it is 0 or infinite."""
    return min(max(1 - math.floor(math.log10(half_width) + 1e-6), 0), 6) if 0.0 < half_width < math.inf else 3


def effective_degrees_of_freedom(estimated_variance: float, total_variance: float, degrees_of_freedom: float) -> float:
    """Degrees of freedom of the sum of a known and an estimated variance; inf if the estimated variance is 0.

    degrees_of_freedom: those of the estimated variance. Source: Welch and Satterthwaite, JCGM 100:2008, G.4.
    """
    return degrees_of_freedom * (total_variance / estimated_variance) ** 2 if estimated_variance > 0.0 else math.inf


def correlation_matrix(covariance: np.ndarray) -> np.ndarray:
    """Correlation matrix (n, n) of a covariance matrix (n, n); 0 for a parameter without variance."""
    deviations = np.sqrt(np.diag(covariance))
    scale = np.where(deviations > 0.0, deviations, 1.0)
    matrix = covariance / np.outer(scale, scale)
    np.fill_diagonal(matrix, 1.0)
    return matrix


def add_ridge(h: np.ndarray) -> np.ndarray:
    """h (n, n) with a ridge added to its diagonal, so that it is invertible: 1e-6 of the mean diagonal, plus 1e-9."""
    return h + (1e-6 * np.trace(h) / max(len(h), 1) + 1e-9) * np.eye(len(h))


def robust_deviation(values: np.ndarray) -> float:
    """Standard deviation estimated from the median absolute deviation, 1.4826 median |v - median v|."""
    return SIGMA_PER_MAD * float(np.median(np.abs(values - np.median(values))))


def white_noise(values: np.ndarray) -> float:
    """Standard deviation of the white noise in samples (n,), n >= 4 [their unit]; samples may be NaN. Third differences
    suppress the motion of the car: sigma = 1.4826 median |d^3 u| / sqrt(20)."""
    return SIGMA_PER_MAD * float(np.nanmedian(np.abs(np.diff(values, 3)))) / math.sqrt(20.0)


def extrapolation_uncertainty(full: tuple[float, float, float], low: tuple[float, float, float]) -> float:
    """Standard uncertainty [unit of C] of the secant slope C of a curve as an estimate of its slope at zero.

    full, low: (C, variance of C, mean |abscissa| a) of this secant and of a secant in a lower range, a_low < a.

        C(a) = C_0 - s a,    u = sqrt(max((C_low - C)^2 - max(u_low^2 - u^2, 0), 0)) a / (a - a_low) / sqrt(3)

    u_low^2 - u^2: variance of the difference if the curve is a line (Hausman, Specification tests in econometrics,
    1978). sqrt(3): rectangular distribution (GUM 4.3.7). Checked by: test_stiffness_model_error.py.
    """
    (slope, variance, abscissa), (slope_low, variance_low, abscissa_low) = full, low
    difference = math.sqrt(max((slope_low - slope) ** 2 - max(variance_low - variance, 0.0), 0.0))
    return difference * abscissa / (abscissa - abscissa_low) / math.sqrt(3.0)


@dataclass(frozen=True, eq=False)
class Spread:
    """Covariance (p, p) of p estimates, degrees of freedom (p,) of Student's t, and basis (p,), such as "8 runs"."""

    covariance: np.ndarray
    degrees_of_freedom: np.ndarray
    basis: tuple[str, ...]

    @property
    def standard_errors(self) -> np.ndarray:
        return np.sqrt(np.diag(self.covariance))

    def interval(self, index: int, value: float, standard_uncertainty: float | None = None) -> tuple[float, float]:
        """95 % confidence interval of a value. standard_uncertainty: by default that of `standard_errors`."""
        uncertainty = self.standard_errors[index] if standard_uncertainty is None else standard_uncertainty
        return symmetric_interval(float(value), float(uncertainty), float(self.degrees_of_freedom[index]))


@dataclass(frozen=True, eq=False)
class Blocks:
    """Partition of samples into blocks."""

    block_index: np.ndarray  # (n,) block index of each sample
    run: np.ndarray  # (k,) run of each block
    number_in_run: np.ndarray  # (k,) number of each block within its run, ascending
    name: str  # description, such as "8 runs"

    def __len__(self) -> int:
        return len(self.run)

    def sum_by_block(self, values: np.ndarray) -> np.ndarray:
        """Sums of values (n, ...) over the samples of each block, (k, ...)."""
        values = np.asarray(values, float)
        result = np.zeros((len(self), *values.shape[1:]))
        np.add.at(result, self.block_index, values)
        return result

    def make_spread(self, influence: np.ndarray) -> Spread:
        """Uncertainty of p estimates from the influence (k, p) of each block; see the module docstring."""
        centred = influence - influence.mean(axis=0)
        return self._inflate(centred.T @ centred, centred)

    def bootstrap(self, estimator: Callable[[np.ndarray], np.ndarray], draws: int, seed: int) -> Spread:
        """Uncertainty from draws of blocks with replacement. estimator: estimates (m, p) for weights (m, k)."""
        count = len(self)
        weights = _draw_weights(count, draws, seed)
        change = estimator(1.0 + WEIGHT_INCREMENT * np.eye(count)) - estimator(np.ones((1, count)))
        influence = change / WEIGHT_INCREMENT
        return self._inflate(np.atleast_2d(np.cov(estimator(weights), rowvar=False)),
                             influence - influence.mean(axis=0))

    @cached_property
    def _distances(self) -> tuple[np.ndarray, np.ndarray]:
        """(distances |i - j| of blocks i, j of the same run, number of pairs (i, j) at each)."""
        distance = np.abs(self.number_in_run[:, None] - self.number_in_run)[self.run[:, None] == self.run]
        return np.unique(distance, return_counts=True)

    def _inflate(self, covariance: np.ndarray, centred: np.ndarray) -> Spread:
        """Uncertainty with the covariance increased by the factor f of each estimate; see the module docstring."""
        count, mean_square = len(self), np.square(centred).mean(axis=0)
        neighbours = np.flatnonzero((np.diff(self.run) == 0) & (np.diff(self.number_in_run) == 1))
        factor = np.ones(len(mean_square))
        if len(neighbours):
            product = (centred[neighbours] * centred[neighbours + 1]).mean(axis=0)
            rho = np.divide(product, mean_square, out=np.zeros_like(mean_square), where=mean_square > 0.0)
            rho = np.clip(rho + (1.0 + 3.0 * rho) / count, 0.0, 0.9)
            distance, pairs = self._distances
            factor = np.power(rho[:, None], distance) @ pairs / count
        covariance = covariance * count / max(count - 1, 1) * np.sqrt(np.outer(factor, factor))
        effective_counts = count / factor
        basis = tuple(self.name + (f" (equivalent to {number:.0f} independent ones)" if number < 0.8 * count else "")
                      for number in effective_counts)
        return Spread(covariance, np.maximum(effective_counts - 1.0, 1.0), basis)

    def fit_least_squares(self, regressors: np.ndarray, response: np.ndarray) -> tuple[np.ndarray, Spread, np.ndarray]:
        """(coefficients (p,), uncertainty, influence (k, p)) of a regression of response (n,) on regressors (n, p)."""
        coefficients = np.linalg.lstsq(regressors, response, rcond=None)[0]
        residuals = response - regressors @ coefficients
        influence = self.compute_influence(self.sum_by_block(regressors[:, :, None] * regressors[:, None, :]),
                                           self.sum_by_block(regressors * residuals[:, None]))
        return coefficients, self.make_spread(influence), influence

    def compute_influence(self, squares: np.ndarray, gradient: np.ndarray) -> np.ndarray:
        """Influence psi (k, p) of each block on a least squares estimate, from its A_c (k, p, p) and g_c (k, p)."""
        # A millionth of the total keeps the system solvable even if only one block excites a parameter.
        others = (1.0 + 1e-6) * squares.sum(axis=0) - squares
        return np.linalg.solve(others, gradient[:, :, None])[:, :, 0] * (len(self) - 1) / len(self)


@lru_cache(maxsize=8)
def _draw_weights(count: int, draws: int, seed: int) -> np.ndarray:
    """How often each of `count` blocks is drawn, (draws, count)."""
    return np.random.default_rng(seed).multinomial(count, np.full(count, 1.0 / count), size=draws).astype(float)


def make_blocks(run_index: Sequence[int] | np.ndarray, time: Sequence[float] | np.ndarray) -> Blocks:
    """Whole runs as blocks if there are at least MIN_RUN_BLOCKS, else sections of runs, BLOCK_LENGTH long.

    run_index: (n,) run number of each sample. time: (n,) time since the start of its run [s].
    """
    run_index = np.asarray(run_index)
    runs, block_index = np.unique(run_index, return_inverse=True)
    if len(runs) >= MIN_RUN_BLOCKS:
        return Blocks(block_index, runs, np.zeros(len(runs), np.int64), f"{len(runs)} runs")
    keys = np.stack((run_index, np.floor(np.asarray(time) / BLOCK_LENGTH).astype(np.int64)), axis=1)
    sections, section_index = np.unique(keys, axis=0, return_inverse=True)
    return Blocks(section_index.ravel(), sections[:, 0], sections[:, 1],
                  f"{len(sections)} blocks of {BLOCK_LENGTH:g} s from {len(runs)} run{'s' * (len(runs) > 1)}")


def random_effects(values: np.ndarray, variances: np.ndarray) -> tuple[float, float, float, float]:
    """(mean, its standard error, variance between runs, Cochran's Q [1]) by a random effects model.

    values, variances > 0: (n,) by run, n >= 1. Source: DerSimonian and Laird, Controlled Clinical Trials 7 (1986).
    """
    w = 1.0 / variances
    cochran_q = float(w @ np.square(values - w @ values / w.sum()))
    between = max(cochran_q - max(len(values) - 1, 1), 0.0) / max(float(w.sum() - np.square(w).sum() / w.sum()), 1e-300)
    w = 1.0 / (variances + between)
    return float(w @ values / w.sum()), float(w.sum() ** -0.5), between, cochran_q
