"""Search for the best set of effects by forward, backward and exchange steps, all with the same test."""

from collections import defaultdict
from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import dataclass, field, replace

import numpy as np

from ..effects import confounded_effects, get_effect
from .decision import ACCEPTED, GAIN_INSIGNIFICANT, NULL, Rival, judge, judge_alternative
from .evidence import Evidence, Scores, evidence, library_p_value, no_worse, null_by_sensors, screen
from .fit import Fit, Problem, Sensitivities
from .loss import Quadratic
from .partitions import Partition
from .result import Reason
from .settings import Limits

CONTENDERS = 4  # effects refitted by simulation in one step
CONTENDER_SHARE = 0.5  # fraction of the best gain; effects with a smaller gain are not refitted
JOINT_DEVIATION = 3.0  # prior standard deviation in a joint fit of many effects [parameter scales]
FIXED_CURVATURE = 1e9  # prior curvature that fixes a parameter
JOINT_FITS, JOINT_STEP = 4, 0.1  # maximum number of joint fits; largest step at convergence [parameter scales]
MAX_EXCHANGES = 3

Near = tuple[tuple[str, ...], np.ndarray]  # (names of the effects in a set, vector of its fit)


@dataclass
class Found:
    """State of the search. fit: fit of the current set. order: names in order of selection. evidence, without, rivals:
    by effect of the set, the evidence for it, the fit without it, and the effects tried in its place. refused:
    (evidence, verdict, fit) of each effect that was tried in addition and rejected. cached_scores: scores of the
    effects outside the set. near: sets that fit nearly as well, see `_near_sets`.
    """

    fit: Fit
    order: list[str]
    evidence: dict[str, Evidence] = field(default_factory=dict)
    without: dict[str, Fit] = field(default_factory=dict)
    refused: dict[str, tuple[Evidence, Reason, Fit]] = field(default_factory=dict)
    rivals: dict[str, list[Rival]] = field(default_factory=dict)
    cached_scores: Scores | None = None
    near: list[Near] = field(default_factory=list)

    @property
    def scores(self) -> Scores:
        assert self.cached_scores is not None, "scores are computed before steps and evidence"
        return self.cached_scores


