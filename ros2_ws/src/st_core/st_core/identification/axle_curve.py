"""Lateral force of an axle against its slip angle over the driven range: model with band, and measurement.

    F(alpha) = (F_model(-alpha) - F_model(alpha)) / 2,   alpha >= 0

F_model is the axle force in the model's equations of motion at equal slip of both axles, straight wheels and no
forward acceleration: every effect that acts at that state is included, offsets cancel. The slip angle is that of the
measured steering, as in a regression, so compliance makes the axle softer. Roll steer does not act at this
state. No curve is given beyond the driven slip. Checked by: test_axle_curve.py.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from ..augmented import AugmentedModel
from ..errors import ConfigurationError, StCoreError
from ..models import Model, get_model
from ..vehicle import VehicleParameters
from .cornering_stiffness import DRIVEN_QUANTILE, AxleSamples

SPEED = 20.0  # m/s, at which the curve is evaluated: no minimum_slip_speed is higher
MIN_DRAWS = 20


@dataclass(frozen=True, eq=False)
class AxleCurve:
    """Force curve of one axle. slip: (m,) [rad], 0 to the driven slip; force, low, high, file: (m,) [N], opposing the
    slip; low and high: the band of `level`, equal to force without draws; file: the original model's.

    density: (m - 1,) share of the driving between two values of slip [1], sum 1 up to the driven slip.
    """

    axle: str
    slip: np.ndarray
    force: np.ndarray
    low: np.ndarray
    high: np.ndarray
    file: np.ndarray
    density: np.ndarray
    level: float


def axle_force(model: str | Model, vehicle: VehicleParameters, axle: str, slip: np.ndarray) -> np.ndarray:
    """Force of the axle ("front" or "rear") opposing slip angles >= 0 [rad], (n,) [N]; equation: see the module.

    Raises StCoreError for a model without tyres.
    """
    model = get_model(model)
    car = model.effective_vehicle(vehicle)
    base = model.base if isinstance(model, AugmentedModel) else model
    if base.axles is None and not (isinstance(model, AugmentedModel) and any(e.lifts for e in model.active)):
        raise StCoreError(f"{base.name}: this model has no axle forces")
    slip = np.asarray(slip, float)
    zero = np.zeros_like(slip)
    p = model.parameters(vehicle)
    w = model.inputs(zero, zero, p, *(zero for _ in model.signals))
    other_axle, sign = (car.cg_to_rear_axle, 1.0) if axle == "front" else (car.cg_to_front_axle, -1.0)
    starts = ((zero, zero, zero + SPEED, SPEED * np.tan(side * slip), zero, zero) for side in (-1.0, 1.0))
    left, right = (model.rhs(model.start_state(start, w, p), w, p) for start in starts)
    # F = (l_other m a_y +- I_z r_dot) / L, by the force and moment balance.
    return (other_axle * car.mass * (left[3] - right[3]) + sign * car.yaw_inertia * (left[5] - right[5])) / (
        2.0 * car.wheelbase)


def axle_curve(model: str | Model, vehicle: VehicleParameters, axle: str, driven_slip: np.ndarray,
               draws: Iterable[Model] = (), original: str | Model | None = None, level: float = 0.9,
               points: int = 41) -> AxleCurve:
    """The force curve of one axle with its band over the driven slip.

    driven_slip: (n,) slip angles of the axle while driving [rad], either sign. draws: models with other values, from
    `draw_models`; the band is their central `level` at each slip. original: model of the
    vehicle file, by default the base model without effects. Raises StCoreError for fewer than two driven slip angles.
    """
    size = np.abs(np.asarray(driven_slip, float))
    size = size[np.isfinite(size)]
    if len(size) < 2 or not size.max() > 0.0:
        raise StCoreError(f"{axle} axle: {len(size)} driven slip angles; two or more above 0 are needed")
    slip = np.linspace(0.0, float(np.quantile(size, DRIVEN_QUANTILE)), points)
    model = get_model(model)
    if original is None:
        original = model.base if isinstance(model, AugmentedModel) else model
    force, file = (axle_force(candidate, vehicle, axle, slip) for candidate in (model, original))
    rows = [axle_force(candidate, vehicle, axle, slip) for candidate in draws]
    low, high = np.quantile(rows, (0.5 - 0.5 * level, 0.5 + 0.5 * level), axis=0) if rows else (force, force)
    counts = np.histogram(size, slip)[0]
    return AxleCurve(axle, slip, force, np.minimum(low, force), np.maximum(high, force), file,
                     counts / max(int(counts.sum()), 1), level)


def draw_models(model: AugmentedModel, covariance: np.ndarray, vehicle: VehicleParameters, count: int = 200,
                seed: int = 0) -> list[AugmentedModel]:
    """Models with values drawn from a normal distribution about those of `model`, within the bounds of each parameter.

    covariance: (p, p) of `model.vector` [SI]; rows of zeros for what is constant. vehicle: draws outside the limits of
    a vehicle file are dropped. Raises StCoreError for fewer than MIN_DRAWS: the uncertainty is as wide as the bounds.
    """
    low, high = np.array([p.bounds for _, p in model.free]).T.reshape(2, -1)
    values = np.random.default_rng(seed).multivariate_normal(model.vector, covariance, count, method="eigh")
    models = []
    for row in np.clip(values, low, high):
        candidate = model.with_vector(row.tolist())
        try:
            candidate.parameters(vehicle)
        except ConfigurationError:
            continue
        models.append(candidate)
    if len(models) < MIN_DRAWS:
        raise StCoreError(f"{len(models)} of {count} drawn parameter sets are valid cars; {MIN_DRAWS} are needed")
    return models


def force_error(model: str | Model, vehicle: VehicleParameters, samples: AxleSamples, bins: int = 12) -> float:
    """Root mean square difference of a model's axle force and the measured one over the slip, over the peak [1].

        sqrt(mean over bins of (F_model(alpha) - mean F)^2) / max |mean F|

    The bins of `AxleSamples.binned` divide the driven |slip| evenly, so that straights do not outweigh bends.
    """
    slip, force = samples.binned(bins)
    return float(np.sqrt(np.mean((axle_force(model, vehicle, samples.axle, slip) - force) ** 2)) / force.max())
