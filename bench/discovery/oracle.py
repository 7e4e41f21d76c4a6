"""The oracle: the true effects, fitted to the suspect drives and evaluated on held-out drives.

    loss = mean over windows, points and channels of log(1 + z^2 / 4),   z = error / size

size: 68 % quantile of the oracle's errors, for each channel and point of the horizon. The position error is the mean
error after 5 s over the windows of the drives, as `st discover` reports it.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from st_core.augmented import AugmentedModel, augment, set_effects_to_null
from st_core.discovery.settings import DiscoverySettings
from st_core.discovery.windows import Windows
from st_core.effects import Parameter, find_applicable_effects, get_effect
from st_core.log import DriveLog
from st_core.vehicle import VehicleParameters

BASE = "nonlinear"
TAIL = 4.0  # squared scaled error above which the loss grows slowly
MAX_ERROR = 100.0  # m, position error of a divergent prediction
MAX_SCALED_ERROR = 30.0
"""Limit of the scaled errors, so that a divergent window does not dominate the sum."""
GAIN, GAIN_UNIT = 0.05, 0.05
"""Relative excess of the measured lateral acceleration due to body roll [1]: initial value of a fit, and scale."""
ITERATIONS, REFITS, DAMPING = 8, 4, (1e-4, 1e-2, 0.3, 10.0)
MIN_DECREASE = 1e-3  # decrease of the loss below which a fit ends
STEP = 0.1  # of difference quotients, relative to the typical size of an effect

Values = Mapping[str, Mapping[str, float]]


@cache
def null_model() -> AugmentedModel:
    """The model with every effect of the library at null, so that all fits use the same compiled functions."""
    return set_effects_to_null(augment(BASE, [n for n in find_applicable_effects(BASE) if not get_effect(n).signals]))


@dataclass(frozen=True, eq=False)
class Point:
    """A model, and the relative excess of the measured lateral acceleration (GAIN)."""

    model: AugmentedModel
    gain: float


class HeldOutErrors:
    """Errors of models on held-out drives. size: scale of the loss (points, channels), which `scale_by` sets."""

    def __init__(self, held_out: Sequence[DriveLog], vehicle: VehicleParameters, settings: DiscoverySettings):
        self._windows = Windows(held_out, vehicle, settings)
        self._lateral = self._windows.columns.index("position_lateral")
        self.size: np.ndarray | None = None

    def errors(self, at: Point) -> np.ndarray:
        return self._windows.errors(at.model, at.gain)

    def scale_by(self, at: Point) -> None:
        self.size = error_sizes(self.errors(at))

    def loss(self, at: Point) -> float:
        return float(np.mean(np.log1p(np.square(scale_errors(self.errors(at), self.size)) / TAIL)))

    def square(self, at: Point) -> float:
        """Mean square of the scaled errors."""
        return float(np.mean(np.square(scale_errors(self.errors(at), self.size))))

    def position(self, at: Point) -> float:
        """Mean position error after 5 s [m]."""
        return mean_distance(self.errors(at)[:, -1, self._lateral:self._lateral + 2])


def mean_distance(errors: np.ndarray) -> float:
    """Mean length of position errors (n, 2) [m]; a divergent prediction counts MAX_ERROR."""
    return float(np.mean(np.minimum(np.nan_to_num(np.hypot(*errors.T), nan=MAX_ERROR), MAX_ERROR)))


def error_sizes(errors: np.ndarray) -> np.ndarray:
    return np.maximum(np.nanquantile(np.abs(errors), 0.683, axis=0), 1e-9)


def scale_errors(errors: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Errors divided by their sizes, flattened and limited to MAX_SCALED_ERROR."""
    z = errors / size
    return np.clip(np.where(np.isfinite(z), z, MAX_SCALED_ERROR), -MAX_SCALED_ERROR, MAX_SCALED_ERROR).ravel()


