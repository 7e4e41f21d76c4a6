"""INS and steering sensor of a car: noise, sampling, resolution and hidden errors."""

import math
from collections.abc import Mapping

import numpy as np
from scipy.signal import lfilter

from .simulation import STEP, VX_DOT, VY_DOT, WHEEL
from .vehicles import Car

NOISE = {"position": (0.003, 0.008), "yaw": (2e-4, 1e-3), "velocity": (0.01, 0.01), "yaw_rate": (5e-4, 5e-5),
         "acceleration": (0.05, 0.01), "steering": (5e-4, 0.0)}
"""Standard deviations of white and of slow noise [m, rad, m/s, rad/s, m/s^2, rad at the steering wheel]."""
SLOW_TIME = 40.0  # s, time constant of the slow noise


def measure(car: Car, rows: np.ndarray, hidden: Mapping[str, float],
            rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Channels [SI] at the rate of the INS; the steering wheel angle is NaN in rows without a steering sample.

    hidden: heading [rad], lever [m], delay of the steering [s], offset of the steering wheel [rad], yaw_rate_scale [1],
    yaw_rate_bias [rad/s].
    """
    every = round(1 / STEP / car.ins_rate)
    q = rows[::every]
    n, rate = len(q), car.ins_rate
    t = np.arange(n) / rate
    skew, arm = hidden.get("heading", 0.0), car.ins + hidden.get("lever", 0.0)
    vx, vy, yaw, r = q[:, 3], q[:, 4] + arm * q[:, 5], q[:, 2], q[:, 5]
    ax, ay = q[:, VX_DOT] - r * q[:, 4] - arm * r * r, q[:, VY_DOT] + r * vx + arm * np.gradient(r, t)

    def noise(kind: str) -> np.ndarray:
        white, slow = NOISE[kind]
        memory = math.exp(-1 / (rate * SLOW_TIME))
        kicks = slow * math.sqrt(1 - memory * memory) * rng.standard_normal(n)
        drift = lfilter([1.0], [1.0, -memory], kicks, zi=[memory * slow * rng.standard_normal()])[0]
        return white * rng.standard_normal(n) + drift

    c, s = math.cos(skew), math.sin(skew)
    steering = rows[:, WHEEL] * car.ratio
    late = round(hidden.get("delay", 0.0) / STEP)
    steering = np.concatenate([np.full(late, steering[0]), steering[:len(steering) - late]])[::every]
    steering = steering + noise("steering") + hidden.get("offset", 0.0)
    resolution = math.radians(car.steering_step)
    steering = np.round(steering / resolution) * resolution
    steering[np.arange(n) % max(1, rate // car.steering_rate) != 0] = np.nan
    return {
        "t": t, "x": q[:, 0] + arm * np.cos(yaw) + noise("position"),
        "y": q[:, 1] + arm * np.sin(yaw) + noise("position"), "yaw": yaw + skew + noise("yaw"),
        "velocity_x": c * vx + s * vy + noise("velocity"), "velocity_y": c * vy - s * vx + noise("velocity"),
        "yaw_rate": r * hidden.get("yaw_rate_scale", 1.0) + hidden.get("yaw_rate_bias", 0.0) + noise("yaw_rate"),
        "acceleration_x": c * ax + s * ay + noise("acceleration"),
        "acceleration_y": c * ay - s * ax + noise("acceleration"), "steering_wheel_angle": steering}
