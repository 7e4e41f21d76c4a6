"""Simulates INS and steering sensor for a whole drive, and returns a DriveLog.

The values, including noise, are those of `st_sim.sensors`, with random numbers in the same order. They are then rounded
as on NCOM and CAN, and converted to the axes of `DriveLog`. Checked by: tests/bench/test_discovery_plants.py.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from oxts_bridge.geometry import Attitude
from scipy.signal import lfilter
from st_core.log import DriveLog
from st_core.vehicle import VehicleParameters
from st_sim.dynamics import A_X, A_Y, A_Y_RATE, GRAVITY, STATES, VX, VY, YAW, YAW_RATE, X, Y, Z
from st_sim.sensors import FULL_VIBRATION_SPEED, NOISE
from st_sim.settings import Settings

from .leaf import Recording

PERIOD, STEERING_PHASE = 0.01, 0.002
"""Time between samples, and from an INS sample to the following steering sample [s]."""
START_NS = 1_800_000_000_000_000_000
CHANNELS = tuple(NOISE)
RESOLUTION = {"rate": 1e-5, "force": 1e-4, "angle": 1e-6, "velocity": 1e-4, "steering": np.radians(0.1), "wheel": 0.01}
"""Resolution of NCOM [rad/s, m/s^2, rad, m/s], and of steering wheel angle [rad] and wheel speeds [m/s] on CAN."""


def make_log(name: str, recording: Recording, car: VehicleParameters, vehicle: VehicleParameters, settings: Settings,
             seed: int, later: tuple[Settings, int] | None = None) -> DriveLog:
    """The log of a drive. car: that of the plant; vehicle: the vehicle file of the reader. later: as in
    `leaf.drive`, for faults of the sensors."""
    r = make_readings(recording, car, settings, seed, later)
    stamp = PERIOD * np.arange(len(recording.rows))
    steering = recording.steering_wheel + car.steering_wheel_offset
    if settings["steering_sensor_noise"]:
        draws = _stream(np.random.default_rng([seed, 4]), len(stamp), 256)
        steering = steering + settings["steering_sensor_noise"] * draws
    late = STEERING_PHASE + settings["steering_sensor_latency"]
    return log_readings(name, stamp + settings["ins_time_error"], r, stamp + late, steering, vehicle)


def log_readings(name: str, ins_time: np.ndarray, readings: Mapping[str, np.ndarray], steering_time: np.ndarray,
                 steering: np.ndarray, vehicle: VehicleParameters) -> DriveLog:
    """The log of readings in the axes of st_sim (fields of `InsReading`, rates and forces as rate_x ... force_z) and of
    steering wheel angles; times in s from START_NS."""
    r = readings
    yaw, roll, pitch = (round_to_resolution(r[key], "angle") for key in ("yaw", "roll", "pitch"))
    cosine, sine = np.cos(r["yaw"]), np.sin(r["yaw"])
    level = np.stack([cosine * r["velocity_x"] - sine * r["velocity_y"], sine * r["velocity_x"] +
                      cosine * r["velocity_y"], r["velocity_z"]])
    velocity = Attitude(yaw, -pitch, roll).to_body(round_to_resolution(level, "velocity"))
    angle = round_to_resolution(steering, "steering")
    return DriveLog(
        name, to_nanoseconds(ins_time), r["x"], r["y"], np.unwrap(yaw), velocity[0], velocity[1],
        round_to_resolution(r["rate_z"], "rate"), to_nanoseconds(steering_time), vehicle.road_wheel_angle(angle),
        angle, round_to_resolution(r["force_x"], "force"), round_to_resolution(r["force_y"], "force"))


def make_readings(recording: Recording, car: VehicleParameters, settings: Settings, seed: int,
                  later: tuple[Settings, int] | None = None) -> dict[str, np.ndarray]:
    """The fields of `InsReading` for every sample, before rounding; rates and forces as rate_x ... force_z."""
    count = len(recording.rows)
    parts = [(settings, slice(0, count))] if later is None else [
        (settings, slice(0, later[1])), (later[0], slice(later[1], count))]
    clean = [_noise_free_readings(recording.rows[part], recording.bank[part], recording.grade[part], car, s) for s,
             part in parts]
    values = np.concatenate(clean, axis=1)
    if settings["ins_noise"]:
        values = values + settings["ins_noise"] * _noise(seed, count, recording.rows[:, VX])
    return dict(zip(CHANNELS, values, strict=True))


def _noise_free_readings(rows: np.ndarray, bank: np.ndarray, grade: np.ndarray, car: VehicleParameters,
                         s: Settings) -> np.ndarray:
    """Channels (15, n) without noise, but with the sensor errors of the settings."""
    x, y, yaw, vx, vy, r, a_y, a_y_rate, a_x = rows[:, (X, Y, YAW, VX, VY, YAW_RATE, A_Y, A_Y_RATE, A_X)].T
    vx_dot, vy_dot, r_dot, climb = rows[:, STATES:].T
    roll, pitch = s["roll_gradient"] * a_y + bank, s["pitch_gradient"] * a_x + grade
    roll_rate = s["roll_gradient"] * a_y_rate
    dx, dy = car.cg_to_ins_x - s["cg_shift"] + s["ins_lever_error"], car.cg_to_ins_y
    c, sine = np.cos(yaw), np.sin(yaw)
    x, y, u, v = x + c * dx - sine * dy, y + sine * dx + c * dy, vx - r * dy, vy + r * dx
    ax, ay = vx_dot - r * vy - r * r * dx - r_dot * dy, vy_dot + r * vx + r_dot * dx - r * r * dy
    cp, sp, cr, sr = np.cos(pitch), np.sin(pitch), np.cos(roll), np.sin(roll)
    rates = np.stack([roll_rate + r * sp, r * sr * cp, r * cr * cp]) * s["yaw_rate_scale"]
    down = sp * ax - cp * GRAVITY
    force_x, force_y, force_z = cp * ax + sp * GRAVITY, cr * ay - sr * down, -sr * ay - cr * down
    if s["ins_misalignment"]:
        c, sine = np.cos(s["ins_misalignment"]), np.sin(s["ins_misalignment"])
        u, v = c * u + sine * v, c * v - sine * u
        force_x, force_y = c * force_x + sine * force_y, c * force_y - sine * force_x
        yaw = yaw + s["ins_misalignment"]
    # Only settings of the multi-body cars contain it.
    rates[2] += s.get("yaw_rate_bias", 0.0)
    scale = s["velocity_scale"]
    force_y = force_y + s["lateral_acceleration_bias"]
    z = rows[:, Z]
    return np.stack([x, y, z, u * scale, v * scale, climb, yaw, roll, pitch, *rates, force_x, force_y, force_z])


def _noise(seed: int, count: int, speed: np.ndarray) -> np.ndarray:
    """Noise (15, n) for `ins_noise` 1: slow noise, and white noise, which for rates and forces grows with speed."""
    kinds = len(CHANNELS)
    draws = _stream(np.random.default_rng([seed, 3]), kinds * (1 + 2 * count), 4096)
    first, draws = draws[:kinds], draws[kinds:].reshape(count, kinds, 2)
    vibration = 0.1 + 0.9 * np.minimum(np.abs(speed) / FULL_VIBRATION_SPEED, 1.0)
    result = np.empty((kinds, count))
    for i, (name, (white, slow, time)) in enumerate(NOISE.items()):
        memory = np.exp(-PERIOD / time)
        kick = slow * np.sqrt(1 - memory**2)
        drift, _ = lfilter([kick], [1.0, -memory], draws[:, i, 0], zi=[memory * slow * first[i]])
        factor = vibration if name.startswith(("rate", "force")) else 1.0
        result[i] = drift + white * factor * draws[:, i, 1]
    return result


def select_noise(seed: int, count: int, speed: np.ndarray, channels: Sequence[str]) -> np.ndarray:
    """INS noise (channels, n) at the forward speeds [m/s]; channels: names in CHANNELS."""
    return _noise(seed, count, speed)[[CHANNELS.index(name) for name in channels]]


def _stream(generator: np.random.Generator, count: int, block: int) -> np.ndarray:
    """The first numbers of `st_sim.plant.make_normal_source`, which takes blocks from their ends."""
    blocks = [generator.standard_normal(block)[::-1] for _ in range(-(-count // block))]
    return np.concatenate(blocks)[:count]


def round_to_resolution(values: np.ndarray, kind: str) -> np.ndarray:
    """Rounds as NCOM and CAN do. kind: key of RESOLUTION."""
    return np.round(values / RESOLUTION[kind]) * RESOLUTION[kind]


def to_nanoseconds(seconds: np.ndarray) -> np.ndarray:
    return START_NS + np.round(seconds * 1e9).astype(np.int64)
