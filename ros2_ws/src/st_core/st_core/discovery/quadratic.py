"""The cost of a set of windows about a point, block by block: c - 2 g'd + d'H d. All statistics are sums of these.

A window with square error e counts rho = s log(1 + e / s), s = TAIL times the number of errors in it: as under
Student's distribution a few windows the base does not hold for cannot outvote the rest.
"""

from dataclasses import dataclass

import numpy as np

from .space import Space
from .windows import CONDITIONS, Windows

LARGEST = 30.0  # standard deviations; a window further off counts as that far, in each direction of the whitened errors
TAIL = 2.0
FAR = 4.0  # mean square of a window beyond which it is taken for an outlier of the floor
BEND = 0.1  # of the usual size: step of the difference quotients


@dataclass(frozen=True, eq=False)
class Whitening:
    """matrices: (CONDITIONS, m, m), errors of a window as a row times that of its kind of driving are uncorrelated and
    of size 1 on healthy drives."""

    matrices: np.ndarray

    def of(self, rows: np.ndarray, condition: np.ndarray) -> np.ndarray:
        """rows: (..., n, m) errors of windows, condition: (n,)."""
        result = np.empty_like(rows)
        for kind in np.unique(condition):
            mine = condition == kind
            result[..., mine, :] = rows[..., mine, :] @ self.matrices[kind]
        return result


@dataclass(frozen=True, eq=False)
class Quadratic:
    """By block: cost (b,), gradient (b, p), hessian (b, p, p), windows (b,). Parameters in their usual sizes."""

    cost: np.ndarray
    gradient: np.ndarray
    hessian: np.ndarray
    windows: np.ndarray

    def at(self, d: np.ndarray) -> np.ndarray:
        """(b,) cost of each block at d."""
        return self.cost - 2.0 * self.gradient @ d + np.einsum("i,bij,j->b", d, self.hessian, d)


def row_errors(windows: Windows, space: Space, vector: np.ndarray) -> np.ndarray:
    """(n, m): all errors of a window in a row."""
    values = windows.errors(space.at(vector), float(vector[-1])).values
    return values.reshape(len(values), -1)


def root(covariance_size: np.ndarray, correlation: np.ndarray) -> np.ndarray:
    """Matrix that whitens rows of that size (m,) and correlation; directions hardly seen are held."""
    values, vectors = np.linalg.eigh(correlation)
    return (vectors / np.sqrt(np.maximum(values, 0.02))) / covariance_size[:, None]


def by_condition(spread: np.ndarray, correlation: np.ndarray, size: np.ndarray, scored: np.ndarray) -> Whitening:
    """spread: (m,) sizes in usual driving. scored: (CONDITIONS, m) whether a column counts in a kind of driving."""
    matrices, roots = np.zeros((CONDITIONS, len(spread), len(spread))), {}
    for kind in range(CONDITIONS):
        use = np.flatnonzero(scored[kind])
        if len(use) not in roots:
            roots[len(use)] = root(spread[use], correlation[np.ix_(use, use)])
        matrices[kind][np.ix_(use, use)] = roots[len(use)] / size[kind]
    return Whitening(matrices)


def whitening(rows: np.ndarray, condition: np.ndarray, noise: np.ndarray, scored: np.ndarray,
              shrink: float = 0.1) -> Whitening:
    """From errors on healthy drives (n, m) and their kinds of driving (n,); noise: (m,) what they are at least.

    Covariance and sizes in turn: a few windows at the limit would else speak for all.
    """
    known = np.isfinite(rows).all(axis=1)
    rows, condition = rows[known], condition[known]
    whole = scored[condition].all(axis=1)
    size, how = np.ones(CONDITIONS), None
    for _ in range(6):
        scaled = rows / size[condition, None]
        if how is not None:  # no window counts as more than a few usual ones
            far = np.square(how.of(rows, condition)).sum(axis=1) / scored[condition].sum(axis=1)
            scaled = scaled * np.minimum(1.0, np.sqrt(FAR / np.maximum(far, 1e-12)))[:, None]
        usual = scaled[whole] if whole.sum() > 0.3 * len(whole) else scaled
        covariance = usual.T @ usual / max(len(usual), 1)
        spread = np.sqrt(np.diag(covariance) + noise**2)
        correlation = covariance / np.outer(spread, spread)
        np.fill_diagonal(correlation, 1.0)
        correlation = (1.0 - shrink) * correlation + shrink * np.eye(len(spread))
        plain = by_condition(spread, correlation, np.ones(CONDITIONS), scored)
        size = _sizes(np.square(plain.of(rows, condition)).sum(axis=1) / scored[condition].sum(axis=1), condition)
        how = Whitening(plain.matrices / size[:, None, None])
    return how


