"""Search for effects that vary between parts of the drives, such as runs, sites or periods of time.

An effect that begins in the middle of a drive has no single value that reduces the errors everywhere, so the search
may miss it. Here each part of a partition has its own value, from the quadratic approximation at the final fit.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy import stats

from ..effects import get_effect
from .evidence import MIN_INFORMATION_FRACTION, Evidence, column_reductions, error_reductions, inverse
from .fit import Fit, Problem
from .loss import Quadratic
from .partitions import Partition


@dataclass(frozen=True)
class VaryingFit:
    """An effect with its own value in each part of a partition."""

    name: str
    varies_with: str  # name of the partition
    gain: float  # reduction of the loss per residual compared with one common value [1]
    # Of the hypothesis that the value is the same in all parts, Bonferroni-corrected for effects and partitions [1].
    p_value: float
    index: int  # parameter with the most information
    values: Mapping[str, tuple[float, float]]  # its (value, standard deviation) by part
    steps: Mapping[int, np.ndarray]  # (p,) step of all parameters [parameter scales], by part


def find_varying_effects(problem: Problem, fit: Fit, partitions: Mapping[str, Partition]) -> list[VaryingFit]:
    """Fits of every effect of the library, except composites, with its own value in each part of a partition, largest
    gain first. Partitions with at least half as many parts as blocks are left out."""
    q = problem.full_quadratic(fit.vector)
    usable_partitions = {name: partition for name, partition in partitions.items()
                         if len(np.unique(partition[0])) < problem.blocks / 2}
    library = [n for n in problem.space.hypotheses if not get_effect(n).members]
    fits = [_fit_by_part(problem, fit, q, effect, name, partition, len(library) * len(usable_partitions))
            for name, partition in usable_partitions.items() for effect in library]
    return sorted((v for v in fits if v), key=lambda v: -v.gain)


def _fit_by_part(problem: Problem, fit: Fit, q: Quadratic, effect: str, name: str, partition: Partition,
                 tests: int) -> VaryingFit | None:
    """One effect with its own value in each part of one partition; None if fewer than two parts are informative, or if
    there are no more blocks than parts. tests: number of tests, for the Bonferroni correction."""
    space, (number, names) = problem.space, partition
    indices = space.indices(effect)
    fitted_indices = problem.free_indices(fit.names) if problem.prior is None else space.indices(*fit.names)
    other_indices = np.setdiff1d(fitted_indices, indices)
    h = q.hessian.sum(axis=0)
    projection = np.zeros((len(space), len(indices)))  # the other fitted parameters are re-optimised
    projection[indices, np.arange(len(indices))] = 1.0
    projection[other_indices] = -inverse(h[np.ix_(other_indices, other_indices)]) @ h[np.ix_(other_indices, indices)]
    gradient, curvature = q.gradient @ projection, projection.T @ q.hessian @ projection
    # (part, half the negative gradient of its loss (m,), half its Hessian (m, m))
    all_parts = [(k, gradient[number == k].sum(axis=0), curvature[number == k].sum(axis=0)) for k in np.unique(number)]
    information = np.diag(sum(hk for *_, hk in all_parts))
    if information.min() <= 1e-9 * float(np.trace(h)) / len(h):
        return None
    parts = [part for part in all_parts if np.diag(part[2]).min() > MIN_INFORMATION_FRACTION * information.min()]
    degrees_of_freedom, residual_degrees = (len(parts) - 1) * len(indices), problem.blocks - len(parts)
    if len(parts) < 2 or residual_degrees < 1:
        return None
    separate_gain = sum(float(gk @ inverse(hk) @ gk) for _, gk, hk in parts)
    total = sum(gk for _, gk, _ in parts)
    gain = separate_gain - float(total @ inverse(sum(hk for *_, hk in parts)) @ total)
    separate_gradient = gradient.copy()  # at the separate values; its sums over blocks give the design effect
    for k, gk, hk in parts:
        separate_gradient[number == k] -= curvature[number == k] @ (inverse(hk) @ gk)
    scores = np.zeros((problem.blocks, len(indices)))
    np.add.at(scores, problem.block, separate_gradient)
    scatter = float(np.trace(inverse(curvature.sum(axis=0)) @ scores.T @ scores))
    design_effect = max(2.0 * scatter / len(indices), 1.0) * problem.blocks / residual_degrees
    ratio = 2.0 * gain / design_effect / degrees_of_freedom
    p_value = min(tests * float(stats.f.sf(ratio, degrees_of_freedom, residual_degrees)), 1.0)
    best = int(np.argmax(information))
    index = indices[best]
    value, scale = float(fit.vector[index]), space.scale[index]
    values = {names[k]: (value + scale * float((inverse(hk) @ gk)[best]),
                         scale * float(np.sqrt(0.5 * design_effect * inverse(hk)[best, best]))) for k, gk, hk in parts}
    steps = {int(k): projection @ (inverse(hk) @ gk) for k, gk, hk in parts}
    return VaryingFit(effect, name, gain / problem.residual_count, p_value, index, values, steps)


def collect_varying_evidence(problem: Problem, fit: Fit, v: VaryingFit,
                             partitions: Mapping[str, Partition]) -> Evidence:
    """Evidence for separate values in the parts, from linearised in-sample errors."""
    rows = problem.errors.at(fit.vector)
    corrected, sensitivities = rows.copy(), problem.all_sensitivities(fit.vector).values
    for k, step in v.steps.items():
        inside = partitions[v.varies_with][0] == k
        corrected[inside] -= np.tensordot(step, sensitivities[:, inside], 1)
    reduction = problem.position_error(rows) - problem.position_error(corrected)
    mean_reduction, reduction_in_condition = error_reductions(reduction, partitions.get("condition"))
    return Evidence(v.name, v.gain, v.p_value, shares=column_reductions(problem, rows, corrected),
                    position_reduction=mean_reduction, position_reduction_in_condition=reduction_in_condition,
                    gain_between_runs=problem.gain_between_runs)
