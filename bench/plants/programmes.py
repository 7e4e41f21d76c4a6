"""Programmes of steering and pedals for the drives of the cases, composed of the manoeuvres of `st_core`.

Steering is open loop, so that any car can drive the same programme, except on roads, where the driver keeps the
heading. The size of a manoeuvre is the lateral acceleration that the nominal car would reach. Random manoeuvres are
shorter than those that `st discover` suggests.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from scipy.signal import lfilter
from st_core import manoeuvres as standard
from st_core.manoeuvres import CATALOGUE, UNDERSTEER_GRADIENT, Manoeuvre
from st_core.vehicle import VehicleParameters

from .leaf import Programme

DT = 0.01
HEADING_GAIN = 0.3
SPEED_CHANGE = 2.5  # m/s^2, acceleration between two manoeuvres
STRAIGHT = 0.6  # s, minimum duration of straight driving before each manoeuvre
ENTRY_TIME = 0.5  # s for steering into a manoeuvre that begins in a bend
TREMOR, TREMOR_TIME = 0.01, 0.4  # standard deviation at the steering wheel [rad] and time constant [s] of the tremor


@dataclass
class Builder:
    """Collects the parts of a programme, with steering wheel angles of the nominal car."""

    car: VehicleParameters
    generator: np.random.Generator
    speed: float
    rows: list[np.ndarray] = field(default_factory=list)
    heading: float = 0.0

    def add(self, angle: np.ndarray, speed: np.ndarray | float | None = None, closed: bool = False) -> None:
        """Adds a part. angle: road wheel angle [rad]; speed [m/s], by default the current one; closed: the
        driver controls the heading."""
        speeds = np.broadcast_to(self.speed if speed is None else speed, angle.shape)
        curvature = angle / (self.car.wheelbase + UNDERSTEER_GRADIENT * speeds**2)
        turned = self.heading + np.cumsum(curvature * speeds) * DT
        gain = np.full(len(angle), HEADING_GAIN if closed else 0.0)
        slope = np.gradient(speeds, DT) if len(speeds) > 1 else np.zeros(len(speeds))
        self.rows.append(np.stack([angle * self.car.steering_ratio, turned, gain, speeds, slope]))
        self.speed, self.heading = float(speeds[-1]), float(turned[-1])

    def drive(self, manoeuvre: Manoeuvre, seconds: float | None = None) -> None:
        """Adds a manoeuvre that begins at the current speed. seconds: its duration, by default one period."""
        time = _time(manoeuvre.period if seconds is None else seconds)
        angle = manoeuvre.steering(time, self.car.wheelbase)
        if manoeuvre.profile(np.zeros(1))[0]:
            angle *= np.minimum(time / ENTRY_TIME, 1.0)
        # A driver who brakes with a constant steering angle does not control the heading.
        self.add(angle, manoeuvre.speed_at(time), closed=manoeuvre.closed_loop and not manoeuvre.pedals)

    def random_side(self) -> int:
        return int(self.generator.choice([-1, 1]))

    def go_to(self, speed: float) -> None:
        """Adds straight driving with a change of speed."""
        count = max(round(STRAIGHT / DT), round(abs(speed - self.speed) / SPEED_CHANGE / DT))
        ramp = self.speed + np.clip(np.arange(1, count + 1) * DT * SPEED_CHANGE, 0, abs(speed - self.speed)) * np.sign(
            speed - self.speed)
        self.add(np.zeros(count), ramp, closed=True)

    def programme(self) -> Programme:
        steering_wheel, yaw, gain, speed, acceleration = np.concatenate(self.rows, axis=1)
        memory = np.exp(-DT / TREMOR_TIME)
        kicks = TREMOR * np.sqrt(1 - memory**2) * self.generator.standard_normal(len(steering_wheel))
        return Programme(steering_wheel + lfilter([1.0], [1.0, -memory], kicks), yaw, gain, speed, acceleration)

    def angle_for(self, lateral: float) -> float:
        """Road-wheel angle [rad] for a steady lateral acceleration [m/s^2]."""
        return lateral / self.speed**2 * (self.car.wheelbase + UNDERSTEER_GRADIENT * self.speed**2)


def _time(duration: float) -> np.ndarray:
    return np.arange(round(duration / DT)) * DT


def sweep(b: Builder, lateral: float) -> None:
    """Sine sweep of 9 s."""
    b.drive(standard.sweep(b.speed, lateral, 9.0, 0.0))


def steps(b: Builder, lateral: float) -> None:
    """Steps of 1.8 s to both sides."""
    b.drive(standard.step(b.speed, b.random_side() * lateral, 1.8, 1.0))


def slalom(b: Builder, lateral: float) -> None:
    """Three periods with a random frequency of 0.4 to 0.7 Hz."""
    b.drive(standard.slalom(b.speed, lateral, b.generator.uniform(0.4, 0.7), 3))


def weave(b: Builder, lateral: float) -> None:
    """One and a half periods."""
    b.drive(standard.weave(b.speed, lateral, 1.5))


def ramp_to_limit(b: Builder, lateral: float) -> None:
    """A ramp beyond the limit of friction to one side within 5 s, and back within 1 s."""
    b.drive(standard.ramp_to_limit(b.speed, b.random_side() * lateral, 5.0, 1.0, 0.0), 6.0)


def brake_in_turn(b: Builder, lateral: float) -> None:
    """2 s in a circle, then braking for 1.4 s and acceleration for 1.6 s."""
    b.drive(standard.brake_in_turn(b.speed, b.random_side() * lateral, 2.0, 4.0, b.speed - 4.0 * 1.4, 2.5, 1.6))


def circle(b: Builder, lateral: float) -> None:
    """A circle to one side for 4 s, with an entry and an exit of 2 s each."""
    b.drive(standard.circle(b.speed, b.random_side() * lateral, 4.0, 2.0), 8.0)


def slow_circle(b: Builder, lateral: float) -> None:
    """A circle that is entered so slowly that the yaw rate hardly changes."""
    b.drive(standard.circle(b.speed, b.random_side() * lateral, 2.0, 8.0), 18.0)


def ordinary(b: Builder, lateral: float, duration: float = 6.0) -> None:
    """A winding road with random smooth curvature, and a speed that varies by 10 %. lateral: root mean square."""
    time = _time(duration)
    waves = [(b.generator.uniform(0.08, 0.35), b.generator.uniform(0, 2 * np.pi)) for _ in range(4)]
    noise = sum(np.sin(2 * np.pi * f * time + phase) for f, phase in waves) / np.sqrt(2.0)
    speeds = b.speed * (1 + 0.1 * np.sin(2 * np.pi * time / duration))
    b.add(b.angle_for(lateral) * noise * np.minimum(time, 1.0), speeds, closed=True)


@dataclass(frozen=True)
class Part:
    """A manoeuvre, and the ranges of its random speed [m/s] and lateral acceleration [m/s^2]."""

    drive: Callable[[Builder, float], None]
    speed: tuple[float, float]
    lateral: tuple[float, float]


SWEEP = Part(sweep, (12.0, 16.0), (2.5, 4.0))
STEPS = Part(steps, (10.0, 14.0), (3.5, 5.0))
SLALOM = Part(slalom, (10.0, 13.0), (3.5, 5.0))
WEAVE = Part(weave, (12.0, 15.0), (0.5, 1.2))
LIMIT = Part(ramp_to_limit, (9.0, 12.0), (10.0, 14.0))
BRAKING = Part(brake_in_turn, (10.0, 12.0), (3.5, 4.5))
ORDINARY = Part(ordinary, (8.0, 14.0), (1.2, 2.0))
CIRCLE = Part(circle, (8.0, 12.0), (2.5, 3.5))
SLOW_CIRCLE = Part(slow_circle, (8.0, 10.0), (1.5, 2.5))

FULL = (SWEEP, LIMIT, BRAKING, ORDINARY)
EXTRA = (STEPS, SLALOM, WEAVE)


def _drive_all(b: Builder, lateral: float, manoeuvre: Manoeuvre) -> None:
    b.drive(manoeuvre, manoeuvre.duration)


def suggested_part(name: str) -> Part:
    """A manoeuvre of the catalogue, as `st discover` suggests it. Raises StopIteration for an unknown name."""
    one = next(m for m in CATALOGUE if m.name == name)
    return Part(partial(_drive_all, manoeuvre=one), (one.speed, one.speed), (one.lateral_acceleration,) * 2)


def make_programme(car: VehicleParameters, seed: tuple[int, ...], parts: tuple[Part, ...] | None = None,
                   speed_factor: float = 1.0, lateral_factor: float = 1.0) -> Programme:
    """A programme of about half a minute: parts in random order and size, by default FULL and one of EXTRA."""
    generator = np.random.default_rng(seed)
    if parts is None:
        parts = (*FULL, EXTRA[generator.integers(len(EXTRA))])
    order = generator.permutation(len(parts))
    b = Builder(car, generator, 10.0 * speed_factor)
    for part in (parts[i] for i in order):
        b.go_to(generator.uniform(*part.speed) * speed_factor)
        part.drive(b, generator.uniform(*part.lateral) * lateral_factor)
    b.go_to(b.speed)
    return b.programme()
