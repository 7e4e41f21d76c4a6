"""A winding road driven by the paper's linear model with steering and tyres that differ from the vehicle file."""

from dataclasses import dataclass, replace

import numpy as np
from st_core.models import MODELS
from st_core.vehicle import VehicleParameters

RATE = 100.0  # Hz


@dataclass(frozen=True)
class Truth:
    """offset [rad], ratio [1] of the steering; scale of both cornering stiffnesses [1]."""

    offset: float
    ratio: float
    scale: float


def winding_road(car: VehicleParameters, truth: Truth, seconds: float, seed: int, noise: float = 1.0) -> np.ndarray:
    """Rows of (t, x, y, yaw, v_x, v_y, yaw rate, steering wheel angle as measured) at RATE, INS point; SI.

    Straights, and bends to both sides up to 3 m/s^2, at 6 to 15 m/s. noise: 1 for an INS with RTK and a steering sensor
    with a resolution of 0.1 deg.
    """
    random = np.random.default_rng(seed)
    real = replace(car, cornering_stiffness_front=car.cornering_stiffness_front * truth.scale,
                   cornering_stiffness_rear=car.cornering_stiffness_rear * truth.scale)
    model = MODELS["linear"]
    p = model.parameters(real)
    step = 1.0 / RATE
    time = step * np.arange(round(seconds * RATE))
    speed = 10.5 + 4.5 * np.sin(2.0 * np.pi * time / 37.0)
    acceleration = np.gradient(speed, step)
    phases = random.uniform(0.0, 2.0 * np.pi, 2)
    winding = np.clip(2.0 * np.sin(2.0 * np.pi * time / 29.0 + phases[1]), 0.0, 1.0)  # straights in between
    lateral_acceleration = 3.0 * np.sin(2.0 * np.pi * time / 11.0 + phases[0]) * winding
    delta = lateral_acceleration * (car.wheelbase / speed**2 + 0.002)
    state = np.array([0.0, 0.0, speed[0], 0.0, 0.0, 0.0])
    rows = []
    for k in range(len(time)):
        state[2] = speed[k]
        yaw = state[4]
        ins_x = state[0] + car.cg_to_ins_x * np.cos(yaw) - car.cg_to_ins_y * np.sin(yaw)
        ins_y = state[1] + car.cg_to_ins_x * np.sin(yaw) + car.cg_to_ins_y * np.cos(yaw)
        rows.append((time[k], ins_x, ins_y, yaw, state[2] - state[5] * car.cg_to_ins_y,
                     state[3] + state[5] * car.cg_to_ins_x, state[5], delta[k] * truth.ratio + truth.offset))
        w = model.inputs(float(delta[k]), float(acceleration[k]), p)
        first = np.array(model.rhs(tuple(state.tolist()), w, p))
        second = np.array(model.rhs(tuple((state + step * first).tolist()), w, p))
        state = state + 0.5 * step * (first + second)
    drive = np.array(rows)
    drive[:, 4:7] += noise * random.normal(0.0, (0.01, 0.015, 0.0005), (len(drive), 3))
    steering_wheel = drive[:, 7] + noise * random.normal(0.0, np.radians(0.05), len(drive))
    drive[:, 7] = np.round(steering_wheel / np.radians(0.1)) * np.radians(0.1)
    return drive
