"""One candidate relation fitted through the simulator, together with everything in the answer."""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass

import numpy as np

from ..augmented import AugmentedModel
from ..discovery.fit import Problem, Slopes
from ..discovery.loss import Errors, Loss, Quadratic
from ..discovery.settings import DiscoverySettings
from ..discovery.space import GAIN, Space
from ..discovery.windows import Windows
from ..effects import get_effect
from ..effects._law import COUNT, Law
from ..log import DriveLog
from ..regression import ridge
from ..vehicle import VehicleParameters
from .candidates import Candidate, run_time

RELATION = Law.name  # of the three kinds, which share their places in the vector
SMOOTHING = (0.003, 0.03, 0.3)  # penalty on second differences, shares of the coefficients' mean curvature
LEVEL = 0.1  # of the penalty, on the coefficients themselves: without information they stay at zero
CONVERGED = 2e-4  # fall of the loss for each scored number: a step that gains less is the last
ITERATIONS, SHARES, ROUNDS = 8, (1.0, 0.5, 0.2), 2
RIDGE = 1e-6
_SECOND = np.diff(np.eye(COUNT), 2, axis=0)
ROUGHNESS = _SECOND.T @ _SECOND + LEVEL * np.eye(COUNT)
"""Penalty: sum of squared second differences, plus LEVEL times the squares."""


@dataclass(frozen=True, eq=False)
class RelationFit:
    """A fit. candidate: None for the answer alone.

    smooth: of SMOOTHING. vector: of the space of its candidate. rows: (n, m) errors. which, slopes: (a,), (a, n, m) of
    the free parameters, the coefficients last. penalty: (a, a). q: by block. held_out: (b,) loss of each block under
    values fitted to the other runs, or blocks. steps: by fold, from the fit to the values fitted without it.
    """

    candidate: Candidate | None
    smooth: float
    vector: np.ndarray
    rows: np.ndarray
    indices: np.ndarray
    slopes: np.ndarray
    penalty: np.ndarray
    q: Quadratic
    held_out: np.ndarray
    steps: dict[int, np.ndarray]

    @property
    def coefficients(self) -> np.ndarray:
        return self.vector[self.indices[-COUNT:]] if self.candidate else np.zeros(COUNT)

    def covariance(self) -> np.ndarray:
        """(COUNT, COUNT) of the coefficients: sandwich over the blocks."""
        inverse = np.linalg.inv(self.q.hessian.sum(axis=0) + self.penalty + RIDGE * np.eye(len(self.indices)))
        scores, blocks = self.q.gradient, len(self.q.cost)
        scatter = scores.T @ scores * blocks / max(blocks - 1, 1)
        return (inverse @ scatter @ inverse)[-COUNT:, -COUNT:]


class RunWindows(Windows):
    """Windows with the time in the run as a signal."""

    def __init__(self, runs: Sequence[DriveLog], vehicle: VehicleParameters, settings: DiscoverySettings):
        super().__init__(runs, vehicle, settings)
        if len(self):
            time_ns = self.joined.ins_time_ns
            self._batch.others["run_time"] = time_ns, run_time(self, time_ns)


