"""Sensors of the virtual car with noise, bias, lever arm and loss; the NCOM and CAN encoders round the values."""

import cmath
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from st_core.vehicle import VehicleParameters

from .dynamics import GRAVITY
from .plant import Truth, make_normal_source
from .settings import Settings

OUTAGE_DURATION = 1.0  # s
# Speed above which vibration noise has its full level [m/s], and fraction of this level at rest.
FULL_VIBRATION_SPEED, REST_VIBRATION = 5.0, 0.1
# m/s; lower wheel speeds and vehicle speeds are sent as 0, as in recordings of the Leaf and related cars.
MIN_WHEEL_SPEED, MIN_VEHICLE_SPEED = 1.1 / 3.6, 2.8 / 3.6


@dataclass(slots=True)
class InsReading:
    """One epoch of the INS in map axes (ENU) and body axes (FLU) [SI]."""

    stamp: float  # reported time since the start [s]
    x: float
    y: float
    z: float
    velocity_x: float  # along the road, also sent as the horizontal speed (0.5 % too high on a grade of 0.1 rad)
    velocity_y: float
    velocity_z: float  # positive up
    yaw: float
    roll: float  # positive right side down
    pitch: float  # positive nose up
    rates: Sequence[float]  # about x, y, z
    specific_force: Sequence[float]  # along x, y, z; at rest on level ground +9.81 along z


# Standard deviations of white and slow noise [SI], and correlation time of the slow noise [s]. About half the specified
# accuracy of an RT3000 v3 with RTK (0.01 m, 0.014 m/s, 0.1 deg in heading, 0.03 deg in roll and pitch); the filter of
# the unit makes errors vary slowly. The white noise of rates and forces is vibration caused by the road.
NOISE = {
    **dict.fromkeys(("x", "y"), (0.001, 0.006, 60.0)), "z": (0.002, 0.012, 60.0),
    **dict.fromkeys(("velocity_x", "velocity_y"), (0.002, 0.005, 20.0)), "velocity_z": (0.003, 0.007, 20.0),
    "yaw": (1e-4, 8e-4, 100.0), **dict.fromkeys(("roll", "pitch"), (5e-5, 3e-4, 100.0)),
    **dict.fromkeys(("rate_x", "rate_y"), (0.006, 5e-5, 300.0)), "rate_z": (0.002, 5e-5, 300.0),
    **dict.fromkeys(("force_x", "force_y"), (0.06, 0.003, 300.0)), "force_z": (0.15, 0.003, 300.0),
}
ACCURACY = {"position": 0.01, "velocity": 0.008, "heading": 0.001, "roll_pitch": 0.0005}  # reported by the unit [SI]


class _Noise:
    """White noise plus a slow first-order Gauss-Markov process. white, slow: standard deviations. time: correlation
    time of the slow noise [s]. interval: time between values [s]. draw: source of standard normal numbers."""

    def __init__(self, white: float, slow: float, time: float, interval: float, draw: Callable[[], float]):
        self._white, self._draw = white, draw
        self._decay = math.exp(-interval / time)
        self._increment = slow * math.sqrt(1 - self._decay**2)
        self._slow = slow * draw()

    def __call__(self, vibration: float = 1.0) -> float:
        """The next value. vibration: factor on the white noise."""
        self._slow = self._decay * self._slow + self._increment * self._draw()
        return self._slow + self._white * vibration * self._draw()


