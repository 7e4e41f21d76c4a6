"""Screening of candidate relations, reasons to reject them, equally good alternatives, and redundant effects."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from ..contract import describe_instability
from ..discovery.evidence import Agreement, describe_position_reduction, pool_ratios
from ..effects import get_effect
from ..effects._relation import MAX_COEFFICIENT, SPLINES
from ..models import get_model
from .candidates import Candidate, find_candidates
from .relation_fit import PENALTIES, RelationFit, RelationFits, profile_coefficients

DRAWS = 999  # number of draws of random block signs
POINTS = 41  # number of points at which a curve is evaluated
BOUND_MARGIN = 0.02  # fraction of the bound of the coefficients; a curve closer to the bound counts as reaching it
MIN_INFORMATION = 0.02  # minimum fraction of the information on the relation that a run needs for its own estimate


@dataclass(frozen=True, eq=False)
class ScreenedCandidate:
    """Statistics of a candidate, linearised at the discovered model."""

    candidate: Candidate
    statistic: float  # score statistic, divided by its mean over random signs of the blocks
    null_statistics: np.ndarray  # (DRAWS,) the same statistic for each draw of random block signs
    degrees_of_freedom: float  # effective number for the curve
    design_effect: float  # factor by which dependent windows increase the variance of the residual scores, at least 1
    gain: float  # reduction of the held-out loss
    information: np.ndarray  # (SPLINES, SPLINES) for the coefficients, with the other parameters projected out

    def compute_detection_limit(self, p_value: float, blocks: int) -> float:
        """Smallest linear relation that reaches `p_value`: its largest magnitude in the range [unit of the curve].
        blocks: number of blocks of the drives."""
        c = self.candidate
        points = np.linspace(c.low, c.high, POINTS)
        line = np.linalg.lstsq(c.compute_splines(points).T, points / max(abs(c.low), abs(c.high)), rcond=1e-6)[0]
        quantile = float(stats.f.isf(p_value, self.degrees_of_freedom, blocks - 1))
        required = 0.5 * quantile * self.degrees_of_freedom * self.design_effect
        return float(np.sqrt(required / max(float(line @ self.information @ line), 1e-30)))


def screen(fits: RelationFits, base_fit: RelationFit, tick: Callable[[], None]) -> list[ScreenedCandidate]:
    """Statistics of every excited candidate that changes a prediction. base_fit: fit without a relation."""
    distance = fits.problem.distance(base_fit.vector)[base_fit.indices]
    base_loss = fits.predict_held_out_loss(base_fit.quadratic, base_fit.penalty, distance)
    vehicle_sensitivities = fits.loss.sensitivities(base_fit.vector, fits.vehicle_indices)
    signs = np.random.default_rng(fits.settings.seed).choice([-1.0, 1.0], (DRAWS, fits.blocks))
    screened = []
    for candidate in find_candidates(fits.windows):
        tick()
        if s := _screen_candidate(fits, base_fit, base_loss, vehicle_sensitivities, candidate, signs):
            screened.append(s)
    return screened


def compute_p_values(screened: Sequence[ScreenedCandidate], blocks: int) -> dict[str, float]:
    """p-value of each candidate, corrected for the number of candidates and of tests: twice the smaller p-value of two
    tests. Sign flips: the statistic is compared with the largest of all candidates under random block signs. Likelihood
    ratio (F test): twice the held-out gain divided by the design effect (at least the median of all) and by the degrees
    of freedom, with a Bonferroni correction; this test detects relations that act in few blocks."""
    largest = np.max([s.null_statistics for s in screened], axis=0)
    median = float(np.median([s.design_effect for s in screened]))
    p_values = {}
    for s in screened:
        p_score = (1 + int((largest >= s.statistic).sum())) / (1 + DRAWS)
        ratio = 2.0 * max(s.gain, 0.0) / max(median, s.design_effect) / s.degrees_of_freedom
        p_ratio = len(screened) * float(stats.f.sf(ratio, s.degrees_of_freedom, blocks - 1))
        p_values[s.candidate.name] = min(2.0 * min(p_score, p_ratio), 1.0)
    return p_values


def _screen_candidate(fits: RelationFits, base_fit: RelationFit, base_loss: np.ndarray,
                      vehicle_sensitivities: np.ndarray, candidate: Candidate,
                      signs: np.ndarray) -> ScreenedCandidate | None:
    """Statistics of a candidate by the efficient scores of its coefficients, with other parameters projected out; None
    if it changes no prediction. base_loss: (b,) held-out loss without a relation. signs: (DRAWS, b)."""
    loss = fits.make_loss(candidate)
    sensitivities = loss.sensitivities(base_fit.vector, fits.relation_indices)
    q = fits.sum_quadratic(loss, base_fit.residuals, np.concatenate([base_fit.sensitivities, sensitivities]))
    h = q.hessian.sum(axis=0)
    if float(np.trace(h[-SPLINES:, -SPLINES:])) <= 1e-9 * float(np.trace(h)):
        return None
    all_sensitivities = np.concatenate([base_fit.sensitivities, vehicle_sensitivities, sensitivities])
    q_all = fits.sum_quadratic(loss, base_fit.residuals, all_sensitivities)
    distance = fits.problem.distance(base_fit.vector)[np.concatenate([base_fit.indices, fits.relation_indices])]
    penalties = {smoothing: fits.make_penalty(candidate, h, smoothing) for smoothing in PENALTIES}
    losses = {smoothing: fits.predict_held_out_loss(q, penalty, distance) for smoothing, penalty in penalties.items()}
    smoothing = min(losses, key=lambda level: float(losses[level].sum()))
    h = q_all.hessian.sum(axis=0)
    projection = profile_coefficients(h)
    gradient, information = q_all.gradient @ projection, h[-SPLINES:] @ projection
    inverse = np.linalg.pinv(information + penalties[smoothing][-SPLINES:, -SPLINES:])
    drawn = np.einsum("di,ij,dj->d", signs @ gradient, inverse, signs @ gradient)
    mean = max(float(drawn.mean()), 1e-30)
    total = gradient.sum(axis=0)
    step, degrees_of_freedom = inverse @ total, max(float(np.trace(inverse @ information)), 1.0)
    after = q_all.after(projection @ step).gradient @ projection
    design_effect = max(2.0 * float(np.einsum("bi,ij,bj->", after, inverse, after)) / degrees_of_freedom, 1.0)
    return ScreenedCandidate(candidate, float(total @ inverse @ total) / mean, drawn / mean, degrees_of_freedom,
                             design_effect, float((base_loss - losses[smoothing]).sum()), information)


def compute_lower_bound(values: np.ndarray, p: float) -> float:
    """One-sided lower confidence bound, at level 1 - p, of the sum of `values` (b,) over the blocks, by Student's t."""
    standard_error = float(values.std(ddof=1)) * np.sqrt(len(values))
    return float(values.sum() - stats.t.isf(p, len(values) - 1) * standard_error)


