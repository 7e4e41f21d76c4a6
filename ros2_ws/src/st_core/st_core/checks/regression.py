"""Robust linear regression of the residual of an identity, with intervals by resampling blocks of driving.

Neighbouring samples share their errors, so whole blocks are drawn again (st_core.regression), and an
interval is as wide as the blocks are few and alike. Causes are added one at a time, the one that explains most first,
all refitted together, until no further one is significant and large enough to matter.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..regression import Blocks, symmetric_interval
from .limits import SYSTEMATIC

OUTLIER = 3.0  # robust standard deviations; windows beyond it count less (Huber)
DRAWS = 200
BLOCK = 5.0  # s, as in the alignment of clocks; what is alike in neighbouring blocks widens the interval
FREEDOM = 4.0  # degrees of freedom of Student's t, at least
RIDGE = 1e-6  # of the whole normal matrix: a draw without excitation stays solvable and counts for nothing otherwise


@dataclass(frozen=True)
class Estimate:
    """value with its standard deviation and 95 % interval."""

    value: float
    deviation: float
    interval: tuple[float, float]

    @property
    def significant(self) -> bool:
        """Whether the 95 % interval leaves out 0, and by half its width more: one of a dozen causes is looked for."""
        low, high = self.interval
        return min(abs(low), abs(high)) > 0.5 * (high - self.value) and low * high > 0.0

    @property
    def half(self) -> float:
        """Half the width of the interval."""
        return 0.5 * (self.interval[1] - self.interval[0])

    def covers(self, value: float) -> bool:
        return self.interval[0] <= value <= self.interval[1]

    def scaled(self, factor: float) -> "Estimate":
        low, high = sorted(factor * end for end in self.interval)
        return Estimate(factor * self.value, abs(factor) * self.deviation, (low, high))

    def inverse(self) -> "Estimate":
        """Of 1 / value, to first order: an interval that reaches beyond 0 stays one."""
        value = 1.0 / float(np.copysign(max(abs(self.value), 1e-12), self.value))
        low, high = (value - (end - self.value) * value**2 for end in reversed(self.interval))
        return Estimate(value, self.deviation * value**2, (low, high))

    def shifted(self, by: float) -> "Estimate":
        return Estimate(self.value + by, self.deviation, (self.interval[0] + by, self.interval[1] + by))


class Regression:
    """y = sum_k theta_k X_k + rest, over windows.

    time: (n,) of the windows [s]. y: (n, m), m components of a window. columns: X_k by name, (n, m) each.
    """

    def __init__(self, time: np.ndarray, y: np.ndarray, columns: Mapping[str, np.ndarray], seed: int = 0):
        self.time, self.y, self.columns, self.seed = time, y, columns, seed
        self._blocks = blocks(time)

    def rest(self, theta: Mapping[str, float]) -> np.ndarray:
        """(n, m) residual of y."""
        return self.y - sum((value * self.columns[name] for name, value in theta.items()), np.zeros_like(self.y))

    def fit(self, names: Sequence[str]) -> tuple[dict[str, float], float, np.ndarray]:
        """(values by name, robust loss per window in robust variances of the rest, weights of the windows)."""
        design = np.stack([self.columns[name] for name in names], axis=-1) if names else np.zeros((*self.y.shape, 0))
        weights, theta = np.ones(len(self.y)), np.zeros(len(names))
        for _ in range(6 if names else 1):
            normal = np.einsum("n,nip,niq->pq", weights, design, design)
            theta = np.linalg.solve(normal + RIDGE * np.diag(np.diag(normal)) + 1e-12 * np.eye(len(names)),
                                    np.einsum("n,nip,ni->p", weights, design, self.y))
            size = np.sqrt(np.square(self.y - design @ theta).sum(axis=1))
            scale = max(float(np.median(size)), 1e-12)
            weights = 1.0 / np.maximum(1.0, size / (OUTLIER * scale))
        return dict(zip(names, theta.tolist(), strict=True)), scale, weights

    def loss(self, names: Sequence[str], scale: float) -> float:
        """Sum of Huber's loss at a common scale, so that two sets of causes can be compared."""
        theta, _, _ = self.fit(names)
        size = np.sqrt(np.square(self.rest(theta)).sum(axis=1)) / (OUTLIER * scale)
        return float(np.where(size <= 1.0, 0.5 * size**2, size - 0.5).sum())

    def estimates(self, names: Sequence[str]) -> dict[str, Estimate]:
        """Joint values of these causes with their intervals."""
        if not names:
            return {}
        theta, _, weights = self.fit(names)
        design = np.stack([self.columns[name] for name in names], axis=-1)
        squares = self._blocks.sums(weights[:, None, None] * np.einsum("nip,niq->npq", design, design))
        pulls = self._blocks.sums(weights[:, None] * np.einsum("nip,ni->np", design, self.y))
        whole, pulled = squares.sum(axis=0), pulls.sum(axis=0)
        held = np.diag(np.diag(whole)) + 1e-12 * np.eye(len(names))  # two causes may be one on this drive

        def estimator(draws: np.ndarray) -> np.ndarray:
            return np.linalg.solve(np.tensordot(draws, squares, 1) + RIDGE * (whole + held),
                                   (draws @ pulls + RIDGE * pulled)[:, :, None])[:, :, 0]

        drawn = self._blocks.bootstrap(estimator, DRAWS, self.seed)
        found = {}
        for k, name in enumerate(names):
            deviation = float(np.sqrt(drawn.covariance[k, k]))
            # The covariance is widened by what blocks share already; its degrees of freedom are at least FREEDOM.
            freedom = max(float(drawn.freedom[k]), FREEDOM)
            found[name] = Estimate(theta[name], deviation, symmetric_interval(theta[name], deviation, freedom))
        return found

    def effect(self, name: str, value: float, seconds: float, window: float) -> float:
        """Root mean square over windows of what a cause moves in `seconds`, where windows of `window` [s] add up."""
        count = max(round(seconds / window), 1)
        column = self.columns[name]
        if len(column) < count:
            return float(np.sqrt(np.square(value * column).sum(axis=1).mean())) * count
        sums = np.cumsum(np.vstack([np.zeros((1, column.shape[1])), column]), axis=0)
        moved = value * (sums[count:] - sums[:-count])
        return float(np.sqrt(np.square(moved).sum(axis=1).mean()))

    def causes(self, candidates: Mapping[str, float], always: Sequence[str] = (),
               alongside: Sequence[str] = ()) -> dict[str, Estimate]:
        """The causes that are significant and large enough, found one at a time and fitted together.

        candidates: by name, the smallest value reported. always: causes that are fitted in any case.
        alongside: causes with which a candidate may become significant: left out, they look like slow noise.
        """
        chosen: list[str] = []
        left = [name for name in candidates if np.abs(self.columns[name]).max(initial=0.0) > 0.0]
        while left:
            _, scale, _ = self.fit([*always, *chosen])
            losses = {name: self.loss([*always, *chosen, name], scale) for name in left}
            best = min(losses, key=losses.__getitem__)
            left.remove(best)
            # A cause that makes previous ones insignificant is collinear with them.
            for extra in ((), [name for name in alongside if name not in (*always, *chosen, best)]):
                joint = self.estimates([*always, *chosen, best, *extra])
                if all(matters(joint[name], candidates[name]) for name in (*chosen, best)):
                    chosen.append(best)
                    break
        joint = self.estimates([*always, *chosen])
        return {name: joint[name] for name in chosen}


def with_systematic(name: str, one: Estimate) -> Estimate:
    """With the systematic uncertainty of the identity, see limits.SYSTEMATIC; name: of the finding with this value."""
    kind = name.rpartition("_")[2]
    half = SYSTEMATIC.get(name, SYSTEMATIC.get(kind, 0.0)) * (abs(one.value) if kind in ("scale", "sign") else 1.0)
    low, high = (one.value + sign * float(np.hypot(end - one.value, half))
                 for sign, end in zip((-1.0, 1.0), one.interval, strict=True))
    return Estimate(one.value, float(np.hypot(one.deviation, 0.5 * half)), (low, high))


def blocks(time: np.ndarray) -> Blocks:
    """Blocks of BLOCK seconds of one run."""
    found, of = np.unique(np.floor(time / BLOCK).astype(np.int64), return_inverse=True)
    return Blocks(of, np.zeros(len(found), np.int64), found, f"{len(found)} blocks of {BLOCK:g} s")


def matters(estimate: Estimate, least: float) -> bool:
    return estimate.significant and abs(estimate.value) >= least
