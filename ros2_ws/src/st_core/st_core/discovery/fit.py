"""Joint fits of sets of effects through the simulator, and their loss on held-out driving."""

from collections.abc import Callable, Iterable, Mapping
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from .loss import Loss, Quadratic, rho
from .space import GAIN, Quantities, prior_deviations

ITERATIONS, STEP_SHARES = 5, (1.0, 0.5, 0.2)  # of a fit; of a step, until the loss falls
SLOPES_VALID_WITHIN, SLOPES_CACHE_SIZE = 0.25, 4  # slopes are reused within this distance [usual sizes]; points kept
MIN_LOSS_FALL = 2e-4  # reduction of the loss per scored error: a fit ends after a smaller one
FOLDS = 8  # groups of blocks, each held out once
MAX_SCALED = 5.0  # scales of the baseline errors: larger errors are clipped, so that a few windows do not dominate
DIVERGED = 100.0  # m: position error of a prediction that diverges
TRUSTED = 0.05  # loss per scored error: where the quadratic predicts more for held-out folds, they are simulated
RIDGE = 1e-6  # of the mean curvature: keeps steps finite along what the drives do not show


def bounded(a: np.ndarray, b: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Minimum of x'Ax - 2 b'x with low <= x <= high (low <= 0 <= high), by an active-set method."""
    x = np.linalg.solve(a, b)
    if ((x >= low) & (x <= high)).all():
        return x
    x, fixed = np.zeros(len(b)), (low >= 0.0) | (high <= 0.0)
    for _ in range(30 * len(b) + 50):
        free, step = ~fixed, np.zeros(len(b))
        if free.any():
            step[free] = np.linalg.solve(a[np.ix_(free, free)], (b - a @ x)[free])
        with np.errstate(divide="ignore", invalid="ignore"):
            room = np.where(step > 0, (high - x) / step, np.where(step < 0, (low - x) / step, np.inf))
        first = int(np.argmin(room))
        if room[first] < 1.0:
            x = np.clip(x + max(room[first], 0.0) * step, low, high)
            x[first], fixed[first] = low[first] if step[first] < 0 else high[first], True
            continue
        x = x + step
        pull = b - a @ x
        inwards = np.where(fixed & (x <= low) & (x < high), pull, np.where(fixed & (x >= high) & (x > low), -pull, 0.0))
        most = int(np.argmax(inwards))
        if inwards[most] <= 1e-9 * max(1.0, float(np.abs(b).max())):
            break
        fixed[most] = False
    return x


@dataclass(frozen=True, eq=False)
class Slopes:
    """Reduction of the errors per usual size, (a, n, m), of the parameters `which`, about `vector`."""

    vector: np.ndarray
    which: np.ndarray
    values: np.ndarray

    def of(self, which: np.ndarray) -> np.ndarray:
        return self.values[np.searchsorted(self.which, which)]

    def moved(self, vector: np.ndarray, scale: np.ndarray, taken: np.ndarray) -> "Slopes":
        """The slopes about another vector, by Broyden's update (1965): for the step there they give the reduction
        `taken` (n, m) of the errors that was just measured."""
        step = ((vector - self.vector) / scale)[self.which]
        square = float(step @ step)
        if square == 0.0:
            return self
        missed = taken - np.tensordot(step, self.values, 1)
        missed[~np.isfinite(missed)] = 0.0  # a window that has just diverged, or recovered, gives no slopes
        return Slopes(vector, self.which, self.values + (step / square)[:, None, None] * missed)

    def renewed(self, which: np.ndarray, values: np.ndarray) -> "Slopes":
        """With those of some parameters replaced."""
        new = self.values.copy()
        new[np.searchsorted(self.which, which)] = values
        return Slopes(self.vector, self.which, new)


@dataclass(frozen=True, eq=False)
class Fit:
    """A set of effects with fitted values. which: free parameters. slopes: of those at least. quadratic: by window, of
    `which`. folds: by fold, step to the values fitted without it; held_out: (b,) loss of each block at those values."""

    names: tuple[str, ...]
    vector: np.ndarray
    which: np.ndarray
    slopes: Slopes
    quadratic: Quadratic
    folds: dict[int, np.ndarray]
    held_out: np.ndarray


def freed(prior: np.ndarray, free: np.ndarray) -> np.ndarray:
    """A prior curvature (p, p) with some parameters marginalised (Schur complement); zero for these."""
    rest = np.setdiff1d(np.arange(len(prior)), free)
    held = np.zeros_like(prior)
    cross = prior[np.ix_(rest, free)]
    inside = prior[np.ix_(free, free)] + 1e-9 * np.eye(len(free))
    held[np.ix_(rest, rest)] = prior[np.ix_(rest, rest)] - cross @ np.linalg.solve(inside, cross.T)
    return held


class Problem:
    """A loss with its priors, and the fits of sets of effects to it.

    start: (p,) where every search begins. prior: (p, p) curvature about `start` of the parameters outside the set, from
    reference drives; None: these stay at the start, except the gain of the accelerometer. block: (n,) number of the
    block of each window. noise: (c,) error of each column from noise alone [SI]. healthy: gain per scored error between
    drives of the healthy car.

    quantities: (p,) quantity of the vehicle file that each parameter changes. Its standard deviation s enters the loss
    as a Gaussian prior, 0.5 design (x / s)^2. design [1]: number of scored errors that count as one independent error,
    see `renew_design`.
    """

    def __init__(self, loss: Loss, start: np.ndarray, block: np.ndarray, prior: np.ndarray | None = None,
                 noise: np.ndarray | None = None, healthy: float = 0.0, quantities: Quantities | None = None):
        self.loss, self.space, self.start, self.prior = loss, loss.space, start, prior
        self.errors, self.healthy, self.design = loss.errors, healthy, 1.0
        self.set_quantities((None,) * len(self.space) if quantities is None else quantities)
        self.noise = np.zeros(len(self.errors.windows.columns)) if noise is None else noise
        self.block, self.blocks = block, int(block.max()) + 1
        self.fold = np.arange(self.blocks) % min(FOLDS, self.blocks)
        self._whole: list[Slopes] = []

    def set_quantities(self, quantities: Quantities) -> None:
        """Set the quantity of the vehicle file that each parameter changes. With a reference, its drives contain what
        comes on top of the file."""
        self.quantities = quantities
        on_top = self.space.deviation if self.prior is None else np.inf
        self._deviation = np.minimum(prior_deviations(quantities, self.space.scale), on_top)

    @cached_property
    def size_of_start(self) -> np.ndarray:
        """(c,) `sizes` of the baseline errors."""
        return np.maximum(self.sizes(self.errors.at(self.start)), 1e-12)

    def sizes(self, rows: np.ndarray) -> np.ndarray:
        """(c,) root mean square error of each column over the horizon [SI], clipped at MAX_SCALED scales of the
        baseline errors."""
        most = MAX_SCALED * self._scale_of_start
        square = np.square(np.clip(np.nan_to_num(rows, nan=np.inf), -most, most))
        points = np.where(self.loss.known, square, 0.0).sum(axis=0) / np.maximum(self.loss.known.sum(axis=0), 1)
        return np.sqrt(points.reshape(len(self.errors.windows.time), -1).mean(axis=0))

    @cached_property
    def _scale_of_start(self) -> np.ndarray:
        return self.loss.scale_of(self.start)

    @cached_property
    def held_out_groups(self) -> np.ndarray:
        """(b,) group of each block for the held-out errors of reports: its run where there are four or more, else its
        fold."""
        run = self.errors.windows.run
        of_block = np.zeros(self.blocks, int)
        of_block[self.block] = run
        return of_block if len(np.unique(run)) > 3 else self.fold

    def without_file(self) -> "Problem":
        """The same problem without the priors of the vehicle file: what predicts best, plausible or not."""
        other = copy(self)
        other.set_quantities((None,) * len(self.space))
        return other

    @property
    def number(self) -> int:
        """Number of scored errors."""
        return self.loss.number

    def which(self, names: Iterable[str]) -> np.ndarray:
        """Parameters that are free in a fit of the effects `names`."""
        if self.prior is not None:
            return np.arange(len(self.space))
        always = (GAIN,) if "acceleration_y" in self.errors.windows.columns else ()
        return self.space.indices(*names, *always)

    def prior_curvature(self, names: Iterable[str], which: np.ndarray) -> np.ndarray:
        """(a, a) curvature of the prior about the start: that of the vehicle file for each; with a reference
        that of its drives for those that are not of the effects `names`."""
        if self.prior is None:
            return np.diag(self.file_curvature[which])
        return freed(self.prior, self.space.indices(*names))

    @property
    def file_curvature(self) -> np.ndarray:
        """(p,) curvature of the prior of the vehicle file."""
        return 0.5 * self.design / np.square(self._deviation)

    def prior_gradient(self, vector: np.ndarray) -> np.ndarray:
        """(p,) half gradient of the prior of the vehicle file at a vector."""
        return self.file_curvature * (vector - self.start) / self.space.scale

    def renew_design(self, vector: np.ndarray) -> None:
        """Estimate the design effect from the errors at a vector: variance of the scores between blocks, and between
        runs, over that of independent errors; median over the library, at least 1.

            D = 2 n var(g_k) / H,   g_k: half gradient of part k of n, H: half of the curvature

        Scores of an incomplete model vary between parts of the driving, so that D grows with what is missing.
        Source: Kish, Survey Sampling (1965), ch. 8.
        """
        q = self.loss.quadratic(self.errors.at(vector), self.everything(vector).values)
        information = np.diag(q.hessian.sum(axis=0))
        seen = information > 1e-9 * information.sum()
        found = [1.0]
        for part in (self.block, self.errors.windows.run):
            gradient = q.summed(part).gradient[:, seen]
            if len(gradient) > 2:
                found.append(float(np.median(2.0 * len(gradient) * gradient.var(axis=0, ddof=1) / information[seen])))
        self.design = max(found)

    def distance_to_bounds(self, vector: np.ndarray, which: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        s = self.space
        return ((np.minimum(s.low - vector, 0.0) / s.scale)[which], (np.maximum(s.high - vector, 0.0) / s.scale)[which])

    def solve(self, q: Quadratic, names: Iterable[str], vector: np.ndarray, which: np.ndarray) -> np.ndarray:
        """(a,) step from `vector` to the minimum of a quadratic by window, within the bounds."""
        return self.stepper(names, vector, which)(q.hessian.sum(axis=0), q.gradient.sum(axis=0))

    def stepper(self, names: Iterable[str], vector: np.ndarray,
                which: np.ndarray) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
        """A function of a Hessian (a, a) and a gradient (a,) that gives the best step (a,) from the vector."""
        held, room = self.prior_curvature(names, which), self.distance_to_bounds(vector, which)
        pulled = held @ ((vector - self.start) / self.space.scale)[which]

        def best_step(h: np.ndarray, g: np.ndarray) -> np.ndarray:
            if not len(which):
                return np.zeros(0)
            h = h + held
            h = h + (RIDGE * np.trace(h) / len(h) + 1e-9) * np.eye(len(h))
            return bounded(h, g - pulled, *room)
        return best_step

    def cost(self, names: Iterable[str], vector: np.ndarray, which: np.ndarray) -> float:
        away = ((vector - self.start) / self.space.scale)[which]
        return self.loss.total(vector) + float(away @ self.prior_curvature(names, which) @ away)

    def everything(self, vector: np.ndarray) -> Slopes:
        """Slopes of all parameters: those of a nearby point, updated for the step, or new ones."""
        for known in reversed(self._whole):
            if np.abs((vector - known.vector) / self.space.scale).max() < SLOPES_VALID_WITHIN:
                return self._follow(known, vector, np.zeros(0, int))
        which = np.arange(len(self.space))
        new = Slopes(vector, which, np.nan_to_num(self.loss.slopes(vector, which), posinf=0.0, neginf=0.0))
        self._whole = [*self._whole[-SLOPES_CACHE_SIZE + 1:], new]
        return new

    def moved(self, vector: np.ndarray, which: np.ndarray, step: np.ndarray) -> np.ndarray:
        there = vector.copy()
        there[which] += step * self.space.scale[which]
        return self.space.inside(there)

    def begin(self, names: Iterable[str], vector: np.ndarray) -> np.ndarray:
        """The vector with all parameters at the start that are not free in a fit of the effects `names`."""
        names = tuple(names)
        keep = np.union1d(self.space.indices(*names), self.which(names))
        there = self.start.copy()
        there[keep] = vector[keep]
        return there

    def vector_without(self, fit: Fit, *names: str) -> np.ndarray:
        """The vector of a fit with the effects `names` at the start."""
        there, own = fit.vector.copy(), self.space.indices(*names)
        there[own] = self.start[own]
        return there

    def fit(self, names: Iterable[str], slopes: Slopes, vector: np.ndarray | None = None, fresh: Iterable[str] = (),
            iterations: int = ITERATIONS) -> Fit:
        """Fit a set of effects by robust Gauss-Newton. slopes: of the free parameters at least, about a nearby point;
        updated along the steps. vector: first point, default that of the slopes. fresh: effects whose slopes are
        recomputed at each step.
        """
        names = tuple(names)
        which, new = self.which(names), self.space.indices(*fresh)
        vector = self.begin(names, slopes.vector if vector is None else vector)
        slopes = self._follow(slopes, vector, new)
        cost = self.cost(names, vector, which)
        for _ in range(iterations if len(which) else 0):
            q = self.loss.quadratic(self.errors.at(vector), slopes.of(which))
            step = self.solve(q, names, vector, which)
            for share in STEP_SHARES:
                trial = self.moved(vector, which, share * step)
                lower = self.cost(names, trial, which)
                if lower < cost:
                    break
            else:
                break
            gained, vector, cost = cost - lower, trial, lower
            slopes = self._follow(slopes, vector, new)
            if gained < MIN_LOSS_FALL * self.number:
                break
        return self.about(names, vector, which, slopes)

    def renewed(self, fit: Fit, iterations: int = 2) -> Fit:
        """The fit, continued with recomputed slopes."""
        own = np.union1d(self.space.indices(*fit.names), self.space.indices(GAIN))
        fresh = Slopes(fit.vector, fit.slopes.which, fit.slopes.values)
        if len(own):
            known = np.intersect1d(own, fit.slopes.which)
            fresh = fresh.renewed(known, np.nan_to_num(self.loss.slopes(fit.vector, known), posinf=0.0, neginf=0.0))
        return self.fit(fit.names, fresh, iterations=iterations)

    def _follow(self, slopes: Slopes, vector: np.ndarray, new: np.ndarray) -> Slopes:
        if not np.array_equal(vector, slopes.vector):
            taken = self.errors.at(slopes.vector) - self.errors.at(vector)
            slopes = slopes.moved(vector, self.space.scale, taken)
        if len(new):
            values = np.nan_to_num(self.loss.slopes(vector, new), posinf=0.0, neginf=0.0)
            slopes = slopes.renewed(new, values)
        return slopes

    def about(self, names: tuple[str, ...], vector: np.ndarray, which: np.ndarray, slopes: Slopes) -> Fit:
        q = self.loss.quadratic(self.errors.at(vector), slopes.of(which))
        folds, held_out = self.leave_out(q.summed(self.block, self.blocks), names, vector, which, self.fold, True)
        fit = Fit(names, vector, which, slopes, q, folds, held_out)
        return replace(fit, held_out=self._simulated(fit, self.fold, folds, held_out))

    def leave_out(self, q: Quadratic, names: Iterable[str], vector: np.ndarray, which: np.ndarray,
                  fold: np.ndarray, settled: bool = False) -> tuple[dict[int, np.ndarray], np.ndarray]:
        """({fold: step to the values fitted without it}, (b,) loss of each block at those values, with its part of the
        prior's cost), by the quadratic. q: by block. settled: the vector is the optimum although the quadratic predicts
        a further step; only the difference that a fold makes counts. With a prior from reference drives a fold moves
        only the parameters of the set.
        """
        names = tuple(names)
        h, g = q.hessian.sum(axis=0), q.gradient.sum(axis=0)
        best_step = self.stepper(names, vector, which)
        promised = best_step(h, g)
        held, away = self.prior_curvature(names, which), ((vector - self.start) / self.space.scale)[which]
        low, high = (edge - promised for edge in self.distance_to_bounds(vector, which))
        own = np.flatnonzero(np.isin(which, self.space.indices(*names)))
        gradient = q.gradient - q.hessian @ promised
        if settled:
            q, from_ = Quadratic(q.cost, gradient, q.hessian), np.zeros(len(which))
        else:
            from_ = promised
        steps, held_out = {}, np.zeros(len(q.cost))
        for k in np.unique(fold):
            mine = fold == k
            rest = h - q.hessian[mine].sum(axis=0)
            if self.prior is None:
                d = best_step(rest, g - (gradient + q.hessian @ promised)[mine].sum(axis=0)) - promised
            else:
                d = np.zeros(len(which))
                flat = RIDGE * np.trace(h) / len(h) * np.eye(len(own))
                d[own] = bounded(rest[np.ix_(own, own)] + flat, gradient[~mine].sum(axis=0)[own],
                                 np.minimum(low, 0.0)[own], np.maximum(high, 0.0)[own])
            steps[int(k)] = d = from_ + d
            rise = np.einsum("i,bij,j->b", d, q.hessian[mine], d) - 2.0 * q.gradient[mine] @ d
            held_out[mine] = q.cost[mine] + self._robust(rise, mine) + (away + d) @ held @ (away + d) / len(q.cost)
        return steps, held_out

    def _robust(self, rise: np.ndarray, blocks: np.ndarray) -> np.ndarray:
        """The increase of the robust loss for an increase of the quadratic: logarithmic beyond 1 per scored error."""
        number = np.maximum(self._numbers[blocks], 1)
        return np.where(rise > number, number * (1.0 + np.log(np.maximum(rise / number, 1.0))), rise)

    @cached_property
    def _numbers(self) -> np.ndarray:
        """(b,) number of scored errors of each block."""
        return np.bincount(self.block, self.loss.known.sum(axis=1), self.blocks)

    def _simulated(self, fit: Fit, fold: np.ndarray, steps: Mapping[int, np.ndarray],
                   held_out: np.ndarray) -> np.ndarray:
        """(b,) held-out loss: that of the quadratic, `held_out`, or simulated where this is much above the fitted loss.
        fold: (b,)."""
        if held_out.sum() - fit.quadratic.cost.sum() < TRUSTED * self.number:
            return held_out
        held = self.prior_curvature(fit.names, fit.which)
        away = ((fit.vector - self.start) / self.space.scale)[fit.which]
        result = np.zeros(self.blocks)
        for k, d in steps.items():
            there = self.loss.by_window(self.moved(fit.vector, fit.which, d))
            mine = fold == k
            result[mine] = np.bincount(self.block, there, self.blocks)[mine] + (away + d) @ held @ (
                away + d) / self.blocks
        return np.minimum(held_out, result)

    def held_out_apart(self, fit: Fit) -> np.ndarray:
        """(b,) loss of each block at values fitted to the other runs."""
        q = fit.quadratic.summed(self.block, self.blocks)
        steps, held_out = self.leave_out(q, fit.names, fit.vector, fit.which, self.held_out_groups, True)
        return self._simulated(fit, self.held_out_groups, steps, held_out)

    def held_out_rows(self, fit: Fit, fold: np.ndarray | None = None) -> np.ndarray:
        """(n, m) errors of each window at values fitted to other driving. fold: (b,) groups, default those of the
        search."""
        rows = self.errors.at(fit.vector)
        steps = fit.folds
        if fold is None:
            fold = self.fold
        else:
            q = fit.quadratic.summed(self.block, self.blocks)
            steps = self.leave_out(q, fit.names, fit.vector, fit.which, fold, True)[0]
        result = rows.copy()
        slopes = fit.slopes.of(fit.which)
        for k, d in steps.items():
            mine = fold[self.block] == k
            result[mine] -= np.einsum("p,pnm->nm", d, slopes[:, mine])
        before, after = (self.loss.scaled(each) for each in (rows, result))
        if rho(after).sum() - rho(before).sum() > TRUSTED * self.number:  # beyond the validity of the slopes
            for k, d in steps.items():
                mine = fold[self.block] == k
                result[mine] = self.errors.at(self.moved(fit.vector, fit.which, d))[mine]
        return result

    @cached_property
    def end_of(self) -> tuple[int, int]:
        """Columns of a row: lateral and longitudinal position at the end of the horizon."""
        columns = self.errors.windows.columns
        last = len(columns) * (len(self.errors.windows.time) - 1)
        return last + columns.index("position_lateral"), last + columns.index("position_longitudinal")

    def position(self, rows: np.ndarray) -> np.ndarray:
        """(n,) position error at the end of the horizon [m], at most DIVERGED; NaN where it was not measured."""
        if "position_lateral" not in self.errors.windows.columns:
            return np.full(len(rows), np.nan)
        ends = list(self.end_of)
        error = np.minimum(np.nan_to_num(np.hypot(*rows[:, ends].T), nan=DIVERGED), DIVERGED)
        return np.where(self.loss.known[:, ends].all(axis=1), error, np.nan)