def average_by_block(fits: RelationFits, values: np.ndarray) -> np.ndarray:
    """(b,) mean of the finite (n,) values in the windows of each block; NaN for a block without any."""
    is_finite = np.isfinite(values)
    count = np.bincount(fits.block[is_finite], minlength=fits.blocks)
    return np.bincount(fits.block[is_finite], values[is_finite], fits.blocks) / np.where(count, count, np.nan)


def describe_unusable_curve(fits: RelationFits, fit: RelationFit) -> str:
    """Reason to reject a curve regardless of its gain: a coefficient reaches its limit, or the simulated car becomes
    unstable; "" if neither applies."""
    assert fit.candidate is not None
    name, vehicle = fit.candidate.name, fits.windows.vehicle
    if np.abs(fit.coefficients).max() > (1.0 - BOUND_MARGIN) * MAX_COEFFICIENT:
        return (f"the curve of {name} reaches its limit of {MAX_COEFFICIENT * fit.candidate.typical_size:.3g} "
                f"{fit.candidate.unit}, beyond any physical relation: check the vehicle file, and run st check")
    model = fits.make_space(fit.candidate).at(fit.vector)
    low, high = np.quantile(fits.windows.speeds[np.isfinite(fits.windows.speeds)], [0.05, 0.95])
    slow = max(float(low), vehicle.minimum_slip_speed)
    problem = describe_instability(get_model(model.base), model, vehicle, np.linspace(slow, max(float(high), slow), 4))
    return f"{name} makes the simulated car unstable, so its path cannot be predicted: {problem}" if problem else ""