def _sizes(cost: np.ndarray, condition: np.ndarray) -> np.ndarray:
    """(CONDITIONS,) root of the mean cost in each kind of driving; held by that of all where there is little of it, and
    no less than in gentler driving."""
    middle = float(np.median(cost)) if len(cost) else 1.0
    cost = np.minimum(cost, 20.0 * middle)
    sums = np.bincount(condition, cost, CONDITIONS) + 3.0 * middle
    mean = (sums / (np.bincount(condition, minlength=CONDITIONS) + 3.0)).reshape(2, -1)
    mean = np.maximum.accumulate(np.maximum.accumulate(mean, axis=1), axis=0)
    return np.sqrt(mean / max(middle, 1e-12)).ravel()


def whitened(rows: np.ndarray, condition: np.ndarray, how: Whitening) -> np.ndarray:
    """NaN becomes 0: what is not known is not scored; how far a diverged prediction is off no longer matters."""
    rows = how.of(np.nan_to_num(rows, nan=0.0, posinf=1e6, neginf=-1e6), condition)
    return np.clip(rows, -LARGEST, LARGEST)


def costs(whitened_rows: np.ndarray, windows: Windows) -> tuple[np.ndarray, np.ndarray]:
    """(n,) rho of each window and its derivative by the square error, 0 to 1."""
    scale = TAIL * windows.scored[windows.condition].sum(axis=1)
    square = np.square(whitened_rows).sum(axis=1)
    return scale * np.log1p(square / scale), 1.0 / (1.0 + square / scale)


def jacobian(windows: Windows, space: Space, vector: np.ndarray, rows: np.ndarray,
             which: np.ndarray | None = None, tick=None) -> np.ndarray:
    """(p, n, m) minus the change of the errors per usual size, by differences; zero for parameters not in `which`."""
    result = np.zeros((len(space), *rows.shape))
    for i in range(len(space)) if which is None else which:
        step = BEND * space.scale[i]
        sign = 1.0 if i == len(space) - 1 else space.free[i].sign
        if not space.low[i] <= vector[i] + sign * step <= space.high[i]:
            sign = -sign
        moved = vector.copy()
        moved[i] += sign * step
        result[i] = (rows - row_errors(windows, space, moved)) / (sign * BEND)
        if tick:
            tick()
    return result


def quadratic(rows: np.ndarray, slopes: np.ndarray, windows: Windows, how: Whitening) -> Quadratic:
    """rows: (n, m) errors; slopes: (p, n, m) of `jacobian`."""
    block = windows.block
    r = whitened(rows, windows.condition, how)
    j = how.of(np.nan_to_num(slopes, nan=0.0, posinf=0.0, neginf=0.0), windows.condition)
    j = np.clip(j, -LARGEST / BEND, LARGEST / BEND)
    each, weight = costs(r, windows)
    r, j = r * np.sqrt(weight)[:, None], j * np.sqrt(weight)[:, None]
    count = int(block.max()) + 1
    p = len(j)
    cost, gradient, hessian = np.zeros(count), np.zeros((count, p)), np.zeros((count, p, p))
    for b in range(count):
        mine = block == b
        jb, rb = j[:, mine].reshape(p, -1), r[mine].ravel()
        cost[b], gradient[b], hessian[b] = each[mine].sum(), jb @ rb, jb @ jb.T
    return Quadratic(cost, gradient, hessian, np.bincount(block, minlength=count))
