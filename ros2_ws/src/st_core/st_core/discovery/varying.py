"""What is there in some parts of the driving only: effects with another value in each run, site or stretch of time.

An effect that comes in the middle of a drive has no one value that helps everywhere, so that the search cannot find it.
Here each part of a level has its own, by the quadratic about the answer.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy import stats

from ..effects import get_effect
from .evidence import Evidence, error_reductions, inverse, shares
from .fit import Fit, Problem
from .levels import Level
from .loss import Quadratic


@dataclass(frozen=True)
class Varying:
    """An effect with a value of its own in each part of a level. gain [1]: fall of the loss for each scored error
    beyond that of one value. chance [1]: that anything of the library gains so much where nothing is. values: of the
    parameters [unit] by part, with standard deviations; the first parameter is what shows most. steps: (p,) in usual
    sizes, by number of the part."""

    name: str
    level: str
    gain: float
    chance: float
    parameter: str
    values: Mapping[str, tuple[float, float]]
    steps: Mapping[int, np.ndarray]


def varying(problem: Problem, fit: Fit, levels: Mapping[str, Level]) -> list[Varying]:
    """Largest gain first. Levels with half as many parts as blocks, or more, are left out."""
    q = problem.loss.quadratic(problem.errors.at(fit.vector), problem.everything(fit.vector).values)
    usable = {name: level for name, level in levels.items() if len(np.unique(level[0])) < problem.blocks / 2}
    library = [n for n in problem.space.hypotheses if not get_effect(n).members]
    collected = [_one(problem, fit, q, effect, name, level, len(library) * len(usable))
            for name, level in usable.items() for effect in library]
    return sorted((s for s in collected if s), key=lambda s: -s.gain)


def _design(problem: Problem, part: np.ndarray, seen: list, g: np.ndarray, hh: np.ndarray) -> float:
    """What dependent windows make of the variance of these values, 1 at least: by what is left of the blocks' scores
    once each part has its own values."""
    left = g.copy()
    for k, gk, hk in seen:
        mine = part == k
        left[mine] -= hh[mine] @ (inverse(hk) @ gk)
    blocks = np.zeros((problem.blocks, g.shape[1]))
    np.add.at(blocks, problem.block, left)
    return max(2.0 * float(np.trace(inverse(hh.sum(axis=0)) @ blocks.T @ blocks)) / g.shape[1], 1.0)


def _one(problem: Problem, fit: Fit, q: Quadratic, effect: str, name: str, level: Level,
         tests: int) -> Varying | None:
    own = problem.space.indices(effect)
    rest = np.setdiff1d(problem.which(fit.names) if problem.prior is None else problem.space.indices(*fit.names), own)
    h = q.hessian.sum(axis=0)
    turn = np.zeros((len(problem.space), len(own)))
    turn[own, np.arange(len(own))] = 1.0
    if len(rest):
        turn[rest] = -inverse(h[np.ix_(rest, rest)]) @ h[np.ix_(rest, own)]
    part, called = level
    numbers = np.unique(part)
    g, hh = q.gradient @ turn, turn.T @ q.hessian @ turn
    sums = [(g[part == k].sum(axis=0), hh[part == k].sum(axis=0)) for k in numbers]
    whole = sum(s[1] for s in sums)
    least = 1e-9 * float(np.trace(h)) / len(h)
    if np.diag(whole).min() <= least:
        return None
    seen = [(k, gk, hk) for k, (gk, hk) in zip(numbers, sums, strict=True) if np.diag(hk).min() > 0.02 * np.diag(
        whole).min()]
    if len(seen) < 2:
        return None
    apart = sum(float(gk @ inverse(hk) @ gk) for _, gk, hk in seen)
    total = sum(gk for _, gk, _ in seen)
    gain = apart - float(total @ inverse(sum(hk for *_, hk in seen)) @ total)
    freedom, blocks = (len(seen) - 1) * len(own), problem.blocks - len(seen)
    if blocks < 1:
        return None
    design = _design(problem, part, seen, g, hh) * problem.blocks / blocks
    chance = min(tests * float(stats.f.sf(2.0 * gain / design / freedom, freedom, blocks)), 1.0)
    best = int(np.argmax(np.diag(whole)))
    at = float(fit.vector[own[best]])
    scale = problem.space.scale[own[best]]
    values = {called[k]: (at + scale * float((inverse(hk) @ gk)[best]),
                          scale * float(np.sqrt(0.5 * design * inverse(hk)[best, best]))) for k, gk, hk in seen}
    steps = {int(k): turn @ (inverse(hk) @ gk) for k, gk, hk in seen}
    return Varying(effect, name, gain / problem.number, chance, problem.space.free[own[best]].parameter, values, steps)


def evidence_of(problem: Problem, fit: Fit, v: Varying, levels: Mapping[str, Level]) -> Evidence:
    """What values of its own in each part take away, to the first order; on the driving they were fitted to."""
    rows = problem.errors.at(fit.vector)
    own, slopes = rows.copy(), problem.everything(fit.vector).values
    for k, step in v.steps.items():
        mine = levels[v.level][0] == k
        own[mine] -= np.tensordot(step, slopes[:, mine], 1)
    overall, somewhere = error_reductions(problem.position(rows) - problem.position(own), levels.get("condition"))
    return Evidence(v.name, v.gain, v.chance, shares=shares(problem, rows, own), position=overall,
                    position_somewhere=somewhere, healthy=problem.healthy)
