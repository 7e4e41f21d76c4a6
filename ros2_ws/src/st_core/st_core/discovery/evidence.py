"""Statistics of one effect in a set of effects, from which `decision` draws the conclusions.

Shapes: n windows, b blocks of windows, p parameters of the library, a free parameters of a fit, k of one effect.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import stats

from ..effects import get_effect
from ..regression import Z95, random_effects
from .fit import Fit, Problem, Sensitivities, minimise_bounded
from .loss import Quadratic
from .partitions import Partition
from .space import FileQuantity, Space

SIGN_DRAWS = 400  # draws of random signs of the blocks, enough to resolve a p-value of 0.01
MIN_CURVATURE = 0.3  # minimum ratio of the curvature of the robust loss to that of the reweighted least squares
PART_PRIOR = 0.05  # prior curvature of the other parameters in one part, divided by the mean curvature of all parts
UNSELECTED_DEVIATION = 0.5  # prior standard deviation of effects outside the set, for intervals [parameter scales]
MIN_INFORMATION_FRACTION = 0.02  # minimum information of a part that is used, as a fraction of that of all drives
Sensors = Mapping[str, tuple[float, float, float]]  # by "effect.parameter": (value, ends of its 95 % interval)


@dataclass(frozen=True)
class Agreement:
    """Consistency of an effect across the parts of the drives (runs, sites, ...)."""

    ratios: Mapping[str, tuple[float, float]]  # by part, (local divided by overall value, standard deviation)
    p_equal: float  # p-value of the hypothesis of equal values in all parts [1]
    p_absent: float  # probability that the effect is absent or of opposite sign in a new part [1]


@dataclass(frozen=True)
class Evidence:
    """Statistics of one effect in a set."""

    name: str
    # Reduction of the held-out loss per residual, approximately the relative reduction of the RMS error; the smaller of
    # two values, with folds and with `Problem.held_out_groups` held out [1].
    gain: float
    p_value: float  # p-value of the gain, corrected for the whole library [1]
    null_p_value: float = 0.0  # p-value of the hypothesis that the effect has its null values [1]
    reductions: Mapping[str, tuple[float, float]] = field(default_factory=dict)  # see `column_reductions`
    position_reduction: float = 0.0  # of the mean held-out position error at the end of the horizon [m]
    position_reduction_in_condition: float = 0.0  # largest of its lower 95 % bounds in the driving conditions [m]
    noise_ratio: float = 1.0  # error with the effect divided by the noise, see `residual_over_noise` [1]
    bound_distance: float = 1.0  # distance to the nearest bound [parameter scales]
    gain_between_runs: float = 0.0  # see `HealthyCar`, 0 without reference drives [1]
    size: float = 0.0  # distance from the null [parameter scales]
    sensors_p_value: float | None = None  # of agreement of the fitted value with redundant sensors [1]
    sensors_null_p_value: float | None = None  # of agreement of the null value with them [1]
    file_comparison: tuple[FileQuantity, float] | None = None  # see `compare_with_file`
    agreement: Mapping[str, Agreement] = field(default_factory=dict)  # consistency between parts, by partition

    @property
    def reduction(self) -> float:
        return relative_reduction(self.gain)


def describe_position_reduction(reduction: float) -> str:
    """Clause such as "reduces the position error at the end of the horizon by 3.2 cm". reduction: [m], 0 if unknown."""
    if reduction == 0.0:
        return "reduces no measured position error"
    verb = "increases" if reduction <= -5e-4 else "reduces"
    size = "less than 0.1" if abs(reduction) < 5e-4 else f"{100.0 * abs(reduction):.1f}"
    return f"{verb} the position error at the end of the horizon by {size} cm"


def relative_reduction(gain: float) -> float:
    """Relative reduction of the RMS error [1], 1 - exp(-gain); negative if errors grow."""
    return -float(np.expm1(-gain))


@dataclass(frozen=True, eq=False)
class Scores:
    """Efficient scores of the effects of the library."""

    by_effect: Mapping[str, np.ndarray]  # (b, k) scores by effect
    largest: np.ndarray  # (draws,) largest score statistic of these effects under random signs of the blocks
    # Factor by which dependent windows increase the variance of a score (median of these effects), at least 1 [1].
    design_effect: float
    # By effect, ((b,) reduction of the held-out loss, vector at the optimum), both from the quadratic approximation.
    gains: Mapping[str, tuple[np.ndarray, np.ndarray]]


def efficient_score(q: Quadratic, problem: Problem, names: tuple[str, ...], effect: str,
                    prior_gradient: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """((b, k) score, (k,) information) of an effect, with the effects `names` projected out. q: loss by block, in all
    parameters. prior_gradient: (p,) half the gradient of the prior at the vector of q; None to leave it out."""
    tested = problem.space.indices(effect)
    indices = np.setdiff1d(problem.free_indices(names), tested)
    h = q.hessian.sum(axis=0) + problem.prior_curvature((*names, effect), np.arange(len(problem.space)))
    gradient = q.gradient if prior_gradient is None else q.gradient - prior_gradient / len(q.gradient)
    cross = np.linalg.solve(_regularise(h[np.ix_(indices, indices)]), h[np.ix_(indices, tested)])
    information = np.diag(h[np.ix_(tested, tested)] - h[np.ix_(tested, indices)] @ cross)
    return gradient[:, tested] - gradient[:, indices] @ cross, np.maximum(information, 0.0)


def score_statistic(scores: np.ndarray) -> float:
    """Score statistic s' (sum_b s_b s_b')^-1 s, s = sum_b s_b. scores: (b, k) scores s_b of the blocks."""
    total = scores.sum(axis=0)
    return float(total @ np.linalg.pinv(scores.T @ scores) @ total)


def screen(problem: Problem, fit: Fit, rng: np.random.Generator) -> Scores:
    """Scores of every effect of the library that does not overlap the fit, from the sensitivities at the fit."""
    q = problem.full_quadratic(fit.vector).sum_groups(problem.block, problem.blocks)
    effects = [effect for effect in problem.space.hypotheses if not problem.space.overlaps(effect, fit.names)]
    return score_effects(problem, q, fit, effects, rng, SIGN_DRAWS, problem.prior_gradient(fit.vector))


def score_effects(problem: Problem, q: Quadratic, fit: Fit, effects: Sequence[str], rng: np.random.Generator,
                  draws: int, prior_gradient: np.ndarray | None = None) -> Scores:
    """`Scores` of effects, each in addition to the effects of a fit that do not overlap it. q: loss by block about the
    vector of the fit, in all parameters. draws: number of sign vectors. prior_gradient: see `efficient_score`."""
    signs, largest, ratios = rng.choice([-1.0, 1.0], (draws, len(q.cost))), np.zeros(draws), []
    min_information = 1e-9 * max(float(np.trace(q.hessian.sum(axis=0))), 1e-30)
    by_effect, gains, losses = {}, {}, {}

    def held_out_loss(names: tuple[str, ...], indices: np.ndarray) -> np.ndarray:
        return problem.leave_out(q.select(indices), names, fit.vector, indices, problem.fold)[1]

    for effect in effects:
        others = tuple(n for n in fit.names if not problem.space.overlaps(effect, (n,)))
        if others not in losses:
            losses[others] = held_out_loss(others, problem.free_indices(others))
        by_effect[effect], information = efficient_score(q, problem, others, effect, prior_gradient)
        s = by_effect[effect]
        informative = information > min_information
        ratios += list(2.0 * np.square(s).sum(axis=0)[informative] / information[informative])
        drawn = signs @ s
        largest = np.maximum(largest, np.einsum("fi,ij,fj->f", drawn, np.linalg.pinv(s.T @ s), drawn))
        names = (*others, effect)
        indices = problem.free_indices(names)
        step = problem.solve(q.select(indices), names, fit.vector, indices)
        gains[effect] = losses[others] - held_out_loss(names, indices), problem.take_step(fit.vector, indices, step)
    return Scores(by_effect, largest, max(float(np.median(ratios)) if ratios else 1.0, 1.0), gains)


def library_p_value(block_scores: np.ndarray, block_gain: np.ndarray, scores: Scores, effect_count: int) -> float:
    """p-value of the gain of an effect, corrected for its selection from the library and for two tests: twice the
    smaller p-value of the two (Bonferroni).

    Sign-flip test: the score statistic is compared with the largest of the library under random signs of the blocks,
    and the mean gain of the blocks is tested against zero; the larger p-value is used. Likelihood-ratio test: twice the
    gain divided by the design effect, with a Bonferroni correction; it detects effects that act in few blocks. Its null
    distribution is F instead of chi-square, because the design effect is estimated. block_scores: (b, k), b >= 2.
    block_gain: (b,). effect_count: number of effects in the library.
    """
    b, k = block_scores.shape
    p_score = (1 + int((scores.largest >= score_statistic(block_scores)).sum())) / (1 + len(scores.largest))
    ratio = 2.0 * max(float(block_gain.sum()), 0.0) / scores.design_effect
    p_ratio = effect_count * float(stats.f.sf(ratio / k, k, b - 1))
    return min(2.0 * max(p_score, p_no_worse(block_gain)), 2.0 * p_ratio, 1.0)


def p_no_worse(difference: np.ndarray) -> float:
    """p-value of the hypothesis that a loss is not higher than another. difference: (b,) that loss minus the other."""
    deviation = float(difference.std(ddof=1)) * np.sqrt(len(difference)) if len(difference) > 1 else np.inf
    return float(stats.norm.sf(difference.sum() / max(deviation, 1e-12)))


def collect_evidence(problem: Problem, reduced: Fit, fit: Fit, effect: str, scores: Scores,
                     partitions: Mapping[str, Partition], sensors: Sensors) -> Evidence:
    """Evidence for an effect, from `fit` with this effect and `reduced` without it. scores: those at `reduced`."""
    gain = reduced.held_out - fit.held_out
    block_scores = scores.by_effect.get(effect)
    if block_scores is None:
        block_scores = efficient_score_at_fit(problem, reduced, effect, fit.sensitivities)
    size = np.abs((fit.vector - problem.space.null) / problem.space.scale)[problem.space.indices(effect)].max()
    before, after = problem.held_out_residuals(reduced), problem.held_out_residuals(fit)
    reduction = problem.position_error(before) - problem.position_error(after)
    if problem.prior is not None:  # the other values, known from the healthy car, do not compensate for the effect
        before = problem.errors.at(problem.vector_without(fit, effect))
    mean_reduction, reduction_in_condition = error_reductions(reduction, partitions.get("condition"))
    sensors_p_value, sensors_null = sensor_p_values(problem, fit, effect, sensors)
    return Evidence(
        effect, gain=min(float(gain.sum()) / problem.residual_count, problem.held_out_gain(reduced, fit)),
        p_value=library_p_value(block_scores, gain, scores, len(problem.space.hypotheses)),
        null_p_value=null_p_value(problem, fit, effect), reductions=column_reductions(problem, before, after),
        position_reduction=mean_reduction, position_reduction_in_condition=reduction_in_condition,
        noise_ratio=residual_over_noise(problem, after), bound_distance=distance_to_bound(problem, fit, effect),
        gain_between_runs=problem.gain_between_runs, size=float(size), sensors_p_value=sensors_p_value,
        sensors_null_p_value=sensors_null, file_comparison=compare_with_file(problem, fit, effect),
        agreement={name: compare_parts(problem, fit, effect, *part) for name, part in partitions.items()})


def residual_over_noise(problem: Problem, residuals: np.ndarray) -> float:
    """Largest ratio of error to noise among the columns; 1 with reference drives, because the healthy car has the same
    residual, which therefore cannot imitate a change since the reference drives."""
    if problem.prior is not None:
        return 1.0
    return float((problem.column_rms(residuals) / np.maximum(problem.noise, 1e-12)).max())


def column_reductions(problem: Problem, reduced: np.ndarray, full: np.ndarray) -> dict[str, tuple[float, float]]:
    """By column, (error reduction divided by the larger of the baseline error and the error without the effect, error
    without the effect divided by the noise). reduced, full: residuals without and with the effect."""
    before, after = problem.column_rms(reduced), problem.column_rms(full)
    reduction = (before - after) / np.maximum(problem.baseline_rms, before)
    noise_ratio = before / np.maximum(problem.noise, 1e-12)
    return dict(zip(problem.errors.windows.columns, zip(reduction.tolist(), noise_ratio.tolist(), strict=True),
                    strict=True))


def efficient_score_at_fit(problem: Problem, fit: Fit, effect: str, sensitivities: Sensitivities) -> np.ndarray:
    """(b, k) efficient scores of an effect outside the fit. sensitivities: to the parameters of the effect and of the
    fit, at or near the vector of the fit."""
    indices = np.union1d(fit.indices, problem.space.indices(effect))
    residuals = problem.errors.at(fit.vector)
    q = problem.loss.quadratic(residuals, sensitivities.select(indices)).sum_groups(problem.block, problem.blocks)
    padded = Quadratic(q.cost, np.zeros((problem.blocks, len(problem.space))),
                       np.zeros((problem.blocks, len(problem.space), len(problem.space))))
    padded.gradient[:, indices] = q.gradient
    padded.hessian[:, indices[:, None], indices] = q.hessian
    return efficient_score(padded, problem, fit.names, effect, problem.prior_gradient(fit.vector))[0]


def error_reductions(reduction: np.ndarray, condition: Partition | None) -> tuple[float, float]:
    """(mean reduction of an error, largest one-sided lower 95 % bound of the mean in one driving condition; without
    conditions, the mean). reduction: (n,) by window."""
    finite = np.isfinite(reduction)
    if not finite.any():
        return 0.0, 0.0
    overall = float(reduction[finite].mean())
    if condition is None:
        return overall, overall
    parts = [reduction[finite & (condition[0] == k)] for k in np.unique(condition[0])]
    bounds = [float(p.mean() - 1.645 * p.std(ddof=1) / np.sqrt(len(p))) for p in parts if len(p) > 2]
    return overall, max(bounds, default=overall)


def distance_to_bound(problem: Problem, fit: Fit, effect: str) -> float:
    """Smallest distance of a value of the effect to one of its `Parameter.hard_bounds` [parameter scales]."""
    space = problem.space
    return min((float(abs(fit.vector[i] - edge) / space.scale[i]) for i in space.indices(effect)
                for edge in space.parameters[i][1].hard_bounds), default=np.inf)


def compare_with_file(problem: Problem, fit: Fit, effect: str) -> tuple[FileQuantity, float] | None:
    """(quantity that an effect moves furthest from the vehicle file, in standard deviations; change of its parameter
    from the null); None without such a quantity, and with reference drives."""
    changes = [(quantity, float(fit.vector[i] - problem.space.null[i])) for i in problem.space.indices(effect)
               if problem.prior is None and (quantity := problem.quantities[i]) is not None]
    return max(changes, key=lambda pair: pair[0].z_score(pair[1]), default=None)


def sensor_p_values(problem: Problem, fit: Fit, effect: str, sensors: Sensors) -> tuple[float | None, float | None]:
    """p-values of agreement of the fitted and of the null value with redundant sensors; None if not measured."""
    deviations = dict(zip(problem.space.indices(effect), standard_deviations(problem, fit, effect), strict=True))
    p_values = [_two_sided_p_value(fit.vector[i] - value, np.hypot(deviation, deviations[i]))
                for i, value, deviation in _sensor_estimates(problem.space, effect, sensors)]
    # With reference drives the null is the value of the healthy car, which the sensors do not measure.
    null = sensors_null_p_value(problem.space, effect, sensors) if problem.prior is None else None
    return min(p_values, default=None), null


def sensors_null_p_value(space: Space, effect: str, sensors: Sensors) -> float | None:
    """p-value of agreement of the null value with redundant sensors; None if not measured."""
    return min((_two_sided_p_value(space.null[i] - value, deviation)
                for i, value, deviation in _sensor_estimates(space, effect, sensors)), default=None)


def _sensor_estimates(space: Space, effect: str, sensors: Sensors) -> list[tuple[int, float, float]]:
    """(index, value, standard deviation) of the parameters that redundant sensors measure."""
    keys = {i: f"{effect}.{space.parameters[i][1].name}" for i in space.indices(effect)}
    measured = [(i, *sensors[key]) for i, key in keys.items() if key in sensors]
    return [(i, value, (high - low) / (2.0 * Z95)) for i, value, low, high in measured]


def _two_sided_p_value(distance: float, deviation: float) -> float:
    """p-value of a distance from 0, normally distributed with this standard deviation."""
    return 2.0 * float(stats.norm.sf(abs(distance) / max(deviation, 1e-12)))


def inverse(h: np.ndarray) -> np.ndarray:
    """Regularised pseudoinverse."""
    return np.linalg.pinv(_regularise(h))


def _regularise(h: np.ndarray) -> np.ndarray:
    """The matrix with 1e-9 of the mean of its diagonal added to the diagonal."""
    return h + 1e-9 * (np.trace(h) / max(len(h), 1) + 1e-12) * np.eye(len(h))


def standard_deviations(problem: Problem, fit: Fit, effect: str) -> np.ndarray:
    """(k,) standard deviations of the values of an effect [unit], from `covariance`."""
    variance = covariance(problem, fit)
    columns = np.searchsorted(fit.indices, problem.space.indices(effect))
    return np.sqrt(np.maximum(np.diag(variance)[columns], 0.0)) * problem.space.scale[fit.indices[columns]]


def covariance(problem: Problem, fit: Fit) -> np.ndarray:
    """(a, a) sandwich covariance H^-1 (S + C V C) H^-1 of the fitted values minus the start [parameter scales]; S is
    the scatter matrix of the block scores, C half the second derivative of the loss, H = C plus the curvature of the
    prior, V the covariance of the start; without V, the variance of the prior gradient replaces C V C. An error v of
    the start changes the difference by -H^-1 C v: shared errors cancel. Source: White, Econometrica 50 (1982)."""
    q = fit.quadratic.sum_groups(problem.block, problem.blocks)
    curvature = problem.loss.curvature(problem.errors.at(fit.vector), fit.sensitivities.select(fit.indices))
    if len(curvature):  # raised in every direction to at least MIN_CURVATURE times that of the reweighted least squares
        root = np.linalg.cholesky(_regularise(q.hessian.sum(axis=0)))
        values, vectors = np.linalg.eigh(np.linalg.solve(root, np.linalg.solve(root, curvature).T))
        curvature = ((root @ vectors) * np.maximum(values, MIN_CURVATURE)) @ (root @ vectors).T
    h = inverse(curvature + problem.prior_curvature(fit.names, fit.indices))
    centred = q.gradient - q.gradient.mean(axis=0)  # at the optimum the sum equals the gradient of the prior
    scatter = centred.T @ centred * problem.blocks / max(problem.blocks - 1, 1)
    if problem.start_covariance is not None:
        scatter = scatter + curvature @ problem.start_covariance @ curvature
    else:  # the values of the vehicle file are uncertain, and so is the gradient of the prior
        scatter = scatter + np.diag(0.5 * problem.design_effect * problem.file_curvature[fit.indices])
    return h @ scatter @ h


@dataclass(frozen=True, eq=False)
class JointFit:
    """A given fit, extended by every other effect that can be combined with it."""

    indices: np.ndarray  # (a,) free parameters
    covariance: np.ndarray  # (a, a) [parameter scales]
    shift: np.ndarray  # (a,) distance of the optimum from the fit [parameter scales]

    def select(self, indices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(standard deviations, shifts) of the parameters `indices` [parameter scales]."""
        columns = np.searchsorted(self.indices, indices)
        return np.sqrt(np.maximum(np.diag(self.covariance)[columns], 0.0)), self.shift[columns]


