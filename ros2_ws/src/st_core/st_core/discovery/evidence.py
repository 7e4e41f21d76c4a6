"""Evidence of the drives for one effect in a set, in figures; `decision` draws the conclusions."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy import stats

from ..effects import get_effect
from ..regression import random_effects
from .fit import Fit, Problem, Slopes, bounded
from .levels import Level
from .loss import Quadratic
from .space import Space

FLIPS = 400  # of the signs of blocks: enough to resolve a p-value of 0.01
TWO_SIDED = float(stats.norm.ppf(0.975))
MIN_CURVATURE = 0.3  # of the curvature of the reweighted squares: errors far out may bend the loss down by no more
PART_PRIOR = 0.05  # of the whole curvature: a part of the driving need not show everything else alone
UNNAMED = 0.5  # usual sizes: standard deviation of an effect that is not in the set, for intervals of those that are
MIN_INFORMATION_SHARE = 0.02  # of the information; a part with less is ignored


@dataclass(frozen=True)
class Agreement:
    """An effect over the parts of a level. shares: of the value stated, with deviations, by part. differ [1]: chance
    that parts of one value differ so. absent [1]: chance that the next part shows none of it or the opposite."""

    shares: Mapping[str, tuple[float, float]]
    differ: float
    absent: float


@dataclass(frozen=True)
class AgainstFile:
    """A quantity of the vehicle file an effect changes. value: with the effect; file, deviation: as the file has it
    [unit]. deviations [1]: between them."""

    key: str
    unit: str
    value: float
    file: float
    deviation: float
    deviations: float


@dataclass(frozen=True)
class Evidence:
    """name: of the effect. gain [1]: fall of the held-out loss for each scored error, about the share of their size;
    the smaller of blocks and of whole runs held out. healthy [1]: the largest such gain of anything between drives of
    the healthy car.

    chance [1]: that anything of the library gains so much where nothing is. null [1]: of values at least as far from
    their null, were that the truth. shares: by column of the errors, (what it takes away of the size of the errors of
    the start, size without it over the noise) [1]. position [m]: fall of the mean held-out position error at
    the end of the horizon; position_somewhere: the largest in one driving condition (lower 95 % bound). left [1]: size
    of the errors with it over the noise, in the column where that is most. bound [1]: distance to the nearest bound in
    usual sizes. size [1]: distance of a value from its null, in usual sizes. sensors [1]: chance of the fitted value by
    what the sensors measure among themselves, and sensors_null of the null; None where they measure nothing.
    against_file: the quantity of the vehicle file with the value furthest from the file's; None where the file does not
    have it. agreement: by level.
    """

    name: str
    gain: float
    chance: float
    null: float = 0.0
    shares: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    position: float = 0.0
    position_somewhere: float = 0.0
    left: float = 1.0
    bound: float = 1.0
    healthy: float = 0.0
    size: float = 0.0
    sensors: float | None = None
    sensors_null: float | None = None
    against_file: AgainstFile | None = None
    agreement: Mapping[str, Agreement] = field(default_factory=dict)

    @property
    def share(self) -> float:
        """Share of the size of the errors removed when the loss falls by the gain for each of them: 1 - exp(-gain)."""
        return share_of(self.gain)


def share_of(gain: float) -> float:
    """1 - exp(-gain): below 0 where errors grow."""
    return -float(np.expm1(-gain))


@dataclass(frozen=True, eq=False)
class Scores:
    """Efficient scores of the library on top of a fit. own: (b, k) by effect; information: (k, k). largest: (FLIPS,)
    statistic of the best effect when the signs of the blocks are chance. design: what dependent windows make of the
    variance of a score, pooled over the library [1]. gains: (b,) linear gain, and the vector it leads to, by effect."""

    own: Mapping[str, np.ndarray]
    largest: np.ndarray
    design: float
    gains: Mapping[str, tuple[np.ndarray, np.ndarray]]


def score(q: Quadratic, problem: Problem, names: tuple[str, ...], effect: str,
          pull: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """((b, k) score of an effect that the effects `names` do not explain, (k,) information). q: by block, of all.
    pull: (p,) half gradient of the prior where the quadratic is about a fit."""
    new = problem.space.indices(effect)
    which = np.setdiff1d(problem.which(names), new)
    h = q.hessian.sum(axis=0) + problem.held((*names, effect), np.arange(len(problem.space)))
    gradient = q.gradient if pull is None else q.gradient - pull / len(q.gradient)
    if not len(which):
        return gradient[:, new], np.diag(h)[new]
    a = h[np.ix_(which, which)]
    a = a + 1e-9 * (np.trace(a) / len(a) + 1e-12) * np.eye(len(a))
    cross = np.linalg.solve(a, h[np.ix_(which, new)])
    left = h[np.ix_(new, new)] - h[np.ix_(new, which)] @ cross
    return gradient[:, new] - gradient[:, which] @ cross, np.maximum(np.diag(left), 0.0)


def statistic(own: np.ndarray) -> float:
    """s' (sum of s s')^-1 s: how far the sum of the blocks' scores is from what their signs by chance would give."""
    total = own.sum(axis=0)
    return float(total @ np.linalg.pinv(own.T @ own) @ total)


