"""Which laws may be there, by the slopes about an answer: held-out gain, and the chance that nothing is."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats

from ..effects._law import COUNT
from ..vehicle import VehicleParameters
from .curve_fit import SMOOTH, Fitted, Laws
from .places import Candidate, candidates

DRAWS = 999  # signs of the blocks drawn by chance
POINTS = 41  # of a line


@dataclass(frozen=True, eq=False)
class Screened:
    """A law by the slopes about the answer. smooth: the penalty that holds out best. observed, drawn: what its freedom
    gains, and with the signs of the blocks by chance (DRAWS,), both over the mean of the draws. freedom: numbers the
    penalty leaves to the curve. design: what dependent windows make of the variance of its scores, 1 at least, by what
    is left of them with the law. gain: held out. information: (COUNT, COUNT) of the drives on the coefficients, what
    everything beside can do taken out."""

    candidate: Candidate
    smooth: float
    observed: float
    drawn: np.ndarray
    freedom: float
    design: float
    gain: float
    information: np.ndarray

    def visible(self, chance: float, blocks: int) -> float:
        """Size at the end of the range [unit of the curve] from which on a straight line is surer than that chance."""
        c = self.candidate
        at = np.linspace(c.low, c.high, POINTS)
        line = np.linalg.lstsq(c.splines(at).T, at / max(abs(c.low), abs(c.high)), rcond=1e-6)[0]
        wanted = 0.5 * float(stats.f.isf(chance, self.freedom, blocks - 1)) * self.freedom * self.design
        return float(np.sqrt(wanted / max(float(line @ self.information @ line), 1e-30)))


def screen(laws: Laws, without: Fitted, vehicle: VehicleParameters, seed: int,
           tick: Callable[[], None]) -> list[Screened]:
    """Every law these drives can ask and that changes a prediction. without: no law, at its best."""
    base = laws.promised(without.q, without.penalty, ((without.vector - laws.start) / laws.space.scale)[without.which])
    car = laws.slopes(without.vector, laws.car)
    signs = np.random.default_rng(seed).choice([-1.0, 1.0], (DRAWS, laws.blocks))
    found = []
    for candidate in candidates(laws.windows, vehicle):
        tick()
        one = _screen(laws, without, base, car, candidate, signs)
        if one is not None:
            found.append(one)
    return found


def chances_of(screened: Sequence[Screened], blocks: int) -> dict[str, float]:
    """That any law gains as much where nothing is, by name; the smaller of two tests, as for the library.

    Signs of blocks: the largest of all laws, each refitted in every draw. Likelihood ratio: twice the held-out gain
    over the design effect (of the law, or the median of all laws if larger) and the freedom of the curve, Fisher's F,
    for all laws; needed for what acts in a few blocks only.
    """
    largest = np.max([s.drawn for s in screened], axis=0)
    design = float(np.median([s.design for s in screened]))
    found = {}
    for s in screened:
        flipped = (1 + int((largest >= s.observed).sum())) / (1 + DRAWS)
        ratio = 2.0 * max(s.gain, 0.0) / max(design, s.design) / s.freedom
        found[s.candidate.name] = min(flipped, len(screened) * float(stats.f.sf(ratio, s.freedom, blocks - 1)))
    return found


def _screen(laws: Laws, without: Fitted, base: np.ndarray, car: np.ndarray, candidate: Candidate,
            signs: np.ndarray) -> Screened | None:
    """Efficient scores of the coefficients: what everything beside explains is taken out of them. base: (b,)
    held-out loss without a law, by the same slopes. car: slopes of the vehicle file's parameters."""
    loss, slopes = laws.linear(candidate, without)
    q = laws.quadratic(loss, without.rows, np.concatenate([without.slopes, slopes]))
    h = q.hessian.sum(axis=0)
    if float(np.trace(h[-COUNT:, -COUNT:])) <= 1e-9 * float(np.trace(h)):
        return None
    q_all = laws.quadratic(loss, without.rows, np.concatenate([without.slopes, car, slopes]))
    away = np.concatenate([((without.vector - laws.start) / laws.space.scale)[without.which], np.zeros(COUNT)])
    best: Any = None
    for smooth in SMOOTH:
        penalty = laws.penalty(candidate, h, smooth)
        gain = float((base - laws.promised(q, penalty, away)).sum())
        if best is None or gain > best[0]:
            best = gain, smooth, penalty
    gain, smooth, penalty = best
    whole = q_all.hessian.sum(axis=0)
    rest = whole[:-COUNT, :-COUNT]
    cross = np.linalg.solve(rest + (1e-6 * np.trace(rest) / max(len(rest), 1) + 1e-9) * np.eye(len(rest)),
                            whole[:-COUNT, -COUNT:])
    own = q_all.gradient[:, -COUNT:] - q_all.gradient[:, :-COUNT] @ cross
    left = whole[-COUNT:, -COUNT:] - whole[-COUNT:, :-COUNT] @ cross + penalty[-COUNT:, -COUNT:]
    inverse = np.linalg.pinv(left)
    drawn = np.einsum("di,ij,dj->d", signs @ own, inverse, signs @ own)
    mean = max(float(drawn.mean()), 1e-30)
    total = own.sum(axis=0)
    freedom = max(float(np.trace(inverse @ (left - penalty[-COUNT:, -COUNT:]))), 1.0)
    step = inverse @ total
    rest_of = q_all.gradient - q_all.hessian @ np.concatenate([-cross @ step, step])
    after = rest_of[:, -COUNT:] - rest_of[:, :-COUNT] @ cross
    design = max(2.0 * float(np.einsum("bi,ij,bj->", after, inverse, after)) / freedom, 1.0)
    return Screened(candidate, smooth, float(total @ inverse @ total) / mean, drawn / mean, freedom, design, gain,
                     left - penalty[-COUNT:, -COUNT:])
