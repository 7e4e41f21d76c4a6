"""Search for the best set of effects by forward, backward and exchange steps, all with the same test.

A composite effect, such as the stiffness of all tyres, combines two or more other effects, its members.
"""

from collections import defaultdict
from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import stats

from ..effects import find_confounded_effects, get_effect
from ..regression import add_ridge
from .decision import ACCEPTED, GAIN_INSIGNIFICANT, NULL, Rival, is_alternative, judge
from .evidence import Evidence, Scores, collect_evidence, library_p_value, p_no_worse, screen, sensors_null_p_value
from .fit import JOINT_DEVIATION, Fit, Problem, Sensitivities
from .loss import Quadratic
from .partitions import Partition
from .result import Reason
from .settings import Limits

CONTENDERS = 4  # maximum number of effects refitted in a step, plus members of composites; half as many in an exchange
CONTENDER_FRACTION = 0.5  # fraction of the best gain that a contender must reach; before a refit, its square
FIXED_CURVATURE = 1e9  # prior curvature that fixes a parameter
MAX_JOINT_FITS, JOINT_TOLERANCE = 4, 0.1  # maximum number of joint fits; largest step at convergence [parameter scales]
MAX_EXCHANGES = 3

NearSet = tuple[tuple[str, ...], np.ndarray]  # (names of the effects in a set, vector of its fit)


@dataclass
class SearchState:
    """The current set of effects, with evidence for each of them and the other effects tried."""

    fit: Fit  # fit of the current set
    order: tuple[str, ...] = ()  # after the search: names by decreasing gain
    evidence: dict[str, Evidence] = field(default_factory=dict)  # for each effect of the set
    fits_without: dict[str, Fit] = field(default_factory=dict)  # fit without each effect of the set
    # (evidence, verdict, fit) of each effect that was rejected in the last forward step, or dropped from the set.
    rejected: dict[str, tuple[Evidence, Reason, Fit]] = field(default_factory=dict)
    rivals: dict[str, list[Rival]] = field(default_factory=dict)  # effects tried in place of each effect of the set
    cached_scores: Scores | None = None  # scores of the effects outside the set
    # Sets that fit nearly as well (`_find_near_sets`), and fits with a load (`_add_load_rivals`).
    near_optimal: list[NearSet] = field(default_factory=list)

    @property
    def all_rivals(self) -> list[Rival]:
        return [rival for rivals in self.rivals.values() for rival in rivals]

    @property
    def scores(self) -> Scores:
        assert self.cached_scores is not None, "scores are computed before steps and evidence"
        return self.cached_scores


