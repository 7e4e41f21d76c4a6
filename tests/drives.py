"""Computed drives as CSV files, for the tests of `st evaluate`."""

from pathlib import Path

import numpy as np
from st_core.log import DriveLog
from st_core.vehicle import VehicleParameters
from st_recordings.runs import LoadedRun
from st_recordings.runs.columns import Layout
from st_recordings.runs.csv import build_drive
from st_recordings.runs.csv_table import read_table

T0 = 1_700_000_000_000_000_000
COLUMNS = "t,x,y,yaw,vx,vy,yaw_rate,ax,ay,delta"


def read_csv(file: Path, vehicle: VehicleParameters | None = None, layout: Layout | None = None) -> LoadedRun:
    """The drive in a CSV file, before implausible samples are removed."""
    return build_drive(read_table(file, layout or Layout()), vehicle)


def weave(seconds: float = 14.0, speed: float = 8.0, curvature: float = 0.03) -> np.ndarray:
    """Rows of COLUMNS at 50 Hz: a kinematic car of 2.7 m wheelbase, measured 1.524 m ahead of its rear axle.

    It weaves with the given largest curvature [1/m]. Its speed varies by 1 %, as a constant one would count as frozen.
    Without slip, so a kinematic model has almost no error.
    """
    dt, rear = 0.001, 1.524
    time = np.arange(0.0, seconds, dt)
    bend = curvature * np.sin(2 * np.pi * time / 7.0)  # of the rear axle's path
    delta = np.arctan(2.7 * bend)
    beta = np.arctan(rear * bend)
    speed = speed * (1.0 + 0.01 * np.sin(2 * np.pi * time / 5.0))
    yaw_rate = speed * bend
    yaw = np.concatenate([[0.0], np.cumsum(yaw_rate[:-1] * dt)])
    # `speed` is along body x; the point moves along yaw + beta.
    course = speed / np.cos(beta)
    x = np.concatenate([[0.0], np.cumsum((course * np.cos(yaw + beta))[:-1] * dt)])
    y = np.concatenate([[0.0], np.cumsum((course * np.sin(yaw + beta))[:-1] * dt)])
    across = speed * rear * bend
    forward = np.gradient(speed, dt) - across * yaw_rate
    left = np.gradient(across, dt) + speed * yaw_rate
    columns = [time, x, y, yaw, speed, across, yaw_rate, forward, left, delta]
    return np.stack(columns, axis=1)[::20]


def circle(seconds: float = 40.0, speed: float = 8.0, curvature: float = 0.03) -> np.ndarray:
    """As `weave`, but with a constant curvature to the left."""
    time = np.arange(0.0, seconds, 0.02)
    beta = np.arctan(1.524 * curvature)
    speed = speed * (1.0 + 0.01 * np.sin(2 * np.pi * time / 5.0))
    yaw_rate, across = speed * curvature, speed * 1.524 * curvature
    yaw = np.concatenate([[0.0], np.cumsum(yaw_rate[:-1] * 0.02)])
    course = speed / np.cos(beta)
    x, y = (np.concatenate([[0.0], np.cumsum((course * turn(yaw + beta))[:-1] * 0.02)]) for turn in (np.cos, np.sin))
    return np.stack([time, x, y, yaw, speed, across, yaw_rate, np.gradient(speed, 0.02) - across * yaw_rate,
                     np.gradient(across, 0.02) + speed * yaw_rate, np.full_like(time, np.arctan(2.7 * curvature))], 1)


def write_drive(path: Path, rows: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(path, rows, delimiter=",", header=COLUMNS, comments="", fmt="%.6f")
    return path


def write_vehicle(path: Path, leaf: Path) -> Path:
    """Writes a vehicle file of the Leaf with the INS at the CG, the point of the drives."""
    text = leaf.read_text().replace("cg_to_ins_x: {value: -0.398", "cg_to_ins_x: {value: 0.0")
    path.write_text(text)
    return path


def wavy_drive(seconds=12.0, seed=1) -> DriveLog:
    """Weaving at 6 to 10 m/s with uneven stamps; INS at 100 Hz, steering at 50 Hz."""
    rng = np.random.default_rng(seed)
    time = np.cumsum(rng.uniform(0.007, 0.013, int(seconds * 100)))
    steering_time = np.cumsum(rng.uniform(0.015, 0.025, int(seconds * 50)))
    speed = 8.0 + 2.0 * np.sin(0.5 * time)
    yaw_rate = 0.25 * np.sin(0.8 * time)
    dt = np.diff(time, prepend=0.0)
    yaw = np.cumsum(yaw_rate * dt)
    return DriveLog(
        "wavy", T0 + np.round(time * 1e9).astype(np.int64), np.cumsum(speed * np.cos(yaw) * dt),
        np.cumsum(speed * np.sin(yaw) * dt), yaw, speed + rng.normal(0.0, 0.01, len(time)), -0.1 * yaw_rate, yaw_rate,
        T0 + np.round(steering_time * 1e9).astype(np.int64), 2.7 / 8.0 * 0.25 * np.sin(0.8 * steering_time))
