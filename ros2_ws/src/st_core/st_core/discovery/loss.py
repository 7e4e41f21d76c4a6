"""How badly a set of values predicts: the loss, and its quadratic, window by window.

An error r of a channel at a point of the horizon, over the scale s of that channel and point, counts as under Student's
distribution: rho(z) = (nu + 1) / 2 log(1 + z^2 / nu), z = r / s. The scale is that of the errors themselves and is
renewed as the model improves, so that no channel is bought by another and small errors matter once large ones are
explained.
About a point, cost(d) ~ cost - 2 g'd + d'H d, d in usual sizes of the parameters: iteratively reweighted squares.
Source: Lange, Little, Taylor, Robust statistical modeling using the t distribution, JASA 84 (1989).
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from ..channels import OF_COLUMN
from .space import Space
from .windows import Windows

NU = 4.0  # degrees of freedom: errors beyond two scales count less and less
DIFFERENCE_STEP = 0.1  # of the usual size: step of the difference quotients
MAX_SCALED_ERROR = 100.0  # scales; a prediction that diverges is that far off, and no further
ERROR_CACHE_SIZE = 64  # rows of errors remembered


def rho(z: np.ndarray) -> np.ndarray:
    return 0.5 * (NU + 1.0) * np.log1p(np.square(z) / NU)


def weight(z: np.ndarray) -> np.ndarray:
    """rho'(z) / (2 z)."""
    return 0.5 * (NU + 1.0) / (NU + np.square(z))


@dataclass(frozen=True, eq=False)
class Quadratic:
    """By window: cost (n,), gradient (n, p), hessian (n, p, p)."""

    cost: np.ndarray
    gradient: np.ndarray
    hessian: np.ndarray

    def summed(self, group: np.ndarray, count: int | None = None) -> "Quadratic":
        """The same by group. group: (n,) number of the group of each window."""
        count = int(group.max()) + 1 if count is None else count
        member = (group == np.arange(count)[:, None]).astype(float)
        return Quadratic(*(np.tensordot(member, values, 1) for values in (self.cost, self.gradient, self.hessian)))

    def only(self, which: np.ndarray) -> "Quadratic":
        """Of some of the parameters."""
        return Quadratic(self.cost, self.gradient[:, which], self.hessian[:, which][:, :, which])


class Errors:
    """Errors of all windows at any vector, remembered. added: (n, m) put on top of them, to imitate other drives."""

    def __init__(self, windows: Windows, space: Space, threads: int = 1):
        self.windows, self.space, self.threads = windows, space, threads
        self.calls = 0
        self._kept: dict[bytes, np.ndarray] = {}

    def at(self, vector: np.ndarray) -> np.ndarray:
        """(n, m): measured minus predicted, all points and columns of a window in a row; NaN where not known."""
        key = vector.tobytes()
        if key not in self._kept:
            self.calls += 1
            values = self.windows.errors(self.space.at(vector).lean(), float(vector[-1])).values
            while len(self._kept) >= ERROR_CACHE_SIZE:
                self._kept.pop(next(iter(self._kept)), None)
            self._kept[key] = values.reshape(len(values), -1)
        return self._kept[key]

    def many(self, vectors: Sequence[np.ndarray]) -> list[np.ndarray]:
        if self.threads < 2 or len(vectors) < 2:
            return [self.at(v) for v in vectors]
        with ThreadPoolExecutor(self.threads) as pool:
            return list(pool.map(self.at, vectors))


class Loss:
    """The loss of errors at one scale. known: (n, m) what was measured. scale: (m,) SI."""

    def __init__(self, errors: Errors, at: np.ndarray):
        self.errors, self.space = errors, errors.space
        measured = errors.windows.known
        self.known = measured & np.isfinite(errors.at(at)).any(axis=1)[:, None]
        self.number = int(self.known.sum())
        self.smallest = np.tile([OF_COLUMN[c].smallest for c in errors.windows.columns], len(errors.windows.time))
        self.scale = self.scale_of(at)

    def scale_of(self, vector: np.ndarray) -> np.ndarray:
        """(m,) what two thirds of the errors are below."""
        rows = np.where(self.known, np.abs(self.errors.at(vector)), np.nan)
        rows[self.known & ~np.isfinite(rows)] = np.inf
        with np.errstate(all="ignore"):
            size = np.nanquantile(rows, 0.683, axis=0)
        return np.clip(np.nan_to_num(size, nan=1.0, posinf=1e3), self.smallest, 1e3)

    def rescale(self, vector: np.ndarray) -> None:
        self.scale = self.scale_of(vector)

    def scaled(self, rows: np.ndarray) -> np.ndarray:
        """(n, m) z of rows of errors; 0 where nothing was measured."""
        z = np.nan_to_num(rows / self.scale, nan=MAX_SCALED_ERROR, posinf=MAX_SCALED_ERROR, neginf=-MAX_SCALED_ERROR)
        return np.where(self.known, np.clip(z, -MAX_SCALED_ERROR, MAX_SCALED_ERROR), 0.0)

    def by_window(self, vector: np.ndarray) -> np.ndarray:
        return rho(self.scaled(self.errors.at(vector))).sum(axis=1)

    def total(self, vector: np.ndarray) -> float:
        return float(self.by_window(vector).sum())

    def slopes(self, vector: np.ndarray, which: np.ndarray) -> np.ndarray:
        """(p, n, m) fall of the errors [SI] per usual size of each of the parameters `which`, by differences."""
        step = DIFFERENCE_STEP * self.space.scale[which] * self.space.sign[which]
        there = vector[which] + step
        step = np.where((there < self.space.low[which]) | (there > self.space.high[which]), -step, step)
        moved = np.tile(vector, (len(which), 1))
        moved[np.arange(len(which)), which] += step
        here = self.errors.at(vector)
        size = step / self.space.scale[which]
        return np.stack([(here - there) / d for there, d in zip(self.errors.many(list(moved)), size, strict=True)]
                        ) if len(which) else np.zeros((0, *here.shape))

    def quadratic(self, rows: np.ndarray, slopes: np.ndarray) -> Quadratic:
        """About the point with these errors (n, m) and slopes (p, n, m)."""
        z = self.scaled(rows)
        far = MAX_SCALED_ERROR / DIFFERENCE_STEP
        j = np.where(self.known, np.clip(np.nan_to_num(slopes / self.scale, nan=0.0, posinf=0.0, neginf=0.0),
                                         -far, far), 0.0)
        j = np.where(np.abs(z) < MAX_SCALED_ERROR, j, 0.0)  # a diverged window does not respond to small changes
        w = weight(z)
        jw = np.moveaxis(j * w, 1, 0)  # (n, p, m)
        return Quadratic(rho(z).sum(axis=1), (jw @ z[:, :, None])[:, :, 0], jw @ np.transpose(j, (1, 2, 0)))

    def curvature(self, rows: np.ndarray, slopes: np.ndarray) -> np.ndarray:
        """(p, p) half the second derivative of the loss, errors taken as linear: errors far out count against it."""
        z = self.scaled(rows)
        j = np.where(self.known & (np.abs(z) < MAX_SCALED_ERROR), np.nan_to_num(slopes / self.scale), 0.0)
        bend = 0.5 * (NU + 1.0) * (NU - np.square(z)) / np.square(NU + np.square(z))
        flat = j.reshape(len(j), -1)
        return (flat * bend.ravel()) @ flat.T
