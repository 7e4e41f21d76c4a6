"""The drives of the corruption matrix: real drives of the Genesis and drives of the virtual Leaf, in two sets.

The sealed set, with other runs, scenarios and seeds than the development set, is used only once, at the end. A drive of
the virtual Leaf is simulated in memory: plant, driver and sensors of st_sim, rounding and axes of NCOM and CAN.
"""

import math
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import numpy as np
from st_core.checks import AuxiliaryData, Series
from st_recordings.paths import config
from st_recordings.runs.columns import Layout
from st_recordings.runs.csv import build_drive
from st_recordings.runs.csv_table import read_table
from st_sim.driver import SimulatedCar
from st_sim.dynamics import GRAVITY
from st_sim.scenarios import load_plan
from st_sim.sensors import Ins, InsReading, SteeringSensor, read_wheel_speeds
from st_sim.settings import Settings, read_vehicle, resolve_settings
from st_sim.stream import STEERING_SCHEDULE, TICK_MS, WHEEL_SCHEDULE

from .._drives import DATA, LEAF_FILE, SOUND_DRIVES, genesis, leaf
from ..plants.sensing import log_readings, round_to_resolution, to_nanoseconds
from .recording import Recording, with_good_quality

REAL = {
    "development": ("cpg_lap_slow", "cpg_lap_fast_controlled", "cpg_low_speed_a", "rfs_turn_b", "rfs_turn_c"),
    "sealed": ("cpg_lap_fast", "cpg_lap_medium", "cpg_low_speed_b", "rfs_turn_a", "cpg_low_speed_f"),
}
VIRTUAL = {
    "development": (("S1", 11), ("S5", 12), ("S6", 13), ("S7", 14), ("step", 15)),
    "sealed": (("lane_change", 81), ("sweep", 82), ("brake_in_turn", 83), (str(config("manoeuvres/slalom.yaml")), 84),
               (str(Path(__file__).with_name("country_road.yaml")), 85)),
}
DURATION = 120.0  # s, of a virtual drive
INS_PERIOD_MS = 10


def list_drives(set_: str) -> tuple[str, ...]:
    """Names of the drives of a set that are available, real ones first."""
    virtual = tuple(drive_name(scenario) for scenario, _ in VIRTUAL[set_])
    return tuple(name for name in REAL[set_] if _file(name).exists()) + virtual


@lru_cache(maxsize=4)
def load(name: str, set_: str) -> Recording:
    for scenario, seed in VIRTUAL[set_]:
        if name == drive_name(scenario):
            return virtual_drive(scenario, seed, DURATION)
    return real_drive(_file(name))


def real_drive(file: Path) -> Recording:
    return Recording(build_drive(read_table(file, Layout())).log, genesis(), True)


def list_real_files() -> list[Path]:
    """Files of all real drives."""
    return sorted(DATA.glob("*/*.csv"))


def _file(name: str) -> Path:
    # For a missing drive, the path of a file that does not exist, which the reader reports.
    files = [file for file in list_real_files() if file.stem == name]
    return files[0] if files else SOUND_DRIVES / f"{name}.csv"


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
    fields = {name: np.array([getattr(reading, name) for reading in readings])
              for name in ("x", "y", "yaw", "roll", "pitch", "velocity_x", "velocity_y", "velocity_z")}
    forces = np.array([reading.specific_force for reading in readings])
    fields |= {"force_x": forces[:, 0], "force_y": forces[:, 1], "rate_z": np.array([r.rates[2] for r in readings])}
    log = log_readings(drive_name(scenario), np.array([reading.stamp for reading in readings]), fields,
                       *np.array(steering).T, vehicle)
    times, speeds = np.array(wheels).T
    auxiliary = AuxiliaryData(wheel_speed=Series(to_nanoseconds(times), round_to_resolution(speeds, "wheel")))
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
