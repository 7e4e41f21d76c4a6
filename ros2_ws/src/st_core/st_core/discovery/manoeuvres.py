"""The drive that would tell the names of an ambiguous answer apart: a catalogue, simulated with the models at hand."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from ..augmented import AugmentedModel
from ..log import DriveLog
from ..prediction import predict
from ..readings import corrected_steering, readings
from ..types import InputSequence, VehicleState
from ..vehicle import VehicleParameters
from .choice import unsure
from .floor import drifts, precision
from .quadratic import jacobian, quadratic, row_errors
from .result import FoundEffect, NextManoeuvre
from .study import Fit, Study
from .windows import STEP, MotionOnly, Windows, added_acceleration

TIMES = 3  # each manoeuvre is driven, as ISO asks for
TOLD = 4.0  # standard deviations a pair must be put apart
MARGIN = 0.15  # of the speeds usually driven: further off nobody has seen how large errors are
PERIOD = STEP / 2  # s, of the simulated log
MOST_LATERAL = 9.0  # m/s^2


@dataclass(frozen=True)
class Manoeuvre:
    """steering(t) -> road wheel angle [rad]; braking(t) -> forward acceleration [m/s^2]; speed at the start [m/s].

    name: the scenario of the virtual car that drives it.
    """

    name: str
    speed: float
    duration: float
    steering: Callable[[float], float]
    forward: Callable[[float], float] = lambda t: 0.0


def _sweep(t: float, low: float = 0.2, high: float = 2.8, length: float = 26.0) -> float:
    rate = math.log(high / low) / length
    return 0.055 * math.sin(2 * math.pi * low / rate * (math.exp(rate * t) - 1.0)) if t < length else 0.0


def _steps(t: float) -> float:
    t %= 14.0
    return 0.0 if t < 3.0 or 7.0 <= t < 10.0 else 0.09 if t < 7.0 else -0.09


def _ramp(t: float) -> float:
    half, t = divmod(t, 16.0)
    return (1.0 if half % 2 == 0 else -1.0) * 0.016 * min(t, 15.0 * max(0.0, 16.0 - t))


def _turn(t: float) -> float:
    return 0.105


def _brake(t: float) -> float:
    t %= 16.0
    return -4.0 if 8.0 <= t < 9.9 else 2.0 if 10.5 <= t < 14.3 else 0.0


CATALOGUE = (
    Manoeuvre("sweep", 14.0, 30.0, _sweep),
    Manoeuvre("step", 12.0, 28.0, _steps),
    Manoeuvre("ramp_to_limit", 11.0, 32.0, _ramp),
    Manoeuvre("brake_in_turn", 11.0, 32.0, _turn, _brake),
    Manoeuvre("lane_change", 12.0, 30.0, lambda t: 0.05 * math.sin(2 * math.pi * 0.35 * t)),
    Manoeuvre("S1", 4.0, 60.0, lambda t: 0.23 * math.tanh(3.0 * math.sin(2 * math.pi * t / 34.0))),
    Manoeuvre("circle", 6.6, 20.0, lambda t: 0.24),
)


def drive(manoeuvre: Manoeuvre, model: AugmentedModel, vehicle: VehicleParameters) -> DriveLog:
    """What sensors without noise would record if the car were the model."""
    steps = round(manoeuvre.duration / PERIOD)
    times = 0.5 * PERIOD * np.arange(2 * steps + 1)
    angle = np.array([manoeuvre.steering(t) for t in times])
    forward = np.array([manoeuvre.forward(t) for t in times])
    start = VehicleState(0.0, 0.0, manoeuvre.speed, 0.0, 0.0, 0.0)
    times_ns = np.round(times * 1e9).astype(np.int64)
    wheels = np.interp(times_ns, *corrected_steering(model, times_ns, angle, 0.1))
    path = predict(model, vehicle, start, InputSequence(wheels, forward), steps * PERIOD, PERIOD)
    true = readings(MotionOnly(model), vehicle, tuple(path.states.T))
    a_y = np.gradient(true.velocity_y, PERIOD) + true.velocity_x * true.yaw_rate
    felt = added_acceleration(model, vehicle, tuple(path.states.T), wheels[::2], forward[::2])
    seen = model.observe(true._replace(acceleration_x=0.0 * a_y, acceleration_y=a_y + felt))
    return DriveLog(manoeuvre.name, times_ns[::2].copy(), seen.x, seen.y, seen.yaw, seen.velocity_x, seen.velocity_y,
                    seen.yaw_rate, times_ns[::2].copy(), angle[::2].copy(), acceleration_x=seen.acceleration_x,
                    acceleration_y=seen.acceleration_y)


def following(study: Study, effects: Sequence[FoundEffect], fits: Mapping[str, Fit]) -> NextManoeuvre | None:
    """The manoeuvre with the largest smallest strength over all pairs of the ambiguous answer; None without a pair, or
    where none at speeds like those driven reaches TOLD."""
    pairs = [pair for e in effects for pair in combinations((e.name, *e.alternatives), 2)
             if all(name in fits for name in pair)]
    if not pairs:
        return None
    weakest = {}
    slowest, fastest = np.nanquantile(study.windows.speeds, (0.05, 0.95)) * (1.0 - MARGIN, 1.0 + MARGIN)
    for manoeuvre in (m for m in CATALOGUE if slowest <= m.speed <= fastest):
        strengths = _strengths(study, manoeuvre, pairs, fits)
        if strengths:
            pair = min(strengths, key=strengths.get)
            weakest[manoeuvre.name] = (strengths[pair], pair)
    if not weakest:
        return None
    name = max(weakest, key=lambda n: weakest[n][0])
    strength, pair = weakest[name]
    if strength < TOLD:
        return None
    chosen = next(m for m in CATALOGUE if m.name == name)
    return NextManoeuvre(
        name=name, scenario=name, separates=pair, strength=strength, options={n: s for n, (s, _) in weakest.items()},
        times=TIMES, duration=chosen.duration, speed=chosen.speed,
        reason=f"{pair[0]} and {pair[1]} differ most there of all manoeuvres of the catalogue")


def _strengths(study: Study, manoeuvre: Manoeuvre, pairs, fits: Mapping[str, Fit]) -> dict:
    space, floor = study.space, study.floor
    log = drive(manoeuvre, space.at(floor.vector), study.windows.vehicle)
    lateral = np.abs(log.velocity_x * log.yaw_rate)
    if not np.isfinite(lateral).all():
        return {}
    fine = lateral <= MOST_LATERAL
    if not fine.all():
        log = log.slice(0, int(log.ins_time_ns[max(int(np.argmin(fine)) - 1, 1)]))
    if log.overlap < study.settings.horizon + 3.0:
        return {}
    windows = Windows([log], study.windows.vehicle, study.settings)
    if not len(windows):
        return {}
    rows = row_errors(windows, space, floor.vector)
    q = quadratic(0.0 * rows, jacobian(windows, space, floor.vector, rows), windows, floor.how)
    h = (study.quadratic.hessian.sum(0) + TIMES * q.hessian.sum(0)) / floor.inflation
    healthy = drifts(space, study.settings.drift, "velocity_y" in windows.columns, floor.restless)
    spread = np.diag(np.square(healthy) + 1e-6)
    result = {}
    for first, second in pairs:
        left = []
        for a, b in ((first, second), (second, first)):
            own = space.indices(a)
            d = np.zeros(len(space))
            d[own] = ((fits[a].vector - floor.vector) / space.scale)[own]
            g = h @ d
            gain, rest = (d @ g - g @ np.linalg.solve(h + precision(spread, space.indices(*names)), g)
                          for names in ((), (b,)))
            # What the equations of an effect are not those of a car counts there as it does in the choice.
            left.append(rest if rest > unsure(a, b) * gain else 0.0)
        result[first, second] = float(np.sqrt(max(min(left), 0.0)))
    return result
