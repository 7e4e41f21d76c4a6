"""One law fitted through the simulator beside everything that was found."""

from collections.abc import Sequence
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
from ..vehicle import VehicleParameters
from .places import Candidate, run_time

LAW = Law.name  # the kind of law the places in the vector are looked up of; they are the same for all kinds
SMOOTH = (0.003, 0.03, 0.3)  # penalty on second differences, shares of the mean curvature of the coefficients
LEVEL = 0.1  # of the penalty, on the coefficients themselves: what driving does not show stays at nothing
SETTLED = 2e-4  # fall of the loss for each scored number: a step that gains less is the last
ITERATIONS, SHARES, ROUNDS = 8, (1.0, 0.5, 0.2), 2
RIDGE = 1e-6


def roughness() -> np.ndarray:
    """(COUNT, COUNT): sum of squared second differences, and a little of the squares."""
    second = np.diff(np.eye(COUNT), 2, axis=0)
    return second.T @ second + LEVEL * np.eye(COUNT)


@dataclass(frozen=True, eq=False)
class Fitted:
    """smooth: of SMOOTH. vector: of the space of its law. rows: (n, m) errors. slopes: (a, n, m) of what moved.
    penalty: (a, a). q: by block. held_out: (b,) loss of each block under values fitted to the other runs, or blocks.
    steps: by fold."""

    candidate: Candidate | None
    smooth: float
    vector: np.ndarray
    rows: np.ndarray
    which: np.ndarray
    slopes: np.ndarray
    penalty: np.ndarray
    q: Quadratic
    held_out: np.ndarray
    steps: dict[int, np.ndarray]

    @property
    def coefficients(self) -> np.ndarray:
        return self.vector[self.which[-COUNT:]] if self.candidate else np.zeros(COUNT)

    def covariance(self) -> np.ndarray:
        """(COUNT, COUNT) of the coefficients: sandwich over the blocks."""
        inverse = np.linalg.inv(self.q.hessian.sum(axis=0) + self.penalty + RIDGE * np.eye(len(self.which)))
        scores, blocks = self.q.gradient, len(self.q.cost)
        scatter = scores.T @ scores * blocks / max(blocks - 1, 1)
        return (inverse @ scatter @ inverse)[-COUNT:, -COUNT:]


class RunWindows(Windows):
    """Windows whose models may ask for the time in the run."""

    def __init__(self, runs: Sequence[DriveLog], vehicle: VehicleParameters, settings: DiscoverySettings):
        super().__init__(runs, vehicle, settings)
        if len(self):
            time_ns = self.joined.ins_time_ns
            self._batch.others["run_time"] = time_ns, run_time(self, time_ns)


