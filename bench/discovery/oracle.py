"""How much a model misses on held-out drives, and what the true effect of the library, fitted, would explain.

    J = mean over points and columns of (error / floor)^2,  floor: the base on the same programmes with the healthy car
    D = 1 - J(true effect, fitted to the suspect drives) / J(base),  on held-out drives

J of the base is 1 for a healthy car. Strata of the score: D above 0.5 strong, 0.25 to 0.5 medium, 0.1 to 0.25 weak.
"""

from collections.abc import Sequence

import numpy as np
from scipy.optimize import least_squares
from st_core.augmented import AugmentedModel
from st_core.discovery import DiscoverySettings
from st_core.discovery.windows import Windows
from st_core.log import DriveLog
from st_core.vehicle import VehicleParameters

STRATA = (("strong", 0.5), ("medium", 0.25), ("weak", 0.1), ("invisible", -np.inf))
LARGEST = 30.0
"""Errors count as so many floors at the most: one window that diverges must not be the whole sum."""


def stratum(detectability: float) -> str:
    return next(name for name, low in STRATA if detectability > low)


class Judge:
    """Scores models on held-out drives. base: of the discovery, gain: of its accelerometer."""

    def __init__(self, held_out: Sequence[DriveLog], twin: Sequence[DriveLog], vehicle: VehicleParameters,
                 settings: DiscoverySettings, base: AugmentedModel, gain: float):
        self.vehicle, self.settings, self.gain = vehicle, settings, gain
        self._windows = Windows(held_out, vehicle, settings)
        self.floor = floors(twin, vehicle, settings, base, gain)
        self.base = self.loss(base)

    def loss(self, model: AugmentedModel) -> float:
        return float(np.mean(np.square(scaled(self._windows, model, self.floor, self.gain))))


def floors(runs: Sequence[DriveLog], vehicle: VehicleParameters, settings: DiscoverySettings, base: AugmentedModel,
           gain: float) -> np.ndarray:
    """(k, c) root mean square error of the base, per point of the horizon and column."""
    errors = Windows(runs, vehicle, settings).errors(base, gain).values
    return np.sqrt(np.nanmean(np.square(errors), axis=0))


def scaled(windows: Windows, model: AugmentedModel, floor: np.ndarray, gain: float) -> np.ndarray:
    """Errors over their floors, one row; what diverged counts LARGEST."""
    errors = windows.errors(model, gain).values / floor
    return np.clip(np.where(np.isfinite(errors), errors, LARGEST), -LARGEST, LARGEST).ravel()


def oracle(suspect: Sequence[DriveLog], names: Sequence[str], vehicle: VehicleParameters, settings: DiscoverySettings,
           base: AugmentedModel, gain: float, floor: np.ndarray) -> AugmentedModel:
    """The base with the named effects fitted to the suspect drives, starting from the better side of where the base has
    them."""
    windows = Windows(suspect, vehicle, settings)
    free = [i for i, (effect, _) in enumerate(base.free) if effect in names]
    parameters = [base.free[i][1] for i in free]
    start = base.vector
    unit = np.array([abs(p.initial - p.null) for p in parameters])
    low, high = (np.array([p.bounds[i] for p in parameters]) for i in (0, 1))

    low, high = (low - start[free]) / unit, (high - start[free]) / unit

    def model(x: np.ndarray) -> AugmentedModel:
        vector = start.copy()
        vector[free] = start[free] + x * unit
        return base.with_vector(vector)

    def residual(x: np.ndarray) -> np.ndarray:
        return scaled(windows, model(x), floor, gain)

    # Half a usual size to either side, where there is room: play and its like have no slope at null.
    begins = [np.clip(np.full(len(free), side), low + 1e-3, high - 1e-3) for side in (0.5, -0.5)]
    begin = min(begins, key=lambda x: np.sum(np.square(residual(x))))
    fit = least_squares(residual, begin, bounds=(low, high), diff_step=1e-2, xtol=1e-3, ftol=1e-3, max_nfev=5)
    return model(fit.x)
