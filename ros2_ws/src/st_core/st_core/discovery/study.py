"""The suspect drives under every hypothesis: one effect or several freed, all else held near the healthy car."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from .floor import Floor, precision, solve_map
from .quadratic import Quadratic, costs, jacobian, quadratic, row_errors, whitened
from .space import Space
from .windows import Windows

ITERATIONS, RENEWALS = 10, 2
SETTLED, STUCK = 0.5, 3.0  # twice the log-likelihood: a step that gains less is the last, unless as much is promised
ALONE = 0.5  # share of a gain that must not need a healthy car's values to move as well
ANYWAY = 0.4  # share of a gain that counts at the least, however much of it the base has as well
ALONE_UNREFERENCED = 0.25  # the same without a reference, where a healthy car may be further from its file


@dataclass(frozen=True, eq=False)
class Fit:
    """A hypothesis fitted. names: effects freed, () for the base. vector: where. quadratic: about it. cost: of the
    fit, priors included, over the inflation."""

    names: tuple[str, ...]
    vector: np.ndarray
    quadratic: Quadratic
    cost: float


class Study:
    """folds: (b,) number of the fold of each block."""

    def __init__(self, windows: Windows, space: Space, floor: Floor, folds: np.ndarray, tick=None):
        self.windows, self.space, self.floor, self.folds, self._tick = windows, space, floor, folds, tick
        self.settings = windows.settings
        self._alone: dict[tuple[str, ...], float] = {}
        self.rows = row_errors(windows, space, floor.vector)
        self.slopes = jacobian(windows, space, floor.vector, self.rows, tick=tick)
        self.quadratic = quadratic(self.rows, self.slopes, windows, floor.how)
        self.low = (space.low - floor.vector) / space.scale
        self.high = (space.high - floor.vector) / space.scale

    def precision(self, free: np.ndarray) -> np.ndarray:
        """Of the deviations from the floor when those in `free` may be anything."""
        return precision(self.floor.spread, free)

    def solve(self, q: Quadratic, precision: np.ndarray, about: np.ndarray) -> np.ndarray:
        """Deviation that fits best, from a quadratic about the deviation `about`; within the bounds."""
        scale = self.floor.inflation
        h, g = q.hessian.sum(0) / scale, q.gradient.sum(0) / scale
        return about + bounded(h + precision, g - precision @ about, self.low - about, self.high - about)

    def linear(self, names: Iterable[str]) -> tuple[np.ndarray, float]:
        """(deviation, cost) of a hypothesis by the quadratic about the floor."""
        weight = self.precision(self.space.indices(*names))
        d = self.solve(self.quadratic, weight, np.zeros(len(self.space)))
        return d, float(self.quadratic.at(d).sum() / self.floor.inflation + d @ weight @ d)

    def rate(self, fits: Iterable[Fit]) -> None:
        """Remember how much of what a fit gains its effects gain alone, all else as in the healthy car; of one effect,
        of what it gains over the base."""
        for fit in fits:
            if fit.names not in self._alone:
                rows = row_errors(self.windows, self.space, self.only(fit, self.space.indices(*fit.names)))
                each, _ = costs(whitened(rows, self.windows.condition, self.floor.how), self.windows)
                gained = float(self.quadratic.cost.sum() - fit.quadratic.cost.sum())
                anyway = float(self.quadratic.cost.sum() - self.base.quadratic.cost.sum())
                gained = max(gained - anyway * (len(fit.names) == 1), ANYWAY * gained, 1e-9)
                self._alone[fit.names] = float(self.quadratic.cost.sum() - each.sum()) / gained

    def credible(self, fit: Fit) -> bool:
        """Whether the effects of a fit do most of the work themselves."""
        self.rate([fit])
        return self._alone[fit.names] >= (ALONE if self.floor.quadratic else ALONE_UNREFERENCED)

    @cached_property
    def base(self) -> Fit:
        return self.fit(())

    def total(self, rows: np.ndarray, d: np.ndarray, weight: np.ndarray) -> float:
        each, _ = costs(whitened(rows, self.windows.condition, self.floor.how), self.windows)
        return float(each.sum() / self.floor.inflation + d @ weight @ d)

    def fit(self, names: Iterable[str], start: np.ndarray | None = None) -> Fit:
        """Gauss-Newton. At each step the slopes of what is freed are renewed, those of the rest corrected by what the
        step did; where that leads nowhere though more is promised, all are renewed."""
        names = tuple(names)
        free = self.space.indices(*names)
        weight = self.precision(free)
        d = self.linear(names)[0] if start is None else start
        slopes, rows, cost = self.slopes, self.rows, self.total(self.rows, np.zeros(len(d)), weight)
        about, q, renewals = np.zeros(len(d)), self.quadratic, 0
        exact, given = True, start is not None
        for _ in range(ITERATIONS):
            moved, trial, lower = self._step(about, d, cost, weight)
            gained = cost - lower
            if moved is not None:
                slopes = secant(slopes, moved - about, rows - trial)
                about, rows, cost = moved, trial, lower
                if len(free):
                    fresh = jacobian(self.windows, self.space, self.at(about), rows, free, self._tick)
                    slopes[free] = fresh[free]
                q, exact = quadratic(rows, slopes, self.windows, self.floor.how), False
            elif exact and not given:
                break  # the same step again
            d, given = self.solve(q, weight, about), False
            if gained < SETTLED and not exact:
                promised = cost - float(q.at(d - about).sum() / self.floor.inflation + d @ weight @ d)
                if renewals == RENEWALS or promised < STUCK:
                    break
                renewals, exact = renewals + 1, True
                slopes = jacobian(self.windows, self.space, self.at(about), rows, tick=self._tick)
                q = quadratic(rows, slopes, self.windows, self.floor.how)
                d = self.solve(q, weight, about)
        return Fit(names, self.at(about), q, cost)

    def no_worse_than_base(self, names: tuple[str, ...]) -> Fit:
        """A fit; where it ends above the base, which is the same with less freedom, another from there."""
        fit = self.fit(names)
        if fit.cost <= self.base.cost:
            return fit
        return min(fit, self.fit(names, self.deviation(self.base)), key=lambda each: each.cost)

    def _step(self, about: np.ndarray, towards: np.ndarray, cost: float, weight: np.ndarray):
        """(deviation, errors there, cost) on the way to a point where the cost falls; (None, None, cost) if nowhere."""
        for share in (1.0, 0.5, 0.2):
            candidate = about + share * (towards - about)
            trial = row_errors(self.windows, self.space, self.at(candidate))
            value = self.total(trial, candidate, weight)
            if value < cost:
                return candidate, trial, value
        return None, None, cost

    def at(self, d: np.ndarray) -> np.ndarray:
        return self.space.inside(self.floor.vector + d * self.space.scale)

    def only(self, fit: Fit, free: np.ndarray, blocks=slice(None)) -> np.ndarray:
        """The vector with the parameters `free` fitted to some blocks and all others those of the floor."""
        about = (fit.vector - self.floor.vector) / self.space.scale
        h, g = fit.quadratic.hessian[blocks].sum(0), fit.quadratic.gradient[blocks].sum(0)
        g = g + h @ about  # about the floor
        d = np.zeros(len(about))
        own = h[np.ix_(free, free)] + 1e-6 * np.eye(len(free))
        d[free] = bounded(own, g[free], self.low[free], self.high[free])
        return self.at(d)

    def promise(self, names: tuple[str, ...], fits, answer: Fit) -> float:
        """About what a group would cost: by the quadratic about the best fit that shares most with it."""
        near = self._near(names, fits, answer)
        weight = self.precision(self.space.indices(*names))
        about = self.deviation(near)
        d = self.solve(near.quadratic, weight, about)
        return float(near.quadratic.at(d - about).sum() / self.floor.inflation + d @ weight @ d)

    def start_of(self, names: tuple[str, ...], fits, answer: Fit) -> np.ndarray:
        """Where the fit of a group begins: the deviation `promise` speaks of."""
        near = self._near(names, fits, answer)
        return self.solve(near.quadratic, self.precision(self.space.indices(*names)), self.deviation(near))

    @staticmethod
    def _near(names: tuple[str, ...], fits, answer: Fit) -> Fit:
        shared = [fits[n] for n in names if n in fits]
        choices = [answer, *shared] if set(answer.names) & set(names) else shared or [answer]
        return min(choices, key=lambda fit: (-len(set(fit.names) & set(names)), fit.cost))

    def deviation(self, fit: Fit) -> np.ndarray:
        return (fit.vector - self.floor.vector) / self.space.scale


def secant(slopes: np.ndarray, step: np.ndarray, taken: np.ndarray) -> np.ndarray:
    """Slopes (p, n, m) that give for this step (p,) what the errors (n, m) have just lost by it (Broyden's update)."""
    known = np.nan_to_num(slopes, nan=0.0, posinf=0.0, neginf=0.0)
    missed = taken - np.tensordot(step, known, 1)
    missed[~np.isfinite(missed)] = 0.0  # a window that has just diverged, or come back, says nothing of slopes
    return known + (step / max(float(step @ step), 1e-12))[:, None, None] * missed


def bounded(a: np.ndarray, b: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Minimum of x'Ax - 2 b'x with low <= x <= high, by an active set."""
    return solve_map(a, b, np.full(len(b), np.inf), np.zeros(len(b)), low, high)