class Laws:
    """All laws on top of one answer.

    windows: the drives. answer: the model found, with the gain of its accelerometer; names of its effects. fold: (b,)
    what "held-out" means in reports; the scale of the errors stays that of the answer. beside: parameters that are
    fitted with a law; car: those of the vehicle file that are not, what they can do is no evidence for a law.
    """

    def __init__(self, windows: Windows, answer: AugmentedModel, gain: float, names: Sequence[str],
                 settings: DiscoverySettings, threads: int = 1):
        self.windows, self.threads, self.answer, self.settings = windows, threads, answer, settings
        self.space = Space(answer, settings, (LAW,))
        self._spaces = {LAW: self.space}
        self.law = self.space.indices(LAW)
        self.start = np.append(self.space.null[:-1], gain)
        self.loss = Loss(Errors(windows, self.space, threads), self.start)
        self.problem = Problem(self.loss, self.start, windows.block)
        self.block, self.blocks, self.fold = windows.block, self.problem.blocks, self.problem.apart
        own = {n for n in self.space.hypotheses if get_effect(n).kind == "vehicle parameters" and not get_effect(
            n).members}
        always = (GAIN,) if "acceleration_y" in windows.columns else ()
        self.beside = self.space.indices(*names, *always)
        self.car = np.setdiff1d(self.space.indices(*own), self.beside)

    def space_of(self, candidate: Candidate) -> Space:
        """The space with a law's place, quantity and range in it."""
        kind = candidate.effect
        if kind not in self._spaces:
            self._spaces[kind] = Space(self.answer, self.settings, (kind,))
        space = object.__new__(Space)
        space.__dict__.update(self._spaces[kind].__dict__)
        space.model = space.model.with_values({kind: candidate.constants})
        return space

    def of(self, candidate: Candidate) -> Loss:
        """The loss of the same windows with a law's place, quantity and range; at the scale of the answer."""
        space = self.space_of(candidate)
        loss = object.__new__(Loss)
        loss.__dict__.update(self.loss.__dict__)
        loss.errors, loss.space = Errors(self.windows, space, self.threads), space
        return loss

    def without(self) -> Fitted:
        """No law: what was found, at its best."""
        vector = self.start
        for _ in range(ROUNDS):
            fit = self._fit(None, self.loss, self.beside, 0.0, self.slopes(vector, self.beside), vector)
            vector = fit.vector
        return fit

    def slopes(self, vector: np.ndarray, which: np.ndarray) -> np.ndarray:
        return np.nan_to_num(self.loss.slopes(vector, which), posinf=0.0, neginf=0.0)

    def linear(self, candidate: Candidate, without: Fitted) -> tuple[Loss, np.ndarray]:
        """The loss of a law, and its slopes (COUNT, n, m) on top of `without`."""
        loss = self.of(candidate)
        return loss, np.nan_to_num(loss.slopes(without.vector, self.law), posinf=0.0, neginf=0.0)

    def quadratic(self, loss: Loss, rows: np.ndarray, slopes: np.ndarray) -> Quadratic:
        return loss.quadratic(rows, slopes).summed(self.block, self.blocks)

    def penalty(self, candidate: Candidate | None, hessian: np.ndarray, smooth: float) -> np.ndarray:
        """(a, a) on everything that moves; the coefficients come last. hessian: (a, a)."""
        held = np.zeros(hessian.shape)
        if candidate:
            own = hessian[-COUNT:, -COUNT:]
            held[-COUNT:, -COUNT:] = smooth * float(np.trace(own)) / COUNT * roughness() + 1e-9 * np.eye(COUNT)
        return held

    def leave_out(self, q: Quadratic, penalty: np.ndarray,
                  away: np.ndarray) -> tuple[dict[int, np.ndarray], np.ndarray]:
        """({fold: step of the values fitted without it}, (b,) loss of each block under them)."""
        h, g = q.hessian.sum(axis=0), q.gradient.sum(axis=0)
        steps, held_out = {}, np.zeros(self.blocks)
        ridge = (RIDGE * np.trace(h) / max(len(h), 1) + 1e-9) * np.eye(len(h))
        whole = np.linalg.solve(h + penalty + ridge, g - penalty @ away)
        for k in np.unique(self.fold):
            mine = self.fold == k
            d = np.linalg.solve(h - q.hessian[mine].sum(axis=0) + penalty + ridge,
                                g - q.gradient[mine].sum(axis=0) - penalty @ away) - whole
            steps[int(k)] = d
            held_out[mine] = q.cost[mine] - 2.0 * q.gradient[mine] @ d + np.einsum("i,bij,j->b", d, q.hessian[mine], d)
        return steps, held_out

    def promised(self, q: Quadratic, penalty: np.ndarray, away: np.ndarray) -> np.ndarray:
        """(b,) held-out loss of each block at the best point of the quadratic, left out fold by fold."""
        h, g = q.hessian.sum(axis=0), q.gradient.sum(axis=0)
        ridge = (RIDGE * np.trace(h) / max(len(h), 1) + 1e-9) * np.eye(len(h))
        step = np.linalg.solve(h + penalty + ridge, g - penalty @ away)
        cost = q.cost - 2.0 * q.gradient @ step + np.einsum("i,bij,j->b", step, q.hessian, step)
        there = Quadratic(cost, q.gradient - q.hessian @ step, q.hessian)
        return self.leave_out(there, penalty, away + step)[1]

    def fit(self, candidate: Candidate, without: Fitted, smooth: float) -> Fitted:
        """Gauss-Newton through the simulator, from no law; smooth: of SMOOTH."""
        which = np.concatenate([self.beside, self.law])
        loss = self.of(candidate)
        slopes = np.concatenate([without.slopes, np.zeros((COUNT, *without.slopes.shape[1:]))])
        return self._fit(candidate, loss, which, smooth, slopes, without.vector)

    def seen(self, fit: Fitted) -> Quadratic:
        """By block, about the fit, in the coefficients of its law alone: everything beside and the parameters of the
        vehicle file follow, so that what those can do is no information."""
        assert fit.candidate is not None
        loss = self.of(fit.candidate)
        car = np.nan_to_num(loss.slopes(fit.vector, self.car), posinf=0.0, neginf=0.0)
        q = self.quadratic(loss, fit.rows, np.concatenate([car, fit.slopes]))
        whole = q.hessian.sum(axis=0)
        rest = whole[:-COUNT, :-COUNT]
        ridge = (RIDGE * np.trace(rest) / max(len(rest), 1) + 1e-9) * np.eye(len(rest))
        turn = np.concatenate([-np.linalg.solve(rest + ridge, whole[:-COUNT, -COUNT:]), np.eye(COUNT)])
        return Quadratic(q.cost, q.gradient @ turn, np.einsum("ik,bij,jl->bkl", turn, q.hessian, turn))

    def less(self, candidate: Candidate, fit: Fitted, name: str) -> Fitted:
        """A law with an effect of the answer taken out, and everything else fitted anew."""
        own = self.space.indices(name)
        vector, which = fit.vector.copy(), np.setdiff1d(fit.which[:-COUNT], own)
        nothing = {p.name: p.null for p in get_effect(name).parameters}
        vector[own] = [nothing[self.space.free[i].parameter] for i in own]
        loss, moving = self.of(candidate), np.concatenate([which, self.law])
        slopes = np.nan_to_num(loss.slopes(vector, moving), posinf=0.0, neginf=0.0)
        return self._fit(candidate, loss, moving, fit.smooth, slopes, vector)

    def _fit(self, candidate: Candidate | None, loss: Loss, which: np.ndarray, smooth: float, slopes: np.ndarray,
             vector: np.ndarray | None = None) -> Fitted:
        vector = self.start.copy() if vector is None else vector.copy()
        law, scale = self.law, self.space.scale
        for number in range(ITERATIONS):
            if candidate:
                slopes = np.concatenate([slopes[:-COUNT], np.nan_to_num(loss.slopes(vector, law), posinf=0.0,
                                                                        neginf=0.0)])
            q = self.quadratic(loss, loss.errors.at(vector), slopes)
            h, g = q.hessian.sum(axis=0), q.gradient.sum(axis=0)
            if not number:
                penalty = self.penalty(candidate, h, smooth)
            away = ((vector - self.start) / scale)[which]
            ridge = (RIDGE * np.trace(h) / max(len(h), 1) + 1e-9) * np.eye(len(h))
            step = np.linalg.solve(h + penalty + ridge, g - penalty @ away)
            cost = loss.total(vector) + away @ penalty @ away
            gained = 0.0
            for share in SHARES:
                there = vector.copy()
                there[which] += share * step * scale[which]
                there = loss.space.inside(there)
                now = ((there - self.start) / scale)[which]
                gained = cost - (loss.total(there) + now @ penalty @ now)
                if gained > 0.0:
                    taken = loss.errors.at(vector) - loss.errors.at(there)
                    slopes = Slopes(vector, which, slopes).moved(there, scale, taken).values
                    vector = there
                    break
            if gained < SETTLED * loss.number:
                break
        rows = loss.errors.at(vector)
        q = self.quadratic(loss, rows, slopes)
        steps, held_out = self.leave_out(q, penalty, ((vector - self.start) / scale)[which])
        return Fitted(candidate, smooth, vector, rows, which, slopes, penalty, q, held_out, steps)
