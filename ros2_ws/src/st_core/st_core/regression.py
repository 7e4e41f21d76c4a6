"""Statistics of regressions: covariance over blocks of driving, intervals, pooling of runs, robust scale, ridge.

Neighbouring samples share slow errors of INS and road, so single samples would give uncertainties far too small. With
psi_c the influence of block c on the estimate, k blocks,

    covariance = k / (k - 1) sum_c psi_c psi_c^T * sqrt(f f^T)
    least squares:  psi_c = (k - 1) / k (A - A_c)^-1 g_c,   A_c = J_c^T J_c, g_c = J_c^T e_c: what leaving it out moves

which a bootstrap over the blocks tends to; `bootstrap` draws one for strongly nonlinear estimators. Blocks of one run
share still slower errors: with the correlation rho of psi from block to block, pooled over the runs, the variance
grows by

    f = sum_ij rho^|i - j| / k,    i, j: blocks of the same run, k: all blocks

and the blocks count as k / f for Student's t. The rho of k values about their own mean is too small by (1 + 3 rho) / k
(Marriott and Pope, 1954), which is added. Source: Cameron and Miller, A practitioner's guide to cluster-robust
inference, 2015 (the jackknife CR3). Checked by: test_blocks.py.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

FEWEST_RUNS = 8
"""With fewer runs, blocks of them are used instead."""
BLOCK_LENGTH = 10.0
"""s."""
NUDGE = 1e-4
"""Change of a block's weight by which its influence on an estimator is differentiated."""
ROBUST = 1.4826
"""Standard deviation of a normal distribution over the median of its magnitude."""


def symmetric_interval(value: float, standard_uncertainty: float, freedom: float = math.inf) -> tuple[float, float]:
    """95 % interval value -/+ t u with Student's t for `freedom` degrees of freedom (infinite: t = 1.96)."""
    from scipy.stats import t as student  # half a second that a start of the nodes does not need

    half = float(student.ppf(0.975, freedom)) * standard_uncertainty
    return value - half, value + half


def welch_freedom(scatter: float, total: float, freedom: float) -> float:
    """Degrees of freedom of a variance `total` of which `scatter` was estimated with `freedom`, the rest known (Welch
    and Satterthwaite, JCGM 100:2008, G.4): freedom (total / scatter)^2."""
    return freedom * (total / scatter) ** 2 if scatter > 0.0 else math.inf


def correlation_of(covariance: np.ndarray) -> np.ndarray:
    """Correlation matrix (n, n) of a covariance (n, n); a parameter without variance is correlated with none."""
    spread = np.sqrt(np.diag(covariance))
    scale = np.where(spread > 0.0, spread, 1.0)
    matrix = covariance / np.outer(scale, scale)
    np.fill_diagonal(matrix, 1.0)
    return matrix


def ridge(h: np.ndarray, share: float = 1e-6) -> np.ndarray:
    """(n, n): h plus a share of its mean diagonal on the diagonal; solvable where a parameter has no effect."""
    return h + (share * np.trace(h) / max(len(h), 1) + 1e-9) * np.eye(len(h))


def robust_deviation(values: np.ndarray) -> float:
    """1.4826 median |v - median v| [unit of the values]."""
    return ROBUST * float(np.median(np.abs(values - np.median(values))))


def white_noise(values: np.ndarray) -> float:
    """Standard deviation of white noise in samples (n,), n >= 4 [their unit]; third differences remove the motion of a
    car: sigma = 1.4826 median |d^3 u| / sqrt(20). Samples may be NaN."""
    return ROBUST * float(np.nanmedian(np.abs(np.diff(values, 3)))) / math.sqrt(20.0)


def extrapolation_uncertainty(whole: tuple[float, float, float], low: tuple[float, float, float]) -> float:
    """Standard uncertainty of a secant C as slope at zero when the curve is not a line, by a second one over a lower
    range [unit of C]. whole, low: (C, its variance, mean range a), a_low < a.

        C(a) = C_0 - s a,    u = sqrt(max((C_low - C)^2 - (u_low^2 - u^2), 0)) a / (a - a_low) / sqrt(3)

    u_low^2 - u^2: variance of the difference by chance (Hausman, Specification tests in econometrics, 1978);
    rectangular distribution (GUM 4.3.7). Checked by: test_stiffness_model_error.py.
    """
    chance = max(low[1] - whole[1], 0.0)
    size = math.sqrt(max((low[0] - whole[0]) ** 2 - chance, 0.0))
    return size * whole[2] / (whole[2] - low[2]) / math.sqrt(3.0)


@dataclass(frozen=True, eq=False)
class Spread:
    """covariance (p, p) of estimates; freedom: (p,) degrees of freedom for Student's t; basis: (p,) samples it is
    based on, in words."""

    covariance: np.ndarray
    freedom: np.ndarray
    basis: tuple[str, ...]

    @property
    def deviations(self) -> np.ndarray:
        return np.sqrt(np.diag(self.covariance))

    def interval(self, index: int, value: float, deviation: float | None = None) -> tuple[float, float]:
        """95 % interval about a value; deviation: another standard uncertainty than the covariance's."""
        own = float(self.deviations[index]) if deviation is None else float(deviation)
        return symmetric_interval(float(value), own, float(self.freedom[index]))


