"""Vehicle files and drives that several benchmarks use: real drives of the Genesis, scenarios of the virtual Leaf."""

import contextlib
import io
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
from st_core.log import DriveLog
from st_core.vehicle import VehicleParameters
from st_recordings.car import read_vehicle
from st_recordings.paths import config, project_root
from st_recordings.runs import find_runs, read
from st_sim.run import main as virtual_leaf

LEAF_FILE, GENESIS_FILE = config("car/leaf/vehicle.yaml"), config("car/hyundai_genesis/vehicle.yaml")
DATA = Path(os.environ.get("ST_SHARED", project_root().parent / "shared")) / "data"
"""Folder of the real drives, which are not part of the repository."""
SOUND_DRIVES, OTHER_DRIVES = DATA / "hyundai_genesis_oxts", DATA / "hyundai_genesis_more"
"""Nine drives without a known fault, and other drives, most of them with a fault of known cause."""
SCENARIOS = ("S1", "S2", "S3", "S4", "S5", "S6", "S7")
SECONDS = 60.0


def leaf() -> VehicleParameters:
    return read_vehicle(LEAF_FILE)


def genesis() -> VehicleParameters:
    return read_vehicle(GENESIS_FILE)


def write_scenarios(folder: Path, seed: int = 1) -> Path:
    """S1 to S7 with the realistic plant, each SECONDS long: folder/<name>/run.ncom and run.mf4."""
    for name in SCENARIOS:
        with contextlib.redirect_stdout(io.StringIO()):
            status = virtual_leaf(["--scenario", name, "--vehicle", str(LEAF_FILE), "--duration", str(SECONDS),
                                   "--seed", str(seed), "--plant", "realistic", "--to-files", str(folder / name),
                                   "--can-format", "mf4"])
        if status:
            raise RuntimeError(f"virtual_leaf --scenario {name}: exit status {status}")
    return folder


def read_runs(path: Path, vehicle: VehicleParameters) -> dict:
    """Name -> log of each run in a folder."""
    return {source.name: read(source, vehicle).log for source in find_runs([path])}


def rotate_ins(log: DriveLog, angle: float) -> DriveLog:
    """The log of an INS that is rotated to the left by `angle` [rad]."""
    c, s = np.cos(angle), np.sin(angle)
    accelerations = {}
    if log.acceleration_x is not None and log.acceleration_y is not None:
        accelerations = {"acceleration_x": c * log.acceleration_x + s * log.acceleration_y,
                         "acceleration_y": c * log.acceleration_y - s * log.acceleration_x}
    return replace(log, yaw=log.yaw + angle, velocity_x=c * log.velocity_x + s * log.velocity_y,
                   velocity_y=c * log.velocity_y - s * log.velocity_x, **accelerations)


def move_ins(log: DriveLog, x: float) -> DriveLog:
    """The log of an INS that is `x` [m] further forward; the yaw acceleration is that of a smoothed yaw rate."""
    accelerations = {}
    if log.acceleration_x is not None:
        accelerations["acceleration_x"] = log.acceleration_x - x * log.yaw_rate**2
    if log.acceleration_y is not None:
        rate = np.convolve(log.yaw_rate, np.ones(5) / 5, "same")
        slope = np.gradient(rate, log.ins_time_ns * 1e-9)
        accelerations["acceleration_y"] = log.acceleration_y + x * slope
    return replace(log, x=log.x + x * np.cos(log.yaw), y=log.y + x * np.sin(log.yaw),
                   velocity_y=log.velocity_y + x * log.yaw_rate, **accelerations)
