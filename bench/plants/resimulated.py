"""Simulates a recorded drive with the base model as the car: recorded inputs, motion of the model, sensor noise."""

from dataclasses import replace

import numpy as np
from st_core.batch import LogBatch
from st_core.log import DriveLog, LogSignals
from st_core.types import cg_to_ins_position
from st_core.vehicle import VehicleParameters
from st_sim.settings import REALISTIC

from .sensing import round_to_resolution, select_noise

MARGIN_NS = 700_000_000  # at both ends, where the smoothed longitudinal acceleration is unknown
STEERING_NOISE = REALISTIC["steering_sensor_noise"]  # rad at the steering wheel
WIDTH = 15  # samples of 10 ms over which the recorded angle is smoothed; steering is slower


def draw_seed(*numbers: int) -> int:
    return int(np.random.default_rng(numbers).integers(2**31))


def resimulate(log: DriveLog, vehicle: VehicleParameters, seed: int) -> DriveLog:
    """Simulates the whole drive in one prediction, every 10 ms, with noise and rounding of the virtual INS.

    The speed is the integral of the recorded acceleration, and the wheels follow the smoothed steering angle, so that
    inputs and motion are consistent; the steering sensor has noise. Raises ValueError if the model spins.
    """
    log = replace(log, road_wheel_angle=_smooth(log.road_wheel_angle), steering_wheel_angle=None)
    time = log.ins_time_ns[(log.ins_time_ns > log.start_ns + MARGIN_NS) & (log.ins_time_ns < log.end_ns - MARGIN_NS)]
    step = 0.01
    # A whole number of steps from the first to the last sample.
    steps = int((time[-1] - time[0]) * 1e-9 / step)
    signals = LogSignals(log, mode="zero_phase")
    states = LogBatch(signals, time[:1], steps * step, step).predict("nonlinear", vehicle)
    x, y, v_x, v_y, yaw, rate = states[0].T
    if not np.isfinite(states).all() or np.abs(v_y).max() > 6.0:
        raise ValueError(f"{log.name}: the model spins on these inputs")
    dx, dy = vehicle.cg_to_ins_x, vehicle.cg_to_ins_y
    x, y = cg_to_ins_position(x, y, yaw, dx, dy)
    turning, a_y = np.gradient(rate, step), np.gradient(v_y, step) + v_x * rate
    noise = dict(zip(("x", "y", "velocity_x", "velocity_y", "yaw", "rate", "force"), select_noise(
        seed, len(x), v_x, ("x", "y", "velocity_x", "velocity_y", "yaw", "rate_z", "force_y")), strict=True))

    def read(values: np.ndarray, channel: str, rounding: str) -> np.ndarray:
        return round_to_resolution(values + noise[channel], rounding)

    steering = log.road_wheel_angle * vehicle.steering_ratio + vehicle.steering_wheel_offset
    steering = steering + STEERING_NOISE * np.random.default_rng([seed, 4]).standard_normal(len(steering))
    steering = round_to_resolution(steering, "steering")
    return replace(
        log, road_wheel_angle=vehicle.road_wheel_angle(steering), steering_wheel_angle=steering,
        ins_time_ns=time[0] + np.round(np.arange(steps + 1) * step * 1e9).astype(np.int64),
        x=x + noise["x"], y=y + noise["y"], yaw=read(yaw, "yaw", "angle"),
        velocity_x=read(v_x - rate * dy, "velocity_x", "velocity"),
        velocity_y=read(v_y + rate * dx, "velocity_y", "velocity"), yaw_rate=read(rate, "rate", "rate"),
        acceleration_x=None, acceleration_y=read(a_y + turning * dx - rate**2 * dy, "force", "force"))


def _smooth(values: np.ndarray) -> np.ndarray:
    """Smooths without delay; the ends are extended by constant values."""
    window = np.hanning(WIDTH + 2)[1:-1]
    padded = np.pad(values, WIDTH // 2, mode="edge")
    return np.convolve(padded, window / window.sum(), "valid")