@dataclass(frozen=True, eq=False)
class Blocks:
    """of: (n,) the block of each sample; run, block: (k,) of each block, in that order; name: what they are."""

    of: np.ndarray
    run: np.ndarray
    block: np.ndarray
    name: str

    def __len__(self) -> int:
        return len(self.run)

    def sums(self, values: np.ndarray) -> np.ndarray:
        """Sums of values (n, ...) over the samples of each block, (k, ...)."""
        values = np.asarray(values, float)
        result = np.zeros((len(self), *values.shape[1:]))
        np.add.at(result, self.of, values)
        return result

    def spread(self, influence: np.ndarray) -> Spread:
        """Of estimates with the influence (k, p) of each block; see the module."""
        own = influence - influence.mean(axis=0)
        return self._widened(own.T @ own, own)

    def bootstrap(self, estimator: Callable[[np.ndarray], np.ndarray], draws: int, seed: int) -> Spread:
        """Of an estimator from weights of the blocks (m, k) to estimates (m, p), by draws with replacement."""
        count = len(self)
        weights = np.random.default_rng(seed).multinomial(count, np.full(count, 1.0 / count), size=draws).astype(float)
        influence = (estimator(1.0 + NUDGE * np.eye(count)) - estimator(np.ones((1, count)))) / NUDGE
        return self._widened(np.atleast_2d(np.cov(estimator(weights), rowvar=False)),
                             influence - influence.mean(axis=0))

    def _widened(self, covariance: np.ndarray, own: np.ndarray) -> Spread:
        count, factor = len(self), self._inflation(own)
        covariance = covariance * count / max(count - 1, 1) * np.sqrt(np.outer(factor, factor))
        effective = count / factor
        basis = tuple(self.name + (f" ({number:.0f} independent ones)" if number < 0.8 * count else "")
                      for number in effective)
        return Spread(covariance, np.maximum(effective - 1.0, 1.0), basis)

    def regression(self, regressors: np.ndarray, response: np.ndarray) -> tuple[np.ndarray, Spread, np.ndarray]:
        """Least squares of response (n,) on regressors (n, p): coefficients (p,), their spread, influence (k, p)."""
        found = np.linalg.lstsq(regressors, response, rcond=None)[0]
        residuals = response - regressors @ found
        influence = self.leave_out(self.sums(regressors[:, :, None] * regressors[:, None, :]),
                                   self.sums(regressors * residuals[:, None]))
        return found, self.spread(influence), influence

    def leave_out(self, squares: np.ndarray, gradient: np.ndarray) -> np.ndarray:
        """Influence psi (k, p) of each block on a least squares estimate, from its A_c (k, p, p) and g_c (k, p)."""
        whole = squares.sum(axis=0)
        # A millionth of the whole keeps it solvable without the one block that shows a parameter.
        others = (1.0 + 1e-6) * whole - squares
        return np.linalg.solve(others, gradient[:, :, None])[:, :, 0] * (len(self) - 1) / len(self)

    def _inflation(self, own: np.ndarray) -> np.ndarray:
        """f of each estimate (p,)."""
        neighbours = np.flatnonzero((np.diff(self.run) == 0) & (np.diff(self.block) == 1))
        power = np.square(own).mean(axis=0)
        if not len(neighbours):
            return np.ones(len(power))
        product = (own[neighbours] * own[neighbours + 1]).mean(axis=0)
        rho = np.divide(product, power, out=np.zeros_like(power), where=power > 0.0)
        rho = np.clip(rho + (1.0 + 3.0 * rho) / len(self), 0.0, 0.9)
        distance = np.abs(self.block[:, None] - self.block)[self.run[:, None] == self.run]
        return np.power(rho[:, None], distance).sum(axis=1) / len(self)


def blocks(run_of: Sequence[int] | np.ndarray, time: Sequence[float] | np.ndarray) -> Blocks:
    """Whole runs from FEWEST_RUNS on, else blocks of BLOCK_LENGTH, never across runs.

    run_of: (n,) number of the run of each sample; time: (n,) after the begin of its run [s].
    """
    run_of = np.asarray(run_of)
    runs, number = np.unique(run_of, return_inverse=True)
    if len(runs) >= FEWEST_RUNS:
        return Blocks(number, runs, np.zeros(len(runs), np.int64), f"{len(runs)} runs")
    keys = np.stack((run_of, np.floor(np.asarray(time) / BLOCK_LENGTH).astype(np.int64)), axis=1)
    found, member = np.unique(keys, axis=0, return_inverse=True)
    plural = "s" if len(runs) > 1 else ""
    return Blocks(member.ravel(), found[:, 0], found[:, 1],
                  f"{len(found)} blocks of {BLOCK_LENGTH:g} s from {len(runs)} run{plural}")


class Pooled(NamedTuple):
    """Pooled mean and its standard deviation. between: variance between estimates. excess: Cochran's Q [1]."""

    mean: float
    deviation: float
    between: float
    excess: float


def random_effects(values: np.ndarray, variances: np.ndarray) -> Pooled:
    """Pooled estimate of values (n,), n >= 1, with variances (n,) > 0.

    Source: DerSimonian and Laird, Meta-analysis in clinical trials, Controlled Clinical Trials 7 (1986). Checked by:
    test_discovery_evidence.py.
    """
    w = 1.0 / variances
    excess = float(w @ np.square(values - w @ values / w.sum()))
    surplus = max(excess - max(len(values) - 1, 1), 0.0)
    between = surplus / max(float(w.sum() - np.square(w).sum() / w.sum()), 1e-300)
    w = 1.0 / (variances + between)
    return Pooled(float(w @ values / w.sum()), float(w.sum() ** -0.5), between, excess)