def screen(problem: Problem, fit: Fit, rng: np.random.Generator) -> Scores:
    """Every effect of the library that is not in the fit, by the slopes about it."""
    rows = problem.errors.at(fit.vector)
    q = problem.loss.quadratic(rows, problem.everything(fit.vector).values).summed(problem.block, problem.blocks)
    own, gains, ratios = {}, {}, []
    base = problem.leave_out(q.only(fit.which), fit.names, fit.vector, fit.which, problem.fold)[1]
    for effect in problem.space.hypotheses:
        if problem.space.overlaps(effect, fit.names):
            continue
        names = (*fit.names, effect)
        own[effect], information = score(q, problem, fit.names, effect, problem.pull(fit.vector))
        seen = information > 1e-9 * max(float(np.trace(q.hessian.sum(axis=0))), 1e-30)
        ratios += list(2.0 * np.square(own[effect]).sum(axis=0)[seen] / information[seen])
        which = problem.which(names)
        part = q.only(which)
        held_out = problem.leave_out(part, names, fit.vector, which, problem.fold)[1]
        step = problem.solve(part, names, fit.vector, which)
        gains[effect] = base - held_out, problem.moved(fit.vector, which, step)
    signs = rng.choice([-1.0, 1.0], (FLIPS, problem.blocks))
    largest = np.zeros(FLIPS)
    for s in own.values():
        drawn = signs @ s
        largest = np.maximum(largest, np.einsum("fi,ij,fj->f", drawn, np.linalg.pinv(s.T @ s), drawn))
    return Scores(own, largest, max(float(np.median(ratios)) if ratios else 1.0, 1.0), gains)


def chance(own: np.ndarray, gain: np.ndarray, scores: Scores, library: int) -> float:
    """That something of the library does as well where nothing is: the smaller p-value of two tests.

    Signs of blocks: the score beyond the largest of the library with signs drawn by chance, and a gain that is above
    zero over the blocks. Likelihood ratio: twice the gain over the design effect, for all of the library; needed for
    what acts in a few blocks only. The design effect is known from so many blocks: Fisher's F, not chi-square.
    """
    blocks, values = own.shape
    if blocks < 2:
        return 1.0
    flipped = (1 + int((scores.largest >= statistic(own)).sum())) / (1 + len(scores.largest))
    spread = float(gain.std(ddof=1)) * np.sqrt(len(gain)) if len(gain) > 1 else np.inf
    even = float(stats.norm.sf(gain.sum() / max(spread, 1e-12)))
    ratio = 2.0 * max(float(gain.sum()), 0.0) / scores.design
    return min(max(flipped, even), library * float(stats.f.sf(ratio / values, values, blocks - 1)), 1.0)


def evidence(problem: Problem, without: Fit, fit: Fit, effect: str, scores: Scores, levels: Mapping[str, Level],
             sensors: Mapping[str, tuple[float, float, float]]) -> Evidence:
    """Of an effect of `fit`, against `without` it. scores: of the library, on about that. sensors: parameters of the
    effect as the sensors measure it among themselves, (value, low, high)."""
    gain = without.held_out - fit.held_out
    by_run = float((problem.held_out_apart(without) - problem.held_out_apart(fit)).sum())
    own = scores.own.get(effect)
    if own is None:
        own = score_of(problem, without, effect, fit.slopes)
    rows = problem.held_out_rows(without, problem.apart), problem.held_out_rows(fit, problem.apart)
    before, after = (problem.position(r) for r in rows)
    if problem.prior is not None:  # a known car is as it was without the effect: nothing else makes up for it
        rows = problem.errors.at(problem.put_back(fit, effect)), rows[1]
    overall, somewhere = falls(before - after, levels.get("condition"))
    return Evidence(effect, min(float(gain.sum()), by_run) / problem.number,
                    chance(own, gain, scores, len(problem.space.hypotheses)), of_null(problem, fit, effect),
                    shares(problem, *rows), overall, somewhere,
                    left_over(problem, rows[1]),
                    to_bound(problem, fit, effect), problem.healthy, size_of(problem, fit, effect),
                    *by_sensors(problem, fit, effect, sensors), against_file(problem, fit, effect),
                    {name: agreement(problem, fit, effect, *level) for name, level in levels.items()})


