"""Power and false-alarm rate of the tests on these drives, predicted from the curvature of the loss or measured.

To measure them, residuals of drives are simulated: those of the final fit, with the sign of each block drawn at random,
plus the change caused by a known effect. The effect counts as detected if one forward step of the search selects it or
an effect inseparable from it, on the quadratic approximation of the loss; the whole search is not repeated.
"""

from collections.abc import Callable

import numpy as np
from scipy import stats

from ..effects import find_confounded_effects
from .evidence import Scores, efficient_score, error_reductions, library_p_value, residual_over_noise, score_effects
from .fit import Fit, Problem
from .result import Power, PowerAnalysis
from .settings import Limits

EFFECT_SIZES = (0.25, 0.5, 1.0)  # tested sizes of an effect [parameter scales]
LARGER_SIZES = 15  # sizes from there to the bound; of these, the first detectable one is listed
DRIVES = 20  # simulated drives for each size of an effect; the standard deviation of the measured power is at most 0.11
FALSE_ALARM_DRIVES, SIGN_DRAWS = 100, 100  # simulated drives without an effect; draws of block signs for each drive


def predict_power(problem: Problem, fit: Fit, scores: Scores, limits: Limits) -> PowerAnalysis:
    """Power from the curvature at the final fit. Twice the gain divided by the design effect has a noncentral
    chi-square distribution with one degree of freedom."""
    q = problem.full_quadratic(fit.vector).sum_groups(problem.block, problem.blocks)
    largest_size = np.abs(problem.distance_to_bounds(fit.vector, np.arange(len(problem.space)))).max(axis=0)
    powers: list[Power] = []
    for effect in problem.space.hypotheses:
        names = tuple(n for n in fit.names if not problem.space.overlaps(effect, (n,)))
        information = efficient_score(q, problem, names, effect)[1]
        best = int(np.argmax(information))
        index = problem.space.indices(effect)[best]
        powers += [_power(problem, fit, index, size, information[best], scores, limits) for size in EFFECT_SIZES]
        if powers[-1].probability < limits.detection_power:
            larger_sizes = np.geomspace(EFFECT_SIZES[-1], largest_size[index], LARGER_SIZES + 1)[1:].tolist()
            larger = (_power(problem, fit, index, size, information[best], scores, limits) for size in larger_sizes)
            powers += [p for p in larger if p.probability >= limits.detection_power][:1]
    return PowerAnalysis(tuple(powers), 0, 0, measured=False)


def find_confounding_effect(problem: Problem, fit: Fit, effect: str, scores: Scores, limits: Limits) -> str:
    """Name of the effect of the fit that masks `effect` most: if its values were known, a change of `effect` by one
    parameter scale would be detected with the highest power; "" if no power reaches `limits.detection_power`."""
    q = problem.full_quadratic(fit.vector).sum_groups(problem.block, problem.blocks)
    names = [n for n in fit.names if not problem.space.overlaps(effect, (n,))]
    indices, masking_effect, largest_power = problem.space.indices(effect), "", limits.detection_power
    for other in names:
        information = efficient_score(q, problem, tuple(n for n in names if n != other), effect)[1]
        index = int(np.argmax(information))
        power = _power(problem, fit, indices[index], EFFECT_SIZES[-1], information[index], scores, limits).probability
        if power >= largest_power:
            masking_effect, largest_power = other, power
    return masking_effect


def _power(problem: Problem, fit: Fit, index: int, size: float, information: float, scores: Scores,
           limits: Limits) -> Power:
    """Power for a change of a parameter by `size` times its scale."""
    effect, parameter = problem.space.parameters[index]
    threshold = float(stats.chi2.isf(limits.false_alarm / (2 * len(problem.space.hypotheses)), 1))
    change = size * problem.all_sensitivities(fit.vector).values[index]
    min_gain = _required_gain(problem, problem.errors.at(fit.vector), change, limits)
    threshold = max(threshold, 2.0 * min_gain * problem.residual_count / scores.design_effect)
    probability = float(stats.ncx2.sf(threshold, 1, max(2.0 * size**2 * information / scores.design_effect, 1e-9)))
    return Power(effect, parameter.name, parameter.unit, size * float(problem.space.scale[index]), probability, 0,
                 error_reductions(problem.position_error(change), None)[0])


def _required_gain(problem: Problem, residuals: np.ndarray, change: np.ndarray, limits: Limits) -> float:
    """Gain per residual above which an effect that causes `change` is reported. residuals: those of the final fit."""
    modelled, unmodelled = problem.position_error(residuals), problem.position_error(residuals + change)
    reduction, _ = error_reductions(unmodelled - modelled, None)  # [m]
    min_gain = limits.negligible if reduction > limits.relevant_position else limits.relevant
    has_unexplained_residual = residual_over_noise(problem, residuals) > limits.max_noise_ratio
    return max(min_gain, limits.unexplained_share) if has_unexplained_residual else min_gain


def measure_power(problem: Problem, fit: Fit, limits: Limits, seed: int, tick: Callable[[], None]) -> PowerAnalysis:
    """Power and false alarms of a forward step on simulated drives."""
    rng = np.random.default_rng(seed)
    residuals = np.nan_to_num(problem.errors.at(fit.vector))
    sensitivities = problem.all_sensitivities(fit.vector).values
    powers = []

    def detect(change: np.ndarray, min_gain: float) -> list[str]:
        """Effects to be reported in one simulated drive: the best one and those inseparable from it; none if the best
        is not significant or gains less than `min_gain` per residual. change: (n, m) residuals due to the effect."""
        signs = rng.choice([-1.0, 1.0], problem.blocks)
        simulated_residuals = signs[problem.block][:, None] * residuals + change
        q = problem.loss.quadratic(simulated_residuals, sensitivities).sum_groups(problem.block, problem.blocks)
        scores = score_effects(problem, q, fit, problem.space.hypotheses, rng, SIGN_DRAWS)
        gains = {effect: float(gain.sum()) for effect, (gain, _) in scores.gains.items()}
        best = max(gains, key=gains.__getitem__)
        p_value = library_p_value(scores.by_effect[best], scores.gains[best][0], scores, len(gains))
        if p_value > limits.false_alarm or gains[best] / problem.residual_count < min_gain:
            return []
        return [e for e, gain in gains.items() if gain > (1.0 - limits.undecided_p) * gains[best]
                or (e in find_confounded_effects(best) and gain > limits.min_rival_gain * gains[best])]

    for effect in problem.space.hypotheses:
        indices = problem.space.indices(effect)
        index = indices[int(np.argmax(np.square(sensitivities[indices] / problem.loss.scale).sum(axis=(1, 2))))]
        parameter, scale = problem.space.parameters[index][1], float(problem.space.scale[index])
        for size in EFFECT_SIZES:
            vector = problem.take_step(fit.vector, np.array([index]), size * problem.space.sign[[index]])
            change = residuals - np.nan_to_num(problem.errors.at(vector))
            min_gain = _required_gain(problem, residuals, change, limits)
            detections = sum(effect in detect(change, min_gain) for _ in range(DRIVES))
            powers.append(Power(effect, parameter.name, parameter.unit, size * scale, detections / DRIVES, DRIVES))
        tick()
    alarms = sum(bool(detect(np.zeros_like(residuals), limits.relevant)) for _ in range(FALSE_ALARM_DRIVES))
    return PowerAnalysis(tuple(powers), alarms, FALSE_ALARM_DRIVES, measured=True)
