"""Drives of the virtual Leaf in memory: plant, driver and sensors of st_sim, rounding and axes of NCOM and CAN."""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
from oxts_bridge.geometry import Attitude
from st_core.checks import AuxiliaryData, Series
from st_core.log import DriveLog
from st_core.vehicle import VehicleParameters
from st_sim.driver import SimulatedCar
from st_sim.dynamics import GRAVITY
from st_sim.scenarios import load_plan
from st_sim.sensors import Ins, InsReading, SteeringSensor, read_wheel_speeds
from st_sim.settings import Settings, read_vehicle, resolve_settings
from st_sim.stream import STEERING_SCHEDULE, TICK_MS, WHEEL_SCHEDULE

from .._cars import LEAF_FILE, leaf
from ..discovery.sensing import round_to_resolution
from .recording import Recording, with_good_quality

START_NS = 1_756_900_800_000_000_000
INS_PERIOD_MS = 10


def drive_name(scenario: str) -> str:
    return f"virtual_{Path(scenario).stem}"


def virtual_drive(scenario: str, seed: int, seconds: float) -> Recording:
    """A scenario or road file driven with the realistic plant; INS and steering at 100 Hz, wheel speeds at 50 Hz."""
    car, vehicle = read_vehicle(LEAF_FILE), leaf()
    settings = resolve_settings("realistic", [])
    source = SimulatedCar(car, settings, load_plan(scenario), seed)
    ins, sensor = Ins(car, settings, INS_PERIOD_MS / 1000, seed), SteeringSensor(car, settings, seed)
    noiseless = Ins(car, {**settings, "ins_noise": 0.0}, INS_PERIOD_MS / 1000, seed)
    readings, exact, steering, wheels = [], [], [], []
    for now in range(0, round(seconds * 1000), TICK_MS):
        source.advance(now / 1000)
        if now % INS_PERIOD_MS == 0:
            readings.append(ins.read(source.make_truth()))
            exact.append(noiseless.read(source.make_truth()))
        if now % STEERING_SCHEDULE[0] == STEERING_SCHEDULE[1]:
            steering.append((now / 1000 + settings["steering_sensor_latency"], sensor.read(source.make_truth())))
        if now % WHEEL_SCHEDULE[0] == WHEEL_SCHEDULE[1]:
            # Rear wheels only: in a turn, the steered front wheels travel further than the car.
            wheels.append((now / 1000, sum(read_wheel_speeds(source.make_truth(), settings)[0][2:]) / 2))
    log = _make_log(drive_name(scenario), readings, np.array(steering), vehicle)
    times, speeds = np.array(wheels).T
    auxiliary = AuxiliaryData(wheel_speed=Series(_to_nanoseconds(times), round_to_resolution(speeds, "wheel")))
    return with_good_quality(Recording(log, vehicle, False, auxiliary, _true_deviations(settings, readings, exact)))


def _true_deviations(settings: Settings, readings: list[InsReading], exact: list[InsReading]) -> dict[str, float]:
    """True values of findings for sensors without a fault: noise has a mean over the drive, which acts as a bias.

    The body rolls outwards and pitches: accelerometers also measure a component of gravity, and the measured yaw rate
    is cos(roll) cos(pitch) times the true one, because the axis of the gyroscope is fixed to the body.
    """
    def mean(value: Callable[[InsReading], float]) -> float:
        return sum(value(one) - value(other) for one, other in zip(readings, exact, strict=True)) / len(readings)
    forward = sum(r.velocity_x for r in exact) / len(exact)
    speed, sideslip = 1 + mean(lambda r: r.velocity_x) / forward, mean(lambda r: r.velocity_y) / forward
    turning = np.array([(r.rates[2], math.cos(r.roll) * math.cos(r.pitch)) for r in exact]).T
    tilted = float(np.sum(turning[0] ** 2) / np.sum(turning[0] ** 2 / turning[1]))
    return {
        "acceleration_x_scale": 1 + GRAVITY * settings["pitch_gradient"],
        "acceleration_y_scale": 1 + GRAVITY * settings["roll_gradient"],
        "acceleration_x_bias": mean(lambda r: r.specific_force[0]),
        "acceleration_y_bias": mean(lambda r: r.specific_force[1]),
        "yaw_rate_bias": mean(lambda r: r.rates[2]), "yaw_rate_scale": tilted,
        "yaw_offset": mean(lambda r: r.yaw) + sideslip, "heading_misaligned": -sideslip,
        "velocity_x_scale": speed, "velocity_scale": speed,
        **dict.fromkeys(("x_scale", "y_scale", "position_scale"), 1 / speed),
    }


def _make_log(name: str, readings: list, steering: np.ndarray, vehicle: VehicleParameters) -> DriveLog:
    def column(field: str) -> np.ndarray:
        return np.array([getattr(reading, field) for reading in readings], float)
    yaw, pitch, roll = (round_to_resolution(column(field), "angle") for field in ("yaw", "pitch", "roll"))
    cosine, sine = np.cos(column("yaw")), np.sin(column("yaw"))
    forward, left = column("velocity_x"), column("velocity_y")
    level = np.stack([cosine * forward - sine * left, sine * forward + cosine * left, column("velocity_z")])
    velocity = Attitude(yaw, -pitch, roll).to_body(round_to_resolution(level, "velocity"))
    angle = round_to_resolution(steering[:, 1], "steering")
    force = round_to_resolution(column("specific_force"), "force")
    return DriveLog(name, _to_nanoseconds(column("stamp")), column("x"), column("y"), np.unwrap(yaw), velocity[0],
                    velocity[1],
                    round_to_resolution(column("rates")[:, 2], "rate"), _to_nanoseconds(steering[:, 0]),
                    vehicle.road_wheel_angle(angle), angle, force[:, 0], force[:, 1])


def _to_nanoseconds(seconds: np.ndarray) -> np.ndarray:
    return START_NS + np.round(seconds * 1e9).astype(np.int64)