def approximate_joint_fit(problem: Problem, fit: Fit) -> JointFit:
    """Quadratic approximation of `fit`, extended by all other effects except composites and overlapping ones. Their
    priors are the uncertainties of the vehicle file, and UNSELECTED_DEVIATION for loads and where it has none.

        covariance = (D / 2) (H + K)^-1,   H, K: curvature of the loss and of the priors,   D: design effect

    An effect that was not selected may still be present; the covariance includes its possible contribution.
    Source: Laplace approximation of the posterior, with the composite likelihood adjusted by the design effect: Pauli,
    Racugno and Ventura, Statistica Sinica 21 (2011).
    """
    space, names = problem.space, fit.names
    others = [n for n in space.hypotheses if not space.overlaps(n, names) and not get_effect(n).members]
    indices = np.union1d(fit.indices, space.indices(*others))
    q = problem.loss.quadratic(problem.errors.at(fit.vector), problem.all_sensitivities(fit.vector).select(indices))
    prior = problem.file_curvature[indices]
    free = ((prior == 0.0) | (space.deviation[indices] < np.inf)) & ~np.isin(indices, fit.indices)
    prior[free] = 0.5 * problem.design_effect / UNSELECTED_DEVIATION**2
    h = _regularise(q.hessian.sum(axis=0) + np.diag(prior))
    gradient = q.gradient.sum(axis=0) - prior * problem.distance(fit.vector)[indices]
    shift = minimise_bounded(h, gradient, *problem.distance_to_bounds(fit.vector, indices))
    return JointFit(indices, 0.5 * problem.design_effect * np.linalg.inv(h), shift)


