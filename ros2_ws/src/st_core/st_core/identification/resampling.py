"""Bootstrap over runs, or over blocks within runs: what is drawn again are whole pieces of driving.

Neighbouring samples share slow errors of INS and road, so single samples would give uncertainties far too small. Blocks
of one run share what is slower still: the mean of an error that wanders over 20 s is alike in two of them. How much
they do shows in what each block pulls at an estimate, psi. With their correlation rho from block to block, pooled over
the runs, the variance grows by

    f = sum_ij rho^|i - j| / k,    i, j: blocks of the same run, k: all blocks

and the blocks count as k / f pieces for Student's t. The rho of k values about their own mean is too small by
(1 + 3 rho) / k (Marriott and Pope, 1954), which is added.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from .result import correlation_of, symmetric_interval

FEWEST_RUNS = 8
"""Below so many runs blocks of them are drawn instead."""
BLOCK = 10.0
"""s, length of such a block."""
NUDGE = 1e-4
"""Weight by which the pull of a piece is tried."""


@dataclass(frozen=True, eq=False)
class Pieces:
    """of: the piece each sample belongs to, (n,). run, block: of each piece, (k,), in that order. words: what they are.
    """

    of: np.ndarray
    run: np.ndarray
    block: np.ndarray
    words: str

    def __len__(self) -> int:
        return len(self.run)

    def sums(self, values: np.ndarray) -> np.ndarray:
        """Sums of values (n, ...) over the samples of each piece, (k, ...)."""
        values = np.asarray(values, float)
        result = np.zeros((len(self), *values.shape[1:]))
        np.add.at(result, self.of, values)
        return result

    def draws(self, count: int, seed: int) -> np.ndarray:
        """How often each piece is drawn, (count, k): each row is a bootstrap sample of as many pieces as there are."""
        generator = np.random.default_rng(seed)
        return generator.multinomial(len(self), np.full(len(self), 1.0 / len(self)), size=count).astype(float)

    def widening(self, pulls: np.ndarray) -> np.ndarray:
        """f of each parameter (p,), from what each piece pulls at it (k, p); see the module."""
        own = pulls - pulls.mean(axis=0)
        next_to = np.flatnonzero((np.diff(self.run) == 0) & (np.diff(self.block) == 1))
        power = np.square(own).mean(axis=0)
        if not len(next_to):
            return np.ones(len(power))
        together = (own[next_to] * own[next_to + 1]).mean(axis=0)
        rho = np.divide(together, power, out=np.zeros_like(power), where=power > 0.0)
        rho = np.clip(rho + (1.0 + 3.0 * rho) / len(self), 0.0, 0.9)
        apart = np.abs(self.block[:, None] - self.block)[self.run[:, None] == self.run]
        return np.power(rho[:, None], apart).sum(axis=1) / len(self)


@dataclass(frozen=True, eq=False)
class Drawn:
    """values: of the bootstrap samples (count, p). covariance (p, p), widened by k / (k - 1) for k pieces and for
    blocks that are alike. worth: how many pieces that were independent are as good, (p,).
    """

    values: np.ndarray
    covariance: np.ndarray
    worth: np.ndarray
    pieces: Pieces

    @property
    def correlation(self) -> np.ndarray:
        return correlation_of(self.covariance)

    def interval(self, index: int, value: float, uncertainty: float) -> tuple[float, float]:
        """95 % with Student's t of one degree of freedom less than the pieces are worth: few runs make it wider."""
        return symmetric_interval(float(value), float(uncertainty), max(float(self.worth[index]) - 1.0, 1.0))

    def words(self, index: int) -> str:
        few = self.worth[index] < 0.8 * len(self.pieces)
        return self.pieces.words + (f" (alike: worth {self.worth[index]:.0f})" if few else "")


def pieces(run_of: Sequence[int] | np.ndarray, time: Sequence[float] | np.ndarray) -> Pieces:
    """run_of: number of the run of each sample, (n,). time: after the begin of its run [s]. Pieces are runs from
    FEWEST_RUNS on, else blocks of BLOCK seconds, never across runs.
    """
    run_of = np.asarray(run_of)
    runs, number = np.unique(run_of, return_inverse=True)
    if len(runs) >= FEWEST_RUNS:
        return Pieces(number, runs, np.zeros(len(runs), np.int64), f"{len(runs)} runs")
    keys = np.stack((run_of, np.floor(np.asarray(time) / BLOCK).astype(np.int64)), axis=1)
    found, piece = np.unique(keys, axis=0, return_inverse=True)
    run, block = found.T
    return Pieces(piece.ravel(), run, block, f"{len(found)} blocks of {BLOCK:g} s from {len(runs)} "
                                             f"run{'s' if len(runs) > 1 else ''}")


def bootstrap(estimator: Callable[[np.ndarray], np.ndarray], of: Pieces, count: int, seed: int) -> Drawn:
    """estimator: weights of the pieces (count, k) -> values (count, p)."""
    number = len(of)
    drawn = estimator(of.draws(count, seed))
    pulls = (estimator(1.0 + NUDGE * np.eye(number)) - estimator(np.ones((1, number)))) / NUDGE
    wider = of.widening(pulls)
    covariance = np.atleast_2d(np.cov(drawn, rowvar=False)) * number / max(number - 1, 1)
    return Drawn(drawn, covariance * np.sqrt(np.outer(wider, wider)), number / wider, of)
