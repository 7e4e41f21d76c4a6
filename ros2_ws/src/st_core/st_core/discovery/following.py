"""The drive to do next: which of the catalogue would separate the names of an answer, or show an effect at all."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..augmented import AugmentedModel, augment
from ..errors import StCoreError
from ..handling import understeer_coefficient
from ..log import OPTIONAL_INS_SIGNALS, DriveLog
from ..manoeuvres import CATALOGUE, Manoeuvre
from ..models import Model
from ..prediction import predict
from ..readings import correct_steering, faultless_readings
from ..types import InputSequence, VehicleState
from ..vehicle import VehicleParameters
from .evidence import inverse
from .fit import Fit, Problem
from .loss import Errors, Loss
from .result import FoundEffect, NextManoeuvre, Separability
from .windows import STEP, Windows, added_acceleration

REPETITIONS = 3  # each manoeuvre is driven, the minimum of ISO 7401
MIN_SEPARATION = 3.0  # standard deviations a pair must be put apart
MAX_SPEED_RATIO = 1.15  # times the speed driven: the size of errors further off is unknown
MAX_LATERAL_ACCELERATION = 9.0  # m/s^2: beyond that the simulation of the base is unreliable
PERIOD = STEP / 2
"""s, of the simulated log."""
LEAD_TIME = 4.0  # s before a manoeuvre, in which the steering reaches its first angle
"""s before the start in which the hands come to where they are at the start, so that the drive begins steadily."""


def drive(manoeuvre: Manoeuvre, model: AugmentedModel, vehicle: VehicleParameters) -> DriveLog:
    """What sensors without noise would record if the car were the model: `duration` seconds at 1 / PERIOD.

    Hands as the understeer of the vehicle file requires, so that the lateral acceleration aimed at is reached.
    """
    lead, steps = round(LEAD_TIME / PERIOD), round(manoeuvre.duration / PERIOD)
    times = 0.5 * PERIOD * np.arange(-2 * lead, 2 * steps + 1)
    understeer = max(vehicle.wheelbase * understeer_coefficient(vehicle), 0.0)
    begun = np.maximum(times, 0.0)
    angle = manoeuvre.steering(begun, vehicle.wheelbase, understeer) * np.clip(2.0 + times / LEAD_TIME * 2.0, 0.0, 1.0)
    forward = np.where(times < 0.0, 0.0, manoeuvre.forward(begun))
    start = VehicleState(0.0, 0.0, manoeuvre.speed, 0.0, 0.0, 0.0)
    times_ns = np.round((times + LEAD_TIME) * 1e9).astype(np.int64)
    wheels = np.interp(times_ns, *correct_steering(model, times_ns, angle, 0.1))
    path = predict(model, vehicle, start, InputSequence(wheels, forward), (lead + steps) * PERIOD, PERIOD)
    states = tuple(path.states[lead:].T)
    true = faultless_readings(model, vehicle, states)
    a_y = np.gradient(true.velocity_y, PERIOD) + true.velocity_x * true.yaw_rate
    kept = slice(2 * lead, None, 2)
    specific_force = added_acceleration(model, vehicle, states, wheels[kept], forward[kept])
    true = true._replace(acceleration_x=0.0 * a_y, acceleration_y=a_y + specific_force)
    seen = model.observe(true)
    time_ns = times_ns[kept] - times_ns[2 * lead]
    return DriveLog(manoeuvre.name, time_ns, seen.x, seen.y, seen.yaw, seen.velocity_x, seen.velocity_y, seen.yaw_rate,
                    time_ns, angle[kept].copy(), acceleration_x=seen.acceleration_x, acceleration_y=seen.acceleration_y)


@dataclass(frozen=True, eq=False)
class Catalogue:
    """Curvature of the loss, (p, p), that each manoeuvre adds when driven REPETITIONS times, by its name."""

    curvature: dict[str, np.ndarray]


def simulated(windows: Windows, base: Model) -> Iterator[tuple[Manoeuvre, Windows]]:
    """All manoeuvres at speeds like those driven, simulated with the bare base model: size and kind of the motion are
    what matters here. The windows of one drive each, with the channels that were recorded."""
    model = augment(base, {})
    fastest = MAX_SPEED_RATIO * float(np.nanquantile(windows.speeds, 0.95))
    settings = replace(windows.settings, windows=50)
    for manoeuvre in CATALOGUE:
        if manoeuvre.speed > fastest:
            continue
        try:
            log = drive(manoeuvre, model, windows.vehicle)
        except StCoreError:
            continue  # the base spins there
        lateral = np.abs(log.velocity_x * log.yaw_rate)
        if (lateral > MAX_LATERAL_ACCELERATION).any():
            log = log.slice(0, int(log.ins_time_ns[max(int(np.argmax(lateral > MAX_LATERAL_ACCELERATION)) - 1, 1)]))
        if log.overlap < settings.horizon + 3.0:
            continue
        unknown: dict[str, Any] = {n: None for n in OPTIONAL_INS_SIGNALS if getattr(windows.joined, n) is None}
        driven = Windows([replace(log, **unknown)], windows.vehicle, settings)
        if len(driven):
            yield manoeuvre, driven


def catalogue(problem: Problem, fit: Fit) -> Catalogue:
    """What every manoeuvre would show."""
    space, result = problem.space, {}
    for manoeuvre, driven in simulated(problem.errors.windows, space.model.base):
        loss = Loss(Errors(driven, space, problem.errors.threads), fit.vector)
        loss.scale = problem.loss.scale
        rows = loss.errors.at(fit.vector)
        q = loss.quadratic(0.0 * np.nan_to_num(rows), loss.slopes(fit.vector, np.arange(len(space))))
        result[manoeuvre.name] = REPETITIONS * q.hessian.sum(axis=0)
    return Catalogue(result)


def apart(h: np.ndarray, problem: Problem, rest: Sequence[str], first: str, second: str, values: np.ndarray,
          design: float) -> tuple[float, float]:
    """(cosine of the signatures, what `second` leaves of `first` in standard deviations) under a curvature. values:
    (p,) deviation of `first` from its null in usual sizes."""
    own, other = problem.space.indices(first), problem.space.indices(second)
    free = np.setdiff1d(problem.which((*rest, second)), own)
    d = values[own]
    inside = h[np.ix_(own, own)]
    cross = h[np.ix_(own, free)] @ inverse(h[np.ix_(free, free)])
    left = float(d @ (inside - cross @ h[np.ix_(free, own)]) @ d)
    e = inverse(h[np.ix_(other, other)]) @ h[np.ix_(other, own)] @ d
    sizes = np.sqrt(max(float(d @ inside @ d), 1e-12) * max(float(e @ h[np.ix_(other, other)] @ e), 1e-12))
    cosine = float(d @ h[np.ix_(own, other)] @ e) / sizes
    return float(np.clip(cosine, -1.0, 1.0)), float(np.sqrt(max(2.0 * left / design, 0.0)))


def separability(problem: Problem, fit: Fit, effects: Sequence[FoundEffect], design: float) -> tuple[Separability, ...]:
    """Of every stated name and its alternatives, in the drives at hand."""
    h = _curvature(problem, fit)
    values = (fit.vector - problem.space.null) / problem.space.scale
    collected = []
    for effect in effects:
        rest = tuple(n for n in fit.names if n != effect.name)
        for other in effect.alternatives:
            collected.append(Separability(effect.name, other,
                                     *apart(h, problem, rest, effect.name, other, values, design)))
    return tuple(collected)


def following(problem: Problem, fit: Fit, effects: Sequence[FoundEffect], driven: Catalogue,
              design: float) -> NextManoeuvre | None:
    """The manoeuvre with the largest smallest strength over all pairs; None where none reaches MIN_SEPARATION."""
    pairs = [(e.name, other) for e in effects for other in e.alternatives]
    if not pairs:
        return None
    h = _curvature(problem, fit)
    values = (fit.vector - problem.space.null) / problem.space.scale
    weakest = {}
    for name, more in driven.curvature.items():
        strengths = {}
        for first, second in pairs:
            rest = tuple(n for n in fit.names if n != first)
            strengths[first, second] = apart(h + more, problem, rest, first, second, values, design)[1]
        pair = min(strengths, key=strengths.__getitem__)
        weakest[name] = strengths[pair], pair
    name = max(weakest, key=lambda n: weakest[n][0], default="")
    if not name or weakest[name][0] < MIN_SEPARATION:
        return None
    strength, pair = weakest[name]
    chosen = next(m for m in CATALOGUE if m.name == name)
    return NextManoeuvre(name, pair, strength, {n: s for n, (s, _) in weakest.items()}, REPETITIONS, chosen.duration,
                         chosen.speed, f"{pair[0]} and {pair[1]} differ most there of all manoeuvres of the catalogue")


def shows(problem: Problem, effect: str, driven: Catalogue) -> str:
    """The manoeuvre in which a usual size of an effect is clearest; "" without any."""
    own = problem.space.indices(effect)
    strength = {}
    for name, h in driven.curvature.items():
        others = np.setdiff1d(problem.which(()), own)
        left = h[np.ix_(own, own)]
        if len(others):
            left = left - h[np.ix_(own, others)] @ inverse(h[np.ix_(others, others)]) @ h[np.ix_(others, own)]
        strength[name] = float(np.diag(left).max())
    return max(strength, key=strength.__getitem__, default="")


def _curvature(problem: Problem, fit: Fit) -> np.ndarray:
    q = problem.loss.quadratic(problem.errors.at(fit.vector), problem.everything(fit.vector).values)
    return q.hessian.sum(axis=0)
