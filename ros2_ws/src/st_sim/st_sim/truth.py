"""What is true at one instant; the simulated car and a recorded drive both give it, sensors and files take it."""

import math
from dataclasses import dataclass, field

from .plant import Forces

DRIVE = 4
"""Gear code on CAN; 1 P, 2 R, 3 N."""


@dataclass(slots=True)
class Truth:
    """At the CG. Map axes x east, y north, z up; body axes x forward, y left. Times are seconds since the start of
    the drive.

    roll: right side down +, pitch: nose up + (body and road together). velocity_z: upwards. steering_wheel_angle:
    left +, without the offset of the sensor. acceleration_x, _y: of the motion, gravity not in them. wheel_speed: FL,
    FR, RL, RR.
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
    forces: Forces | None = None
    surroundings: dict[str, float] = field(default_factory=dict)

    def at_point(self, x: float, y: float) -> tuple[float, float, float, float]:
        """Position and body-axes velocity of the point (x, y) of the body, seen from the CG: map x, map y, v_x, v_y."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        return (
            self.x + c * x - s * y,
            self.y + s * x + c * y,
            self.velocity_x - self.yaw_rate * y,
            self.velocity_y + self.yaw_rate * x,
        )

    def acceleration_at(self, x: float, y: float) -> tuple[float, float]:
        """a_x - r^2 x - dr/dt y,  a_y + dr/dt x - r^2 y  [m/s^2]."""
        r2, r_dot = self.yaw_rate**2, self.yaw_acceleration
        return self.acceleration_x - r2 * x - r_dot * y, self.acceleration_y + r_dot * x - r2 * y
