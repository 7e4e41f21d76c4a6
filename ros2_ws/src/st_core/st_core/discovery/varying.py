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
    p_value: float  # of equal values in all parts, Bonferroni-corrected for the number of effects and partitions [1]
    index: int  # parameter with the most information
    values: Mapping[str, tuple[float, float]]  # (value, standard deviation) of this parameter, by part
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
    """One effect with its own value in each part of one partition; None if fewer than two parts are informative, if
    there are no more blocks than parts, or if the effect has no influence. tests: number of tests (Bonferroni)."""
    space, (part_of_window, names) = problem.space, partition
    indices = space.indices(effect)
    fitted_indices = problem.free_indices(fit.names) if problem.prior is None else space.indices(*fit.names)
    other_indices = np.setdiff1d(fitted_indices, indices)
    h = q.hessian.sum(axis=0)
    projection = np.zeros((len(space), len(indices)))  # the other fitted parameters are re-optimised
    projection[indices, np.arange(len(indices))] = 1.0
    projection[other_indices] = -inverse(h[np.ix_(other_indices, other_indices)]) @ h[np.ix_(other_indices, indices)]
    gradient, curvature = q.gradient @ projection, projection.T @ q.hessian @ projection
    parts = Quadratic(q.cost, gradient, curvature).sum_groups(part_of_window)
    information = np.diag(parts.hessian.sum(axis=0))
    if information.min() <= 1e-9 * float(np.trace(h)) / len(h):
        return None
    least_information = np.diagonal(parts.hessian, axis1=1, axis2=2).min(axis=1)
    informative = np.flatnonzero(least_information > MIN_INFORMATION_FRACTION * information.min()).tolist()
    degrees_of_freedom, residual_degrees = (len(informative) - 1) * len(indices), problem.blocks - len(informative)
    if len(informative) < 2 or residual_degrees < 1:
        return None
    inverses = {k: inverse(parts.hessian[k]) for k in informative}
    steps = {k: inverses[k] @ parts.gradient[k] for k in informative}  # from the common to the separate values
    total = parts.gradient[informative].sum(axis=0)
    gain = (sum(float(parts.gradient[k] @ step) for k, step in steps.items())
            - float(total @ inverse(parts.hessian[informative].sum(axis=0)) @ total))
    separate_gradient = gradient.copy()  # at the separate values; its sums over blocks give the design effect
    for k, step in steps.items():
        separate_gradient[part_of_window == k] -= curvature[part_of_window == k] @ step
    scores = np.zeros((problem.blocks, len(indices)))
    np.add.at(scores, problem.block, separate_gradient)
    scatter = float(np.trace(inverse(curvature.sum(axis=0)) @ scores.T @ scores))
    design_effect = max(2.0 * scatter / len(indices), 1.0) * problem.blocks / residual_degrees
    ratio = 2.0 * gain / design_effect / degrees_of_freedom
    p_value = min(tests * float(stats.f.sf(ratio, degrees_of_freedom, residual_degrees)), 1.0)
    best = int(np.argmax(information))
    index = indices[best]
    value, scale = float(fit.vector[index]), space.scale[index]
    values = {names[k]: (value + scale * float(step[best]),
                         scale * float(np.sqrt(0.5 * design_effect * inverses[k][best, best])))
              for k, step in steps.items()}
    return VaryingFit(effect, name, gain / problem.residual_count, p_value, index, values,
                      {k: projection @ step for k, step in steps.items()})


def collect_varying_evidence(problem: Problem, fit: Fit, v: VaryingFit,
                             partitions: Mapping[str, Partition]) -> Evidence:
    """Evidence for separate values in the parts, from linearised in-sample errors."""
    residuals = problem.errors.at(fit.vector)
    corrected, sensitivities = residuals.copy(), problem.all_sensitivities(fit.vector).values
    for k, step in v.steps.items():
        inside = partitions[v.varies_with][0] == k
        corrected[inside] -= np.tensordot(step, sensitivities[:, inside], 1)
    reduction = problem.position_error(residuals) - problem.position_error(corrected)
    mean_reduction, reduction_in_condition = error_reductions(reduction, partitions.get("condition"))
    return Evidence(v.name, v.gain, v.p_value, reductions=column_reductions(problem, residuals, corrected),
                    position_reduction=mean_reduction, position_reduction_in_condition=reduction_in_condition,
                    gain_between_runs=problem.gain_between_runs)
