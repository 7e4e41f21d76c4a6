"""Lateral force of an axle in a model versus slip angle, with an uncertainty band, and its deviation from measurement.

    F(alpha) = (F_model(-alpha) - F_model(alpha)) / 2,   alpha >= 0

F_model is the axle force in the model's equations of motion in steady cornering with equal slip of both axles, without
forward acceleration and steering effects; offsets cancel. The slip angle is computed from the measured steering, as in
the regression, so compliance and roll steer change the curve. Checked by: test_axle_curve.py.
"""

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from ..augmented import AugmentedModel
from ..errors import ConfigurationError, StCoreError
from ..models import Model, get_model
from ..vehicle import VehicleParameters
from .cornering_stiffness import AXLES, SLIP_QUANTILE, AxleSamples

EVALUATION_SPEED = 20.0  # m/s, at which the curve is evaluated; above every minimum_slip_speed
MIN_DRAWS = 20  # minimum number of drawn models for a band
MAX_SECANT_STEPS = 6  # for the lateral acceleration; error of the force below 0.1 % at the bounds of roll steer
BAND = (0.05, 0.95)  # quantiles of the draws


@dataclass(frozen=True)
class ForceCurve:
    """Lateral force of an axle versus slip angle, within the range of the drives. slip: slip angle, >= 0 [rad]. force,
    low, high, file: force, its 90 % band, and force at the start of the search (vehicle file or reference), positive
    against the slip [N]. density: fraction of the driving between neighbouring values of slip."""

    axle: str
    slip: tuple[float, ...]
    force: tuple[float, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    file: tuple[float, ...]
    density: tuple[float, ...]


def compute_axle_forces(model: str | Model, vehicle: VehicleParameters,
                        slip: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Forces of the front and the rear axle that oppose slip angles >= 0 [rad], (n,) each [N]; see the module.

        v_y = l_r r + v tan(slip),   delta = atan((v_y + l_f r) / v) - slip,   r = a_y / v
        F_f cos(delta) = (l_r m a_y + I_z r_dot) / L,   F_r = (l_f m a_y - I_z r_dot) / L

    Raises StCoreError for a model without tyres.
    """
    model = get_model(model)
    if not model.has_tyres:
        raise StCoreError(f"{getattr(model, 'base', model).name}: this model has no axle forces")
    if isinstance(model, AugmentedModel):
        model = model.select_effects(e for e in model.effects if e.slot != "steering")
    slip = np.concatenate((-np.asarray(slip, float), slip))
    p, car = model.parameters(vehicle), model.effective_vehicle(vehicle)
    zero = np.zeros_like(slip)

    def compute_accelerations(a_y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(v_y_dot + v_x r [m/s^2], r_dot [rad/s^2], road wheel angle [rad]) of the model in a turn with this a_y."""
        r = a_y / EVALUATION_SPEED
        v_y = car.cg_to_rear_axle * r + EVALUATION_SPEED * np.tan(slip)
        angle = np.arctan((v_y + car.cg_to_front_axle * r) / EVALUATION_SPEED) - slip
        w = model.inputs(angle, zero, p, *(zero for _ in model.signals))
        rates = model.rhs(model.start_state((zero, zero, zero + EVALUATION_SPEED, v_y, zero, r), w, p), w, p)
        return rates[3] + EVALUATION_SPEED * r, rates[5], angle

    a_y, (resulting, yaw_acceleration, angle) = zero, compute_accelerations(zero)
    slope = zero
    for _ in range(MAX_SECANT_STEPS):
        last_a_y, last_resulting = a_y, resulting
        a_y = a_y + (resulting - a_y) / (1.0 - slope)
        resulting, yaw_acceleration, angle = compute_accelerations(a_y)
        change = a_y - last_a_y
        slope = np.divide(resulting - last_resulting, change, out=zero.copy(), where=np.abs(change) > 1e-9)
        if np.abs(resulting - a_y).max() < 1e-6:
            break
    force, moment = car.mass * resulting, car.yaw_inertia * yaw_acceleration
    front = ((car.cg_to_rear_axle * force + moment) / (car.wheelbase * np.cos(angle))).reshape(2, -1)
    rear = ((car.cg_to_front_axle * force - moment) / car.wheelbase).reshape(2, -1)
    return 0.5 * (front[0] - front[1]), 0.5 * (rear[0] - rear[1])


def compute_axle_force(model: str | Model, vehicle: VehicleParameters, axle: str, slip: np.ndarray) -> np.ndarray:
    """`compute_axle_forces` of one axle ("front" or "rear")."""
    return compute_axle_forces(model, vehicle, slip)[AXLES.index(axle)]


def make_axle_curve(model: str | Model, vehicle: VehicleParameters, axle: str, measured_slip: np.ndarray,
                    original: str | Model, draws: Iterable[Model] = (),
                    alternatives: Iterable[Model] = ()) -> ForceCurve:
    """The force curve of one axle with its band, at 41 slip angles up to the largest slip of the drives.

    measured_slip: (n,) slip angles of the axle [rad], either sign. draws: models from `draw_models`; the band is their
    central 90 % at each slip, extended to the curve and those of `alternatives`, other models that explain the drives.
    original: model at the start of the search, for `ForceCurve.file`. Raises StCoreError for fewer than two measured
    slip angles, or only zeros.
    """
    abs_slip = np.abs(np.asarray(measured_slip, float))
    abs_slip = abs_slip[np.isfinite(abs_slip)]
    if len(abs_slip) < 2 or not abs_slip.max() > 0.0:
        raise StCoreError(f"{axle} axle: {len(abs_slip)} measured slip angles; two are needed, not all 0")
    slip = np.linspace(0.0, float(np.quantile(abs_slip, SLIP_QUANTILE)), 41)
    force, file = (compute_axle_force(candidate, vehicle, axle, slip) for candidate in (model, original))
    rows = [compute_axle_force(candidate, vehicle, axle, slip) for candidate in draws]
    low, high = np.quantile(rows, BAND, axis=0) if rows else (force, force)
    curves = [force, *(compute_axle_force(candidate, vehicle, axle, slip) for candidate in alternatives)]
    counts = np.histogram(abs_slip, slip)[0]
    return ForceCurve(axle, *(tuple(values.tolist()) for values in (
        slip, force, np.min([low, *curves], axis=0), np.max([high, *curves], axis=0), file,
        counts / max(int(counts.sum()), 1))))


def draw_models(model: AugmentedModel, covariance: np.ndarray, vehicle: VehicleParameters,
                count: int) -> list[AugmentedModel]:
    """Models with values drawn from a normal distribution about those of `model`, within the bounds of each parameter.

    covariance: (p, p) of `model.vector` [SI]; rows of zeros for constants. vehicle: of `count` draws, those that change
    it beyond the limits of a vehicle file are dropped. Raises StCoreError if fewer than MIN_DRAWS draws are left.
    """
    low, high = np.array([p.bounds for _, p in model.free]).T.reshape(2, -1)
    values = np.random.default_rng(0).multivariate_normal(model.vector, covariance, count, method="eigh")
    models = select_valid_models([model.with_vector(row.tolist()) for row in np.clip(values, low, high)], vehicle)
    if len(models) < MIN_DRAWS:
        raise StCoreError(f"{len(models)} of {count} drawn parameter sets are within the limits of a vehicle file, "
                          f"{MIN_DRAWS} are needed: the values are too uncertain")
    return models


def select_valid_models(models: Iterable[AugmentedModel], vehicle: VehicleParameters) -> list[AugmentedModel]:
    """The models with values within the limits of a vehicle file."""
    valid = []
    for candidate in models:
        with suppress(ConfigurationError):
            candidate.parameters(vehicle)
            valid.append(candidate)
    return valid


def compute_force_error(model: str | Model, vehicle: VehicleParameters, samples: AxleSamples) -> float:
    """RMS difference between modelled and measured axle force versus slip, divided by the measured peak [1].

        sqrt(mean over bins of (F_model(alpha) - mean F)^2) / max (mean F),    mean F: mean measured force of a bin

    The bins of `AxleSamples.bin_forces` divide the measured |slip| evenly, so that straights do not outweigh bends.
    """
    slip, force = samples.bin_forces()
    return float(np.sqrt(np.mean((compute_axle_force(model, vehicle, samples.axle, slip) - force) ** 2)) / force.max())