def left_over(problem: Problem, rows: np.ndarray) -> float:
    """Size of errors over the noise. With a reference what no effect describes is in the healthy car as well, and no
    change of it can imitate that: 1."""
    if problem.prior is not None:
        return 1.0
    return float((problem.sizes(rows) / np.maximum(problem.noise, 1e-12)).max())


def shares(problem: Problem, without: np.ndarray, rows: np.ndarray) -> dict[str, tuple[float, float]]:
    """By column: fall of the size of the errors over that of the start, or without the effect if that is larger; and
    the size without it over the noise."""
    before, after = problem.sizes(without), problem.sizes(rows)
    return {column: (float(fall), float(over)) for column, fall, over in zip(
        problem.errors.windows.columns, (before - after) / np.maximum(problem.size_of_start, before),
        before / np.maximum(problem.noise, 1e-12), strict=True)}


def score_of(problem: Problem, fit: Fit, effect: str, slopes: Slopes) -> np.ndarray:
    """(b, k) efficient scores of an effect on top of a fit. slopes: of both, about a point near by."""
    which = np.union1d(fit.which, problem.space.indices(effect))
    q = problem.loss.quadratic(problem.errors.at(fit.vector), slopes.of(which)).summed(problem.block, problem.blocks)
    whole = Quadratic(q.cost, np.zeros((problem.blocks, len(problem.space))),
                      np.zeros((problem.blocks, len(problem.space), len(problem.space))))
    whole.gradient[:, which] = q.gradient
    whole.hessian[:, which[:, None], which] = q.hessian
    return score(whole, problem, fit.names, effect, problem.pull(fit.vector))[0]


def falls(fall: np.ndarray, condition: Level | None) -> tuple[float, float]:
    """(mean fall of an error, the largest that is sure in one driving condition) from that of each window."""
    known = np.isfinite(fall)
    if not known.any():
        return 0.0, 0.0
    overall = float(fall[known].mean())
    if condition is None:
        return overall, overall
    parts = [fall[known & (condition[0] == k)] for k in np.unique(condition[0])]
    sure = [float(p.mean() - 1.645 * p.std(ddof=1) / np.sqrt(len(p))) for p in parts if len(p) > 2]
    return overall, max(sure, default=overall)


def to_bound(problem: Problem, fit: Fit, effect: str) -> float:
    """Distance of the effect's values to their nearest bounds, in usual sizes. Bounds at the null, at the theoretical
    value or of the shape of a curve do not count."""
    space, nearest = problem.space, np.inf
    for i in space.indices(effect):
        null, shape = next((p.null, p.shape) for p in get_effect(effect).parameters
                           if p.name == space.free[i].parameter)
        if shape:
            continue
        for edge in (space.low[i], space.high[i]):
            if edge not in (null, space.free[i].theory):
                nearest = min(nearest, abs(fit.vector[i] - edge) / space.scale[i])
    return float(nearest)


def size_of(problem: Problem, fit: Fit, effect: str) -> float:
    """Largest distance of the effect's values from their null, in usual sizes."""
    own = problem.space.indices(effect)
    return float(np.abs((fit.vector - problem.space.null) / problem.space.scale)[own].max())


def against_file(problem: Problem, fit: Fit, effect: str) -> AgainstFile | None:
    """The quantity of the vehicle file that an effect takes furthest from the file's value, in standard deviations."""
    found = []
    for i in problem.space.indices(effect) if problem.prior is None else ():
        known, change = problem.quantities[i], float(fit.vector[i] - problem.space.null[i])
        if known is not None:
            found.append(AgainstFile(known.key, known.unit, known.at(change), known.value, known.deviation,
                                     known.deviations(change)))
    return max(found, key=lambda a: a.deviations, default=None)


