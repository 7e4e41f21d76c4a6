"""The virtual car on its road: a double-track vehicle with its own equations, independent of the models in st_core.

Axes are ISO 8855 (x forward, y left, z up), the state is at the true CG, yaw is counter-clockwise from east. Order of
the wheels: front left, front right, rear left, rear right. A slip angle is positive when the wheel slides to its left;
the lateral force is then negative.

    m (dv_x/dt - r v_y) = sum F_x - drag - rolling resistance - m g sin(grade)
    m (dv_y/dt + r v_x) = sum F_y + wind - m g sin(bank)
    I_z dr/dt           = sum (x_i F_y,i - y_i F_x,i) + wind moment + drive_offset F_drive

Forces are rotated from wheel to body axes. Tyre forces follow from transient slip, loads from filtered accelerations.
From steering wheel to road wheels: delay -> play -> ratio -> lag -> offset, roll steer, compliance.

Source: Pacejka, Tire and Vehicle Dynamics, ch. 1 and 7. Checked by: test_plant.py, test_effects.py.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from math import atan, atan2, cos, exp, pi, sin, sqrt
from typing import NamedTuple

import numpy as np
from st_core.vehicle import VehicleParameters

from . import dynamics
from .dynamics import A_X, A_Y, A_Y_RATE, MIN_SLIP_SPEED, RACK, STATES, VX, VY, YAW, YAW_RATE, X, Y, Z, derivative
from .settings import Settings

STEP = 0.002  # s, of Heun's method; halving it moves the end of a 10 s drive by less than 1 mm (test_plant.py)
STANDSTILL_SPEED = 0.02  # m/s; at lower v_x without a positive drive force, the car is at rest
DRIVE = 4  # gear code on CAN; 1 P, 2 R, 3 N
WAVELENGTH = 80.0  # m, of the terrain along x
PATCH_LENGTH, PATCH_PERIOD = 10.0, 40.0  # m along x, length and spacing of patches with different friction
GUST_TIME = 1.5  # s, correlation time of gusts


@dataclass(slots=True)
class Truth:
    """True motion at the CG in a simulated or recorded drive [SI]; time since the start of the drive.

    Map axes x east, y north, z up; body axes x forward, y left. roll > 0: right side down, pitch > 0: nose up, each
    the sum of body and road. velocity_z > 0: up. steering_wheel_angle > 0: left, without sensor offset.
    acceleration_x, _y: kinematic, not the specific force. Tuples are FL, FR, RL, RR: wheel_speed and, only for a
    simulated car, lateral_force, longitudinal_force, load [N] and slip_angle [rad], in wheel axes.
    """

    time: float
    x: float
    y: float
    z: float
    yaw: float
    velocity_x: float
    velocity_y: float
    yaw_rate: float
    acceleration_x: float
    acceleration_y: float
    yaw_acceleration: float
    steering_wheel_angle: float
    road_wheel_angle: float
    steering_wheel_rate: float = 0.0
    velocity_z: float = 0.0
    roll: float = 0.0
    pitch: float = 0.0
    roll_rate: float = 0.0
    wheel_speed: tuple[float, ...] = (0.0,) * 4
    gear: int = DRIVE
    lateral_force: tuple[float, ...] = ()
    longitudinal_force: tuple[float, ...] = ()
    load: tuple[float, ...] = ()
    slip_angle: tuple[float, ...] = ()
    conditions: dict[str, float] = field(default_factory=dict)

    def motion_at(self, x: float, y: float) -> tuple[float, float, float, float]:
        """Map x, y [m] and body velocity v_x, v_y [m/s] of the body point (x, y) relative to the CG [m]."""
        c, s = cos(self.yaw), sin(self.yaw)
        return (self.x + c * x - s * y, self.y + s * x + c * y, self.velocity_x - self.yaw_rate * y,
                self.velocity_y + self.yaw_rate * x)

    def acceleration_at(self, x: float, y: float) -> tuple[float, float]:
        """Acceleration of a body point: a_x - r^2 x - dr/dt y,  a_y + dr/dt x - r^2 y  [m/s^2]."""
        r2, r_dot = self.yaw_rate**2, self.yaw_acceleration
        return self.acceleration_x - r2 * x - r_dot * y, self.acceleration_y + r_dot * x - r2 * y


class Conditions(NamedTuple):
    """Road and air at the car."""

    friction: float  # factor on the peak force of the tyres
    bank_angle: float  # positive: rises to the left [rad]
    grade_angle: float  # positive: rises ahead [rad]
    wind_x: float  # velocity of the air towards east [m/s]
    wind_y: float  # velocity of the air towards north [m/s]


class Road(NamedTuple):
    """Settings of the road; meaning and unit: SETTINGS."""

    friction_factor: float
    friction_patch: float
    bank_angle: float
    grade_angle: float
    hillside_slope: float
    terrain_wave: float


def make_road(settings: Settings) -> Road:
    return Road(*(settings[name] for name in Road._fields))


def evaluate_road(road: Road, x: float, yaw: float) -> tuple[float, float, float]:
    """(friction factor, bank, grade [rad]) for a car at x [m, map] with a yaw angle [rad]. Also compiled with numba."""
    friction = road.friction_factor * (road.friction_patch if x % PATCH_PERIOD < PATCH_LENGTH else 1.0)
    bank, grade = road.bank_angle, road.grade_angle
    if road.hillside_slope or road.terrain_wave:
        slope_east, slope_north = road.terrain_wave * sin(2 * pi * x / WAVELENGTH), road.hillside_slope
        c, s = cos(yaw), sin(yaw)
        grade += slope_east * c + slope_north * s
        bank += slope_north * c - slope_east * s
    return friction, bank, grade


class Environment:
    """Road and air along a drive; gusts are an Ornstein-Uhlenbeck process."""

    def __init__(self, settings: Settings, step: float, seed: int):
        self._road = make_road(settings)
        self._wind, self._gust_speed = settings["wind_speed"], settings["gust_speed"]
        self._gust_decay = exp(-step / GUST_TIME)
        self._gust = [0.0, 0.0]
        self._draw = make_normal_source(np.random.default_rng([seed, 1]))

    def advance(self, x: float, yaw: float) -> Conditions:
        """Advance the gusts by one step and return the conditions for a car at x [m, map] with a yaw angle [rad]."""
        if self._gust_speed:
            noise = self._gust_speed * sqrt(1 - self._gust_decay**2)
            self._gust = [self._gust_decay * g + noise * self._draw() for g in self._gust]
        return Conditions(*evaluate_road(self._road, x, yaw), self._gust[0], self._wind + self._gust[1])


def make_normal_source(generator: np.random.Generator, block: int = 4096) -> Callable[[], float]:
    """A function that returns one standard normal number per call; drawing in blocks makes it several times faster.
    Each source of randomness in st_sim has its own generator, seeded with [seed, number of the source]."""
    buffer: list[float] = []

    def draw() -> float:
        if not buffer:
            buffer.extend(generator.standard_normal(block).tolist())
        return buffer.pop()

    return draw


class Plant:
    """State of one car; `step` advances it by one time step with constant steering-wheel angle and drive force."""

    def __init__(self, car: VehicleParameters, settings: Settings, seed: int = 0, step: float = STEP):
        self.car, self.settings, self.time_step = car, settings, step
        self.environment = Environment(settings, step, seed)
        self.state: tuple[float, ...] = (0.0,) * STATES
        self.is_at_rest = False
        self.conditions = self.environment.advance(0.0, 0.0)
        self.constants = dynamics.make_constants(car, settings, step)
        self.mass, self.to_rear = self.constants.mass, self.constants.to_rear
        self._ratio = car.steering_ratio * settings["steering_ratio_factor"]
        self._half_play = settings["steering_backlash"] / 2
        self._delay: deque[float] = deque([0.0] * round(settings["steering_delay"] / step))
        self._angle_after_play = 0.0
        self._wheel_slip_compliance = settings["wheel_slip_compliance"]

    def place(self, x: float, y: float, yaw: float, speed: float, curvature: float = 0.0) -> None:
        """Set position [m], yaw [rad], speed [m/s] and path curvature [1/m, positive: left], without tyre slip."""
        values = [0.0] * STATES
        values[X], values[Y], values[YAW], values[VX], values[YAW_RATE] = x, y, yaw, speed, speed * curvature
        values[VY] = speed * curvature * self.to_rear
        values[RACK] = rack = atan(self.car.wheelbase * curvature)
        self.state = tuple(values)
        self.conditions = self.environment.advance(x, yaw)
        self._angle_after_play = rack * self._ratio
        self._delay = deque([self._angle_after_play] * len(self._delay))

    @property
    def rack_steering_wheel_angle(self) -> float:
        """Steering-wheel angle that corresponds to the current rack position [rad]."""
        return self.state[RACK] * self._ratio

    def step(self, steering_wheel_angle: float, drive_force: float) -> None:
        """Advance by a time step. steering_wheel_angle: true [rad, > 0: left]. drive_force: of all wheels [N]."""
        s, dt = self.state, self.time_step
        self.conditions = conditions = self.environment.advance(s[X], s[YAW])
        if self._delay:
            self._delay.append(steering_wheel_angle)
            steering_wheel_angle = self._delay.popleft()
        if half_play := self._half_play:
            low, high = steering_wheel_angle - half_play, steering_wheel_angle + half_play
            self._angle_after_play = steering_wheel_angle = min(max(self._angle_after_play, low), high)
        target = steering_wheel_angle / self._ratio
        if self.constants.steering_lag == 0.0:
            s = (*s[:RACK], target, *s[RACK + 1 :])
        if self.is_at_rest and drive_force <= 0.0:
            self.state = dynamics.bring_to_rest(s, dt)
            return
        self.is_at_rest = False
        c = self.constants
        k1, _ = derivative(s, target, drive_force, conditions, c)
        k2, _ = derivative([a + dt * b for a, b in zip(s, k1, strict=True)], target, drive_force, conditions, c)
        s = tuple([x + 0.5 * dt * (rate_1 + rate_2) for x, rate_1, rate_2 in zip(s, k1, k2, strict=True)])
        self.is_at_rest = s[VX] < STANDSTILL_SPEED and drive_force <= 0.0
        self.state = dynamics.bring_to_rest(s, dt) if self.is_at_rest else s

    def observe(self, drive_force: float, time: float = 0.0, steering_wheel_angle: float = 0.0,
                steering_wheel_rate: float = 0.0) -> Truth:
        """True motion and forces in the current state; accelerations are zero at rest. drive_force: as for `step`. The
        other arguments are copied to the result."""
        s, settings, conditions, is_moving = self.state, self.settings, self.conditions, not self.is_at_rest
        rates, wheels = derivative(s, s[RACK], drive_force, conditions, self.constants)
        road_wheel_angle, lateral, longitudinal, load, across_speeds, along_speeds = wheels
        slip = [atan2(across, max(abs(along), MIN_SLIP_SPEED))
                for across, along in zip(across_speeds, along_speeds, strict=True)]
        speeds = [along * (1 + self._wheel_slip_compliance * force / wheel_load)
                  for along, force, wheel_load in zip(along_speeds, longitudinal, load, strict=True)]
        return Truth(
            time, x=s[X], y=s[Y], z=s[Z], yaw=s[YAW], velocity_x=s[VX], velocity_y=s[VY], yaw_rate=s[YAW_RATE],
            acceleration_x=rates[VX] - s[YAW_RATE] * s[VY] if is_moving else 0.0,
            acceleration_y=rates[VY] + s[YAW_RATE] * s[VX] if is_moving else 0.0,
            yaw_acceleration=rates[YAW_RATE] if is_moving else 0.0, velocity_z=rates[Z] if is_moving else 0.0,
            steering_wheel_angle=steering_wheel_angle, steering_wheel_rate=steering_wheel_rate,
            road_wheel_angle=road_wheel_angle, roll=settings["roll_gradient"] * s[A_Y] + conditions.bank_angle,
            pitch=settings["pitch_gradient"] * s[A_X] + conditions.grade_angle, slip_angle=tuple(slip),
            roll_rate=settings["roll_gradient"] * s[A_Y_RATE] if is_moving else 0.0, wheel_speed=tuple(speeds),
            lateral_force=lateral, longitudinal_force=longitudinal, load=load, conditions=conditions._asdict())