def describe_deterioration(fits: RelationFits, name: str, before: np.ndarray, after: np.ndarray) -> str:
    """Reason to reject a relation that increases the held-out position error at the end of the horizon on average, or
    in one run significantly and by at least `Limits.relevant_position`; "" if there is none. Runs with fewer than three
    blocks are not tested. before, after: (n,) [m]."""
    increase = after - before
    if not np.isfinite(increase).any():
        return ""
    if np.nanmean(increase) > 0.0:
        return (f"{name} is significant, but raises the held-out position error after "
                f"{fits.settings.horizon:g} s from {np.nanmean(before):.3f} to {np.nanmean(after):.3f} m")
    blocks, run, names = average_by_block(fits, increase), fits.problem.run_of_block, fits.windows.names
    for k in np.unique(run):
        run_increases = blocks[(run == k) & np.isfinite(blocks)]
        windows = fits.windows.run == k
        if len(run_increases) <= 2 or np.nanmean(increase[windows]) < fits.limits.relevant_position:
            continue
        if compute_lower_bound(run_increases, fits.limits.undecided_p / len(names)) > 0.0:  # Bonferroni over the runs
            return (f"{name} is significant, but raises the held-out position error of {names[k]} after "
                    f"{fits.settings.horizon:g} s from {np.nanmean(before[windows]):.3f} to "
                    f"{np.nanmean(after[windows]):.3f} m")
    return ""


def describe_gain(fits: RelationFits, gains: np.ndarray, position_gain: np.ndarray) -> str:
    """Text on the held-out gain. gains: (b,) reduction of the loss. position_gain: (n,) of the position error [m]."""
    gain, low = (-np.expm1(-total / fits.loss.residual_count)
                 for total in (gains.sum(), compute_lower_bound(gains, fits.limits.undecided_p)))
    text = (f"reduces the held-out residual of all channels by {100 * gain:.1f} % (95 % confidence: at least "
            f"{100 * low:.1f} %)")
    has_positions = np.isfinite(position_gain).any()
    return f"{text}, and {describe_position_reduction(average_finite(position_gain))}" if has_positions else text


def describe_small_gain(fits: RelationFits, candidate: Candidate, gains: np.ndarray, position_gain: np.ndarray) -> str:
    """Reason to reject a relation with a small effect, or "": a held-out gain that is below the thresholds or not
    significant, or a predicted path that does not improve significantly. The path is not tested if the candidate is a
    sensor error, or with fewer than two blocks with a position."""
    limits = fits.limits
    small = (gains.sum() < limits.relevant * fits.loss.residual_count
             and average_finite(position_gain) < limits.relevant_position)
    if small or compute_lower_bound(gains, limits.undecided_p) <= 0.0:
        return f"{candidate.name} is significant, but only {describe_gain(fits, gains, position_gain)}"
    blocks = average_by_block(fits, position_gain)
    blocks = blocks[np.isfinite(blocks)]
    if not candidate.is_sensor_error and len(blocks) > 1 and compute_lower_bound(blocks, limits.false_alarm) <= 0.0:
        return (f"{candidate.name} is significant, but its gain in the predicted path is not: it "
                f"{describe_gain(fits, gains, position_gain)}")
    return ""


def average_finite(values: np.ndarray) -> float:
    """Mean of the finite values; 0 if there are none."""
    return float(np.nanmean(values)) if np.isfinite(values).any() else 0.0


def find_equally_good(excess_loss: np.ndarray, p: float, seed: int) -> np.ndarray:
    """(k,) whether each alternative is as good as the best. excess_loss: (k, b) held-out loss minus that of the best.
    Paired t test: an alternative is worse if its t exceeds the quantile 1 - p of the largest t of all under random
    signs of whole blocks (Romano and Wolf 2005)."""
    if not len(excess_loss):
        return np.zeros(0, bool)
    count = excess_loss.shape[1]
    centred = excess_loss - excess_loss.mean(axis=1, keepdims=True)
    drawn = np.random.default_rng(seed).choice([-1.0, 1.0], (DRAWS, count)) @ centred.T / count
    standard_errors = np.sqrt(np.maximum(np.square(centred).mean(axis=1) - np.square(drawn), 1e-30) / (count - 1))
    largest = (drawn / standard_errors).max(axis=1)
    t = excess_loss.mean(axis=1) / np.maximum(excess_loss.std(axis=1, ddof=1) / np.sqrt(count), 1e-30)
    return t <= np.quantile(largest, 1.0 - p)