def by_sensors(problem: Problem, fit: Fit, effect: str, sensors: Mapping) -> tuple[float | None, float | None]:
    """Chance of a value at least as far from what the sensors measure among themselves, and of the null by that; None
    where they measure nothing."""
    own = dict(zip(problem.space.indices(effect), deviation(problem, fit, effect), strict=True))
    agree = [_as_far(fit.vector[i] - value, np.hypot(spread, own[i]))
             for i, value, spread in _measured(problem.space, effect, sensors)]
    # With a reference the null is what the healthy car had, and that the sensors do not know.
    deny = null_by_sensors(problem.space, effect, sensors) if problem.prior is None else None
    return min(agree, default=None), deny


def null_by_sensors(space: Space, effect: str, sensors: Mapping) -> float | None:
    """p-value of what the sensors measure among themselves without the effect; None where they measure nothing."""
    return min((_as_far(space.free[i].null - value, spread) for i, value, spread in _measured(space, effect, sensors)),
               default=None)


def _measured(space: Space, effect: str, sensors: Mapping) -> list[tuple[int, float, float]]:
    """(index, value, standard deviation) of the parameters the sensors measure among themselves."""
    named = [(i, sensors.get(f"{effect}.{space.free[i].parameter}")) for i in space.indices(effect)]
    return [(i, known[0], (known[2] - known[1]) / (2.0 * TWO_SIDED)) for i, known in named if known]


def _as_far(distance: float, spread: float) -> float:
    return 2.0 * float(stats.norm.sf(abs(distance) / max(spread, 1e-12)))


def inverse(h: np.ndarray) -> np.ndarray:
    return np.linalg.pinv(h + 1e-9 * (np.trace(h) / max(len(h), 1) + 1e-12) * np.eye(len(h)))


def deviation(problem: Problem, fit: Fit, effect: str) -> np.ndarray:
    """(k,) standard deviations of the values of an effect [unit]: blocks independent, everything fitted joint."""
    variance = covariance(problem, fit)
    own = np.searchsorted(fit.which, problem.space.indices(effect))
    return np.sqrt(np.maximum(np.diag(variance)[own], 0.0)) * problem.space.scale[fit.which[own]]


def covariance(problem: Problem, fit: Fit) -> np.ndarray:
    """(a, a) of what moved, in usual sizes: sandwich over the blocks, about the second derivative of the loss."""
    q = fit.quadratic.summed(problem.block, problem.blocks)
    bent = problem.loss.curvature(problem.errors.at(fit.vector), fit.slopes.of(fit.which))
    h = inverse(_no_flatter(bent, q.hessian.sum(axis=0)) + problem.held(fit.names, fit.which))
    off = q.gradient - q.gradient.mean(axis=0)  # at the optimum the sum is what the prior pulls
    scatter = off.T @ off * problem.blocks / max(problem.blocks - 1, 1)
    if problem.prior is None:  # a value of the file is known to its deviation: (curvature deviation)^2 of the pull
        scatter = scatter + np.diag(0.5 * problem.design * problem.known[fit.which])
    return h @ scatter @ h


