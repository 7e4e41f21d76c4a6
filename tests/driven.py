"""Drives of a single-track car with the equations that identification assumes, and sensors with chosen errors."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from st_core import integrate
from st_core.log import DriveLog
from st_core.models import Model, get_model
from st_core.vehicle import VehicleParameters

T0 = 1_700_000_000_000_000_000
STEP = 0.01


@dataclass(frozen=True)
class Sensors:
    """Standard deviations of white noise [SI]; misalignment: heading too far left [rad]; lever: INS further forward and
    left than in the vehicle file [m]; yaw_rate_bias [rad/s]; delay: of the road wheels after the measured angle [s].
    """

    velocity: float = 0.003
    yaw_rate: float = 0.002
    yaw: float = 1e-4
    steering_wheel: float = 0.001
    misalignment: float = 0.0
    lever: tuple[float, float] = (0.0, 0.0)
    yaw_rate_bias: float = 0.0
    delay: float = 0.0


SILENT = Sensors(velocity=0.0, yaw_rate=0.0, yaw=0.0, steering_wheel=0.0)


def with_stiffness(vehicle: VehicleParameters, front: float, rear: float) -> VehicleParameters:
    """The car with other axle cornering stiffnesses [N/rad]; lambda_ky of both tyres follows."""
    return replace(vehicle, cornering_stiffness_front=front, cornering_stiffness_rear=rear).with_derived_scales()


def drive(vehicle: VehicleParameters, speed: float, steer: Callable[[np.ndarray], np.ndarray], seconds: float = 60.0,
          *, model: str | Model = "linear", sensors: Sensors = Sensors(), seed: int = 0, name: str = "") -> DriveLog:
    """Drives at constant speed [m/s]. steer(time) -> road wheel angle [rad]. INS and steering at 100 Hz."""
    time = np.arange(0.0, seconds, STEP)
    equations = get_model(model) if isinstance(model, str) else model
    p = equations.parameters(vehicle)
    angle = np.asarray(steer(time - sensors.delay), float)
    middle = np.asarray(steer(time + 0.5 * STEP - sensors.delay), float)
    state = (0.0, 0.0, speed, 0.0, 0.3, 0.0, *[0.0] * len(equations.extra_states))
    rows = [state]
    for before, between, after in zip(angle[:-1].tolist(), middle[:-1].tolist(), angle[1:].tolist(), strict=True):
        w = [equations.inputs(value, 0.0, p) for value in (before, between, after)]
        state = integrate.rk4_step(equations.rhs, state, *w, p, STEP)
        rows.append(state)
    x, y, forward, across, yaw, rate = np.array(rows).T[:6]
    d_x, d_y = vehicle.cg_to_ins_x + sensors.lever[0], vehicle.cg_to_ins_y + sensors.lever[1]
    cosine, sine = np.cos(yaw), np.sin(yaw)
    forward, across = forward - rate * d_y, across + rate * d_x
    turn_c, turn_s = np.cos(sensors.misalignment), np.sin(sensors.misalignment)
    draw = np.random.default_rng([seed, round(1000 * speed)]).standard_normal((6, len(time)))
    steering = vehicle.steering_wheel_angle(np.asarray(steer(time), float)) + sensors.steering_wheel * draw[0]
    time_ns = T0 + np.round(time * 1e9).astype(np.int64)
    return DriveLog(
        name or f"{speed:g} m/s", time_ns, x + cosine * d_x - sine * d_y, y + sine * d_x + cosine * d_y,
        yaw + sensors.misalignment + sensors.yaw * draw[1],
        turn_c * forward + turn_s * across + sensors.velocity * draw[2],
        turn_c * across - turn_s * forward + sensors.velocity * draw[3],
        rate + sensors.yaw_rate_bias + sensors.yaw_rate * draw[4], time_ns,
        vehicle.road_wheel_angle(steering), steering)


def weave(amplitude: float, period: float = 9.0) -> Callable[[np.ndarray], np.ndarray]:
    """Steers left and right, with a slower modulation so that no two bends are equal."""
    return lambda t: amplitude * np.sin(2 * np.pi * t / period) * (0.75 + 0.25 * np.sin(2 * np.pi * t / 37.0))


def steps(amplitude: float) -> Callable[[np.ndarray], np.ndarray]:
    """Steers left, straight, right, straight, 1.5 s each, with ramps of 0.15 s."""
    def steer(time: np.ndarray) -> np.ndarray:
        corners = np.array([0.0, 0.15, 1.5, 1.65, 3.0, 3.15, 4.5, 4.65, 6.0])
        return np.interp(time % 6.0, corners, amplitude * np.array([0.0, 1.0, 1.0, 0.0, 0.0, -1.0, -1.0, 0.0, 0.0]))
    return steer


def straight(time: np.ndarray) -> np.ndarray:
    """Small steering motion of a driver on a straight road."""
    return 0.0008 * np.sin(1.3 * time) + 0.0005 * np.sin(0.31 * time)