def compare_runs(fits: RelationFits, fit: RelationFit) -> Agreement:
    """Size of the relation in each run relative to its overall size, from the quadratic approximation, with all other
    parameters profiled out; empty with fewer than two informative runs."""
    direction = profile_coefficients(fit.quadratic.hessian.sum(axis=0)) @ fit.coefficients
    gradient = fit.quadratic.gradient @ direction
    curvature = np.einsum("i,bij,j->b", direction, fit.quadratic.hessian, direction)
    run = fits.problem.run_of_block
    gradients, curvatures = np.bincount(run, gradient), np.bincount(run, curvature)
    informative_runs = np.flatnonzero(curvatures > MIN_INFORMATION * curvature.sum())
    if len(informative_runs) < 2:
        return Agreement({}, 1.0, 0.0)
    excess = gradients / np.maximum(curvatures, 1e-30)
    used = np.isin(run, informative_runs)
    scatter = np.square(gradient - excess[run] * curvature)[used].sum()
    variance_ratio, count = 2.0 * scatter / curvature[used].sum(), used.sum()
    design_effect = max(variance_ratio * count / max(count - len(informative_runs), 1), 1.0)
    return pool_ratios(1.0 + excess[informative_runs], 0.5 * design_effect / curvatures[informative_runs],
                       [fits.windows.names[k] for k in informative_runs])


def compute_position_errors(fits: RelationFits, fit: RelationFit) -> np.ndarray:
    """(n,) position error at the end of the horizon with values fitted to the other folds [m]."""
    residuals = fit.residuals.copy()
    for k, d in fit.steps.items():
        in_fold = fits.fold[fits.block] == k
        residuals[in_fold] -= np.einsum("p,pnm->nm", d, fit.sensitivities[:, in_fold])
    return fits.problem.position_error(residuals)


def compute_cosine(fits: RelationFits, first: RelationFit, second: RelationFit) -> float:
    """Cosine similarity of two relations' effects on the predictions, all other parameters projected out."""
    changes = []
    for fit in (first, second):
        rows = np.where(fits.loss.known, fit.sensitivities / fits.loss.scale, 0.0).reshape(len(fit.sensitivities), -1)
        others, change = rows[:-SPLINES], fit.coefficients @ rows[-SPLINES:]
        changes.append(change - np.linalg.lstsq(others.T, change, rcond=None)[0] @ others)
    return float(changes[0] @ changes[1] / max(np.linalg.norm(changes[0]) * np.linalg.norm(changes[1]), 1e-30))


def find_redundant_effects(fits: RelationFits, fit: RelationFit, base_fit: RelationFit,
                           names: Sequence[str]) -> dict[str, float]:
    """Effects of the result that the relation makes redundant, with the residual reduction [1] that each still adds. An
    effect is redundant if its held-out gain in addition to the relation is too small or not significant, and a fit with
    the relation instead of the effect has a significantly lower held-out loss than the result of the discovery."""
    redundant, limits = {}, fits.limits
    errors_with_both = compute_position_errors(fits, fit)
    # An effect that converts the base model into a different one (`converts`) is a precondition of the relation.
    for name in (n for n in names if not get_effect(n).converts):
        reduced = fits.fit_without_effect(fit, name)
        gains = reduced.held_out - fit.held_out
        position = average_finite(compute_position_errors(fits, reduced) - errors_with_both)
        relevant = gains.sum() >= limits.relevant * fits.loss.residual_count or position >= limits.relevant_position
        is_needed = relevant and compute_lower_bound(gains, limits.undecided_p) > 0.0
        if not is_needed and compute_lower_bound(base_fit.held_out - reduced.held_out, limits.undecided_p) > 0.0:
            redundant[name] = max(float(-np.expm1(-gains.sum() / fits.loss.residual_count)), 0.0)
    return redundant