class Search:
    """A search from several starts. partitions: partitions of the driving. sensors: (value, low, high) from redundant
    sensors, by "effect.parameter". tick: called at every refit. judge: function that gives the verdict on an effect."""

    def __init__(self, problem: Problem, limits: Limits, partitions: Mapping[str, Partition], sensors: Mapping,
                 seed: int = 0, tick: Callable[[], None] = lambda: None,
                 judge: Callable[[Evidence, Limits], Reason] = judge):
        self.problem, self.limits, self.partitions, self.sensors, self.tick = problem, limits, partitions, sensors, tick
        self._judge = judge
        self.seed = seed
        self._visited: set[frozenset[str]] = set()
        self._required: frozenset[str] = frozenset()  # effects that stay in every set
        self._fits_tried: list[tuple[np.ndarray, Near, float]] = []

    def run(self) -> Found:
        """Find the best set from three starts: the empty set, the set found from it plus all physical effects, and the
        whole library."""
        p = self.problem
        p.update_design_effect(p.start)
        first = self._step_from(p.fit((), p.all_sensitivities(p.start)))
        assert first is not None  # no set was visited before
        candidates: list[Found | None] = [first]
        library = [n for n in p.space.hypotheses
                   if n not in p.space.additions and not get_effect(n).forward_only]
        physics = [n for n in library if get_effect(n).kind == "physics"]
        for names in ([*first.fit.names, *physics], [n for n in library if not get_effect(n).members]):
            scale, design_effect = p.loss.scale, p.design_effect
            start = self._prune(first.fit.vector, list(dict.fromkeys(names)))
            while start and start.names:  # remove the effects that fail the test, weakest first
                state = Found(start, list(start.names), cached_scores=self._scores(start))
                weakest = self._weakest_failing(state, self.limits.relevant)
                if not weakest:
                    break
                start = self._rescale(self._refit_without(start, weakest))
            candidates.append(self._step_from(start) if start else None)
            if candidates[-1] is None:
                p.loss.scale, p.design_effect = scale, design_effect
        found = self._exchange_until_accepted(self._select([a for a in candidates if a]))
        found.order = sorted(found.fit.names, key=lambda n: -found.evidence[n].gain)
        found.near = self._near_sets(found)
        found.rivals = {name: [replace(r, added=self._added_share(found, r)) for r in rivals]
                        for name, rivals in found.rivals.items()}
        self._add_partial_rivals(found)
        return found

    def _added_share(self, found: Found, rival: Rival) -> float:
        """`Rival.added`: an effect that gains as much in addition to another as in its place explains other errors."""
        added = found.scores.gains.get(rival.name, (np.zeros(1), None))[0]
        gain = self._gain(found.without[rival.replaces], found.fit)
        return max(float(added.sum()), 0.0) / max(gain, 1e-12)

    def _add_partial_rivals(self, found: Found) -> None:
        """Add a load as a rival of lower tyre stiffness, since drives show only the ratio of stiffness to mass. Unless
        the drives exclude the load, it becomes an alternative to each effect that it moves nearer to the vehicle file.
        Loads tried: the prior standard deviation, then `limits.min_relative_size` parameter scales. Bands of axle
        forces include the laden car; intervals of values do not, since they apply to the car without a load."""
        p, names = self.problem, found.fit.names
        for other in (n for n in p.space.additions if names and n not in names and not p.space.overlaps(n, names)):
            for size in (p.space.deviation[p.space.indices(other)], self.limits.min_relative_size):
                # The load is fixed at its start value. With a reference all parameters are free: it is the prior mean.
                laden, load, vector = copy(p), p.space.indices(other), found.fit.vector.copy()
                laden.start = p.start.copy()
                laden.start[load] += size * p.space.scale[load]
                vector[load] = laden.start[load]
                self.tick()
                fit = laden.refit(laden.fit(names, laden.all_sensitivities(vector), vector))
                difference = fit.held_out - found.fit.held_out
                own = p.space.indices(*(n for n in names if n in confounded_effects(other)))
                nearer = own[np.abs(fit.vector - p.start)[own] < np.abs(found.fit.vector - p.start)[own]]
                rivals = [Rival(other, name, 1.0, no_worse(difference), float(difference.sum()) / p.residual_count,
                                found.evidence[name], p.space.values(other, fit.vector), shared=True)
                          for name in sorted({p.space.free[i].effect for i in nearer})]
                if rivals and judge_alternative(rivals[0], self.limits).rule == "alternative":
                    for rival in rivals:
                        others = found.rivals.get(rival.replaces, ())
                        found.rivals[rival.replaces] = [*(r for r in others if r.name != other), rival]
                    found.near.append(((), fit.vector))
                    break

    def corrections(self, fit: Fit) -> Fit:
        """The best fit with all effects of `fit`, which is from another problem, and further effects."""
        self._required = frozenset(fit.names)
        p = self.problem
        found = self._step_from(p.fit(fit.names, p.all_sensitivities(fit.vector), fit.vector))
        assert found is not None  # no set was visited before
        return self._drop_rejected(found).fit

    def _near_sets(self, found: Found) -> list[Near]:
        """Sets tried with a held-out loss per residual less than `limits.unexplained_share` above that of the final
        set; none if the residual is near the noise."""
        p, limits = self.problem, self.limits
        if max((e.noise_ratio for e in found.evidence.values()), default=0.0) <= limits.max_noise_ratio:
            return []
        limit = found.fit.held_out.sum() + limits.unexplained_share * p.residual_count
        return [near for scale, near, loss in self._fits_tried if scale is p.loss.scale and loss < limit]

    def _step_from(self, fit: Fit, revisit: bool = False) -> Found | None:
        """Take forward and backward steps until no further effect is accepted. Returns None if they lead to a set that
        was visited from another start, unless `revisit`."""
        found = Found(fit, list(fit.names))
        path: set[frozenset[str]] = set()
        while True:
            key = frozenset(found.fit.names)
            if key in self._visited - path and not revisit:
                return None
            if key in path:
                return found
            path.add(key)
            self._visited.add(key)
            scale = self.problem.loss.scale
            added = self._forward(found) if len(found.fit.names) < self.limits.max_effects else None
            if added is None:
                self.problem.loss.scale = scale  # `_forward` may have changed it for effects that it refused
                return found
            found.fit = self._rescale(self._backward(added, found.scores))
            found.order = [n for n in dict.fromkeys((*found.order, *added.names)) if n in found.fit.names]
            found.cached_scores = None

    def _rescale(self, fit: Fit) -> Fit:
        """Repeat a fit with the residual scale and the design effect estimated from its own residuals."""
        self.problem.loss.rescale(fit.vector)
        self.problem.update_design_effect(fit.vector)
        return self.problem.refit(fit)

    def _scores(self, fit: Fit) -> Scores:
        return screen(self.problem, fit, np.random.default_rng(self.seed))

    def _refit_without(self, fit: Fit, name: str) -> Fit:
        self.tick()
        names = tuple(n for n in fit.names if n != name)
        return self._remember(self.problem.fit(names, fit.sensitivities, iterations=2))

    def _remember(self, fit: Fit) -> Fit:
        self._fits_tried.append((self.problem.loss.scale, (fit.names, fit.vector), float(fit.held_out.sum())))
        return fit

    def _select(self, candidates: list[Found]) -> Found:
        """The set with the lowest held-out loss plus a penalty of `limits.negligible` per effect and residual, at the
        residual scale and the design effect of the set with the smallest errors."""
        p = self.problem
        if len(candidates) > 1:
            smallest = min(candidates, key=lambda a: float(np.log(p.loss.scale_of(a.fit.vector)).sum()))
            p.loss.rescale(smallest.fit.vector)
            p.update_design_effect(smallest.fit.vector)
            for a in candidates:
                a.fit, a.cached_scores = p.fit(a.fit.names, a.fit.sensitivities, iterations=2), None
        price = self.limits.negligible * p.residual_count
        return min(candidates, key=lambda a: float(a.fit.held_out.sum()) + price * len(a.fit.names))

    def _forward(self, found: Found) -> Fit | None:
        """The fit with the best further effect that passes the test; None if there is none."""
        p, limits = self.problem, self.limits
        self.tick()
        found.cached_scores = found.cached_scores or self._scores(found.fit)
        gains = found.scores.gains
        largest = max((gain.sum() for gain, _ in gains.values()), default=0.0)
        relevant = max(limits.negligible * p.residual_count, CONTENDER_SHARE * largest)
        # Additions, such as a load, are tried only as rivals of effects already in the set.
        ranked = [e for e in sorted(gains, key=lambda e: -gains[e][0].sum())
                  if gains[e][0].sum() > CONTENDER_SHARE * relevant and e not in p.space.additions]
        # Significant effects are preferred: with much noise, others can gain more by chance.
        library = len(p.space.hypotheses)
        significant = [e for e in ranked
                       if library_p_value(found.scores.by_effect[e], gains[e][0], found.scores,
                                          library) <= limits.false_alarm]
        contenders = (significant or ranked)[:CONTENDERS]
        contenders += [m for e in contenders for m in get_effect(e).members if m in gains and m not in contenders]
        fits = {effect: self._refit_with(found.fit, effect, gains[effect][1]) for effect in contenders}
        if not fits:
            return None
        without, fits = self._refine(found.fit, fits)
        best, found.refused = 0.0, {}  # best: largest gain of a significant effect that was refused
        for effect in self._members_first(fits, without):
            gain = self._gain(without, fits[effect])
            if gain < CONTENDER_SHARE * best:
                break
            e = self._evidence(without, fits[effect], effect, found.scores)
            verdict = self._judge(e, limits)
            if verdict.rule == ACCEPTED:
                return fits[effect]
            found.refused[effect] = e, verdict, fits[effect]
            if verdict.rule not in (GAIN_INSIGNIFICANT, NULL):
                best = max(best, gain)
        # An effect that redundant sensors confirm is added whatever its gain.
        for effect in (n for n in gains if n not in fits and p.prior is None):
            null = null_by_sensors(p.space, effect, self.sensors)
            if null is not None and null <= limits.false_alarm:
                fit = self._refit_with(without, effect, gains[effect][1])
                if self._judge(self._evidence(without, fit, effect, found.scores), limits).rule == ACCEPTED:
                    return fit
        return None

    def _refit_with(self, fit: Fit, effect: str, start: np.ndarray, around: Sensitivities | None = None) -> Fit:
        """A fit with a further effect, from the initial vector with the lower loss: `start` or that of `fit`. around:
        sensitivities to use, by default those at `fit`."""
        p = self.problem
        self.tick()
        better = p.loss.total(start) < p.loss.total(fit.vector)
        sensitivities = p.all_sensitivities(fit.vector) if around is None else around
        return self._remember(p.fit((*fit.names, effect), sensitivities, start if better else fit.vector, (effect,), 2))

    @staticmethod
    def _gain(without: Fit, fit: Fit) -> float:
        return float((without.held_out - fit.held_out).sum())

    def _members_first(self, fits: Mapping[str, Fit], without: Fit) -> list[str]:
        """Names by decreasing gain; a member precedes its composite effect unless the composite is clearly better."""
        gain = {e: self._gain(without, f) for e, f in fits.items()}
        order = sorted(fits, key=lambda e: -gain[e])
        for name in [e for e in order if get_effect(e).members]:
            close = max(self.limits.negligible * self.problem.residual_count, self.limits.undecided_p * gain[name])
            near = [m for m in get_effect(name).members if m in gain and gain[name] - gain[m] < close]
            if near:
                order.remove(name)
                order.insert(max(order.index(m) for m in near) + 1, name)
        return order

    def _refine(self, without: Fit, fits: dict[str, Fit]) -> tuple[Fit, dict[str, Fit]]:
        """Refit the contenders at the residual scale of the best one: large errors would mask their differences."""
        p = self.problem
        best = max(fits, key=lambda e: self._gain(without, fits[e]))
        gain = self._gain(without, fits[best])
        near = {e: f for e, f in fits.items() if self._gain(without, f) > CONTENDER_SHARE * gain}
        if len(near) < 2 or gain < 10.0 * self.limits.negligible * p.residual_count:
            return without, fits
        p.loss.rescale(fits[best].vector)
        return (p.fit(without.names, without.sensitivities, iterations=1),
                {e: p.fit(f.names, f.sensitivities, None, (e,), 2) for e, f in near.items()})

    def _evidence(self, without: Fit, fit: Fit, effect: str, scores: Scores) -> Evidence:
        return evidence(self.problem, without, fit, effect, scores, self.partitions, self.sensors)

    def _backward(self, fit: Fit, scores: Scores) -> Fit:
        """Remove the effects that the others make redundant from a fit."""
        p = self.problem
        while len(fit.names) > max(len(self._required), 1):
            rise = {n: self.predicted_rise(fit, n) for n in fit.names if n not in self._required}
            weakest = min(rise, key=rise.__getitem__)
            if rise[weakest] > 3.0 * self.limits.relevant * p.residual_count:
                return fit
            without = self._refit_without(fit, weakest)
            if self._judge(self._evidence(without, fit, weakest, scores), self.limits).rule == ACCEPTED:
                return fit
            fit = without
        return fit

    def predicted_rise(self, fit: Fit, *names: str, fixed: tuple[str, ...] = ()) -> float:
        """Increase of the loss if the effects `names` are removed from a fit, from the quadratic approximation. fixed:
        effects that keep their values; the others are refitted."""
        p = self.problem
        remaining = tuple(n for n in fit.names if n not in names)
        removed = np.isin(fit.indices, np.setdiff1d(p.space.indices(*names), p.space.indices(*remaining)))
        step = np.where(removed, -p.distance(fit.vector)[fit.indices], 0.0)
        free = ~removed & ~np.isin(fit.indices, p.space.indices(*fixed))
        return _constrained_step(p, fit.quadratic, fit.vector, fit.indices, step, free)[0]

    def cancelling(self, fit: Fit, name: str) -> tuple[str, ...]:
        """Effects of a fit that cancel `name`, so that the drives show only the sum. Without both, the loss increases
        by less than `limits.min_rival_gain` times its increase without one while the other keeps its value."""
        def cancels(other: str) -> bool:
            alone = min(self.predicted_rise(fit, name, fixed=(other,)), self.predicted_rise(fit, other, fixed=(name,)))
            return self.predicted_rise(fit, name, other) < self.limits.min_rival_gain * alone
        return tuple(n for n in fit.names if n != name and cancels(n))

    def _prune(self, vector: np.ndarray, names: list[str]) -> Fit | None:
        """Backward elimination from a joint fit of many effects with a weak prior; None if no effect remains, or if the
        remaining set was visited before."""
        p = self.problem
        free = np.isin(np.arange(len(p.space)), p.free_indices(names))
        curvature = np.where(free, np.maximum(JOINT_DEVIATION**-2, p.file_curvature), FIXED_CURVATURE)
        joint = Problem(p.loss, p.start, p.block, np.diag(curvature))
        p.loss.rescale(vector)
        for _ in range(JOINT_FITS):
            self.tick()
            before = vector
            vector = joint.fit((), p.all_sensitivities(vector), vector, iterations=2).vector
            p.loss.rescale(vector)
            if np.abs((vector - before) / p.space.scale).max() < JOINT_STEP:
                break
        sensitivities, q = p.all_sensitivities(vector), p.quadratic_of_all(vector)

        def cost(selected: list[str]) -> float:
            free = np.isin(sensitivities.indices, p.free_indices(selected))
            to_start = np.where(free, 0.0, -p.distance(vector))
            return _constrained_step(p, q, vector, sensitivities.indices, to_start, free)[0]

        while names:
            current = cost(names)
            rise = {n: cost([m for m in names if m != n]) - current for n in names}
            weakest = min(rise, key=rise.__getitem__)
            if rise[weakest] > self.limits.relevant * p.residual_count and len(names) <= self.limits.max_effects:
                break
            names.remove(weakest)
        if not names or frozenset(names) in self._visited:
            return None
        return self._rescale(p.fit(tuple(names), sensitivities, iterations=2))

    def _exchange_until_accepted(self, found: Found) -> Found:
        """Exchange effects and drop rejected ones until the test accepts all."""
        for _ in range(MAX_EXCHANGES):
            found = self._drop_rejected(found)
            better = self._exchange(found)
            if better is None:
                return found
            further = self._step_from(self._rescale(better), revisit=True)
            assert further is not None  # because of `revisit`
            further.order = [n for n in dict.fromkeys((*found.order, *further.fit.names)) if n in further.fit.names]
            found = further
        return self._drop_rejected(found)

    def _drop_rejected(self, found: Found) -> Found:
        """Drop the effects that fail the test, weakest first, and fill in the evidence of the others."""
        while weakest := self._weakest_failing(found):
            fit = self._rescale(found.without[weakest])
            refused = {weakest: (found.evidence[weakest], self._judge(found.evidence[weakest], self.limits), found.fit)}
            found = Found(fit, [n for n in found.order if n != weakest], refused={**found.refused, **refused})
        return found

    def _weakest_failing(self, found: Found, required: float = np.inf) -> str:
        """Fill in `evidence` and `without`, and return the weakest effect that fails the test; "" if none fails.
        required: an effect passes without a refit if its removal raises the loss per residual by over three times
        this."""
        p = self.problem
        found.cached_scores = found.cached_scores or self._scores(found.fit)
        found.evidence, found.without = {}, {}
        for name in (n for n in found.fit.names if n not in self._required):
            rise = self.predicted_rise(found.fit, name) / p.residual_count
            if rise > 3.0 * required:
                without = found.without[name] = found.fit
                e = self._evidence(found.fit, found.fit, name, found.scores)
                found.evidence[name] = replace(e, gain=rise, p_value=0.0)
                continue
            without = found.without[name] = self._refit_without(found.fit, name)
            found.evidence[name] = self._evidence(without, found.fit, name, found.scores)
        failing = [n for n, e in found.evidence.items() if self._judge(e, self.limits).rule != ACCEPTED]
        return min(failing, key=lambda n: found.evidence[n].gain, default="")

    def _exchange(self, found: Found) -> Fit | None:
        """Fill in `rivals`. Returns the best fit with one effect exchanged if significantly better, else `_merge`."""
        p, better = self.problem, None
        around = p.all_sensitivities(found.fit.vector)
        q, to_start = p.quadratic_of_all(found.fit.vector), -p.distance(found.fit.vector)
        every = np.arange(len(p.space))
        found.rivals, alternatives = {}, defaultdict(list)
        for name, without in found.without.items():
            gain = self._gain(without, found.fit)
            others = {}
            for n in (n for n in p.space.hypotheses if n != name and not p.space.overlaps(n, without.names)):
                free = np.isin(every, p.free_indices((*without.names, n)))
                cost, step = _constrained_step(p, q, found.fit.vector, every, np.where(free, 0.0, to_start), free)
                others[n] = cost, p.moved(found.fit.vector, every, step)
            found.rivals[name] = []
            for other in sorted(others, key=lambda n: others[n][0])[:CONTENDERS // 2]:
                if others[other][0] > (1.0 - 0.5 * self.limits.min_rival_gain) * gain:
                    continue
                fit = self._refit_with(without, other, others[other][1], around)
                difference = fit.held_out - found.fit.held_out
                deficit = float(difference.sum())
                rival = Rival(other, name, 1.0 - deficit / max(gain, 1e-12), no_worse(difference),
                              deficit / p.residual_count, self._evidence(without, fit, other, found.scores),
                              p.space.values(other, fit.vector))
                found.rivals[name].append(rival)
                if judge_alternative(rival, self.limits).rule == "alternative":
                    alternatives[other].append(fit)
                significant = rival.p_no_worse > 1.0 - self.limits.undecided_p
                if (significant and frozenset(fit.names) not in self._visited
                        and self._judge(rival.evidence, self.limits).rule == ACCEPTED
                        and (better is None or fit.held_out.sum() < better.held_out.sum())):
                    better = fit
        return better or self._merge(found, alternatives)

    def _merge(self, found: Found, alternatives: Mapping[str, list[Fit]]) -> Fit | None:
        """The fit with one effect in place of several; None if the held-out loss per residual rises by more than
        `limits.negligible` per effect saved. alternatives: by effect, the fits in which it replaces another effect."""
        for fits in alternatives.values():
            fit = min(fits, key=lambda fit: float(fit.held_out.sum()))
            if len(fits) > 1 and frozenset(fit.names) not in self._visited:
                fit = self._backward(fit, found.scores)
                fewer = len(found.fit.names) - len(fit.names)
                price = self.limits.negligible * self.problem.residual_count * fewer
                if fewer > 0 and float((fit.held_out - found.fit.held_out).sum()) < price:
                    return fit
        return None


def _constrained_step(problem: Problem, q: Quadratic, vector: np.ndarray, indices: np.ndarray, fixed: np.ndarray,
                      free: np.ndarray) -> tuple[float, np.ndarray]:
    """(increase of the loss, best step), with the components `free` of the step optimised and the others as in `fixed`.
    q: quadratic approximation of the loss about the vector, in the parameters `indices`."""
    d = np.array(fixed)
    h = q.hessian.sum(axis=0) + np.diag(problem.file_curvature[indices])
    g = q.gradient.sum(axis=0) - problem.prior_gradient(vector)[indices]
    if free.any():
        a = h[np.ix_(free, free)]
        a = a + 1e-6 * (np.trace(a) / len(a) + 1e-9) * np.eye(len(a))
        d[free] = np.linalg.solve(a, g[free] - h[np.ix_(free, ~free)] @ d[~free])
    return float(d @ h @ d - 2.0 * g @ d), d