def null_p_value(problem: Problem, fit: Fit, effect: str) -> float:
    """p-value of the hypothesis that the values of an effect are those at the start of the search (the null values, or
    those of the healthy car), by Hotelling's T^2 test with sandwich covariance."""
    indices = problem.space.indices(effect)
    columns = np.searchsorted(fit.indices, indices)
    variance = covariance(problem, fit)[np.ix_(columns, columns)]
    d = problem.distance(fit.vector)[indices]
    degrees_of_freedom = problem.blocks - len(indices)
    if degrees_of_freedom < 1:
        return 1.0
    scale = degrees_of_freedom / (len(indices) * max(problem.blocks - 1, 1))
    return float(stats.f.sf(scale * float(d @ np.linalg.pinv(variance) @ d), len(indices), degrees_of_freedom))


def compare_parts(problem: Problem, fit: Fit, effect: str, part: np.ndarray, names: list[str]) -> Agreement:
    """Compare the values of an effect in the parts of the drives by a random-effects model.

    part: (n,) part of each window. names: names of the parts. The ratio of a part is 1 plus the Newton step of its loss
    in the direction of the fitted values; the other fitted parameters are free, with a weak prior (PART_PRIOR).
    Variances include the design effect. Parts with less information than MIN_INFORMATION_FRACTION are left out.
    """
    columns = np.searchsorted(fit.indices, problem.space.indices(effect))
    others = np.setdiff1d(np.arange(len(fit.indices)), columns)
    d = problem.distance(fit.vector)[fit.indices[columns]]
    basis = np.zeros((len(fit.indices), 1 + len(others)))
    basis[columns, 0] = d
    basis[others, 1 + np.arange(len(others))] = 1.0
    q = fit.quadratic.sum_groups(part)
    g, h = q.gradient @ basis, basis.T @ q.hessian @ basis
    overall = h.sum(axis=0)
    variance = inverse(overall)
    total = 1.0 / max(variance[0, 0], 1e-30)
    blocks = fit.quadratic.sum_groups(problem.block, problem.blocks).gradient @ basis
    # At least 0.5, the value for independent windows, because h is half the second derivative of the loss.
    design_effect = max(float((variance @ (blocks.T @ blocks) @ variance)[0, 0] * total), 0.5)
    prior = PART_PRIOR * overall / len(h)
    prior[0, :] = prior[:, 0] = 0.0
    ratios, variances, informative = [], [], []
    for k in range(len(h)):
        part_variance = inverse(h[k] + prior)
        information = 1.0 / max(part_variance[0, 0], 1e-30)
        if h[k, 0, 0] <= 0.0 or information < MIN_INFORMATION_FRACTION * total:
            continue
        ratios.append(1.0 + float((part_variance @ g[k])[0]))
        variances.append(design_effect / information)
        informative.append(names[k])
    return pool_ratios(np.array(ratios), np.array(variances), informative)


def pool_ratios(ratios: np.ndarray, variances: np.ndarray, names: list[str]) -> Agreement:
    """`Agreement` of independent ratios, by a random-effects model."""
    by_part = {n: (float(r), float(np.sqrt(v))) for n, r, v in zip(names, ratios, variances, strict=True)}
    if len(ratios) < 2:
        return Agreement(by_part, 1.0, 0.0)
    mean, error, between, q = random_effects(ratios, variances)
    return Agreement(by_part, float(stats.chi2.sf(q, len(ratios) - 1)),
                     float(stats.norm.sf(mean / np.sqrt(between + error**2))))