class Search:
    """A search from several starts, for the set of effects that predicts held-out driving best. partitions: of the
    drives. sensors: `evidence.Sensors`. seed: of the random signs. tick: called to show progress."""

    def __init__(self, problem: Problem, limits: Limits, partitions: Mapping[str, Partition], sensors: Mapping,
                 seed: int = 0, tick: Callable[[], None] = lambda: None,
                 judge: Callable[[Evidence, Limits], Reason] = judge):
        self.problem, self.limits, self.partitions, self.sensors, self.tick = problem, limits, partitions, sensors, tick
        self._judge, self.seed = judge, seed
        self._visited: set[frozenset[str]] = set()
        self._required: frozenset[str] = frozenset()  # effects that stay in every set
        self._fits_tried: list[tuple[np.ndarray, NearSet, float]] = []

    def run(self) -> SearchState:
        """The best set from three starts. These are the empty set; the set found from it, extended by all physical
        effects; and the library without composite effects. Payloads and `forward_only` effects are not added to the
        second and third start."""
        p = self.problem
        p.update_design_effect(p.start)
        first = self._step_from(p.fit((), p.all_sensitivities(p.start)))
        assert first is not None  # no set was visited before
        candidates: list[SearchState | None] = [first]
        library = [n for n in p.space.hypotheses if n not in p.space.payloads and not get_effect(n).forward_only]
        physics = [n for n in library if get_effect(n).kind == "physics"]
        for names in ([*first.fit.names, *physics], [n for n in library if not get_effect(n).members]):
            scale, design_effect = p.loss.scale, p.design_effect
            start = self._prune(first.fit.vector, list(dict.fromkeys(names)))
            start = start and self._drop_rejected(SearchState(start), self.limits.relevant).fit
            candidates.append(self._step_from(start) if start else None)
            if candidates[-1] is None:
                p.loss.scale, p.design_effect = scale, design_effect
        state = self._exchange_until_accepted(self._select([c for c in candidates if c]))
        state.order = tuple(sorted(state.fit.names, key=lambda n: -state.evidence[n].gain))
        state.near_optimal = self._find_near_sets(state)
        # A rival that gains as much in addition to an effect as in its place explains different errors.
        added = {name: max(float(gains.sum()), 0.0) for name, (gains, _) in state.scores.gains.items()}
        for name, rivals in state.rivals.items():
            gain = max(self._gain(state.fits_without[name], state.fit), 1e-12)
            state.rivals[name] = [replace(r, added=added.get(r.name, 0.0) / gain) for r in rivals]
        self._add_load_rivals(state)
        return state

    def add_corrections(self, fit: Fit) -> Fit:
        """The best fit that contains at least the effects of `fit`, which may be from a different problem."""
        self._required = frozenset(fit.names)
        p = self.problem
        state = self._step_from(p.fit(fit.names, p.all_sensitivities(fit.vector), fit.vector))
        assert state is not None  # no set was visited before
        return self._drop_rejected(state).fit

    def find_best_rival(self, state: SearchState, name: str) -> Rival:
        """A rival of the effect `name`: the best set without this effect and its alternatives. If a single effect
        replaces it and is an alternative, it is added to `state.rivals`, and the search is repeated without it."""
        other, p, rivals = copy(self), copy(self.problem), state.rivals.setdefault(name, [])
        other.problem, p.loss, p.space = p, copy(p.loss), copy(p.space)
        excluded = [name, *(r.name for r in rivals if is_alternative(r, self.limits))]
        p.space.hypotheses = tuple(n for n in p.space.hypotheses if not p.space.overlaps(n, excluded))
        found = other._step_from(p.refit(state.fits_without[name]), revisit=True)
        assert found is not None  # because of `revisit`
        fit = self.problem.refit(self.problem.fit(found.fit.names, found.fit.sensitivities))
        names = [n for n in fit.names if n not in state.fit.names]
        rival = self._make_rival(" and ".join(names), name, fit, state, state.evidence[name])
        # A signed-rank test is added, because the mean of few blocks is uncertain even if all blocks are worse. The
        # smaller p-value is doubled (Bonferroni correction for two tests).
        test = stats.wilcoxon(fit.held_out, state.fit.held_out, zero_method="zsplit", alternative="greater")
        rival = replace(rival, p_no_worse=min(2.0 * min(rival.p_no_worse, float(test.pvalue)), 1.0))
        if len(names) != 1 or not is_alternative(rival, self.limits):
            return rival
        state.rivals[name] = [*(r for r in rivals if r.name != rival.name), rival]
        return self.find_best_rival(state, name)

    def predict_rise(self, fit: Fit, *names: str, fixed: tuple[str, ...] = ()) -> float:
        """Predicted increase of the loss if the effects `names` are removed and all but `fixed` are refitted."""
        p = self.problem
        remaining_names = tuple(n for n in fit.names if n not in names)
        is_removed = np.isin(fit.indices, np.setdiff1d(p.space.indices(*names), p.space.indices(*remaining_names)))
        step = np.where(is_removed, -p.distance(fit.vector)[fit.indices], 0.0)
        is_free = ~is_removed & ~np.isin(fit.indices, p.space.indices(*fixed))
        return _constrained_step(p, fit.quadratic, fit.vector, fit.indices, step, is_free)[0]

    def find_cancelling_effects(self, fit: Fit, name: str) -> tuple[str, ...]:
        """Effects of a fit that cancel `name`, so that only the sum of both is identifiable: if both are removed, the
        loss increases by less than `limits.min_rival_gain` times the smaller increase if one of them is removed and the
        other fixed."""
        cancelling_names = []
        for other in (n for n in fit.names if n != name):
            alone = min(self.predict_rise(fit, name, fixed=(other,)), self.predict_rise(fit, other, fixed=(name,)))
            if self.predict_rise(fit, name, other) < self.limits.min_rival_gain * alone:
                cancelling_names.append(other)
        return tuple(cancelling_names)

    def _add_load_rivals(self, state: SearchState) -> None:
        """Add a load as a rival of lower tyre stiffness, since drives show only the ratio of stiffness to mass. The
        load is an alternative to each effect with values that are nearer to the vehicle file when it is added, unless
        the drives exclude it. Loads tried: the prior standard deviation, then `min_relative_size` [parameter scales].
        Bands of axle forces, and intervals of these effects and of combinations, include the laden car."""
        p, names = self.problem, state.fit.names
        for payload in (n for n in p.space.payloads if names and n not in names and not p.space.overlaps(n, names)):
            for size in (p.space.deviation[p.space.indices(payload)], self.limits.min_relative_size):
                # The load keeps this start value; with reference drives it is free, with this value as its prior mean.
                laden_problem, load, vector = copy(p), p.space.indices(payload), state.fit.vector.copy()
                laden_problem.start = p.start.copy()
                vector[load] = laden_problem.start[load] = p.start[load] + size * p.space.scale[load]
                self.tick()
                fit = laden_problem.refit(laden_problem.fit(names, laden_problem.all_sensitivities(vector), vector))
                indices = p.space.indices(*(n for n in names if n in find_confounded_effects(payload)))
                nearer = indices[np.abs(fit.vector - p.start)[indices] < np.abs(state.fit.vector - p.start)[indices]]
                rivals = [replace(self._make_rival(payload, name, fit, state, state.evidence[name]), gain_ratio=1.0,
                                  with_effect=True) for name in sorted({p.space.parameters[i][0] for i in nearer})]
                if rivals and is_alternative(rivals[0], self.limits):
                    for rival in rivals:
                        others = state.rivals.get(rival.replaces, ())
                        state.rivals[rival.replaces] = [*(r for r in others if r.name != payload), rival]
                    state.near_optimal.append(((payload, *(r.replaces for r in rivals)), fit.vector))
                    break

    def _make_rival(self, other: str, name: str, fit: Fit, state: SearchState, evidence: Evidence) -> Rival:
        difference, gain = fit.held_out - state.fit.held_out, self._gain(state.fits_without[name], state.fit)
        deficit = float(difference.sum())
        return Rival(other, name, 1.0 - deficit / max(gain, 1e-12), p_no_worse(difference),
                     deficit / self.problem.residual_count, evidence, self.problem.space.values(other, fit.vector))

    def _find_near_sets(self, state: SearchState) -> list[NearSet]:
        """Sets fitted at the final residual scale with a held-out loss per residual that is lower than that of the
        final set, or higher by less than `limits.unexplained_share`; none if the residual is near the noise."""
        p, limits = self.problem, self.limits
        if max((e.noise_ratio for e in state.evidence.values()), default=0.0) <= limits.max_noise_ratio:
            return []
        limit = state.fit.held_out.sum() + limits.unexplained_share * p.residual_count
        return [near for scale, near, loss in self._fits_tried if scale is p.loss.scale and loss < limit]

    def _step_from(self, fit: Fit, revisit: bool = False) -> SearchState | None:
        """The state after forward and backward steps until no further effect is accepted, or a set recurs. None if they
        lead to a set that was visited from a different start, unless `revisit` is set."""
        state = SearchState(fit)
        path: set[frozenset[str]] = set()
        while True:
            key = frozenset(state.fit.names)
            if key in self._visited - path and not revisit:
                return None
            if key in path:
                return state
            path.add(key)
            self._visited.add(key)
            scale = self.problem.loss.scale
            extended_fit = self._step_forward(state) if len(state.fit.names) < self.limits.max_effects else None
            if extended_fit is None:
                self.problem.loss.scale = scale  # `_step_forward` may have changed it for effects that it rejected
                return state
            state.fit = self._rescale(self._step_backward(extended_fit, state.scores))
            state.cached_scores = None

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

    def _select(self, candidates: list[SearchState]) -> SearchState:
        """The set with the lowest held-out loss plus a penalty of `limits.negligible` per effect and residual. All sets
        are compared at the residual scale and the design effect of the set with the smallest errors."""
        p = self.problem
        if len(candidates) > 1:
            smallest = min(candidates, key=lambda c: float(np.log(p.loss.scale_of(c.fit.vector)).sum()))
            p.loss.rescale(smallest.fit.vector)
            p.update_design_effect(smallest.fit.vector)
            for c in candidates:
                c.fit = self._remember(p.fit(c.fit.names, c.fit.sensitivities, iterations=2))
                c.cached_scores = None
        penalty = self.limits.negligible * p.residual_count
        return min(candidates, key=lambda c: float(c.fit.held_out.sum()) + penalty * len(c.fit.names))

    def _step_forward(self, state: SearchState) -> Fit | None:
        """Fit with one more effect that passes the test: the best contender, or one that sensors confirm; else None."""
        p, limits = self.problem, self.limits
        self.tick()
        state.cached_scores = state.cached_scores or self._scores(state.fit)
        gains = state.scores.gains
        largest = max((gain.sum() for gain, _ in gains.values()), default=0.0)
        min_gain = CONTENDER_FRACTION * max(limits.negligible * p.residual_count, CONTENDER_FRACTION * largest)
        # A payload is tried only as a rival of effects already in the set.
        ranking = [e for e in sorted(gains, key=lambda e: -gains[e][0].sum())
                   if gains[e][0].sum() > min_gain and e not in p.space.payloads]
        # Significant effects are preferred: with much noise, others can gain more by chance.
        effect_count, by_effect = len(p.space.hypotheses), state.scores.by_effect
        significant = [e for e in ranking if library_p_value(by_effect[e], gains[e][0], state.scores, effect_count)
                       <= limits.false_alarm]
        contenders = (significant or ranking)[:CONTENDERS]
        contenders += [m for e in contenders for m in get_effect(e).members if m in gains and m not in contenders]
        fits = {effect: self._refit_with(state.fit, effect, gains[effect][1]) for effect in contenders}
        if not fits:
            return None
        without, fits = self._refine(state.fit, fits)
        largest_rejected, state.rejected = 0.0, {}  # largest gain of a significant effect that was rejected
        for effect in self._order_members_first(fits, without):
            gain = self._gain(without, fits[effect])
            if gain < CONTENDER_FRACTION * largest_rejected:
                break
            e = self._evidence(without, fits[effect], effect, state.scores)
            verdict = self._judge(e, limits)
            if verdict.rule == ACCEPTED:
                return fits[effect]
            state.rejected[effect] = e, verdict, fits[effect]
            if verdict.rule not in (GAIN_INSIGNIFICANT, NULL):
                largest_rejected = max(largest_rejected, gain)
        # An effect that redundant sensors confirm is tried whatever its gain.
        for effect in (n for n in gains if n not in fits and p.prior is None):
            null = sensors_null_p_value(p.space, effect, self.sensors)
            if null is not None and null <= limits.false_alarm:
                fit = self._refit_with(without, effect, gains[effect][1])
                if self._judge(self._evidence(without, fit, effect, state.scores), limits).rule == ACCEPTED:
                    return fit
        return None

    def _refit_with(self, fit: Fit, effect: str, start: np.ndarray, sensitivities: Sensitivities | None = None) -> Fit:
        """A fit with a further effect, started from `start` or from the vector of `fit`, whichever has the lower loss.
        sensitivities: by default those at `fit`."""
        p = self.problem
        self.tick()
        best_start = min(fit.vector, start, key=p.loss.total)
        sensitivities = sensitivities or p.all_sensitivities(fit.vector)
        return self._remember(p.fit((*fit.names, effect), sensitivities, best_start, (effect,), 2))

    @staticmethod
    def _gain(without: Fit, fit: Fit) -> float:
        return float((without.held_out - fit.held_out).sum())

    def _order_members_first(self, fits: Mapping[str, Fit], without: Fit) -> list[str]:
        """Names by decreasing gain; a member precedes its composite effect unless the composite is clearly better."""
        gain = {e: self._gain(without, f) for e, f in fits.items()}
        order = sorted(fits, key=lambda e: -gain[e])
        for name in [e for e in order if get_effect(e).members]:
            tolerance = max(self.limits.negligible * self.problem.residual_count, self.limits.undecided_p * gain[name])
            members = [m for m in get_effect(name).members if m in gain and gain[name] - gain[m] < tolerance]
            if members:
                order.remove(name)
                order.insert(max(order.index(m) for m in members) + 1, name)
        return order

    def _refine(self, without: Fit, fits: dict[str, Fit]) -> tuple[Fit, dict[str, Fit]]:
        """Refit the contenders at the residual scale of the best one, since large errors mask their differences."""
        p = self.problem
        best = max(fits, key=lambda e: self._gain(without, fits[e]))
        gain = self._gain(without, fits[best])
        near = {e: f for e, f in fits.items() if self._gain(without, f) > CONTENDER_FRACTION * gain}
        if len(near) < 2 or gain < 10.0 * self.limits.negligible * p.residual_count:
            return without, fits
        p.loss.rescale(fits[best].vector)
        return (p.fit(without.names, without.sensitivities, iterations=1),
                {e: p.fit(f.names, f.sensitivities, None, (e,), 2) for e, f in near.items()})

    def _evidence(self, without: Fit, fit: Fit, effect: str, scores: Scores) -> Evidence:
        return collect_evidence(self.problem, without, fit, effect, scores, self.partitions, self.sensors)

    def _step_backward(self, fit: Fit, scores: Scores) -> Fit:
        """The fit without the effects that fail the test once the others are refitted."""
        while len(fit.names) > max(len(self._required), 1):
            rise = {n: self.predict_rise(fit, n) for n in fit.names if n not in self._required}
            weakest = min(rise, key=rise.__getitem__)
            if rise[weakest] > 3.0 * self.limits.relevant * self.problem.residual_count:
                return fit
            without = self._refit_without(fit, weakest)
            if self._judge(self._evidence(without, fit, weakest, scores), self.limits).rule == ACCEPTED:
                return fit
            fit = without
        return fit

    def _prune(self, vector: np.ndarray, names: list[str]) -> Fit | None:
        """Backward elimination from a joint fit with a weak prior; None if it leads to an empty or visited set."""
        p = self.problem
        free = np.isin(np.arange(len(p.space)), p.free_indices(names))
        curvature = np.where(free, np.maximum(JOINT_DEVIATION**-2, p.file_curvature), FIXED_CURVATURE)
        joint_problem = Problem(p.loss, p.start, p.block, np.diag(curvature))
        p.loss.rescale(vector)
        for _ in range(MAX_JOINT_FITS):
            self.tick()
            before = vector
            vector = joint_problem.fit((), p.all_sensitivities(vector), vector, iterations=2).vector
            p.loss.rescale(vector)
            if np.abs((vector - before) / p.space.scale).max() < JOINT_TOLERANCE:
                break
        sensitivities, q = p.all_sensitivities(vector), p.full_quadratic(vector)

        def cost(selected: list[str]) -> float:
            is_free = np.isin(sensitivities.indices, p.free_indices(selected))
            to_start = np.where(is_free, 0.0, -p.distance(vector))
            return _constrained_step(p, q, vector, sensitivities.indices, to_start, is_free)[0]

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

    def _exchange_until_accepted(self, state: SearchState) -> SearchState:
        """Exchange effects and drop rejected ones until the test accepts all."""
        for _ in range(MAX_EXCHANGES):
            state = self._drop_rejected(state)
            exchanged_fit = self._exchange(state)
            if exchanged_fit is None:
                return state
            result = self._step_from(self._rescale(exchanged_fit), revisit=True)
            assert result is not None  # because of `revisit`
            state = result
        return self._drop_rejected(state)

    def _drop_rejected(self, state: SearchState, required_gain: float = np.inf) -> SearchState:
        """Drop the effects that fail the test, weakest first, and fill in `evidence` and `fits_without` of the others.
        An effect counts as significant without a refit if its removal is predicted to raise the loss per residual by
        more than three times `required_gain`; the other criteria still apply."""
        while True:
            state.cached_scores = state.cached_scores or self._scores(state.fit)
            state.evidence, state.fits_without = {}, {}
            for name in (n for n in state.fit.names if n not in self._required):
                rise = self.predict_rise(state.fit, name) / self.problem.residual_count
                is_certain = rise > 3.0 * required_gain
                without = state.fits_without[name] = state.fit if is_certain else self._refit_without(state.fit, name)
                e = self._evidence(without, state.fit, name, state.scores)
                state.evidence[name] = replace(e, gain=rise, p_value=0.0) if is_certain else e
            verdicts = {n: self._judge(e, self.limits) for n, e in state.evidence.items()}
            failing = {n: state.evidence[n].gain for n, verdict in verdicts.items() if verdict.rule != ACCEPTED}
            if not failing:
                return state
            weakest = min(failing, key=failing.__getitem__)
            rejected = {**state.rejected, weakest: (state.evidence[weakest], verdicts[weakest], state.fit)}
            state = SearchState(self._rescale(self._refit_without(state.fit, weakest)), rejected=rejected)

    def _exchange(self, state: SearchState) -> Fit | None:
        """The best fit of those that exchange one effect and are significantly better; if there is none, the result of
        `_merge`. Fills in `state.rivals`."""
        p, better_fit = self.problem, None
        sensitivities = p.all_sensitivities(state.fit.vector)
        q, to_start = p.full_quadratic(state.fit.vector), -p.distance(state.fit.vector)
        indices = np.arange(len(p.space))
        state.rivals, alternatives = {}, defaultdict(list)
        for name, without in state.fits_without.items():
            gain = self._gain(without, state.fit)
            others = {}
            for n in (n for n in p.space.hypotheses if n != name and not p.space.overlaps(n, without.names)):
                free = np.isin(indices, p.free_indices((*without.names, n)))
                cost, step = _constrained_step(p, q, state.fit.vector, indices, np.where(free, 0.0, to_start), free)
                others[n] = cost, p.take_step(state.fit.vector, indices, step)
            state.rivals[name] = []
            for other in sorted(others, key=lambda n: others[n][0])[:CONTENDERS // 2]:
                if others[other][0] > (1.0 - 0.5 * self.limits.min_rival_gain) * gain:
                    continue
                fit = self._refit_with(without, other, others[other][1], sensitivities)
                rival = self._make_rival(other, name, fit, state, self._evidence(without, fit, other, state.scores))
                state.rivals[name].append(rival)
                if is_alternative(rival, self.limits):
                    alternatives[other].append(fit)
                if (rival.p_no_worse > 1.0 - self.limits.undecided_p and frozenset(fit.names) not in self._visited
                        and self._judge(rival.evidence, self.limits).rule == ACCEPTED
                        and (better_fit is None or fit.held_out.sum() < better_fit.held_out.sum())):
                    better_fit = fit
        return better_fit or self._merge(state, alternatives)

    def _merge(self, state: SearchState, alternatives: Mapping[str, list[Fit]]) -> Fit | None:
        """A fit with one effect in place of several; None if the held-out loss per residual rises by more than
        `limits.negligible` per effect saved. alternatives: by effect, the fits in which it is the replacement."""
        for fits in alternatives.values():
            fit = min(fits, key=lambda fit: float(fit.held_out.sum()))
            if len(fits) > 1 and frozenset(fit.names) not in self._visited:
                fit = self._step_backward(fit, state.scores)
                saved_count = len(state.fit.names) - len(fit.names)
                limit = self.limits.negligible * self.problem.residual_count * saved_count
                if saved_count > 0 and float((fit.held_out - state.fit.held_out).sum()) < limit:
                    return fit
        return None


def _constrained_step(problem: Problem, q: Quadratic, vector: np.ndarray, indices: np.ndarray, fixed_step: np.ndarray,
                      free: np.ndarray) -> tuple[float, np.ndarray]:
    """(increase of the loss, best step [parameter scales]), with the components `free` of the step optimised and the
    others as in `fixed_step`. q: quadratic approximation of the loss about the vector, in the parameters `indices`."""
    d = np.array(fixed_step)
    h = q.hessian.sum(axis=0) + np.diag(problem.file_curvature[indices])
    g = q.gradient.sum(axis=0) - problem.prior_gradient(vector)[indices]
    if free.any():
        d[free] = np.linalg.solve(add_ridge(h[np.ix_(free, free)]), g[free] - h[np.ix_(free, ~free)] @ d[~free])
    return float(d @ h @ d - 2.0 * g @ d), d