@dataclass(frozen=True, eq=False)
class Joint:
    """A fit with everything else of the library free as well. which: (a,) numbers that move; covariance: (a, a) of
    them, in usual sizes; shift: (a,) by which their best values differ from the fit's."""

    which: np.ndarray
    covariance: np.ndarray
    shift: np.ndarray

    def of(self, indices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(standard deviations, shifts) in usual sizes of some of the numbers."""
        place = np.searchsorted(self.which, indices)
        return np.sqrt(np.maximum(np.diag(self.covariance)[place], 0.0)), self.shift[place]


def joint(problem: Problem, fit: Fit) -> Joint:
    """What a fit leaves open when the quantities of the vehicle file are as uncertain as it declares, and every effect
    that was not chosen may be there with a standard deviation of UNNAMED.

        covariance = (D / 2) (H + K)^-1,   K: curvature of the priors,   D: the design effect

    That an effect was not chosen does not mean that it is not there; what it could take from a value is in this.
    Source: Laplace approximation of the posterior; Pauli and others, composite likelihoods with a curvature adjusted by
    the design effect, Statistica Sinica 21 (2011).
    """
    space, names = problem.space, fit.names
    others = [n for n in space.hypotheses if not space.overlaps(n, names) and not get_effect(n).members]
    which = np.union1d(fit.which, space.indices(*others))
    q = problem.loss.quadratic(problem.errors.at(fit.vector), problem.everything(fit.vector).of(which))
    known = problem.known[which]
    free = ((known == 0.0) | (space.deviation[which] < np.inf)) & ~np.isin(which, fit.which)
    known[free] = 0.5 * problem.design / UNNAMED**2
    h = q.hessian.sum(axis=0) + np.diag(known)
    h = h + (1e-9 * np.trace(h) / len(h)) * np.eye(len(h))
    away = ((fit.vector - problem.start) / space.scale)[which]
    shift = bounded(h, q.gradient.sum(axis=0) - known * away, *problem.room(fit.vector, which))
    return Joint(which, 0.5 * problem.design * np.linalg.inv(h), shift)


def _no_flatter(bent: np.ndarray, whole: np.ndarray) -> np.ndarray:
    """A curvature that is MIN_CURVATURE of `whole`, that of the reweighted squares, at the least in any direction."""
    if not len(bent):
        return bent
    root = np.linalg.cholesky(whole + 1e-9 * (np.trace(whole) / len(whole) + 1e-12) * np.eye(len(whole)))
    values, vectors = np.linalg.eigh(np.linalg.solve(root, np.linalg.solve(root, bent).T))
    turn = root @ vectors
    return (turn * np.maximum(values, MIN_CURVATURE)) @ turn.T


def of_null(problem: Problem, fit: Fit, effect: str) -> float:
    """Chance of values as far from the start as these, by their sandwich covariance (Hotelling's T^2)."""
    own = problem.space.indices(effect)
    place = np.searchsorted(fit.which, own)
    variance = covariance(problem, fit)[np.ix_(place, place)]
    d = ((fit.vector - problem.start) / problem.space.scale)[own]
    freedom = problem.blocks - len(own)
    if freedom < 1:
        return 1.0
    square = float(d @ np.linalg.pinv(variance) @ d)
    return float(stats.f.sf(square * freedom / (len(own) * max(problem.blocks - 1, 1)), len(own), freedom))


def agreement(problem: Problem, fit: Fit, effect: str, part: np.ndarray, called: list[str]) -> Agreement:
    """How much of an effect each part of the driving shows, by random effects.

    Along the values stated, d, a part shows the share a = 1 + what its own gradient moves it by, everything else that
    was fitted being free but held a little to the whole. Variances carry the design effect of dependent windows.
    """
    own = np.searchsorted(fit.which, problem.space.indices(effect))
    rest = np.setdiff1d(np.arange(len(fit.which)), own)
    d = ((fit.vector - problem.space.null) / problem.space.scale)[fit.which[own]]
    turn = np.zeros((len(fit.which), 1 + len(rest)))
    turn[own, 0] = d
    turn[rest, 1 + np.arange(len(rest))] = 1.0
    q = fit.quadratic.summed(part)
    g, h = q.gradient @ turn, turn.T @ q.hessian @ turn
    whole = h.sum(axis=0)
    everything = inverse(whole)
    blocks = fit.quadratic.summed(problem.block, problem.blocks).gradient @ turn
    design = max(float((everything @ (blocks.T @ blocks) @ everything)[0, 0] / max(everything[0, 0], 1e-30)), 0.5)
    hold = PART_PRIOR * whole / len(h)
    hold[0, :] = hold[:, 0] = 0.0
    shares, variances, names = [], [], []
    total = 1.0 / max(everything[0, 0], 1e-30)
    for k in range(len(h)):
        own_inverse = inverse(h[k] + hold)
        information = 1.0 / max(own_inverse[0, 0], 1e-30)
        if h[k, 0, 0] <= 0.0 or information < MIN_INFORMATION_SHARE * total:
            continue
        shares.append(1.0 + float((own_inverse @ g[k])[0]))
        variances.append(design / information)
        names.append(called[k])
    return pooled(np.array(shares), np.array(variances), names)


def pooled(shares: np.ndarray, variances: np.ndarray, names: list[str]) -> Agreement:
    collected = {n: (float(s), float(np.sqrt(v))) for n, s, v in zip(names, shares, variances, strict=True)}
    if len(shares) < 2:
        return Agreement(collected, 1.0, 0.0)
    mean, error, between, q = random_effects(shares, variances)
    return Agreement(collected, float(stats.chi2.sf(q, len(shares) - 1)),
                     float(stats.norm.sf(mean / np.sqrt(between + error**2))))
