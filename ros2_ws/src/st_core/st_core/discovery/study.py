"""The suspect drives under every hypothesis: one effect or several freed, all else held near the healthy car."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from .floor import Floor, solve_map
from .quadratic import Quadratic, costs, jacobian, quadratic, row_errors, whitened
from .space import Space
from .windows import Windows

ITERATIONS = 3
ALONE = 0.5  # share of a gain that must not need a healthy car's values to move as well
ANYWAY = 0.4  # share of a gain that counts at the least, however much of it the base has as well
ALONE_UNREFERENCED = 0.25  # the same without a reference, where a healthy car may be further from its file


@dataclass(frozen=True, eq=False)
class Fit:
    """A hypothesis fitted. names: effects freed, () for the base. vector: where. quadratic: about it. cost: of the
    fit, priors included, over the inflation. held_out: (b,) cost of each block with values fitted to the other folds,
    over the inflation."""

    names: tuple[str, ...]
    vector: np.ndarray
    quadratic: Quadratic
    cost: float
    held_out: np.ndarray


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
        rest = np.setdiff1d(np.arange(len(self.space)), free)
        result = np.zeros((len(self.space),) * 2)
        result[np.ix_(rest, rest)] = np.linalg.inv(self.floor.spread[np.ix_(rest, rest)])
        result[free, free] = 1e-6
        return result

    def solve(self, q: Quadratic, precision: np.ndarray, about: np.ndarray, blocks=slice(None)) -> np.ndarray:
        """Deviation that fits best, from a quadratic about the deviation `about`; within the bounds."""
        scale = self.floor.inflation
        h, g = q.hessian[blocks].sum(0) / scale, q.gradient[blocks].sum(0) / scale
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
        """Gauss-Newton; slopes of what is freed are renewed at each step, those of the rest are the floor's."""
        names = tuple(names)
        free = self.space.indices(*names)
        weight = self.precision(free)
        d = self.linear(names)[0] if start is None else start
        slopes, rows, cost = self.slopes, self.rows, self.total(self.rows, np.zeros(len(d)), weight)
        about = np.zeros(len(d))
        q = self.quadratic
        for _ in range(ITERATIONS if names else 2):
            moved, trial, lower = None, None, cost
            for share in (1.0, 0.5, 0.2):
                candidate = about + share * (d - about)
                trial = row_errors(self.windows, self.space, self.at(candidate))
                value = self.total(trial, candidate, weight)
                if value < lower:
                    moved, lower = candidate, value
                    break
            if moved is None:
                break
            gained, about, rows, cost = cost - lower, moved, trial, lower
            if len(free):
                fresh = jacobian(self.windows, self.space, self.at(about), rows, free, self._tick)
                slopes = slopes.copy()
                slopes[free] = fresh[free]
            q = quadratic(rows, slopes, self.windows, self.floor.how)
            if gained < 0.5:
                break
            d = self.solve(q, weight, about)
        return Fit(names, self.at(about), q, cost, self._held_out(q, weight, about))

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

    def _held_out(self, q: Quadratic, weight: np.ndarray, about: np.ndarray) -> np.ndarray:
        result = np.zeros(len(q.cost))
        for fold in np.unique(self.folds):
            mine = self.folds == fold
            d = self.solve(q, weight, about, ~mine)
            result[mine] = q.at(d - about)[mine] / self.floor.inflation
        return result


def bounded(a: np.ndarray, b: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Minimum of x'Ax - 2 b'x with low <= x <= high, by an active set."""
    return solve_map(a, b, np.full(len(b), np.inf), np.zeros(len(b)), low, high)
