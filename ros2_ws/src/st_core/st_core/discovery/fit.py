"""Joint fits of sets of effects by simulation, and their held-out loss."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.optimize import lsq_linear

from ..regression import add_ridge
from .loss import Loss, Quadratic, rho
from .space import ACCELEROMETER_GAIN, Quantities, prior_deviations

ITERATIONS, STEP_FRACTIONS = 5, (1.0, 0.5, 0.2)  # maximum number of steps; fractions tried until the loss falls
MAX_REUSE_DISTANCE = 0.25  # parameter scales; below it, cached sensitivities are updated instead of recomputed
SENSITIVITY_CACHE_SIZE = 4  # number of vectors
MIN_LOSS_REDUCTION = 2e-4  # per residual; a fit ends with the first step that reduces the loss by less
FOLDS = 8  # groups of blocks, each held out once
RMS_CLIP_LIMIT = 5.0  # robust scales of the baseline; larger residuals are clipped in an RMS value
JOINT_DEVIATION = 3.0  # parameter scales; a joint fit has a prior of at least (distance / JOINT_DEVIATION)^2
DIVERGED_ERROR = 100.0  # SI unit of the channel; error assigned to a prediction that diverges, and clip limit
MAX_QUADRATIC_RISE = 0.05  # per residual; at a larger predicted increase of the loss, held-out folds are simulated
RIDGE = 1e-6  # fraction of the mean curvature, added to the diagonal to keep steps finite without information


def minimise_bounded(a: np.ndarray, b: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """x that minimises x'Ax - 2 b'x subject to low <= x <= high, for a positive definite A."""
    x = np.linalg.solve(a, b)
    if ((x >= low) & (x <= high)).all():
        return x
    root = np.linalg.cholesky(a)
    result = lsq_linear(root.T, np.linalg.solve(root, b), (low, high), "bvls", 1e-12, max_iter=30 * len(b) + 50)
    return np.clip(result.x, low, high)


@dataclass(frozen=True, eq=False)
class Sensitivities:
    """Sensitivities of the residuals at `vector`, i.e. their negative Jacobian. values: (a, n, m) reduction of the m
    residuals of n windows per parameter scale, for the a parameters `indices`."""

    vector: np.ndarray
    indices: np.ndarray
    values: np.ndarray

    def select(self, indices: np.ndarray) -> np.ndarray:
        return self.values[np.searchsorted(self.indices, indices)]

    def update(self, vector: np.ndarray, scale: np.ndarray, reduction: np.ndarray) -> "Sensitivities":
        """The sensitivities at a new vector by Broyden's update (1965). reduction: (n, m) of residuals, simulated."""
        step = ((vector - self.vector) / scale)[self.indices]
        square = float(step @ step)
        if square == 0.0:
            return self
        error = reduction - np.tensordot(step, self.values, 1)
        error[~np.isfinite(error)] = 0.0  # the window diverges at one of the two vectors
        return Sensitivities(vector, self.indices, self.values + (step / square)[:, None, None] * error)

    def with_values(self, indices: np.ndarray, values: np.ndarray) -> "Sensitivities":
        all_values = self.values.copy()
        all_values[np.searchsorted(self.indices, indices)] = values
        return Sensitivities(self.vector, self.indices, all_values)


@dataclass(frozen=True, eq=False)
class Fit:
    """A set of effects with fitted values."""

    names: tuple[str, ...]
    vector: np.ndarray
    indices: np.ndarray  # (a,) free parameters
    sensitivities: Sensitivities  # with respect to at least these parameters
    quadratic: Quadratic  # approximation of the loss of each window in these parameters
    held_out: np.ndarray  # (b,) loss of each block at values fitted without its fold


