"""Robust loss of the prediction errors, and its quadratic approximation by window.

    rho(z) = (nu + 1) / 2 log(1 + z^2 / nu),   z = r / s

rho is the negative log-likelihood of Student's t distribution, r the residual (measured minus predicted) of a column at
a scored point of the horizon, s its scale. The scale is estimated from the residuals and recomputed as the model
improves: all channels have similar weight, and small errors count once large errors are explained. The quadratic
approximation is that of iteratively reweighted least squares:

    cost(d) ~ cost - 2 g'd + d'H d,   d: step of the parameters, in parameter scales (`Space.scale`)

Source: Lange, Little, Taylor, Robust statistical modeling using the t distribution, JASA 84 (1989).
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from ..augmented import AugmentedModel
from ..channels import CHANNEL_OF_COLUMN
from ..errors import ConfigurationError
from .space import Space
from .windows import Windows

NU = 4.0  # degrees of freedom; residuals beyond two scales have decreasing influence
DIFFERENCE_STEP = 0.1  # step of the difference quotients, as a fraction of the parameter scale
CENTRAL_STEP = 0.03  # likewise, for central quotients
MAX_SCALED_ERROR = 100.0  # clip limit of the scaled residuals, and their value for a diverged prediction
ERROR_CACHE_SIZE = 64  # number of parameter vectors


def rho(z: np.ndarray) -> np.ndarray:
    return 0.5 * (NU + 1.0) * np.log1p(np.square(z) / NU)


def weight(z: np.ndarray) -> np.ndarray:
    """Weight of a squared residual in the quadratic approximation, rho'(z) / (2 z)."""
    return 0.5 * (NU + 1.0) / (NU + np.square(z))


@dataclass(frozen=True, eq=False)
class Quadratic:
    """Quadratic approximation of the loss of each window: cost (n,), gradient g (n, p) and hessian H (n, p, p). By the
    formula in the module docstring, g is half the negative gradient, and H half the Hessian."""

    cost: np.ndarray
    gradient: np.ndarray
    hessian: np.ndarray

    def sum_groups(self, group: np.ndarray, count: int | None = None) -> "Quadratic":
        """Sums over groups of windows. group: (n,) number of the group of each window."""
        count = int(group.max()) + 1 if count is None else count
        member = (group == np.arange(count)[:, None]).astype(float)
        return Quadratic(*(np.tensordot(member, values, 1) for values in (self.cost, self.gradient, self.hessian)))

    def rise(self, step: np.ndarray) -> np.ndarray:
        """(n,) increase of the loss of each window by a step (p,) of the parameters."""
        return np.einsum("i,bij,j->b", step, self.hessian, step) - 2.0 * self.gradient @ step

    def after(self, step: np.ndarray) -> "Quadratic":
        """The approximation about the parameters after a step (p,)."""
        return Quadratic(self.cost + self.rise(step), self.gradient - self.hessian @ step, self.hessian)

    def select(self, indices: np.ndarray) -> "Quadratic":
        """The approximation in the parameters `indices`, with the others fixed."""
        return Quadratic(self.cost, self.gradient[:, indices], self.hessian[:, indices][:, :, indices])


class Errors:
    """Cached prediction errors of all windows by parameter vector. threads: used by `at_all`."""

    def __init__(self, windows: Windows, space: Space, threads: int = 1):
        self.windows, self.space, self.threads = windows, space, threads
        self._cache: dict[bytes, np.ndarray] = {}

    def at(self, vector: np.ndarray) -> np.ndarray:
        """(n, m) measured minus predicted, a row per window [SI]; NaN where unknown, or if `model_at` is None."""
        key = vector.tobytes()
        if key not in self._cache:
            model = self.model_at(vector)
            values = (np.full(self.windows.known.shape, np.nan) if model is None else
                      self.windows.errors(model, float(vector[-1])))
            while len(self._cache) >= ERROR_CACHE_SIZE:
                self._cache.pop(next(iter(self._cache)), None)
            self._cache[key] = values.reshape(len(values), -1)
        return self._cache[key]

    def model_at(self, vector: np.ndarray) -> AugmentedModel | None:
        """The model at a parameter vector; None if its car is outside the limits of a vehicle file."""
        model = self.space.at(vector).without_costly_null_effects()
        try:
            model.effective_vehicle(self.windows.vehicle)
        except ConfigurationError:
            return None
        return model

    def at_all(self, vectors: Sequence[np.ndarray]) -> list[np.ndarray]:
        if self.threads < 2 or len(vectors) < 2:
            return [self.at(v) for v in vectors]
        with ThreadPoolExecutor(self.threads) as pool:
            return list(pool.map(self.at, vectors))


