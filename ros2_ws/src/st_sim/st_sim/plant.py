"""The truth: a double-track car on the road. Own equations, no model of the suite is used here.

Axes ISO 8855 (x forward, y left, z up), state at the true CG, yaw counter-clockwise from east. Wheels: front left,
front right, rear left, rear right. A slip angle is positive when the wheel slides to its left, so the force is
negative.

    m (dv_x/dt - r v_y) = sum F_x - drag - m g sin(grade)
    m (dv_y/dt + r v_x) = sum F_y + wind - m g sin(bank)
    I_z dr/dt           = sum (x_i F_y,i - y_i F_x,i) + wind moment

with forces turned from each wheel into the body, tyre force from the delayed slip, loads from filtered accelerations,
and the steering chain hand wheel -> delay -> play -> ratio -> lag -> offset, roll steer, compliance.

Source: Pacejka, Tire and Vehicle Dynamics, ch. 1 and 7. Checked by: test_plant.py, test_effects.py.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from math import atan, atan2

from .car import Car
from .dynamics import (
    GIVE,
    LEAN,
    LEAN_RATE,
    LOWEST_SLIP_SPEED,
    PITCH_TIME,
    RACK,
    S_FL,
    S_FR,
    S_RL,
    S_RR,
    SQUAT,
    VX,
    VY,
    YAW,
    YAW_RATE,
    X,
    Y,
    Z,
    constants,
    derivative,
)
from .environment import Environment
from .settings import Settings

STEP = 0.002
"""s, of the integrator (Heun). Halving it moves a 10 s drive by less than a millimetre (test_plant.py)."""

STANDSTILL = 0.02
"""m/s. Slower than this with the brakes on is at rest."""


@dataclass(slots=True)
class Forces:
    """What the last derivative saw.

    Per wheel (FL, FR, RL, RR) and of the body, for the truth record and the sensors.
    """

    acceleration_x: float = 0.0
    acceleration_y: float = 0.0
    yaw_acceleration: float = 0.0
    velocity_x_dot: float = 0.0
    velocity_y_dot: float = 0.0
    velocity_z: float = 0.0
    road_wheel_angle: float = 0.0
    lateral: tuple[float, ...] = (0.0,) * 4
    longitudinal: tuple[float, ...] = (0.0,) * 4
    load: tuple[float, ...] = (0.0,) * 4
    slip_angle: tuple[float, ...] = (0.0,) * 4
    wheel_speed: tuple[float, ...] = (0.0,) * 4


class Plant:
    """One car. `step` advances by STEP with the hand wheel and the drive force held."""

    def __init__(self, car: Car, settings: Settings, seed: int = 0, step: float = STEP):
        self.car, self.settings, self.time_step = car, settings, step
        self.environment = Environment(settings, step, seed)
        self.state: tuple[float, ...] = (0.0,) * 16
        self.forces = Forces()
        self.parked = False
        self.here = self.environment.at(0.0, 0.0, 0.0)
        s = settings
        self.constants = constants(car, settings, step)
        self.mass, self.yaw_inertia = self.constants.mass, self.constants.yaw_inertia
        self.to_front, self.to_rear = self.constants.to_front, self.constants.to_rear
        self._ratio = car.steering_ratio * s["steering_ratio_factor"]
        self._play = s["steering_backlash"] / 2
        self._delay: deque[float] = deque([0.0] * round(s["steering_delay"] / step))
        self._loose = 0.0
        self._wheel_slip = s["wheel_slip_compliance"]

    def place(self, x: float, y: float, yaw: float, speed: float, curvature: float = 0.0) -> None:
        """Start there, on a circle of that curvature, without slip; what settles then is part of the drive."""
        values = [0.0] * 16
        values[X], values[Y], values[YAW], values[VX], values[YAW_RATE] = x, y, yaw, speed, speed * curvature
        values[VY] = speed * curvature * self.to_rear
        rack = atan(self.car.wheelbase * curvature)
        values[RACK] = rack
        self.state = tuple(values)
        self.here = self.environment.at(x, y, yaw)
        self._loose = rack * self._ratio
        self._delay = deque([self._loose] * len(self._delay))

    @property
    def steering_wheel_for(self) -> float:
        """Hand-wheel angle that belongs to the present rack position [rad]."""
        return self.state[RACK] * self._ratio

    @property
    def body_roll(self) -> float:
        """rad, relative to the road, right side down positive (the outside in a left turn)."""
        return self.settings["roll_gradient"] * self.state[LEAN]

    @property
    def body_pitch(self) -> float:
        """rad, relative to the road, nose up positive."""
        return self.settings["pitch_gradient"] * self.state[SQUAT]

    def step(self, steering_wheel_angle: float, drive_force: float) -> None:
        """Advance by one time step.

        steering_wheel_angle: true, left + [rad]; drive_force: sum over the wheels, braking < 0 [N].
        """
        s, dt = self.state, self.time_step
        self.here = here = self.environment.at(s[X], s[Y], s[YAW])
        target = self._rack_target(steering_wheel_angle)
        if self.constants.lag == 0.0:
            s = (*s[:RACK], target, *s[RACK + 1 :])
        if self.parked and drive_force <= 0.0:
            self.state = self._at_rest(s)
            return
        self.parked = False
        c = self.constants
        k1, _ = derivative(s, target, drive_force, here, c)
        k2, _ = derivative([a + dt * b for a, b in zip(s, k1, strict=True)], target, drive_force, here, c)
        half = dt / 2
        s = tuple([a + half * (b + c) for a, b, c in zip(s, k1, k2, strict=True)])
        self.parked = s[VX] < STANDSTILL and drive_force <= 0.0
        self.state = self._at_rest(s) if self.parked else s

    def observe(self, drive_force: float) -> Forces:
        """Forces and accelerations at the present state, also kept in `forces`. At rest nothing accelerates."""
        s, f, here = self.state, self.forces, self.here
        rates, seen = derivative(s, s[RACK], drive_force, here, self.constants)
        f.velocity_z, f.velocity_x_dot = rates[Z], rates[VX]
        f.velocity_y_dot, f.yaw_acceleration = rates[VY], rates[YAW_RATE]
        f.acceleration_x = f.velocity_x_dot - s[YAW_RATE] * s[VY]
        f.acceleration_y = f.velocity_y_dot + s[YAW_RATE] * s[VX]
        f.road_wheel_angle, f.lateral, f.longitudinal, f.load, slid, rolled = seen
        f.slip_angle = tuple(
            [atan2(across, max(abs(along), LOWEST_SLIP_SPEED)) for across, along in zip(slid, rolled, strict=True)]
        )
        f.wheel_speed = tuple(
            [
                along * (1 + self._wheel_slip * pull / load)
                for along, pull, load in zip(rolled, f.longitudinal, f.load, strict=True)
            ]
        )
        if self.parked:
            f.acceleration_x = f.acceleration_y = f.yaw_acceleration = 0.0
            f.velocity_x_dot = f.velocity_y_dot = f.velocity_z = 0.0
        return f

    def _at_rest(self, s: Sequence[float]) -> tuple[float, ...]:
        """Held by the brakes: no velocity, no slip; the body settles."""
        values = list(s)
        for i in (VX, VY, YAW_RATE, GIVE, S_FL, S_FR, S_RL, S_RR):
            values[i] = 0.0
        for i in (LEAN, LEAN_RATE, SQUAT):
            values[i] *= 1.0 - self.time_step / PITCH_TIME
        return tuple(values)

    def _rack_target(self, hand: float) -> float:
        if self._delay:
            self._delay.append(hand)
            hand = self._delay.popleft()
        if self._play:
            self._loose = min(max(self._loose, hand - self._play), hand + self._play)
            hand = self._loose
        return hand / self._ratio
