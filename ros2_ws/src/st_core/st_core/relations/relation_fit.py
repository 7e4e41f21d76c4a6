"""Fits of one candidate relation by simulation, together with the effects of a discovered model."""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass

import numpy as np

from ..augmented import AugmentedModel
from ..discovery.fit import MIN_LOSS_REDUCTION, STEP_FRACTIONS, Problem, Sensitivities
from ..discovery.loss import Errors, Loss, Quadratic
from ..discovery.settings import DiscoverySettings
from ..discovery.space import ACCELEROMETER_GAIN, Space
from ..discovery.windows import Windows
from ..effects import get_effect
from ..effects._relation import SPLINES, RelationEffect
from ..regression import add_ridge
from .candidates import Candidate

RELATION = RelationEffect.name  # the three relation effects have the same indices in the vector
PENALTIES = (0.003, 0.03, 0.3)  # of second differences, relative to the mean curvature of the loss per coefficient
SIZE_PENALTY = 0.1  # of coefficients, relative to that of second differences; shrinks undetermined coefficients
ITERATIONS, BASE_FITS = 8, 2  # maximum number of steps of a fit; fits of the discovered model without a relation
RIDGE = 1e-6  # added to the diagonal of a curvature before inversion
_SECOND_DIFFERENCE = np.diff(np.eye(SPLINES), 2, axis=0)
ROUGHNESS = _SECOND_DIFFERENCE.T @ _SECOND_DIFFERENCE + SIZE_PENALTY * np.eye(SPLINES)
"""Penalty matrix: sum of squared second differences, plus SIZE_PENALTY times the sum of squares."""


@dataclass(frozen=True, eq=False)
class RelationFit:
    """A fit with a candidate, or of the discovered model without a relation (candidate None)."""

    candidate: Candidate | None
    smoothing: float  # one of PENALTIES, 0 without a candidate
    vector: np.ndarray  # in the candidate's parameter space
    residuals: np.ndarray  # (n, m) [SI], by window
    indices: np.ndarray  # (a,) free parameters, the coefficients last
    sensitivities: np.ndarray  # (a, n, m), reduction of the residuals per parameter scale
    penalty: np.ndarray  # (a, a), see `RelationFits.make_penalty`
    quadratic: Quadratic  # approximation of the loss, by block
    held_out: np.ndarray  # (b,) loss of each block at values fitted without its fold
    steps: dict[int, np.ndarray]  # by fold, step to the values fitted without it [parameter scales]

    @property
    def coefficients(self) -> np.ndarray:
        return self.vector[self.indices[-SPLINES:]] if self.candidate else np.zeros(SPLINES)

    def compute_covariance(self) -> np.ndarray:
        """(SPLINES, SPLINES) sandwich covariance of the coefficients, with scores summed by block."""
        inverse = np.linalg.inv(self.quadratic.hessian.sum(axis=0) + self.penalty + RIDGE * np.eye(len(self.indices)))
        scores, blocks = self.quadratic.gradient, len(self.quadratic.cost)
        scatter = scores.T @ scores * blocks / max(blocks - 1, 1)
        return (inverse @ scatter @ inverse)[-SPLINES:, -SPLINES:]


def profile_coefficients(h: np.ndarray) -> np.ndarray:
    """(a, SPLINES) optimal change of all parameters per unit of each coefficient. h: (a, a), coefficients last."""
    others = -np.linalg.solve(add_ridge(h[:-SPLINES, :-SPLINES]), h[:-SPLINES, -SPLINES:])
    return np.concatenate([others, np.eye(SPLINES)])