class RelationFits:
    """Fits of candidate relations on top of one answer.

    windows: the drives. answer: the model found, with the gain of its accelerometer; names of its effects. fold: (b,)
    fold of each block; the scale of the errors stays that of the answer. refitted: parameters fitted together with a
    relation; car: those of the vehicle file that are not; their effects are projected out as evidence.
    """

    def __init__(self, windows: Windows, answer: AugmentedModel, gain: float, names: Sequence[str],
                 settings: DiscoverySettings, threads: int = 1):
        self.windows, self.threads, self.answer, self.settings = windows, threads, answer, settings
        self.space = Space(answer, settings, (RELATION,))
        self._spaces = {RELATION: self.space}
        self.relation = self.space.indices(RELATION)
        self.start = np.append(self.space.null[:-1], gain)
        self.loss = Loss(Errors(windows, self.space, threads), self.start)
        self.problem = Problem(self.loss, self.start, windows.block)
        self.block, self.blocks, self.fold = windows.block, self.problem.blocks, self.problem.held_out_groups
        own = {n for n in self.space.hypotheses if get_effect(n).kind == "vehicle parameters" and not get_effect(
            n).members}
        always = (GAIN,) if "acceleration_y" in windows.columns else ()
        self.refitted = self.space.indices(*names, *always)
        self.car = np.setdiff1d(self.space.indices(*own), self.refitted)

    def space_of(self, candidate: Candidate) -> Space:
        """The space with the place, quantity and range of a candidate."""
        kind = candidate.effect
        if kind not in self._spaces:
            self._spaces[kind] = Space(self.answer, self.settings, (kind,))
        space = copy(self._spaces[kind])
        space.model = space.model.with_values({kind: candidate.constants})
        return space

    def of(self, candidate: Candidate) -> Loss:
        """Loss of the same windows with the place, quantity and range of a candidate; at the scale of the answer."""
        space = self.space_of(candidate)
        loss = copy(self.loss)
        loss.errors, loss.space = Errors(self.windows, space, self.threads), space
        return loss

    def without(self) -> RelationFit:
        """The answer alone, refitted."""
        vector = self.start
        for _ in range(ROUNDS):
            fit = self._fit(None, self.loss, self.refitted, 0.0, self.slopes(vector, self.refitted), vector)
            vector = fit.vector
        return fit

    def slopes(self, vector: np.ndarray, indices: np.ndarray, loss: Loss | None = None) -> np.ndarray:
        return np.nan_to_num((loss or self.loss).slopes(vector, indices), posinf=0.0, neginf=0.0)

    def quadratic(self, loss: Loss, rows: np.ndarray, slopes: np.ndarray) -> Quadratic:
        return loss.quadratic(rows, slopes).summed(self.block, self.blocks)

    def penalty(self, candidate: Candidate | None, hessian: np.ndarray, smooth: float) -> np.ndarray:
        """(a, a) on all free parameters, the coefficients last. hessian: (a, a)."""
        penalty = np.zeros(hessian.shape)
        if candidate:
            own = hessian[-COUNT:, -COUNT:]
            penalty[-COUNT:, -COUNT:] = smooth * float(np.trace(own)) / COUNT * ROUGHNESS + 1e-9 * np.eye(COUNT)
        return penalty

    def left_out_steps(self, q: Quadratic, penalty: np.ndarray,
                  away: np.ndarray) -> tuple[dict[int, np.ndarray], np.ndarray]:
        """({fold: step of the values fitted without it}, (b,) loss of each block under them)."""
        h, g = ridge(q.hessian.sum(axis=0)) + penalty, q.gradient.sum(axis=0) - penalty @ away
        steps, held_out = {}, np.zeros(self.blocks)
        whole = np.linalg.solve(h, g)
        for k in np.unique(self.fold):
            in_fold = self.fold == k
            d = np.linalg.solve(h - q.hessian[in_fold].sum(axis=0), g - q.gradient[in_fold].sum(axis=0)) - whole
            steps[int(k)] = d
            curved = np.einsum("i,bij,j->b", d, q.hessian[in_fold], d)
            held_out[in_fold] = q.cost[in_fold] - 2.0 * q.gradient[in_fold] @ d + curved
        return steps, held_out

    def predicted_held_out(self, q: Quadratic, penalty: np.ndarray, away: np.ndarray) -> np.ndarray:
        """(b,) held-out loss of each block at the best point of the quadratic, left out fold by fold."""
        step = np.linalg.solve(ridge(q.hessian.sum(axis=0)) + penalty, q.gradient.sum(axis=0) - penalty @ away)
        cost = q.cost - 2.0 * q.gradient @ step + np.einsum("i,bij,j->b", step, q.hessian, step)
        there = Quadratic(cost, q.gradient - q.hessian @ step, q.hessian)
        return self.left_out_steps(there, penalty, away + step)[1]

    def fit(self, candidate: Candidate, without: RelationFit, smooth: float) -> RelationFit:
        """Gauss-Newton through the simulator, from zero coefficients; smooth: of SMOOTHING."""
        indices = np.concatenate([self.refitted, self.relation])
        loss = self.of(candidate)
        slopes = np.concatenate([without.slopes, np.zeros((COUNT, *without.slopes.shape[1:]))])
        return self._fit(candidate, loss, indices, smooth, slopes, without.vector)

    def profile(self, fit: RelationFit) -> Quadratic:
        """Quadratic by block about the fit in the coefficients alone: all other parameters, those of the vehicle file
        included, are profiled out."""
        assert fit.candidate is not None
        loss = self.of(fit.candidate)
        car = self.slopes(fit.vector, self.car, loss)
        q = self.quadratic(loss, fit.rows, np.concatenate([car, fit.slopes]))
        whole = q.hessian.sum(axis=0)
        others = whole[:-COUNT, :-COUNT]
        turn = np.concatenate([-np.linalg.solve(ridge(others), whole[:-COUNT, -COUNT:]), np.eye(COUNT)])
        return Quadratic(q.cost, q.gradient @ turn, np.einsum("ik,bij,jl->bkl", turn, q.hessian, turn))

    def without_effect(self, candidate: Candidate, fit: RelationFit, name: str) -> RelationFit:
        """The relation with an effect of the answer removed and everything else refitted."""
        own = self.space.indices(name)
        vector, indices = fit.vector.copy(), np.setdiff1d(fit.indices[:-COUNT], own)
        null = {p.name: p.null for p in get_effect(name).parameters}
        vector[own] = [null[self.space.free[i].parameter] for i in own]
        loss, moving = self.of(candidate), np.concatenate([indices, self.relation])
        return self._fit(candidate, loss, moving, fit.smooth, self.slopes(vector, moving, loss), vector)

    def _fit(self, candidate: Candidate | None, loss: Loss, indices: np.ndarray, smooth: float, slopes: np.ndarray,
             vector: np.ndarray) -> RelationFit:
        vector, scale = vector.copy(), self.space.scale
        for number in range(ITERATIONS):
            if candidate:
                slopes = np.concatenate([slopes[:-COUNT], self.slopes(vector, self.relation, loss)])
            q = self.quadratic(loss, loss.errors.at(vector), slopes)
            h, g = q.hessian.sum(axis=0), q.gradient.sum(axis=0)
            if not number:
                penalty = self.penalty(candidate, h, smooth)
            away = ((vector - self.start) / scale)[indices]
            step = np.linalg.solve(ridge(h) + penalty, g - penalty @ away)
            cost = loss.total(vector) + away @ penalty @ away
            gained = 0.0
            for share in SHARES:
                there = vector.copy()
                there[indices] += share * step * scale[indices]
                there = loss.space.inside(there)
                now = ((there - self.start) / scale)[indices]
                gained = cost - (loss.total(there) + now @ penalty @ now)
                if gained > 0.0:
                    taken = loss.errors.at(vector) - loss.errors.at(there)
                    slopes = Slopes(vector, indices, slopes).moved(there, scale, taken).values
                    vector = there
                    break
            if gained < CONVERGED * loss.number:
                break
        rows = loss.errors.at(vector)
        q = self.quadratic(loss, rows, slopes)
        steps, held_out = self.left_out_steps(q, penalty, ((vector - self.start) / scale)[indices])
        return RelationFit(candidate, smooth, vector, rows, indices, slopes, penalty, q, held_out, steps)