class Oracle:
    """The effects `names`, fitted to drives by a robust Gauss-Newton method from `start`.

    Other and removed effects have their values at `origin`, by default null.
    """

    def __init__(self, drives: Sequence[DriveLog], vehicle: VehicleParameters, names: Collection[str], start: Values,
                 settings: DiscoverySettings, origin: Point | None = None):
        self._windows = Windows(drives, vehicle, settings)
        origin = origin or Point(null_model(), GAIN)
        self._model = origin.model
        self._free: list[tuple[str, Parameter]] = [(n, p) for n, p in self._model.free_parameters if n in names]
        self._null = np.array([self._model.values[n][p.name] for n, p in self._free] + [origin.gain])
        self._unit = np.array([abs(p.initial - p.null) for _, p in self._free] + [GAIN_UNIT])
        self._low = np.array([p.bounds[0] for _, p in self._free] + [-0.3])
        self._high = np.array([p.bounds[1] for _, p in self._free] + [0.5])
        begin = [start.get(n, {}).get(p.name, null) for (n, p), null in zip(self._free, self._null[:-1], strict=True)]
        self._x = self._clip(np.array([*begin, origin.gain]))
        self._fit()

    @property
    def best(self) -> Point:
        return self._at(self._x)

    @property
    def base(self) -> Point:
        """The base model with the fitted gain of the accelerometer."""
        return self._at(np.append(self._null[:-1], self._x[-1]))

    def without(self, names: Collection[str]) -> Point:
        """The model without the effects `names`; the others are refitted with the derivatives at the best point, which
        takes a few evaluations instead of a hundred."""
        removed = np.array([n in names for n, _ in self._free] + [False])
        if not removed.any():
            return self.best
        d = np.where(removed, (self._null - self._x) / self._unit, 0.0)
        free = np.flatnonzero(~removed)
        h = self._hessian
        d[free] = np.linalg.solve(h[np.ix_(free, free)], -h[np.ix_(free, removed)] @ d[removed])
        x = min((self._clip(self._x + d * self._unit), np.where(removed, self._null, self._x)), key=self._cost)
        for _ in range(REFITS):
            z = self._scaled_errors(x)
            j = self._derivatives[free]
            weight = 1.0 / (1.0 + np.square(z) / TAIL)
            trial = self._improve(x, z, (j * weight) @ j.T, (j * weight) @ z, free)
            if trial is None:
                break
            x = trial
        return self._at(x)

    def only(self, names: Collection[str]) -> Point:
        return self.without([n for n, _ in self._free if n not in names])

    def _at(self, x: np.ndarray) -> Point:
        values: dict[str, dict[str, float]] = {}
        for (name, parameter), value in zip(self._free, x[:-1], strict=True):
            values.setdefault(name, {})[parameter.name] = float(value)
        return Point(self._model.with_values(values), float(x[-1]))

    def _clip(self, x: np.ndarray) -> np.ndarray:
        return np.clip(x, self._low, self._high)

    def _scaled_errors(self, x: np.ndarray) -> np.ndarray:
        at = self._at(x)
        return scale_errors(self._windows.errors(at.model, at.gain), self._size)

    def _cost(self, x: np.ndarray) -> float:
        return float(np.log1p(np.square(self._scaled_errors(x)) / TAIL).sum())

    def _fit(self) -> None:
        """Fits by Levenberg-Marquardt steps; the sizes of the errors are updated in each iteration."""
        free = np.arange(len(self._x))
        for _ in range(ITERATIONS):
            at = self._at(self._x)
            self._size = error_sizes(self._windows.errors(at.model, at.gain))
            z = self._scaled_errors(self._x)
            j = self._derivatives = self._difference_quotients(z)
            weight = 1.0 / (1.0 + np.square(z) / TAIL)
            self._hessian = (j * weight) @ j.T
            self._hessian += 1e-6 * np.trace(self._hessian) / len(j) * np.eye(len(j))
            trial = self._improve(self._x, z, self._hessian, (j * weight) @ z, free)
            if trial is None:
                return
            self._x = trial

    def _improve(self, x: np.ndarray, z: np.ndarray, hessian: np.ndarray, gradient: np.ndarray,
               free: np.ndarray) -> np.ndarray | None:
        """The parameters after a step that lowers the cost by more than MIN_DECREASE per error, or None."""
        before = np.log1p(np.square(z) / TAIL).sum()
        for damping in DAMPING:
            d = self._step(x, hessian + damping * np.diag(np.diag(hessian)), gradient, free)
            trial = x.copy()
            trial[free] += d * self._unit[free]
            trial = self._clip(trial)
            if before - self._cost(trial) > MIN_DECREASE * len(z):
                return trial
        return None

    def _step(self, x: np.ndarray, hessian: np.ndarray, gradient: np.ndarray, free: np.ndarray) -> np.ndarray:
        """The minimum of the quadratic approximation within the bounds, in typical sizes."""
        low, high = (((side - x) / self._unit)[free] for side in (self._low, self._high))
        d, fixed = np.zeros(len(free)), np.zeros(len(free), bool)
        for _ in free:
            residual = gradient[~fixed] - hessian[np.ix_(~fixed, fixed)] @ d[fixed]
            d[~fixed] = np.linalg.solve(hessian[np.ix_(~fixed, ~fixed)], residual)
            outside = ~fixed & ((d < low) | (d > high))
            if not outside.any():
                break
            d, fixed = np.clip(d, low, high), fixed | outside
        return d

    def _difference_quotients(self, z: np.ndarray) -> np.ndarray:
        """(p, n) negative derivatives of z with respect to the parameters, in typical sizes."""
        slopes = np.zeros((len(self._x), len(z)))
        for i, unit in enumerate(self._unit):
            sign = 1.0 if self._x[i] + STEP * unit <= self._high[i] else -1.0
            trial = self._x.copy()
            trial[i] += sign * STEP * unit
            slopes[i] = (z - self._scaled_errors(trial)) / (sign * STEP)
        return slopes
