"""Choice of the manoeuvre of the catalogue that best separates alternative effects, or best excites one effect."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..augmented import AugmentedModel, augment
from ..errors import StCoreError
from ..handling import stability_factor
from ..log import OPTIONAL_INS_SIGNALS, DriveLog
from ..manoeuvres import CATALOGUE, Manoeuvre
from ..models import Model
from ..prediction import predict
from ..readings import correct_steering, predict_ideal_readings
from ..types import InputSequence, VehicleState
from ..vehicle import VehicleParameters
from .evidence import inverse
from .fit import Fit, Problem
from .loss import Errors, Loss
from .result import FoundEffect, NextManoeuvre, Separability
from .windows import MAX_GAP, STEP, Windows, specific_force_excess

REPETITIONS = 3  # drives of each manoeuvre, the minimum in ISO 7401
MIN_SEPARATION = 3.0  # standard deviations; a pair with a smaller separation counts as not separated
MAX_SPEED_RATIO = 1.15  # of manoeuvre speed to recorded speed; model errors at higher speed are unknown
MAX_LATERAL_ACCELERATION = 9.0  # m/s^2; above it the simulation with the base model is unreliable
PERIOD = STEP / 2  # s, sampling period of the simulated log
LEAD_TIME = 4.0  # s before a manoeuvre, to reach its initial steering angle

Curvatures = Mapping[str, np.ndarray]  # curvature (p, p) that a manoeuvre adds to the loss, by its name


def simulate_drive(manoeuvre: Manoeuvre, model: AugmentedModel, vehicle: VehicleParameters) -> DriveLog:
    """Log of a manoeuvre, simulated with noise-free sensors and sampled every PERIOD. The steering compensates for the
    understeer of the vehicle file, to reach the target lateral acceleration."""
    lead, steps = round(LEAD_TIME / PERIOD), round(manoeuvre.duration / PERIOD)
    times = 0.5 * PERIOD * np.arange(-2 * lead, 2 * steps + 1)  # the integration also needs the middle of each step
    understeer = max(vehicle.wheelbase * stability_factor(vehicle), 0.0)
    since_start = np.maximum(times, 0.0)
    angle = manoeuvre.steering(since_start, vehicle.wheelbase, understeer)
    angle = angle * np.clip(2.0 * (1.0 + times / LEAD_TIME), 0.0, 1.0)  # rises in the first half of the lead time
    forward = np.where(times < 0.0, 0.0, manoeuvre.acceleration_at(since_start))
    start = VehicleState(0.0, 0.0, manoeuvre.speed, 0.0, 0.0, 0.0)
    times_ns = np.round((times + LEAD_TIME) * 1e9).astype(np.int64)
    road_wheel_angle = np.interp(times_ns, *correct_steering(model, times_ns, angle, MAX_GAP))
    path = predict(model, vehicle, start, InputSequence(road_wheel_angle, forward), (lead + steps) * PERIOD, PERIOD)
    states = tuple(path.states[lead:].T)
    ideal = predict_ideal_readings(model, vehicle, states)
    a_y = np.gradient(ideal.velocity_y, PERIOD) + ideal.velocity_x * ideal.yaw_rate
    log_samples = slice(2 * lead, None, 2)
    excess = specific_force_excess(model, vehicle, states, road_wheel_angle[log_samples], forward[log_samples])
    readings = model.observe(ideal._replace(acceleration_x=0.0 * a_y, acceleration_y=a_y + excess))
    time_ns = times_ns[log_samples] - times_ns[2 * lead]
    return DriveLog(manoeuvre.name, time_ns, *readings[:6],  # x, y, yaw, velocities, yaw rate
                    time_ns, angle[log_samples].copy(), acceleration_x=readings.acceleration_x,
                    acceleration_y=readings.acceleration_y)


def simulate_manoeuvres(windows: Windows, base: Model) -> Iterator[tuple[Manoeuvre, Windows]]:
    """Yields (manoeuvre, its windows before MAX_LATERAL_ACCELERATION is exceeded), for manoeuvres that the base model
    can drive, up to MAX_SPEED_RATIO times the recorded speed. Manoeuvres can be compared without effects."""
    model = augment(base, {})
    fastest = MAX_SPEED_RATIO * float(np.nanquantile(windows.speeds, 0.95))
    settings = replace(windows.settings, windows=50)
    for manoeuvre in CATALOGUE:
        if manoeuvre.speed > fastest:
            continue
        try:
            log = simulate_drive(manoeuvre, model, windows.vehicle)
        except StCoreError:
            continue  # the base model spins
        is_beyond_limit = np.abs(log.velocity_x * log.yaw_rate) > MAX_LATERAL_ACCELERATION
        if is_beyond_limit.any():
            log = log.slice(0, int(log.ins_time_ns[max(int(np.argmax(is_beyond_limit)) - 1, 1)]))
        if log.overlap < settings.horizon + 3.0:
            continue
        missing: dict[str, Any] = {n: None for n in OPTIONAL_INS_SIGNALS if getattr(windows.joined_log, n) is None}
        simulated_windows = Windows([replace(log, **missing)], windows.vehicle, settings)
        if len(simulated_windows):
            yield manoeuvre, simulated_windows


def simulate_catalogue(problem: Problem, fit: Fit) -> Curvatures:
    """Curvatures of the loss at the values of a fit, for REPETITIONS drives of each manoeuvre."""
    space, curvatures = problem.space, {}
    for manoeuvre, simulated_windows in simulate_manoeuvres(problem.errors.windows, space.model.base):
        loss = Loss(Errors(simulated_windows, space, problem.errors.threads), fit.vector)
        loss.scale = problem.loss.scale
        no_errors = np.zeros_like(loss.errors.at(fit.vector))
        q = loss.quadratic(no_errors, loss.sensitivities(fit.vector, np.arange(len(space))))
        curvatures[manoeuvre.name] = REPETITIONS * q.hessian.sum(axis=0)
    return curvatures


def compute_separation(problem: Problem, fit: Fit, h: np.ndarray, first: str, second: str,
                       design_effect: float) -> tuple[float, float]:
    """(cosine similarity of the error changes that two effects cause, part of `first` that `second` and the other
    effects of the fit do not explain [standard deviations of the noise]), for a curvature h (p, p) at a fit."""
    indices, other_indices = problem.space.indices(first), problem.space.indices(second)
    others = (n for n in fit.names if n != first)
    free = np.setdiff1d(problem.free_indices((*others, second)), indices)
    d = problem.distance(fit.vector)[indices]
    curvature = h[np.ix_(indices, indices)]
    cross = h[np.ix_(indices, free)] @ inverse(h[np.ix_(free, free)])
    unexplained_square = float(d @ (curvature - cross @ h[np.ix_(free, indices)]) @ d)
    other_curvature = h[np.ix_(other_indices, other_indices)]
    e = inverse(other_curvature) @ h[np.ix_(other_indices, indices)] @ d
    sizes = np.sqrt(max(float(d @ curvature @ d), 1e-12) * max(float(e @ other_curvature @ e), 1e-12))
    cosine = float(d @ h[np.ix_(indices, other_indices)] @ e) / sizes
    return float(np.clip(cosine, -1.0, 1.0)), float(np.sqrt(max(2.0 * unexplained_square / design_effect, 0.0)))


def list_separabilities(problem: Problem, fit: Fit, effects: Sequence[FoundEffect],
                        design_effect: float) -> tuple[Separability, ...]:
    """Separability of every reported effect from its alternatives in these drives."""
    h = problem.full_quadratic(fit.vector).hessian.sum(axis=0)
    return tuple(Separability(e.name, other, *compute_separation(problem, fit, h, e.name, other, design_effect))
                 for e in effects for other in e.alternatives)


def choose_manoeuvre(problem: Problem, fit: Fit, separabilities: Sequence[Separability], curvatures: Curvatures,
                     design_effect: float) -> NextManoeuvre | None:
    """The manoeuvre with the largest minimum separation over all pairs that these drives separate by less than
    MIN_SEPARATION. None if no manoeuvre reaches MIN_SEPARATION, or if there is no such pair: alternatives then remain
    because of model errors, which more driving does not reduce."""
    pairs = [(s.first, s.second) for s in separabilities if s.strength < MIN_SEPARATION]
    if not pairs:
        return None
    h = problem.full_quadratic(fit.vector).hessian.sum(axis=0)
    weakest = {name: min((compute_separation(problem, fit, h + curvature, *pair, design_effect)[1], pair)
                         for pair in pairs) for name, curvature in curvatures.items()}
    name = max(weakest, key=lambda n: weakest[n][0], default="")
    if not name or weakest[name][0] < MIN_SEPARATION:
        return None
    strength, pair = weakest[name]
    manoeuvre = next(m for m in CATALOGUE if m.name == name)
    reason = ("of all manoeuvres simulated at these speeds, it has the largest separation of the least separated pair, "
              f"here {pair[0]} and {pair[1]}")
    return NextManoeuvre(name, pair, strength, {n: s for n, (s, _) in weakest.items()}, REPETITIONS, manoeuvre.duration,
                         manoeuvre.speed, reason)


def find_most_informative(problem: Problem, effect: str, curvatures: Curvatures) -> str:
    """Name of the manoeuvre with the most information on an effect, or ""."""
    indices = problem.space.indices(effect)
    others = np.setdiff1d(problem.free_indices(()), indices)
    largest = {}
    for name, h in curvatures.items():
        cross = h[np.ix_(indices, others)] @ inverse(h[np.ix_(others, others)])
        information = h[np.ix_(indices, indices)] - cross @ h[np.ix_(others, indices)]
        largest[name] = float(np.diag(information).max())
    return max(largest, key=largest.__getitem__, default="")
