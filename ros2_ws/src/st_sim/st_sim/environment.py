"""Road and wind of the virtual car: friction and slopes as functions of position, wind as a function of time."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from .settings import Settings

WAVE_LENGTH = 80.0  # m, wavelength of the terrain along x
PATCH_LENGTH, PATCH_PERIOD = 10.0, 40.0  # m along x, length and spacing of patches with different friction
GUST_TIME = 1.5  # s, correlation time of gusts


class Surroundings(NamedTuple):
    """Road and air at the car. friction: factor on the peak force of the tyres. bank_angle: + rises to the left,
    grade_angle: + rises ahead [rad]. wind_x, wind_y: velocity of the air in map axes [m/s]."""

    friction: float
    bank_angle: float
    grade_angle: float
    wind_x: float
    wind_y: float


class Road(NamedTuple):
    """Friction factors of road and patches, bank and grade angles [rad], slopes of hillside and waves; see SETTINGS."""

    friction: float
    patch: float
    bank: float
    grade: float
    hillside: float
    wave: float


def make_road(settings: Settings) -> Road:
    names = ("friction_factor", "friction_patch", "bank_angle", "grade_angle", "hillside_slope", "terrain_wave")
    return Road(*(settings[name] for name in names))


def evaluate_road(road: Road, x: float, yaw: float) -> tuple[float, float, float]:
    """(friction factor, bank, grade [rad]) of a car at x [m, map] with a yaw angle [rad]. Also compiled with numba."""
    friction = road.friction * (road.patch if x % PATCH_PERIOD < PATCH_LENGTH else 1.0)
    bank, grade = road.bank, road.grade
    if road.hillside or road.wave:
        slope_east, slope_north = road.wave * math.sin(2 * math.pi * x / WAVE_LENGTH), road.hillside
        c, s = math.cos(yaw), math.sin(yaw)
        grade += slope_east * c + slope_north * s
        bank += slope_north * c - slope_east * s
    return friction, bank, grade


class Environment:
    """Surroundings along a drive; gusts are an Ornstein-Uhlenbeck process."""

    def __init__(self, settings: Settings, step: float, seed: int):
        self._road = road = make_road(settings)
        self._wind, self._gust_speed = settings["wind_speed"], settings["gust_speed"]
        self._gust_decay = math.exp(-step / GUST_TIME)
        self._gust = [0.0, 0.0]
        self._draw = make_normal_source(np.random.default_rng([seed, 1]))
        self._constant = Surroundings(road.friction, road.bank, road.grade, 0.0, 0.0)
        self._is_constant = not (self._wind or self._gust_speed or road.hillside or road.wave) and road.patch == 1.0

    def advance(self, x: float, yaw: float) -> Surroundings:
        """Advance the gusts by one step; returns the surroundings of a car at x [m, map] with a yaw angle [rad]."""
        if self._is_constant:
            return self._constant
        if self._gust_speed:
            noise = self._gust_speed * math.sqrt(1 - self._gust_decay**2)
            self._gust = [self._gust_decay * g + noise * self._draw() for g in self._gust]
        return Surroundings(*evaluate_road(self._road, x, yaw), self._gust[0], self._wind + self._gust[1])


def make_normal_source(generator: np.random.Generator, block: int = 4096) -> Callable[[], float]:
    """A function that returns one standard normal number per call; drawing in blocks makes it ten times faster.

    Every use of random numbers in st_sim has its own generator, seeded with [seed, number of the use].
    """
    buffer: list[float] = []

    def draw() -> float:
        if not buffer:
            buffer.extend(generator.standard_normal(block).tolist())
        return buffer.pop()

    return draw