class RelationFits:
    """Fits of candidate relations in addition to a discovered model.

    model: the discovered model; its residual scale applies to all fits. effect_names: its effects.
    acceleration_gain: as in `Discovery`.
    fold: (b,) `Problem.held_out_groups`.
    refitted_indices: parameters fitted together with a relation.
    vehicle_indices: the other vehicle parameters, which are projected out of the evidence for a relation.
    """

    def __init__(self, windows: Windows, model: AugmentedModel, acceleration_gain: float,
                 effect_names: Sequence[str], settings: DiscoverySettings, threads: int = 1):
        self.windows, self.threads, self.model = windows, threads, model
        self.settings, self.limits = settings, settings.limits
        self.space = Space(model, settings, (RELATION,))
        self._spaces = {RELATION: self.space}
        self.relation_indices = self.space.indices(RELATION)
        self.start = np.append(self.space.null[:-1], acceleration_gain)
        self.loss = Loss(Errors(windows, self.space, threads), self.start)
        self.problem = Problem(self.loss, self.start, windows.block)
        self.block, self.blocks, self.fold = windows.block, self.problem.blocks, self.problem.held_out_groups
        car_effects = [n for n in self.space.hypotheses
                       if get_effect(n).kind == "vehicle parameters" and not get_effect(n).members]
        required = (ACCELEROMETER_GAIN,) if "acceleration_y" in windows.columns else ()
        self.refitted_indices = self.space.indices(*effect_names, *required)
        self.vehicle_indices = np.setdiff1d(self.space.indices(*car_effects), self.refitted_indices)

    def make_space(self, candidate: Candidate) -> Space:
        """The parameter space for the term, quantity and range of a candidate."""
        kind = candidate.effect
        if kind not in self._spaces:
            self._spaces[kind] = Space(self.model, self.settings, (kind,))
        space = copy(self._spaces[kind])
        space.model = space.model.with_values({kind: candidate.constants})
        return space

    def make_loss(self, candidate: Candidate) -> Loss:
        """Loss of the same windows, at the same residual scale, in the space of a candidate."""
        space = self.make_space(candidate)
        loss = copy(self.loss)
        loss.errors, loss.space = Errors(self.windows, space, self.threads), space
        return loss

    def fit_without_relation(self) -> RelationFit:
        """The discovered model without a relation, refitted."""
        vector = self.start
        for _ in range(BASE_FITS):
            sensitivities = self.loss.sensitivities(vector, self.refitted_indices)
            fit = self._fit(None, self.loss, self.refitted_indices, 0.0, sensitivities, vector)
            vector = fit.vector
        return fit

    def sum_quadratic(self, loss: Loss, residuals: np.ndarray, sensitivities: np.ndarray) -> Quadratic:
        return loss.quadratic(residuals, sensitivities).sum_groups(self.block, self.blocks)

    def make_penalty(self, candidate: Candidate | None, hessian: np.ndarray, smoothing: float) -> np.ndarray:
        """(a, a) penalty matrix, zero except for the coefficients, which are the last SPLINES of the free parameters.
        hessian: (a, a) curvature of the loss."""
        penalty = np.zeros(hessian.shape)
        if candidate:
            curvature = float(np.trace(hessian[-SPLINES:, -SPLINES:])) / SPLINES
            penalty[-SPLINES:, -SPLINES:] = smoothing * curvature * ROUGHNESS + 1e-9 * np.eye(SPLINES)
        return penalty

    def find_held_out_steps(self, q: Quadratic, penalty: np.ndarray,
                            distance: np.ndarray) -> tuple[dict[int, np.ndarray], np.ndarray]:
        """({fold: step to the values fitted without it}, (b,) loss of each block at these values).
        distance: (a,) distance of the vector from the start [parameter scales]."""
        h, g = add_ridge(q.hessian.sum(axis=0)) + penalty, q.gradient.sum(axis=0) - penalty @ distance
        steps, held_out = {}, np.zeros(self.blocks)
        common = np.linalg.solve(h, g)
        for k in np.unique(self.fold):
            in_fold = self.fold == k
            d = np.linalg.solve(h - q.hessian[in_fold].sum(axis=0), g - q.gradient[in_fold].sum(axis=0)) - common
            steps[int(k)], held_out[in_fold] = d, (q.cost + q.rise(d))[in_fold]
        return steps, held_out

    def predict_held_out_loss(self, q: Quadratic, penalty: np.ndarray, distance: np.ndarray) -> np.ndarray:
        """(b,) held-out loss of each block for the optimum of the quadratic."""
        step = np.linalg.solve(add_ridge(q.hessian.sum(axis=0)) + penalty, q.gradient.sum(axis=0) - penalty @ distance)
        return self.find_held_out_steps(q.after(step), penalty, distance + step)[1]

    def fit(self, candidate: Candidate, base_fit: RelationFit) -> RelationFit:
        """Fit a candidate by Gauss-Newton with simulation, repeatedly with decreasing smoothing. The first fit starts
        from zero coefficients, the others from the previous fit. Returns the last fit that lowers the held-out loss."""
        indices = np.concatenate([self.refitted_indices, self.relation_indices])
        loss = self.make_loss(candidate)
        sensitivities = np.concatenate([base_fit.sensitivities, np.zeros((SPLINES, *base_fit.sensitivities.shape[1:]))])
        strong, *weaker = sorted(PENALTIES, reverse=True)
        best = self._fit(candidate, loss, indices, strong, sensitivities, base_fit.vector)
        for smoothing in weaker:
            fit = self._fit(candidate, loss, indices, smoothing, best.sensitivities, best.vector)
            if fit.held_out.sum() >= best.held_out.sum():
                break
            best = fit
        return best

    def profile(self, fit: RelationFit) -> Quadratic:
        """Quadratic approximation of the loss in the coefficients, by block; all other parameters are profiled out."""
        assert fit.candidate is not None
        loss = self.make_loss(fit.candidate)
        vehicle_sensitivities = loss.sensitivities(fit.vector, self.vehicle_indices)
        q = self.sum_quadratic(loss, fit.residuals, np.concatenate([vehicle_sensitivities, fit.sensitivities]))
        projection = profile_coefficients(q.hessian.sum(axis=0))
        return Quadratic(q.cost, q.gradient @ projection, projection.T @ q.hessian @ projection)

    def fit_without_effect(self, fit: RelationFit, name: str) -> RelationFit:
        """The fit without an effect of the discovered model; its other effects and the relation are refitted."""
        removed = self.space.indices(name)
        vector, others = fit.vector.copy(), np.setdiff1d(fit.indices[:-SPLINES], removed)
        vector[removed] = [self.space.parameters[i][1].null for i in removed]
        assert fit.candidate is not None
        loss, indices = self.make_loss(fit.candidate), np.concatenate([others, self.relation_indices])
        return self._fit(fit.candidate, loss, indices, fit.smoothing, loss.sensitivities(vector, indices), vector)

    def _fit(self, candidate: Candidate | None, loss: Loss, indices: np.ndarray, smoothing: float,
             sensitivities: np.ndarray, vector: np.ndarray) -> RelationFit:
        for iteration in range(ITERATIONS):
            if candidate:
                relation_sensitivities = loss.sensitivities(vector, self.relation_indices)
                sensitivities = np.concatenate([sensitivities[:-SPLINES], relation_sensitivities])
            q = self.sum_quadratic(loss, loss.errors.at(vector), sensitivities)
            h, g = q.hessian.sum(axis=0), q.gradient.sum(axis=0)
            if not iteration:
                penalty = self.make_penalty(candidate, h, smoothing)
            distance = self.problem.distance(vector)[indices]
            step = np.linalg.solve(add_ridge(h) + penalty, g - penalty @ distance)
            cost = loss.total(vector) + distance @ penalty @ distance
            for fraction in STEP_FRACTIONS:
                trial = self.problem.take_step(vector, indices, fraction * step)
                distance = self.problem.distance(trial)[indices]
                gain = cost - (loss.total(trial) + distance @ penalty @ distance)
                if gain > 0.0:
                    reduction = loss.errors.at(vector) - loss.errors.at(trial)
                    sensitivities = Sensitivities(vector, indices, sensitivities).update(
                        trial, self.space.scale, reduction).values
                    vector = trial
                    break
            if gain < MIN_LOSS_REDUCTION * loss.residual_count:
                break
        residuals = loss.errors.at(vector)
        q = self.sum_quadratic(loss, residuals, sensitivities)
        steps, held_out = self.find_held_out_steps(q, penalty, self.problem.distance(vector)[indices])
        return RelationFit(candidate, smoothing, vector, residuals, indices, sensitivities, penalty, q, held_out, steps)