class Loss:
    """Robust loss, initially with the scale of the residuals at `vector`. known: (n, m) whether a residual is measured,
    in a window that can be predicted at `vector`; residual_count: their number. scale: (m,) of the residuals [SI].
    central: use central difference quotients, which need twice as many simulations."""

    def __init__(self, errors: Errors, vector: np.ndarray, central: bool = False):
        self.errors, self.space, self.central = errors, errors.space, central
        self.known = errors.windows.known & np.isfinite(errors.at(vector)).any(axis=1)[:, None]
        self.residual_count = int(self.known.sum())
        smallest = [CHANNEL_OF_COLUMN[column].min_residual_scale for column in errors.windows.columns]
        self.min_scale = np.tile(smallest, len(errors.windows.time))
        self.scale = self.scale_of(vector)

    def scale_of(self, vector: np.ndarray) -> np.ndarray:
        """(m,) 68 % quantile of the |residuals|, one standard deviation if they are normal; at least min_scale."""
        sizes = np.where(self.known, np.abs(self.errors.at(vector)), np.nan)
        sizes[self.known & ~np.isfinite(sizes)] = np.inf
        with np.errstate(all="ignore"):
            size = np.nanquantile(sizes, 0.683, axis=0)
        return np.clip(np.nan_to_num(size, nan=1.0, posinf=1e3), self.min_scale, 1e3)

    def rescale(self, vector: np.ndarray) -> None:
        self.scale = self.scale_of(vector)

    def scale_residuals(self, residuals: np.ndarray) -> np.ndarray:
        """(n, m) scaled residuals z, clipped; 0 where not measured. residuals: (n, m) [SI]."""
        z = np.nan_to_num(residuals / self.scale, nan=MAX_SCALED_ERROR)
        return np.where(self.known, np.clip(z, -MAX_SCALED_ERROR, MAX_SCALED_ERROR), 0.0)

    def window_losses(self, vector: np.ndarray) -> np.ndarray:
        return rho(self.scale_residuals(self.errors.at(vector))).sum(axis=1)

    def total(self, vector: np.ndarray) -> float:
        return float(self.window_losses(vector).sum())

    def sensitivities(self, vector: np.ndarray, indices: np.ndarray) -> np.ndarray:
        """(p, n, m) reduction of the residuals [SI] per parameter scale of the parameters `indices`, by one-sided
        difference quotients (two-sided if `central`) within the bounds and the limits of a vehicle file; 0 where a
        prediction diverges. A step is at most a third of the range, so that one side is within the bounds."""
        space, size = self.space, CENTRAL_STEP if self.central else DIFFERENCE_STEP
        shape, before, after = (len(indices), *self.errors.at(vector).shape), [], []
        for i in indices:
            step = min(size * space.scale[i], (space.high[i] - space.low[i]) / 3.0) * space.sign[i]
            sides = vector + np.outer((step, -step), np.arange(len(vector)) == i)
            within_bounds = [v for v in sides if space.low[i] <= v[i] <= space.high[i]]
            valid = [v for v in within_bounds if self.errors.model_at(v) is not None] or within_bounds
            after.append(valid[0])
            before.append(valid[1] if self.central and len(valid) > 1 else vector)
        steps = [(a - b)[i] / space.scale[i] for a, b, i in zip(after, before, indices, strict=True)]
        quotients = zip(self.errors.at_all(before), self.errors.at_all(after), steps, strict=True)
        sensitivities = [(b - a) / step for b, a, step in quotients]
        return np.nan_to_num(np.reshape(sensitivities, shape), posinf=0.0, neginf=0.0)

    def quadratic(self, residuals: np.ndarray, sensitivities: np.ndarray) -> Quadratic:
        """The approximation about a vector. residuals: (n, m) [SI], sensitivities: (p, n, m), both at this vector."""
        z = self.scale_residuals(residuals)
        j = self._scaled_sensitivities(sensitivities, z)
        jw = np.moveaxis(j * weight(z), 1, 0)  # (n, p, m)
        return Quadratic(rho(z).sum(axis=1), (jw @ z[:, :, None])[:, :, 0], jw @ np.transpose(j, (1, 2, 0)))

    def curvature(self, residuals: np.ndarray, sensitivities: np.ndarray) -> np.ndarray:
        """(p, p) half the second derivative of the loss for residuals linear in the parameters; outliers reduce it."""
        z = self.scale_residuals(residuals)
        j = self._scaled_sensitivities(sensitivities, z)
        second = 0.5 * (NU + 1.0) * (NU - np.square(z)) / np.square(NU + np.square(z))  # rho'' / 2
        flat = j.reshape(len(j), -1)
        return (flat * second.ravel()) @ flat.T

    def _scaled_sensitivities(self, sensitivities: np.ndarray, z: np.ndarray) -> np.ndarray:
        """(p, n, m) sensitivities divided by the residual scale, clipped; 0 where not measured or diverging."""
        limit = MAX_SCALED_ERROR / DIFFERENCE_STEP
        j = np.clip(np.nan_to_num(sensitivities / self.scale, nan=0.0, posinf=0.0, neginf=0.0), -limit, limit)
        return np.where(self.known & (np.abs(z) < MAX_SCALED_ERROR), j, 0.0)
