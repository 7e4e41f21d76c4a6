"""Reduction of the held-out error per channel by each effect and kind of cause; values of effects with intervals."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
from scipy import stats

from ..channels import UNITS
from ..effects import EFFECT_KINDS, get_effect
from ..regression import Z95, random_effects
from .evidence import JointFit, compare_parts, standard_deviations
from .fit import DIVERGED_ERROR, Fit, Problem
from .partitions import Partition
from .result import BUDGET_PARTS, BudgetLine, Change, ChannelError, FittedParameter, Step

BOOTSTRAP_SAMPLES = 400  # of whole blocks, for 95 % intervals


class HorizonErrors:
    """Errors at the end of the horizon on held-out driving."""

    def __init__(self, problem: Problem, seed: int):
        self.problem = problem
        self.names = problem.errors.windows.names
        self.run, self.block = problem.errors.windows.run, problem.block
        draws = np.random.default_rng(seed).integers(problem.blocks, size=(BOOTSTRAP_SAMPLES, problem.blocks))
        self._weights = np.stack([np.bincount(d, minlength=problem.blocks) for d in draws])

    def by_channel(self, fit: Fit) -> dict[str, np.ndarray]:
        """(n,) squared errors by channel, and position errors as position_5s; clipped at DIVERGED_ERROR."""
        columns = self.problem.errors.windows.columns
        last = np.nan_to_num(self.problem.held_out_residuals(fit)[:, -len(columns):], nan=DIVERGED_ERROR)
        last = np.clip(last, -DIVERGED_ERROR, DIVERGED_ERROR)
        squares = np.square(np.where(self.problem.loss.known[:, -len(columns):], last, np.nan))
        result = {channel.name: squares[:, [columns.index(column) for column in channel.columns]].sum(axis=1)
                  for channel in self.problem.errors.windows.channels}
        if "position" in result:
            result["position_5s"] = np.sqrt(result["position"])
        return result

    def compare(self, channel: str, before: np.ndarray, after: np.ndarray) -> Change:
        """Error before and after a step, with a 95 % interval of the reduction by bootstrap of whole blocks."""
        known = np.isfinite(before) & np.isfinite(after)
        if not known.any():
            return Change(float("nan"), float("nan"), (float("nan"), float("nan")), UNITS[channel])
        count = np.bincount(self.block[known], minlength=self.problem.blocks)
        sums = [np.bincount(self.block[known], v[known], self.problem.blocks) for v in (before, after)]
        counts = np.maximum(self._weights @ count, 1)
        resampled_means = [self._weights @ s / counts for s in sums]
        means = [v[known].mean() for v in (before, after)]
        if channel != "position_5s":  # the values are squares
            resampled_means, means = [np.sqrt(v) for v in resampled_means], [np.sqrt(v) for v in means]
        low, high = np.quantile(resampled_means[0] - resampled_means[1], (0.025, 0.975))
        return Change(float(means[0]), float(means[1]), (float(low), float(high)), UNITS[channel])

    def error_by_run(self, channel: str, values: np.ndarray) -> dict[str, float]:
        """Mean error for position_5s, RMS error for a channel, by run with values. values: entry of `by_channel`."""
        means = {name: float(np.nanmean(values[self.run == k])) for k, name in enumerate(self.names)
                 if np.isfinite(values[self.run == k]).any()}
        return means if channel == "position_5s" else {name: math.sqrt(mean) for name, mean in means.items()}


def estimate_parameters(problem: Problem, fit: Fit, effect: str, partitions: Mapping[str, Partition],
                        near_sets: Sequence[tuple[Sequence[str], np.ndarray]] = (), joint_fit: JointFit | None = None,
                        noise_ratio: float = 1.0) -> dict[str, FittedParameter]:
    """Fitted values of an effect with 95 % intervals, by parameter.

    The half-width is the largest of three estimates: (1) from blocks taken as independent; (2) from the scatter between
    at least three parts of a partition, such as runs or sites, but not map cells; (3) from `joint_fit`, where all other
    parameters are free: deviation and shift in quadrature, multiplied by `noise_ratio` (Birge, Phys. Rev. 40, 1932),
    and the model error in quadrature. To allow for errors of the model equations, both ends are shifted by the largest
    distances to the values in `near_sets`, effect sets that fit nearly as well. noise_ratio: residual / noise [1].
    """
    space, result = problem.space, {}
    indices = space.indices(effect)
    model_error = np.array([p.model_error for p in get_effect(effect).parameters if p.fit])
    change = (fit.vector - problem.start)[indices]
    fitted_count = len(fit.indices if problem.prior is None else space.indices(*fit.names))
    quantile = float(stats.t.ppf(0.975, max(problem.blocks - fitted_count, 2)))
    half_widths = quantile * standard_deviations(problem, fit, effect)
    if joint_fit is not None:
        joint_deviations, shift = joint_fit.select(indices)
        joint_half_widths = np.hypot(quantile * joint_deviations, shift) * space.scale[indices] * max(noise_ratio, 1.0)
        half_widths = np.maximum(half_widths, np.hypot(joint_half_widths, Z95 * model_error))
    for partition in (partition for name, partition in partitions.items() if name != "place"):
        ratios = compare_parts(problem, fit, effect, *partition).ratios
        if len(ratios) > 2:  # 95 % prediction interval for a new part, relative to the value
            values, ratio_deviations = np.array(list(ratios.values())).T
            _, error, between, _ = random_effects(values, np.square(ratio_deviations))
            half_widths = np.maximum(half_widths, np.abs(change) * Z95 * float(np.sqrt(between + error**2)))
    shifts = np.array([v[indices] for v in (fit.vector, *(vector for names, vector in near_sets if effect in names))])
    shifts -= fit.vector[indices]
    values = space.null[indices] + change  # with reference drives, changes since these drives
    low, high = values + shifts.min(axis=0) - half_widths, values + shifts.max(axis=0) + half_widths
    for k, i in enumerate(indices):
        parameter, interval = space.parameters[i][1], (float(low[k]), float(high[k]))
        result[parameter.name] = FittedParameter(float(values[k]), parameter.unit, interval, float(space.null[i]))
    return result


def build_steps(problem: Problem, final: Fit, order: Sequence[str], errors: HorizonErrors,
                partitions: Mapping[str, Partition]) -> tuple[list[Step], Fit]:
    """(steps from the base model to the final model, each with one more effect; fit of the base model); ([], final) if
    `order` is empty. The residual scale is re-estimated in each step; the design effect of the final fit is kept."""
    if not order:
        return [], final
    scale = problem.loss.scale.copy()
    problem.loss.rescale(problem.start)
    fit = problem.fit((), problem.all_sensitivities(problem.start))
    problem.loss.rescale(fit.vector)
    fit = base = problem.refit(fit)
    steps, before = [], errors.by_channel(fit)
    for k, effect in enumerate(order):
        if k == len(order) - 1:
            fit = final
        else:
            fit = problem.fit(order[:k + 1], fit.sensitivities, None, (effect,), 3)
            problem.loss.rescale(fit.vector)
            fit = problem.refit(fit, 1)
        after = errors.by_channel(fit)
        changes = {c: errors.compare(c, before[c], after[c]) for c in after}
        position = changes.pop("position_5s", None) or next(iter(changes.values()))
        key = "position_5s" if "position_5s" in after else next(iter(after))
        old, new = (errors.error_by_run(key, e[key]) for e in (before, after))
        steps.append(Step(effect, get_effect(effect).kind, estimate_parameters(problem, fit, effect, partitions),
                          position, changes, {n: (old[n], new[n]) for n in new}))
        before = after
    problem.loss.scale = scale
    return steps, base


def compare_channel_errors(errors: HorizonErrors, base: Fit, final: Fit,
                           noise: Mapping[str, float]) -> dict[str, ChannelError]:
    """Errors of the fits `base` and `final`, by channel and for the position after 5 s. noise: by channel [SI]."""
    before, after, result = errors.by_channel(base), errors.by_channel(final), {}
    for channel in after:
        change = errors.compare(channel, before[channel], after[channel])
        old, new = (errors.error_by_run(channel, e[channel]) for e in (before, after))
        floor = noise.get(channel, 0.0)
        worst = max(new, key=new.__getitem__, default="")
        result[channel] = ChannelError(change.base, change.augmented, change.interval, change.unit, floor, worst,
                                       new.get(worst, 0.0), tuple(n for n in new if new[n] > old[n] + floor))
    return result


def leave_one_out(problem: Problem, fit: Fit) -> dict[str, dict[str, dict[str, float]]]:
    """{run: {effect: {parameter: value}}}, fitted without this run; empty for a single run."""
    windows = problem.errors.windows
    if len(np.unique(windows.run)) < 2:
        return {}
    steps, _ = problem.leave_out_groups(fit, problem.run_of_block)
    vectors = {k: problem.take_step(fit.vector, fit.indices, step) for k, step in steps.items()}
    return {windows.names[k]: {n: problem.space.values(n, vector) for n in fit.names} for k, vector in vectors.items()}


def build_budget(problem: Problem, base: Fit, final: Fit, corrected: Fit, varying: Fit | None,
                 errors: HorizonErrors) -> list[BudgetLine]:
    """Contribution of each kind of cause, added last and added first, to the mean position error after 5 s and to the
    loss at the residual scale of the final fit. corrected: fit with effective corrections. varying: fit with an effect
    that varies between parts of the drives, or None."""
    def measure(fit: Fit) -> np.ndarray:
        """(mean position error [m], loss per residual)."""
        position = errors.by_channel(fit).get("position_5s", np.zeros(1))
        return np.array([np.nanmean(position), fit.held_out.sum() / problem.residual_count])

    def make_line(part: str, last: np.ndarray, first: np.ndarray) -> BudgetLine:
        shares_last, shares_first = (v / np.maximum(start, 1e-9) for v in (last, first))
        return BudgetLine(part, *map(float, (last[0], first[0], shares_last[0], shares_first[0], shares_last[1],
                                             shares_first[1])))

    def refit(names: tuple[str, ...]) -> Fit:
        """The best of three fits: the base, one started at the final values, and one started at the base values."""
        from_final = problem.refit(problem.fit(names, final.sensitivities, iterations=3))
        from_base = problem.refit(problem.fit(names, problem.all_sensitivities(base.vector), base.vector, names))
        return min((from_final, from_base, base), key=lambda fit: float(fit.held_out.sum()))

    base = problem.fit_at(base.names, base.vector, base.indices, base.sensitivities)
    start, end = measure(base), measure(final)
    lines = []
    for part in EFFECT_KINDS:
        effects = tuple(n for n in final.names if get_effect(n).kind == part)
        if not effects:
            continue
        others = tuple(n for n in final.names if n not in effects)
        error_without = measure(refit(others)) if others else start
        error_alone = measure(refit(effects)) if others else end
        lines.append(make_line(part, error_without - end, start - error_alone))
    extended_fits = (corrected if corrected is not final else None, varying)
    for part, fit in zip(BUDGET_PARTS[len(EFFECT_KINDS):], extended_fits, strict=False):
        if fit is not None:
            reduction = np.maximum(end - measure(fit), 0.0)
            lines.append(make_line(part, reduction, reduction))
            end = end - reduction
    return [*lines, make_line(BUDGET_PARTS[-1], end, end)]
