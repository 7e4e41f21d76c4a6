"""Bootstrap over runs, or over blocks within runs: what is drawn again are whole pieces of driving.

Neighbouring samples share slow errors of INS and road, so single samples would give uncertainties far too small.
"""

from collections.abc import Sequence

import numpy as np

from .result import correlation_of, symmetric_interval

FEWEST_RUNS = 8
"""Below so many runs blocks of them are drawn instead."""
BLOCK = 10.0
"""s, length of such a block."""


def pieces(run_of: np.ndarray, time: np.ndarray) -> tuple[np.ndarray, str]:
    """(number of the piece each sample belongs to, what pieces are).

    run_of: number of the run of each sample, (n,). time: after the begin of its run [s]. Pieces are runs from
    FEWEST_RUNS on, else blocks of BLOCK seconds, never across runs.
    """
    run_of = np.asarray(run_of)
    runs = np.unique(run_of)
    if len(runs) >= FEWEST_RUNS:
        return np.unique(run_of, return_inverse=True)[1], f"{len(runs)} runs"
    keys = np.stack((run_of, np.floor(np.asarray(time) / BLOCK).astype(np.int64)), axis=1)
    found, piece = np.unique(keys, axis=0, return_inverse=True)
    return piece.ravel(), f"{len(found)} blocks of {BLOCK:g} s from {len(runs)} run{'s' if len(runs) > 1 else ''}"


def sums(piece: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Sums of values (n, ...) over the samples of each piece, (pieces, ...)."""
    values = np.asarray(values, float)
    result = np.zeros((int(piece.max()) + 1, *values.shape[1:]))
    np.add.at(result, piece, values)
    return result


def draws(count: int, pieces_count: int, seed: int) -> np.ndarray:
    """How often each piece is drawn, (count, pieces): each row is a bootstrap sample of as many pieces as there are."""
    generator = np.random.default_rng(seed)
    return generator.multinomial(pieces_count, np.full(pieces_count, 1.0 / pieces_count), size=count).astype(float)


def spread(values: np.ndarray, pieces_count: int) -> tuple[np.ndarray, np.ndarray]:
    """(covariance, correlation) of bootstrap values (count, p), widened by k / (k - 1) for k pieces."""
    covariance = np.atleast_2d(np.cov(np.asarray(values), rowvar=False)) * pieces_count / max(pieces_count - 1, 1)
    return covariance, correlation_of(covariance)


def intervals(values: Sequence[float], uncertainty: Sequence[float], pieces_count: int) -> list[tuple[float, float]]:
    """95 % intervals with Student's t of k - 1 degrees of freedom for k pieces: few runs make them wider."""
    freedom = max(pieces_count - 1, 1)
    return [symmetric_interval(float(v), float(u), freedom) for v, u in zip(values, uncertainty, strict=True)]
