"""Programmes of steering and pedals, put together from the manoeuvres of `st_core`: what is driven in the cases.

Steering is open loop, so that the same programme can be driven by any car, except on roads, where the driver keeps the
heading as a driver does. Sizes are given as the lateral acceleration the nominal car would reach. Drawn manoeuvres are
shorter than those that are suggested.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from scipy.signal import lfilter
from st_core import manoeuvres as standard
from st_core.manoeuvres import CATALOGUE, UNDERSTEER, Manoeuvre
from st_sim.car import Car

from .compiled import Programme

DT = 0.01
HEADING_GAIN = 0.3
SPEED_CHANGE = 2.5
"""m/s^2 between two manoeuvres."""
STRAIGHT = 0.6
"""s of straight driving before each manoeuvre."""
INTO = 0.5
"""s in which the hands go in where a manoeuvre begins in a bend."""
TREMOR, TREMOR_TIME = 0.01, 0.4
"""rad at the steering wheel and s: of a driver who is never still."""


@dataclass
class Builder:
    """Collects parts; road-wheel angles become hand-wheel angles of the nominal car."""

    car: Car
    generator: np.random.Generator
    speed: float
    rows: list[np.ndarray] = field(default_factory=list)
    heading: float = 0.0

    def add(self, angle: np.ndarray, speed: np.ndarray | float | None = None, closed: bool = False) -> None:
        """angle: of the road wheels [rad]; speed [m/s], the present one if not given; closed: hold the heading."""
        speeds = np.broadcast_to(self.speed if speed is None else speed, angle.shape)
        curvature = angle / (self.car.wheelbase + UNDERSTEER * speeds**2)
        turned = self.heading + np.cumsum(curvature * speeds) * DT
        gain = np.full(len(angle), HEADING_GAIN if closed else 0.0)
        slope = np.gradient(speeds, DT) if len(speeds) > 1 else np.zeros(len(speeds))
        self.rows.append(np.stack([angle * self.car.steering_ratio, turned, gain, speeds, slope]))
        self.speed, self.heading = float(speeds[-1]), float(turned[-1])

    def drive(self, manoeuvre: Manoeuvre, seconds: float | None = None) -> None:
        """From the present speed, which is that of the manoeuvre. seconds: of it, one round if not given."""
        time = _time(manoeuvre.period if seconds is None else seconds)
        angle = manoeuvre.steering(time, self.car.wheelbase)
        if manoeuvre.profile(np.zeros(1))[0]:
            angle *= np.minimum(time / INTO, 1.0)
        # Hands that are still while braking do not look.
        self.add(angle, manoeuvre.speed_at(time), closed=manoeuvre.closed_loop and not manoeuvre.pedals)

    def side(self) -> int:
        return int(self.generator.choice([-1, 1]))

    def go_to(self, speed: float) -> None:
        """Straight on, to another speed."""
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
        return lateral / self.speed**2 * (self.car.wheelbase + UNDERSTEER * self.speed**2)


def _time(duration: float) -> np.ndarray:
    return np.arange(round(duration / DT)) * DT


def sweep(b: Builder, lateral: float) -> None:
    """Within 9 s."""
    b.drive(standard.sweep(b.speed, lateral, 9.0, 0.0))


def steps(b: Builder, lateral: float) -> None:
    """To each side for 1.8 s."""
    b.drive(standard.step(b.speed, b.side() * lateral, 1.8, 1.0))


def slalom(b: Builder, lateral: float) -> None:
    """Three waves of a frequency between 0.4 and 0.7 Hz."""
    b.drive(standard.slalom(b.speed, lateral, b.generator.uniform(0.4, 0.7), 3))


def weave(b: Builder, lateral: float) -> None:
    """One wave and a half."""
    b.drive(standard.weave(b.speed, lateral, 1.5))


def ramp_to_limit(b: Builder, lateral: float) -> None:
    """To beyond the limit of one side in 5 s, back in 1 s."""
    b.drive(standard.ramp_to_limit(b.speed, b.side() * lateral, 5.0, 1.0, 0.0), 6.0)


def brake_in_turn(b: Builder, lateral: float) -> None:
    """2 s of circle, braking for 1.4 s, power for 1.6 s."""
    b.drive(standard.brake_in_turn(b.speed, b.side() * lateral, 2.0, 4.0, b.speed - 4.0 * 1.4, 2.5, 1.6))


def circle(b: Builder, lateral: float) -> None:
    """4 s of one side, in and out of it within 2 s."""
    b.drive(standard.circle(b.speed, b.side() * lateral, 4.0, 2.0), 8.0)


def slow_circle(b: Builder, lateral: float) -> None:
    """As slowly that the yaw rate hardly changes."""
    b.drive(standard.circle(b.speed, b.side() * lateral, 2.0, 8.0), 18.0)


def ordinary(b: Builder, lateral: float, duration: float = 6.0) -> None:
    """A winding road: curvature as smooth noise, `lateral` its root mean square; speed up and down by a tenth."""
    time = _time(duration)
    waves = [(b.generator.uniform(0.08, 0.35), b.generator.uniform(0, 2 * np.pi)) for _ in range(4)]
    noise = sum(np.sin(2 * np.pi * f * time + phase) for f, phase in waves) / np.sqrt(2.0)
    speeds = b.speed * (1 + 0.1 * np.sin(2 * np.pi * time / duration))
    b.add(b.angle_for(lateral) * noise * np.minimum(time, 1.0), speeds, closed=True)


@dataclass(frozen=True)
class Part:
    """One manoeuvre and the ranges its speed [m/s] and lateral acceleration [m/s^2] are drawn from."""

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


def _whole(b: Builder, lateral: float, manoeuvre: Manoeuvre) -> None:
    b.drive(manoeuvre, manoeuvre.duration)


def suggested_part(name: str) -> Part:
    """A drive of the catalogue as suggested. Raises StopIteration for an unknown name."""
    one = next(m for m in CATALOGUE if m.name == name)
    return Part(partial(_whole, manoeuvre=one), (one.speed, one.speed), (one.lateral, one.lateral))


def make_programme(car: Car, seed: tuple[int, ...], parts: tuple[Part, ...] | None = None, speed_factor: float = 1.0,
                   lateral_factor: float = 1.0) -> Programme:
    """A run of about half a minute: the parts in random order and size. None: FULL and one of EXTRA."""
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
