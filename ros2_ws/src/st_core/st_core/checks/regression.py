"""Robust linear regression of a residual on its possible causes.

Errors of neighbouring samples are correlated, so confidence intervals come from a bootstrap of blocks of driving
(`st_core.regression`). Causes are found by forward selection: the cause that reduces the loss most is added and all are
refitted, until no further cause is significant and relevant.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import stdtrit

from ..regression import Blocks, count_decimals
from .finding import SYSTEMATIC_UNCERTAINTY

OUTLIER_RATIO = 3.0  # windows with a residual above this multiple of the median residual have less weight (Huber)
HUBER_ITERATIONS = 6
DRAWS, SEED = 200, 0  # number of draws and random seed of the bootstrap
BLOCK_LENGTH = 5.0  # s, as in the alignment of clocks; correlation between neighbouring blocks widens the interval
MIN_DEGREES_OF_FREEDOM = 4.0  # lower limit for Student's t distribution
RIDGE = 1e-6  # fraction of the normal matrix or its diagonal added to it, so that draws without excitation are solvable


@dataclass(frozen=True)
class Estimate:
    """An estimated value with its uncertainty."""

    value: float
    standard_error: float
    half_width: float  # of `interval`, the 95 % confidence interval

    def __str__(self) -> str:
        """Value ± half-width, the latter with two significant digits."""
        decimals = count_decimals(self.half_width)
        return f"{self.value:.{decimals}f} ± {self.half_width:.{decimals}f}"

    def __abs__(self) -> "Estimate":
        return Estimate(abs(self.value), self.standard_error, self.half_width)

    @property
    def interval(self) -> tuple[float, float]:
        return self.value - self.half_width, self.value + self.half_width

    @property
    def is_significant(self) -> bool:
        """Whether 0 is outside 1.5 times the 95 % interval; the factor accounts for testing a dozen causes."""
        return abs(self.value) > 1.5 * self.half_width

    def covers(self, value: float) -> bool:
        return abs(value - self.value) <= self.half_width

    def scaled(self, factor: float) -> "Estimate":
        return Estimate(factor * self.value, abs(factor) * self.standard_error, abs(factor) * self.half_width)

    def inverse(self) -> "Estimate":
        """Estimate of 1 / value, by first-order error propagation; the exact interval may be unbounded."""
        value = 1.0 / float(np.copysign(max(abs(self.value), 1e-12), self.value))
        return Estimate(value, self.standard_error * value**2, self.half_width * value**2)

    def widened(self, half_width: float) -> "Estimate":
        """The estimate with a further uncertainty added in quadrature; half_width: of its 95 % interval."""
        return Estimate(self.value, float(np.hypot(self.standard_error, 0.5 * half_width)),
                        float(np.hypot(self.half_width, half_width)))

    def shifted(self, change: float) -> "Estimate":
        return replace(self, value=self.value + change)


class Regression:
    """Robust regression y = sum_k theta_k X_k + residual, with one row per window.

    time: (n,) start of each window [s]. y: (n, m), m components per window. columns: X_k by name, (n, m) each.
    """

    def __init__(self, time: np.ndarray, y: np.ndarray, columns: Mapping[str, np.ndarray]):
        self.time, self.y, self.columns = time, y, columns
        self._fits: dict[tuple[str, ...], tuple[dict[str, float], float, np.ndarray]] = {}  # by names
        numbers, block_of = np.unique(np.floor(time / BLOCK_LENGTH).astype(np.int64), return_inverse=True)
        self._blocks = Blocks(block_of, np.zeros(len(numbers), np.int64), numbers,
                              f"{len(numbers)} blocks of {BLOCK_LENGTH:g} s")

    def _compute_products(self, names: Sequence[str]) -> np.ndarray:
        """(n, p + 1, p) products of these columns with each other and, in the last row, with y."""
        design = np.stack([*(self.columns[name] for name in names), self.y], axis=-1)
        return np.einsum("nip,niq->npq", design, design[:, :, :-1])

    def compute_residual(self, theta: Mapping[str, float]) -> np.ndarray:
        """y - sum_k theta_k X_k (n, m); theta_k is 0 if it is not given."""
        return self.y - sum((value * self.columns[name] for name, value in theta.items()), np.zeros_like(self.y))

    def fit(self, names: Sequence[str]) -> tuple[dict[str, float], float, np.ndarray]:
        """(theta by name, median norm of the residuals of the windows, Huber weights of the windows (n,))."""
        count, key = len(names), tuple(names)
        if key not in self._fits:
            products = self._compute_products(names).reshape(len(self.y), -1)
            weights, theta = np.ones(len(self.y)), {}
            for _ in range(HUBER_ITERATIONS if names else 1):
                sums = (weights @ products).reshape(count + 1, count)
                normal = sums[:-1] + RIDGE * np.diag(np.diag(sums)) + 1e-12 * np.eye(count)
                theta = dict(zip(names, np.linalg.solve(normal, sums[-1]).tolist(), strict=True))
                size = np.sqrt(np.square(self.compute_residual(theta)).sum(axis=1))
                scale = max(float(np.median(size)), 1e-12)
                weights = 1.0 / np.maximum(1.0, size / (OUTLIER_RATIO * scale))
            self._fits[key] = theta, scale, weights
        return self._fits[key]

    def compute_loss(self, names: Sequence[str], scale: float) -> float:
        """Huber loss of the fit of these causes; a common scale makes the losses of two sets comparable."""
        theta, _, _ = self.fit(names)
        size = np.sqrt(np.square(self.compute_residual(theta)).sum(axis=1)) / (OUTLIER_RATIO * scale)
        return float(np.where(size <= 1.0, 0.5 * size**2, size - 0.5).sum())

    def estimate(self, names: Sequence[str]) -> dict[str, Estimate]:
        """Estimates of these causes by one joint fit."""
        if not names:
            return {}
        theta, _, weights = self.fit(names)
        sums = self._blocks.sum_by_block(weights[:, None, None] * self._compute_products(names))
        normals, right_sides = sums[:, :-1], sums[:, -1]
        normal, right_side = normals.sum(axis=0), right_sides.sum(axis=0)
        diagonal = np.diag(np.diag(normal)) + 1e-12 * np.eye(len(names))  # the causes may be collinear on this drive

        def solve(weights_of_blocks: np.ndarray) -> np.ndarray:
            return np.linalg.solve(np.tensordot(weights_of_blocks, normals, 1) + RIDGE * (normal + diagonal),
                                   (weights_of_blocks @ right_sides + RIDGE * right_side)[:, :, None])[:, :, 0]

        spread = self._blocks.bootstrap(solve, DRAWS, SEED)
        errors = spread.standard_errors
        half_widths = stdtrit(np.maximum(spread.degrees_of_freedom, MIN_DEGREES_OF_FREEDOM), 0.975) * errors
        return {name: Estimate(theta[name], *row)
                for name, *row in zip(names, errors.tolist(), half_widths.tolist(), strict=True)}

    def compute_effect(self, name: str, count: int) -> float:
        """RMS change of y over `count` <= n successive windows, per unit of a cause."""
        column = self.columns[name]
        sums = np.cumsum(np.vstack([np.zeros((1, column.shape[1])), column]), axis=0)
        return float(np.sqrt(np.square(sums[count:] - sums[:-count]).sum(axis=1).mean()))

    def select_causes(self, candidates: Sequence[str], min_values: Mapping[str, float], required: Sequence[str],
                      nuisance: Sequence[str]) -> dict[str, Estimate]:
        """The significant and relevant causes, selected one at a time and fitted together. min_values: smallest
        reported value by cause. required: causes that are always fitted. nuisance: causes that are also fitted if a
        candidate is not relevant without them, because they act as slow noise on it."""
        causes: list[str] = []
        remaining = [name for name in candidates if np.abs(self.columns[name]).max(initial=0.0) > 0.0]
        while remaining:
            _, scale, _ = self.fit([*required, *causes])
            losses = {name: self.compute_loss([*required, *causes, name], scale) for name in remaining}
            cause = min(losses, key=losses.__getitem__)
            remaining.remove(cause)
            # A cause that makes a previous one insignificant is collinear with it and must not be added.
            for extra in ((), [name for name in nuisance if name not in (*required, *causes, cause)]):
                joint = self.estimate([*required, *causes, cause, *extra])
                if all(is_relevant(joint[name], min_values[name]) for name in (*causes, cause)):
                    causes.append(cause)
                    break
        joint = self.estimate([*required, *causes])
        return {name: joint[name] for name in causes}


def add_systematic_uncertainty(name: str, estimate: Estimate) -> Estimate:
    """The estimate widened by the systematic uncertainty of the finding of this name (SYSTEMATIC_UNCERTAINTY)."""
    kind = name.rpartition("_")[2]
    half_width = SYSTEMATIC_UNCERTAINTY.get(name, SYSTEMATIC_UNCERTAINTY.get(kind, 0.0))
    return estimate.widened(half_width * abs(estimate.value) if kind in ("scale", "sign") else half_width)


def is_relevant(estimate: Estimate, minimum: float) -> bool:
    """Whether an estimate is significant and at least as large as the smallest reported value."""
    return estimate.is_significant and abs(estimate.value) >= minimum
