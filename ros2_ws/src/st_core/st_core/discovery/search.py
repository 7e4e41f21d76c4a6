"""The set of effects that explains the drives best: forward, backward and exchange steps with one and the same test."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy import stats

from ..effects import get_effect
from .decision import STATED, Rival, judge
from .evidence import Evidence, Scores, evidence, screen
from .fit import Fit, Problem, Slopes
from .levels import Level
from .limits import Limits
from .loss import Quadratic
from .result import Reason

CONTENDERS = 4  # refitted through the simulator in a step
NEAR = 0.5  # of the best one's gain: contenders below that are not looked at
STARTS = 3  # different first effects
LOOSE = 3.0  # usual sizes: how far everything at once may go
EXCHANGES = 3  # rounds


@dataclass
class Found:
    """fit: the answer. order: names as they came in. evidence, without: of each of them, the fit without it. refused:
    what was tried on top of it, with the verdict. rivals: in the place of each. scores: of the library on top of it."""

    fit: Fit
    order: list[str]
    evidence: dict[str, Evidence] = field(default_factory=dict)
    without: dict[str, Fit] = field(default_factory=dict)
    refused: dict[str, tuple[Evidence, Reason, Fit]] = field(default_factory=dict)
    rivals: dict[str, list[Rival]] = field(default_factory=dict)
    scores: Scores | None = None


class Search:
    """levels: ways to divide the driving. sensors: what the sensors say among themselves, (value, low, high) by
    "effect.parameter". tick: called now and then as the search goes on."""

    def __init__(self, problem: Problem, limits: Limits, levels: Mapping[str, Level], sensors: Mapping,
                 seed: int = 0, tick: Callable[[], None] = lambda: None):
        self.problem, self.limits, self.levels, self.sensors, self.tick = problem, limits, levels, sensors, tick
        self.seed = seed
        self._seen: set[frozenset[str]] = set()

    def run(self) -> Found:
        """The best of several starts: from nothing, from everything at once, from other first effects."""
        p, rng = self.problem, np.random.default_rng(self.seed)
        at = p.loss.scale.copy()
        base = p.fit((), p.everything(p.start))
        first = screen(p, base, rng)
        ranked = sorted(first.gains, key=lambda e: -first.gains[e][0].sum())
        best = first.gains[ranked[0]][0].sum()
        answers = [self._from(base, first)]
        pruned = self._pruned(answers[0].fit.vector, at)
        if pruned:
            answers.append(self._from(self._cleaned(pruned)))
        for name in ranked[1:STARTS]:
            if first.gains[name][0].sum() > NEAR * best > self.limits.negligible * p.number:
                p.loss.scale = at.copy()
                start = p.fit((name,), p.everything(p.start), first.gains[name][1], (name,), 2)
                answers.append(self._from(start))
        return self._settled(self._best([a for a in answers if a]))

    def _from(self, fit: Fit, scores: Scores | None = None) -> Found | None:
        """Steps until nothing is accepted; None where they lead to a set that was seen before."""
        p = self.problem
        found = Found(fit, list(fit.names), scores=scores)
        while True:
            key = frozenset(found.fit.names)
            if key in self._seen:
                return None
            self._seen.add(key)
            added = self._forward(found) if len(found.fit.names) < self.limits.most else None
            if added is None:
                return found
            found.fit = self._renewed(self._backward(added, found.scores))
            found.order = [n for n in dict.fromkeys((*found.order, *added.names)) if n in found.fit.names]
            found.scores = None

    def _renewed(self, fit: Fit) -> Fit:
        """At the scale of its own errors."""
        self.problem.loss.rescale(fit.vector)
        return self.problem.renewed(fit)

    def _cleaned(self, fit: Fit) -> Fit:
        """Without the effects that fail the test, weakest first."""
        while fit.names:
            found = Found(fit, list(fit.names))
            smaller = self._measured(found)
            if smaller is None:
                break
            fit = self._renewed(smaller)
        return fit

    def _best(self, answers: list[Found]) -> Found:
        """At the scale of the one with the smallest errors; one effect more must be worth it."""
        p = self.problem
        if len(answers) > 1:
            smallest = min(answers, key=lambda a: float(np.log(p.loss.scale_of(a.fit.vector)).sum()))
            p.loss.rescale(smallest.fit.vector)
            for a in answers:
                a.fit = p.fit(a.fit.names, a.fit.slopes, iterations=2)
        price = self.limits.negligible * p.number
        return min(answers, key=lambda a: float(a.fit.held_out.sum()) + price * len(a.fit.names))

    def _forward(self, found: Found) -> Fit | None:
        """The best effect more that is accepted; None if there is none."""
        p, limits = self.problem, self.limits
        self.tick()
        if found.scores is None:
            found.scores = screen(p, found.fit, np.random.default_rng(self.seed))
        gains = found.scores.gains
        least = limits.negligible * p.number
        ranked = [e for e in sorted(gains, key=lambda e: -gains[e][0].sum()) if gains[e][0].sum() > 0.5 * least]
        fits = {effect: self._more(found.fit, effect, gains[effect][1]) for effect in ranked[:CONTENDERS]}
        if not fits:
            return None
        without, fits = self._finer(found.fit, fits)
        best = max(self._gain(without, f) for f in fits.values())
        found.refused = {}
        for effect in self._in_turn(fits, without):
            gain = self._gain(without, fits[effect])
            if gain < NEAR * best:
                break
            e = self._evidence(without, fits[effect], effect, found.scores)
            verdict = judge(e, limits)
            if verdict.rule == STATED:
                return fits[effect]
            found.refused[effect] = e, verdict, fits[effect]
        return None

    def _more(self, fit: Fit, effect: str, there: np.ndarray, around: Slopes | None = None) -> Fit:
        """A fit with an effect more, begun where the quadratic promises most. around: slopes, of `fit` if not given."""
        p = self.problem
        self.tick()
        better = p.loss.total(there) < p.loss.total(fit.vector)
        slopes = p.everything(fit.vector) if around is None else around
        return p.fit((*fit.names, effect), slopes, there if better else fit.vector, (effect,), 2)

    @staticmethod
    def _gain(without: Fit, fit: Fit) -> float:
        return float((without.held_out - fit.held_out).sum())

    def _in_turn(self, fits: Mapping[str, Fit], without: Fit) -> list[str]:
        """Best first; a member goes before its composite unless that is clearly better."""
        gain = {e: self._gain(without, f) for e, f in fits.items()}
        order = sorted(fits, key=lambda e: -gain[e])
        for name in [e for e in order if get_effect(e).members]:
            close = max(self.limits.negligible * self.problem.number, self.limits.doubt * gain[name])
            near = [m for m in get_effect(name).members if m in gain and gain[name] - gain[m] < close]
            if near:
                order.remove(name)
                order.insert(max(order.index(m) for m in near) + 1, name)
        return order

    def _finer(self, without: Fit, fits: dict[str, Fit]) -> tuple[Fit, dict[str, Fit]]:
        """Contenders once more at the scale of the best: beside errors of a metre they all look alike."""
        p = self.problem
        best = max(fits, key=lambda e: self._gain(without, fits[e]))
        gain = self._gain(without, fits[best])
        near = {e: f for e, f in fits.items() if self._gain(without, f) > NEAR * gain}
        if len(near) < 2 or gain < 10.0 * self.limits.negligible * p.number:
            return without, fits
        p.loss.rescale(fits[best].vector)
        return (p.fit(without.names, without.slopes, iterations=1),
                {e: p.fit(f.names, f.slopes, None, (e,), 2) for e, f in near.items()})

    def _evidence(self, without: Fit, fit: Fit, effect: str, scores: Scores) -> Evidence:
        return evidence(self.problem, without, fit, effect, scores, self.levels, self.sensors)

    def _backward(self, fit: Fit, scores: Scores) -> Fit:
        """Without what is no longer needed beside the rest."""
        p = self.problem
        while len(fit.names) > 1:
            promised = {n: self._promised(fit, n) for n in fit.names}
            weakest = min(promised, key=promised.get)
            if promised[weakest] > 3.0 * self.limits.worth * p.number:
                return fit
            self.tick()
            without = p.fit(tuple(n for n in fit.names if n != weakest), fit.slopes, iterations=2)
            if judge(self._evidence(without, fit, weakest, scores), self.limits).rule == STATED:
                return fit
            fit = without
        return fit

    def _promised(self, fit: Fit, name: str) -> float:
        """Loss that a fit without one of its effects would have more, by its quadratic."""
        p = self.problem
        q = fit.quadratic
        rest = tuple(n for n in fit.names if n != name)
        gone = np.isin(fit.which, np.setdiff1d(p.space.indices(name), p.space.indices(*rest)))
        d = _held_at(p, q, rest, fit.which, np.where(gone, ((p.space.null - fit.vector) / p.space.scale)[fit.which], 0.0),
                     ~gone)
        h, g = q.hessian.sum(axis=0), q.gradient.sum(axis=0)
        return float(d @ h @ d - 2.0 * g @ d)

    def _pruned(self, vector: np.ndarray, scale: np.ndarray) -> Fit | None:
        """From everything at once, held a little, by leaving out what is missed least. At the scale the first answer
        left, which is finer than `scale`, that of the beginning."""
        p = self.problem
        library = [n for n in p.space.hypotheses if not get_effect(n).members]
        everything = np.arange(len(p.space))
        loose = Problem(p.loss, p.start, p.block, np.eye(len(p.space)) / LOOSE**2)
        self.tick()
        q = p.loss.quadratic(p.errors.at(vector), p.everything(vector).values)
        there = loose.moved(vector, everything, loose.solve(q, (), vector, everything))
        if p.loss.total(there) < p.loss.total(vector):
            self.tick()
            vector = there
            q = p.loss.quadratic(p.errors.at(vector), p.everything(vector).values)
        back = (p.start - vector) / p.space.scale
        h, g = q.hessian.sum(axis=0), q.gradient.sum(axis=0)

        def cost(kept: list[str]) -> float:
            free = np.isin(everything, p.which(kept))
            d = _held_at(p, q, kept, everything, np.where(free, 0.0, back), free)
            return float(d @ h @ d - 2.0 * g @ d)
        names = list(library)
        while names:
            now = cost(names)
            missed = {n: cost([m for m in names if m != n]) - now for n in names}
            weakest = min(missed, key=missed.get)
            if missed[weakest] > self.limits.worth * p.number and len(names) <= self.limits.most:
                break
            names.remove(weakest)
        if not names or frozenset(names) in self._seen:
            return None
        return self._renewed(p.fit(tuple(names), p.everything(vector), iterations=2))

    def _settled(self, found: Found) -> Found:
        """Exchanges where that is better and leaving out where the test says so, until all hold; then the search goes
        on from there once more."""
        for _ in range(EXCHANGES):
            better = self._measured(found) or self._exchanged(found)
            if better is None:
                break
            self._seen.discard(frozenset(better.names))
            further = self._from(self._renewed(better))
            if further is None:
                break
            further.order = [n for n in dict.fromkeys((*found.order, *further.fit.names)) if n in further.fit.names]
            found = further
        else:
            self._measured(found)
        return found

    def _measured(self, found: Found) -> Fit | None:
        """Fill in `evidence` and `without`. The fit without the weakest effect that fails the test; None if none does."""
        p = self.problem
        if found.scores is None:
            found.scores = screen(p, found.fit, np.random.default_rng(self.seed))
        found.evidence, found.without = {}, {}
        for name in found.fit.names:
            self.tick()
            found.without[name] = p.fit(tuple(n for n in found.fit.names if n != name), found.fit.slopes, iterations=2)
            found.evidence[name] = self._evidence(found.without[name], found.fit, name, found.scores)
        failing = [n for n, e in found.evidence.items() if judge(e, self.limits).rule != STATED]
        if not failing:
            return None
        return found.without[min(failing, key=lambda n: found.evidence[n].gain)]

    def _exchanged(self, found: Found) -> Fit | None:
        """Fill in `rivals`. The fit with one effect exchanged that is better than the present one; None if none is."""
        p, better = self.problem, None
        around = p.everything(found.fit.vector)
        q = p.loss.quadratic(p.errors.at(found.fit.vector), around.values)
        found.rivals = {}
        for name, without in found.without.items():
            gain = self._gain(without, found.fit)
            others = {n: self._in_place(q, found.fit, without.names, n) for n in p.space.hypotheses
                      if n != name and not p.space.overlaps(n, without.names)}
            found.rivals[name] = []
            for other in sorted(others, key=lambda n: others[n][0])[:CONTENDERS // 2]:
                if others[other][0] > (1.0 - 0.5 * self.limits.rival) * gain:
                    continue
                fit = self._more(without, other, others[other][1], around)
                difference = fit.held_out - found.fit.held_out
                rival = Rival(other, 1.0 - float(difference.sum()) / max(gain, 1e-12), no_worse(difference),
                              self._evidence(without, fit, other, found.scores))
                found.rivals[name].append(rival)
                surely = rival.worse > 1.0 - self.limits.doubt
                if surely and frozenset(fit.names) not in self._seen and judge(
                        rival.evidence, self.limits).rule == STATED and (
                        better is None or fit.held_out.sum() < better.held_out.sum()):
                    better = fit
        return better

    def _in_place(self, q: Quadratic, fit: Fit, rest: tuple[str, ...], other: str) -> tuple[float, np.ndarray]:
        """(loss more, vector) with another effect in the place of one, by the quadratic of everything about the fit."""
        p = self.problem
        everything = np.arange(len(p.space))
        free = np.isin(everything, p.which((*rest, other)))
        back = np.where(free, 0.0, (p.space.null - fit.vector) / p.space.scale)
        d = _held_at(p, q, (*rest, other), everything, back, free)
        cost = float(d @ q.hessian.sum(axis=0) @ d - 2.0 * q.gradient.sum(axis=0) @ d)
        return cost, p.moved(fit.vector, everything, d)


def _held_at(p: Problem, q: Quadratic, names, which: np.ndarray, fixed: np.ndarray, free: np.ndarray) -> np.ndarray:
    """The best step with some of its parts `fixed`, the others `free`."""
    d = np.array(fixed)
    if free.any():
        h, g = q.hessian.sum(axis=0), q.gradient.sum(axis=0)
        a = h[np.ix_(free, free)]
        a = a + 1e-6 * (np.trace(a) / len(a) + 1e-9) * np.eye(len(a))
        d[free] = np.linalg.solve(a, g[free] - h[np.ix_(free, ~free)] @ d[~free])
    return d


def no_worse(difference: np.ndarray) -> float:
    """Chance that a loss is no higher, from its differences by block."""
    spread = float(difference.std(ddof=1)) * np.sqrt(len(difference)) if len(difference) > 1 else np.inf
    return float(stats.norm.sf(difference.sum() / max(spread, 1e-12)))
