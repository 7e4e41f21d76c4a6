"""Screening of candidate relations by the slopes about an answer: held-out gain and p-value of each."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats

from ..effects._law import COUNT
from ..vehicle import VehicleParameters
from .candidates import Candidate, candidates
from .relation_fit import SMOOTHING, RelationFit, RelationFits

DRAWS = 999  # random signs of the blocks
POINTS = 41  # of a line


@dataclass(frozen=True, eq=False)
class Screened:
    """A candidate by the slopes about the answer.

    smooth: the penalty of least held-out loss. observed, drawn: score statistic, and with random signs of the blocks
    (DRAWS,), both over the mean of the draws. freedom: effective degrees of freedom of the curve. design: design effect
    of dependent windows on the variance of the scores, >= 1, from the residual scores. held_out: (b,) loss. gain:
    held-out fall of the loss. information: (COUNT, COUNT) on the coefficients, other parameters projected out.
    """

    candidate: Candidate
    smooth: float
    observed: float
    drawn: np.ndarray
    freedom: float
    design: float
    held_out: np.ndarray
    gain: float
    information: np.ndarray

    def detectable(self, p_value: float, blocks: int) -> float:
        """Smallest detectable size at the end of the range [unit of the curve] of a straight line, at that p-value."""
        c = self.candidate
        at = np.linspace(c.low, c.high, POINTS)
        line = np.linalg.lstsq(c.splines(at).T, at / max(abs(c.low), abs(c.high)), rcond=1e-6)[0]
        required = 0.5 * float(stats.f.isf(p_value, self.freedom, blocks - 1)) * self.freedom * self.design
        return float(np.sqrt(required / max(float(line @ self.information @ line), 1e-30)))


def screen(fits: RelationFits, without: RelationFit, vehicle: VehicleParameters, seed: int,
           tick: Callable[[], None]) -> list[Screened]:
    """Every candidate that these drives excite and that changes a prediction. without: the answer alone."""
    away = ((without.vector - fits.start) / fits.space.scale)[without.which]
    base = fits.predicted_held_out(without.q, without.penalty, away)
    car = fits.slopes(without.vector, fits.car)
    signs = np.random.default_rng(seed).choice([-1.0, 1.0], (DRAWS, fits.blocks))
    found = []
    for candidate in candidates(fits.windows, vehicle):
        tick()
        one = _screen(fits, without, base, car, candidate, signs)
        if one is not None:
            found.append(one)
    return found


def p_values(screened: Sequence[Screened], blocks: int) -> dict[str, float]:
    """p-value by name that any candidate gains as much without a real effect; the smaller of two tests.

    Random signs of blocks: the largest statistic of all candidates in every draw. Likelihood ratio: twice the held-out
    gain over the design effect (of the candidate, or the median of all if larger) and its degrees of freedom, Fisher's
    F, Bonferroni over the candidates; for what acts in few blocks only.
    """
    largest = np.max([s.drawn for s in screened], axis=0)
    design = float(np.median([s.design for s in screened]))
    found = {}
    for s in screened:
        flipped = (1 + int((largest >= s.observed).sum())) / (1 + DRAWS)
        ratio = 2.0 * max(s.gain, 0.0) / max(design, s.design) / s.freedom
        found[s.candidate.name] = min(flipped, len(screened) * float(stats.f.sf(ratio, s.freedom, blocks - 1)))
    return found


def _screen(fits: RelationFits, without: RelationFit, base: np.ndarray, car: np.ndarray, candidate: Candidate,
            signs: np.ndarray) -> Screened | None:
    """Efficient scores of the coefficients: all other parameters projected out. base: (b,) held-out loss of the answer
    alone, by the same slopes. car: slopes of the vehicle file's parameters."""
    loss, slopes = fits.linear(candidate, without)
    q = fits.quadratic(loss, without.rows, np.concatenate([without.slopes, slopes]))
    h = q.hessian.sum(axis=0)
    if float(np.trace(h[-COUNT:, -COUNT:])) <= 1e-9 * float(np.trace(h)):
        return None
    q_all = fits.quadratic(loss, without.rows, np.concatenate([without.slopes, car, slopes]))
    away = np.concatenate([((without.vector - fits.start) / fits.space.scale)[without.which], np.zeros(COUNT)])
    best: Any = None
    for smooth in SMOOTHING:
        penalty = fits.penalty(candidate, h, smooth)
        held_out = fits.predicted_held_out(q, penalty, away)
        if best is None or held_out.sum() < best[0].sum():
            best = held_out, smooth, penalty
    held_out, smooth, penalty = best
    whole = q_all.hessian.sum(axis=0)
    others = whole[:-COUNT, :-COUNT]
    cross = np.linalg.solve(others + (1e-6 * np.trace(others) / max(len(others), 1) + 1e-9) * np.eye(len(others)),
                            whole[:-COUNT, -COUNT:])
    own = q_all.gradient[:, -COUNT:] - q_all.gradient[:, :-COUNT] @ cross
    remaining = whole[-COUNT:, -COUNT:] - whole[-COUNT:, :-COUNT] @ cross + penalty[-COUNT:, -COUNT:]
    inverse = np.linalg.pinv(remaining)
    drawn = np.einsum("di,ij,dj->d", signs @ own, inverse, signs @ own)
    mean = max(float(drawn.mean()), 1e-30)
    total = own.sum(axis=0)
    freedom = max(float(np.trace(inverse @ (remaining - penalty[-COUNT:, -COUNT:]))), 1.0)
    step = inverse @ total
    residual_gradient = q_all.gradient - q_all.hessian @ np.concatenate([-cross @ step, step])
    after = residual_gradient[:, -COUNT:] - residual_gradient[:, :-COUNT] @ cross
    design = max(2.0 * float(np.einsum("bi,ij,bj->", after, inverse, after)) / freedom, 1.0)
    return Screened(candidate, smooth, float(total @ inverse @ total) / mean, drawn / mean, freedom, design,
                    held_out, float((base - held_out).sum()), remaining - penalty[-COUNT:, -COUNT:])