def marginalise(prior: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Prior curvature (p, p) with the parameters `free` marginalised (Schur complement); their entries are zero."""
    others = np.setdiff1d(np.arange(len(prior)), free)
    marginal = np.zeros_like(prior)
    cross = prior[np.ix_(others, free)]
    free_block = prior[np.ix_(free, free)] + 1e-9 * np.eye(len(free))
    marginal[np.ix_(others, others)] = prior[np.ix_(others, others)] - cross @ np.linalg.solve(free_block, cross.T)
    return marginal


class Problem:
    """A loss with its priors, and the fits of sets of effects that minimise it.

    start: (p,) initial vector of a search.
    block: (n,) number of the block of each window.
    prior: (p, p) curvature about `start`, divided by design_effect, from reference drives, for parameters outside the
        fitted set; if None, these keep their start values, except the accelerometer gain if acceleration_y is measured.
    noise: (c,) error of each column due to noise alone [SI].
    gain_between_runs, start_covariance: those of the `HealthyCar`; without a covariance, the start is exact.

    quantities: (p,) quantity of the vehicle file that each parameter changes. Its standard deviation s adds a Gaussian
    prior 0.5 D (x / s)^2 to the loss, x: change of the quantity. design_effect D [1]: see `update_design_effect`.
    """

    def __init__(self, loss: Loss, start: np.ndarray, block: np.ndarray, prior: np.ndarray | None = None,
                 noise: np.ndarray | None = None, gain_between_runs: float = 0.0, quantities: Quantities | None = None,
                 start_covariance: np.ndarray | None = None):
        self.loss, self.errors, self.space, self.residual_count = loss, loss.errors, loss.space, loss.residual_count
        self.start, self.prior, self.start_covariance = start, prior, start_covariance
        self.gain_between_runs, self.design_effect = gain_between_runs, 1.0
        self.set_quantities((None,) * len(self.space) if quantities is None else quantities)
        self.noise = np.zeros(len(self.errors.windows.columns)) if noise is None else noise
        self.block, self.blocks = block, int(block.max()) + 1
        self.fold = np.arange(self.blocks) % min(FOLDS, self.blocks)
        self._residual_counts = np.bincount(block, loss.known.sum(axis=1), self.blocks)
        self._cached_sensitivities: list[Sensitivities] = []

    def set_quantities(self, quantities: Quantities) -> None:
        """Set the quantities of the vehicle file that the parameters change. Priors of payloads apply only without
        reference drives, which already include the load."""
        self.quantities = quantities
        payload_deviation = self.space.deviation if self.prior is None else np.inf
        self._deviation = np.minimum(prior_deviations(quantities, self.space.scale), payload_deviation)

    @cached_property
    def baseline_rms(self) -> np.ndarray:
        """(c,) RMS of the baseline residuals, see `column_rms`."""
        return np.maximum(self.column_rms(self.errors.at(self.start)), 1e-12)

    @cached_property
    def _baseline_scale(self) -> np.ndarray:
        return self.loss.scale_of(self.start)

    def column_rms(self, residuals: np.ndarray) -> np.ndarray:
        """(c,) RMS of the residuals of each column at all points of the horizon, clipped (RMS_CLIP_LIMIT) [SI]."""
        limit = RMS_CLIP_LIMIT * self._baseline_scale
        square = np.square(np.clip(np.nan_to_num(residuals, nan=np.inf), -limit, limit))
        mean = np.where(self.loss.known, square, 0.0).sum(axis=0) / np.maximum(self.loss.known.sum(axis=0), 1)
        return np.sqrt(mean.reshape(len(self.errors.windows.time), -1).mean(axis=0))

    @cached_property
    def held_out_groups(self) -> np.ndarray:
        """(b,) group of each block for reported held-out errors: its run, or its fold if there are at most 3 runs."""
        return self.run_of_block if len(np.unique(self.run_of_block)) > 3 else self.fold

    @cached_property
    def run_of_block(self) -> np.ndarray:
        """(b,) run of each block."""
        run = np.zeros(self.blocks, int)
        run[self.block] = self.errors.windows.run
        return run

    def free_indices(self, names: Iterable[str]) -> np.ndarray:
        """(a,) indices of the parameters that are free in a fit of the effects `names`."""
        if self.prior is not None:
            return np.arange(len(self.space))
        gain_names = (ACCELEROMETER_GAIN,) if "acceleration_y" in self.errors.windows.columns else ()
        return self.space.indices(*names, *gain_names)

    def prior_curvature(self, names: Iterable[str], indices: np.ndarray) -> np.ndarray:
        """(a, a) curvature of the prior about the start: from the vehicle file, or from the reference drives with the
        parameters of the effects `names` marginalised."""
        if self.prior is None:
            return np.diag(self.file_curvature[indices])
        return self.design_effect * marginalise(self.prior, self.space.indices(*names))

    @property
    def file_curvature(self) -> np.ndarray:
        """(p,) curvature of the prior from the vehicle file."""
        return 0.5 * self.design_effect / np.square(self._deviation)

    def prior_gradient(self, vector: np.ndarray) -> np.ndarray:
        """(p,) half the gradient of the prior from the vehicle file, at a vector."""
        return self.file_curvature * (vector - self.start) / self.space.scale

    def update_design_effect(self, vector: np.ndarray) -> None:
        """Estimate the design effect from the residuals at a vector: variance of the scores between blocks, or between
        runs if larger, divided by the variance for independent residuals; median of the parameters, at least 1.

            D = 2 n var(g_k) / H,   g_k: half the gradient of the loss in part k of n, H: half its second derivative

        Scores of an incomplete model vary between parts of the drives, so D grows with unmodelled effects.
        Source: Kish, Survey Sampling (1965), ch. 8.
        """
        q = self.full_quadratic(vector)
        information = np.diag(q.hessian.sum(axis=0))
        informative = information > 1e-9 * information.sum()
        estimates = [1.0]
        for part in (self.block, self.errors.windows.run):
            gradient = q.sum_groups(part).gradient[:, informative]
            if len(gradient) > 2:
                variance = 2.0 * len(gradient) * gradient.var(axis=0, ddof=1)
                estimates.append(float(np.median(variance / information[informative])))
        self.design_effect = max(estimates)

    def distance(self, vector: np.ndarray) -> np.ndarray:
        """(p,) signed distance from the start [parameter scales]."""
        return (vector - self.start) / self.space.scale

    def distance_to_bounds(self, vector: np.ndarray, indices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(a,) largest negative and positive steps of some parameters to their bounds [parameter scales]."""
        low, high = np.minimum(self.space.low - vector, 0.0), np.maximum(self.space.high - vector, 0.0)
        return (low / self.space.scale)[indices], (high / self.space.scale)[indices]

    def solve(self, q: Quadratic, names: Iterable[str], vector: np.ndarray, indices: np.ndarray) -> np.ndarray:
        """(a,) step from `vector` to the minimum of the quadratic q plus the prior within the bounds."""
        prior = self.prior_curvature(names, indices)
        gradient = q.gradient.sum(axis=0) - prior @ self.distance(vector)[indices]
        return minimise_bounded(add_ridge(q.hessian.sum(axis=0) + prior), gradient,
                                *self.distance_to_bounds(vector, indices))

    def cost(self, names: Iterable[str], vector: np.ndarray, indices: np.ndarray) -> float:
        """The loss plus the cost of the prior."""
        distance = self.distance(vector)[indices]
        return self.loss.total(vector) + float(distance @ self.prior_curvature(names, indices) @ distance)

    def all_sensitivities(self, vector: np.ndarray) -> Sensitivities:
        """Sensitivities to all parameters: cached for a nearby vector and updated for the step, or computed."""
        for cached in reversed(self._cached_sensitivities):
            if np.abs((vector - cached.vector) / self.space.scale).max() < MAX_REUSE_DISTANCE:
                return self._sensitivities_at(cached, vector, np.zeros(0, int))
        indices = np.arange(len(self.space))
        new = Sensitivities(vector, indices, self.loss.sensitivities(vector, indices))
        self._cached_sensitivities = [*self._cached_sensitivities[-SENSITIVITY_CACHE_SIZE + 1:], new]
        return new

    def full_quadratic(self, vector: np.ndarray) -> Quadratic:
        """Quadratic approximation of the loss of each window about a vector, in all parameters."""
        return self.loss.quadratic(self.errors.at(vector), self.all_sensitivities(vector).values)

    def take_step(self, vector: np.ndarray, indices: np.ndarray, step: np.ndarray) -> np.ndarray:
        """The vector after a step [parameter scales] of some parameters, limited to the bounds."""
        result = vector.copy()
        result[indices] += step * self.space.scale[indices]
        return self.space.clip_to_bounds(result)

    def vector_without(self, fit: Fit, *names: str) -> np.ndarray:
        """The vector of a fit with the effects `names` at their start values."""
        vector, indices = fit.vector.copy(), self.space.indices(*names)
        vector[indices] = self.start[indices]
        return vector

    def fit(self, names: Iterable[str], sensitivities: Sensitivities, vector: np.ndarray | None = None,
            recompute: Iterable[str] = (), iterations: int = ITERATIONS) -> Fit:
        """Fit a set of effects by robust Gauss-Newton. sensitivities: with respect to at least the free parameters, at
        a nearby vector; updated at each step. vector: initial vector, by default that of the sensitivities. recompute:
        effects with new sensitivities at each step."""
        names = tuple(names)
        indices, stale = self.free_indices(names), self.space.indices(*recompute)
        initial, vector = sensitivities.vector if vector is None else vector, self.start.copy()
        vector[indices] = initial[indices]
        sensitivities = self._sensitivities_at(sensitivities, vector, stale)
        cost = self.cost(names, vector, indices)
        for _ in range(iterations if len(indices) else 0):
            q = self.loss.quadratic(self.errors.at(vector), sensitivities.select(indices))
            step = self.solve(q, names, vector, indices)
            for fraction in STEP_FRACTIONS:
                trial = self.take_step(vector, indices, fraction * step)
                trial_cost = self.cost(names, trial, indices)
                if trial_cost < cost:
                    break
            else:
                break
            reduction, vector, cost = cost - trial_cost, trial, trial_cost
            sensitivities = self._sensitivities_at(sensitivities, vector, stale)
            if reduction < MIN_LOSS_REDUCTION * self.residual_count:
                break
        return self.fit_at(names, vector, indices, sensitivities)

    def refit(self, fit: Fit, iterations: int = 2) -> Fit:
        """Continue a fit with recomputed sensitivities to the parameters of its effects and the accelerometer gain."""
        own_indices = np.intersect1d(self.space.indices(*fit.names, ACCELEROMETER_GAIN), fit.sensitivities.indices)
        sensitivities = replace(fit.sensitivities, vector=fit.vector)
        sensitivities = sensitivities.with_values(own_indices, self.loss.sensitivities(fit.vector, own_indices))
        return self.fit(fit.names, sensitivities, iterations=iterations)

    def _sensitivities_at(self, sensitivities: Sensitivities, vector: np.ndarray, stale: np.ndarray) -> Sensitivities:
        """The sensitivities at a new vector, with those to the parameters `stale` recomputed."""
        if not np.array_equal(vector, sensitivities.vector):
            reduction = self.errors.at(sensitivities.vector) - self.errors.at(vector)
            sensitivities = sensitivities.update(vector, self.space.scale, reduction)
        return sensitivities.with_values(stale, self.loss.sensitivities(vector, stale)) if len(stale) else sensitivities

    def fit_at(self, names: tuple[str, ...], vector: np.ndarray, indices: np.ndarray,
               sensitivities: Sensitivities) -> Fit:
        """The `Fit` at a vector, with the quadratic approximation and the held-out loss there."""
        q = self.loss.quadratic(self.errors.at(vector), sensitivities.select(indices))
        fit = Fit(names, vector, indices, sensitivities, q, np.zeros(self.blocks))
        return replace(fit, held_out=self.held_out_loss(fit, self.fold))

    def leave_out(self, q: Quadratic, names: Iterable[str], vector: np.ndarray, indices: np.ndarray,
                  fold: np.ndarray, at_optimum: bool = False) -> tuple[dict[int, np.ndarray], np.ndarray]:
        """({fold: step to the values fitted without it}, (b,) loss of each block at the values fitted without its fold,
        including its share of the prior cost), from the quadratic approximation of the loss. q: loss by block. fold:
        (b,) fold of each block. at_optimum: treat `vector` as the optimum, without a further Gauss-Newton step. With a
        prior from reference drives, leaving out a fold changes only the parameters of the effects `names`."""
        names = tuple(names)
        h, g = q.hessian.sum(axis=0), q.gradient.sum(axis=0)
        optimum = self.solve(q, names, vector, indices)
        prior, distance = self.prior_curvature(names, indices), self.distance(vector)[indices]
        limits = self.distance_to_bounds(vector, indices)
        low, high = (edge - optimum for edge in limits)
        columns = np.flatnonzero(np.isin(indices, self.space.indices(*names)))
        gradient = q.gradient - q.hessian @ optimum
        initial_gradient, base = (gradient, np.zeros(len(indices))) if at_optimum else (q.gradient, optimum)
        steps, held_out = {}, np.zeros(len(q.cost))
        for k in np.unique(fold):
            in_fold = fold == k
            remaining_h = h - q.hessian[in_fold].sum(axis=0)
            if self.prior is None:
                remaining_g = g - q.gradient[in_fold].sum(axis=0) - prior @ distance
                d = minimise_bounded(add_ridge(remaining_h + prior), remaining_g, *limits) - optimum
            else:
                d = np.zeros(len(indices))
                ridge = RIDGE * np.trace(h) / len(h) * np.eye(len(columns))
                d[columns] = minimise_bounded(
                    remaining_h[np.ix_(columns, columns)] + ridge, gradient[~in_fold].sum(axis=0)[columns],
                    np.minimum(low, 0.0)[columns], np.maximum(high, 0.0)[columns])
            steps[int(k)] = d = base + d
            rise = np.einsum("i,bij,j->b", d, q.hessian[in_fold], d) - 2.0 * initial_gradient[in_fold] @ d
            prior_cost = (distance + d) @ prior @ (distance + d) / len(q.cost)
            # The robust loss grows with the logarithm of its quadratic approximation above 1 per residual.
            count = np.maximum(self._residual_counts[in_fold], 1)
            robust = np.where(rise > count, count * (1.0 + np.log(np.maximum(rise / count, 1.0))), rise)
            held_out[in_fold] = q.cost[in_fold] + robust + prior_cost
        return steps, held_out

    def leave_out_groups(self, fit: Fit, groups: np.ndarray) -> tuple[dict[int, np.ndarray], np.ndarray]:
        """`leave_out` at the optimum of a fit. groups: (b,) group of each block."""
        q = fit.quadratic.sum_groups(self.block, self.blocks)
        return self.leave_out(q, fit.names, fit.vector, fit.indices, groups, at_optimum=True)

    def held_out_loss(self, fit: Fit, groups: np.ndarray) -> np.ndarray:
        """(b,) loss of each block at values fitted without its group. groups: (b,) group of each block. Calculated from
        the quadratic approximation; if this is much larger than the loss of the fit, a simulated loss limits it."""
        steps, held_out = self.leave_out_groups(fit, groups)
        if held_out.sum() - fit.quadratic.cost.sum() < MAX_QUADRATIC_RISE * self.residual_count:
            return held_out
        prior, distance = self.prior_curvature(fit.names, fit.indices), self.distance(fit.vector)[fit.indices]
        simulated_loss = np.zeros(self.blocks)
        for k, d in steps.items():
            in_group, loss = groups == k, self.loss.window_losses(self.take_step(fit.vector, fit.indices, d))
            prior_cost = (distance + d) @ prior @ (distance + d) / self.blocks
            simulated_loss[in_group] = np.bincount(self.block, loss, self.blocks)[in_group] + prior_cost
        return np.minimum(held_out, simulated_loss)

    def held_out_gain(self, without: Fit, fit: Fit) -> float:
        """Reduction of the held-out loss per residual by the additional effects of `fit`, by `held_out_groups`."""
        before, after = (self.held_out_loss(f, self.held_out_groups) for f in (without, fit))
        return float((before - after).sum()) / self.residual_count

    def held_out_residuals(self, fit: Fit) -> np.ndarray:
        """(n, m) errors of each window at values fitted without its group (`held_out_groups`)."""
        steps, _ = self.leave_out_groups(fit, self.held_out_groups)
        group, sensitivities = self.held_out_groups[self.block], fit.sensitivities.select(fit.indices)
        residuals = self.errors.at(fit.vector)
        result = residuals.copy()
        for k, d in steps.items():
            in_group = group == k
            result[in_group] -= np.einsum("p,pnm->nm", d, sensitivities[:, in_group])
        before, after = self.loss.scale_residuals(residuals), self.loss.scale_residuals(result)
        # Where the linear approximation is not valid, the held-out errors are simulated.
        if rho(after).sum() - rho(before).sum() > MAX_QUADRATIC_RISE * self.residual_count:
            for k, d in steps.items():
                in_group = group == k
                result[in_group] = self.errors.at(self.take_step(fit.vector, fit.indices, d))[in_group]
        return result

    def position_error(self, residuals: np.ndarray) -> np.ndarray:
        """(n,) position error at the end of the horizon [m], at most DIVERGED_ERROR; NaN where it was not measured."""
        columns = self.errors.windows.columns
        if "position_lateral" not in columns:
            return np.full(len(residuals), np.nan)
        ends = [columns.index(f"position_{axis}") - len(columns) for axis in ("lateral", "longitudinal")]
        error = np.minimum(np.nan_to_num(np.hypot(*residuals[:, ends].T), nan=DIVERGED_ERROR), DIVERGED_ERROR)
        return np.where(self.loss.known[:, ends].all(axis=1), error, np.nan)