class Ins:
    """The INS and its errors. interval: time between epochs [s]."""

    def __init__(self, car: VehicleParameters, settings: Settings, interval: float, seed: int):
        self._settings = settings
        # The INS is fixed to the body, so a shift of the CG changes its lever arm.
        self._lever_arm = (car.cg_to_ins_x - settings["cg_shift"] + settings["ins_lever_error"], car.cg_to_ins_y)
        scale = settings["ins_noise"]
        draw = make_normal_source(np.random.default_rng([seed, 3]))
        self._noise = {name: _Noise(scale * white, scale * slow, time, interval, draw)
                       for name, (white, slow, time) in NOISE.items() if scale}

    def read(self, truth: Truth) -> InsReading:
        x, y, vx, vy = truth.motion_at(*self._lever_arm)
        ax, ay = truth.acceleration_at(*self._lever_arm)
        cp, sp, cr, sr = math.cos(truth.pitch), math.sin(truth.pitch), math.cos(truth.roll), math.sin(truth.roll)
        pitched_z = cp * GRAVITY - sp * ax
        reading = InsReading(
            stamp=truth.time + self._settings["ins_time_error"], x=x, y=y, z=truth.z, velocity_x=vx, velocity_y=vy,
            velocity_z=truth.velocity_z, yaw=truth.yaw, roll=truth.roll, pitch=truth.pitch,
            # In the axes of the tilted body, for a constant pitch angle and a horizontal acceleration (ax, ay, 0).
            rates=(truth.roll_rate + truth.yaw_rate * sp, truth.yaw_rate * sr * cp, truth.yaw_rate * cr * cp),
            specific_force=(cp * ax + sp * GRAVITY, cr * ay + sr * pitched_z, cr * pitched_z - sr * ay))
        self._add_errors(reading)
        if self._noise:
            for name in ("x", "y", "z", "velocity_x", "velocity_y", "velocity_z", "yaw", "roll", "pitch"):
                setattr(reading, name, getattr(reading, name) + self._noise[name]())
            speed_ratio = min(abs(truth.velocity_x) / FULL_VIBRATION_SPEED, 1.0)
            vibration = REST_VIBRATION + (1.0 - REST_VIBRATION) * speed_ratio
            reading.rates = [rate + self._noise[f"rate_{axis}"](vibration)
                             for rate, axis in zip(reading.rates, "xyz", strict=True)]
            reading.specific_force = [force + self._noise[f"force_{axis}"](vibration)
                                      for force, axis in zip(reading.specific_force, "xyz", strict=True)]
        return reading

    def _add_errors(self, r: InsReading) -> None:
        s, (fx, fy, fz) = self._settings, r.specific_force
        # Only the body axes rotate; position and velocity over ground are not affected.
        rotation = cmath.rect(1.0, -s["ins_misalignment"])
        velocity = complex(r.velocity_x, r.velocity_y) * rotation * s["velocity_scale"]
        force = complex(fx, fy) * rotation
        r.velocity_x, r.velocity_y, r.yaw = velocity.real, velocity.imag, r.yaw + s["ins_misalignment"]
        r.rates = [rate * s["yaw_rate_scale"] for rate in r.rates]
        r.specific_force = force.real, force.imag + s["lateral_acceleration_bias"], fz


class SteeringSensor:
    """Steering-wheel angle sensor: true angle plus the offset of the vehicle file and noise [rad]."""

    def __init__(self, car: VehicleParameters, settings: Settings, seed: int):
        self._offset, self._noise = car.steering_wheel_offset, settings["steering_sensor_noise"]
        self._draw = make_normal_source(np.random.default_rng([seed, 4]), 256)

    def read(self, truth: Truth) -> float:
        return truth.steering_wheel_angle + self._offset + (self._noise * self._draw() if self._noise else 0.0)


def read_wheel_speeds(truth: Truth, settings: Settings) -> tuple[list[float], float]:
    """Unsigned wheel speeds FL, FR, RL, RR and vehicle speed of the ABS unit [m/s]; 0 below their minimum."""
    speeds = [abs(speed * settings["wheel_speed_scale"]) for speed in truth.wheel_speed]
    vehicle_speed = abs(truth.velocity_x)
    return ([speed if speed >= MIN_WHEEL_SPEED else 0.0 for speed in speeds],
            vehicle_speed if vehicle_speed >= MIN_VEHICLE_SPEED else 0.0)


class TransmissionLoss:
    """Random loss of a fraction of datagrams or frames, and outages of 1 s from each multiple of `outage_every` [s]."""

    def __init__(self, fraction: float, outage_every: float, seed: tuple[int, int]):
        self._fraction, self._outage_every = fraction, outage_every
        self._generator = np.random.default_rng(seed)

    def is_lost(self, time: float) -> bool:
        """Whether the datagram or frame sent at `time` [s since the start] is lost; call once for each."""
        if self._outage_every and time >= self._outage_every and time % self._outage_every < OUTAGE_DURATION:
            return True
        return bool(self._fraction) and self._generator.random() < self._fraction
