"""Road and air around the car: friction, slopes, wind; each depends on where the car is or on the time."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from .settings import Settings

WAVE_LENGTH = 80.0
PATCH_LENGTH, PATCH_PERIOD = 10.0, 40.0
GUST_TIME = 1.5


class Surroundings(NamedTuple):
    """What the car meets now.

    bank_angle: road rises to the left; grade_angle: road rises ahead [rad]. Wind over ground, in map axes.
    """

    friction: float
    bank_angle: float
    grade_angle: float
    wind_x: float
    wind_y: float


class Environment:
    """Surroundings at a place and time.

    Gusts are a seeded Ornstein-Uhlenbeck process that advances with `at`, once per step.
    """

    def __init__(self, settings: Settings, step: float, seed: int):
        self._friction = settings["friction_factor"]
        self._patch = settings["friction_patch"]
        self._bank, self._grade = settings["bank_angle"], settings["grade_angle"]
        self._hillside, self._wave = settings["hillside_slope"], settings["terrain_wave"]
        self._wind, self._gust_sigma = settings["wind_speed"], settings["gust_speed"]
        self._memory = math.exp(-step / GUST_TIME)
        self._gust = [0.0, 0.0]
        self._draw = normal_stream(np.random.default_rng([seed, 1]))
        self._level = not (self._hillside or self._wave)
        self._calm = not (self._wind or self._gust_sigma)
        self._constant = Surroundings(self._friction, self._bank, self._grade, 0.0, 0.0)
        self._everywhere = self._level and self._calm and self._patch == 1.0

    @property
    def calm(self) -> bool:
        return self._calm

    def at(self, x: float, y: float, yaw: float) -> Surroundings:
        if self._everywhere:
            return self._constant
        friction = self._friction * (self._patch if x % PATCH_PERIOD < PATCH_LENGTH else 1.0)
        bank, grade = self._bank, self._grade
        if not self._level:
            east, north = self._wave * math.sin(2 * math.pi * x / WAVE_LENGTH), self._hillside
            c, s = math.cos(yaw), math.sin(yaw)
            grade += east * c + north * s
            bank += north * c - east * s
        if self._gust_sigma:
            kick = self._gust_sigma * math.sqrt(1 - self._memory**2)
            self._gust = [self._memory * g + kick * self._draw() for g in self._gust]
        return Surroundings(friction, bank, grade, self._gust[0], self._wind + self._gust[1])


def normal_stream(generator: np.random.Generator, block: int = 4096) -> Callable[[], float]:
    """Standard normal numbers one at a time; drawn in blocks, which is ten times faster than single draws."""
    buffer: list[float] = []

    def draw() -> float:
        if not buffer:
            buffer.extend(generator.standard_normal(block).tolist())
        return buffer.pop()

    return draw
