"""Experiment tables with realistic noise of a car with known parameters, which `st identify` has to recover."""

import sys
from pathlib import Path

import numpy as np
from st_core.identification.magic_formula import FlatPlank
from st_core.identification.mass_and_cg import LiftRows, Weighings
from st_core.identification.steering import Turntable
from st_core.tyres import tyre_force
from st_core.vehicle import VehicleParameters

SCALE_NOISE, SCALE_ERROR, SCALE_STEP = 0.8, 0.5, 0.5  # kg: repeatability, error of a scale, resolution
PITCH_NOISE, RADIUS_NOISE = np.radians(0.05), 0.003  # rad, m
STEERING_STEP, TABLE_NOISE = np.radians(0.1), np.radians(0.1)  # rad: resolution of the angle, noise of a turntable
FORCE_NOISE, LOAD_NOISE = 20.0, 10.0  # N; the force noise is 0.5 % of the largest force
RADII = (0.302, 0.299)  # m, loaded wheels front and rear
TYRE_STIFFNESS = 20000.0  # kg/m, of one tyre


def weighings(car: VehicleParameters, seed: int, count: int = 3) -> Weighings:
    """Four scales; the driver loads the left side slightly more."""
    random = np.random.default_rng(seed)
    share = car.cg_to_front_axle / car.wheelbase
    true = car.mass * np.array([0.51 * (1 - share), 0.49 * (1 - share), 0.51 * share, 0.49 * share])
    read = true + random.normal(0.0, SCALE_ERROR, 4) + random.normal(0.0, SCALE_NOISE, (count, 4))
    names = tuple(map(str, range(1, count + 1)))
    return Weighings(np.round(read / SCALE_STEP) * SCALE_STEP, names, ("driver",) * count)


def axle_lift(car: VehicleParameters, seed: int, lifts: int = 2) -> LiftRows:
    """Front axle lifted in steps; exact statics with elastic rear tyres, noise of scales and inclinometer."""
    random = np.random.default_rng(seed)
    pitch = np.tile(np.radians([0.0, 3.0, 6.0, 9.0, 12.0, 15.0]), lifts)
    share = car.cg_to_front_axle / car.wheelbase
    line = RADII[0] * (1 - share) + RADII[1] * share
    load = car.mass * (share + (car.cg_height - line) / car.wheelbase * np.tan(pitch))
    rear = RADII[1] - (load - load[0]) / 2 / TYRE_STIFFNESS
    measured = load + random.normal(0.0, SCALE_NOISE, len(load)) + random.normal(0.0, SCALE_ERROR)
    off = random.normal(0.0, RADIUS_NOISE, 2)
    names = tuple(np.repeat([f"lift {k + 1}" for k in range(lifts)], 6).tolist())
    return LiftRows(pitch + random.normal(0.0, PITCH_NOISE, len(pitch)) * (pitch > 0),
                np.round(measured / SCALE_STEP) * SCALE_STEP,
                names, np.full(len(pitch), RADII[0] + off[0]), rear + off[1])


def turntable(car: VehicleParameters, seed: int) -> Turntable:
    """Sweep forth and back in steps of 45 deg; Ackermann steering, zero error of the tables, play between sweeps."""
    random = np.random.default_rng(seed)
    half = np.radians(np.arange(-540.0, 541.0, 45.0))
    steering = np.concatenate([half, half[::-1]])
    mean = steering / car.steering_ratio
    split = 0.5 * 1.54 / car.wheelbase * np.sin(mean) ** 2
    play = np.repeat([1.0, -1.0], len(half)) * np.radians(0.1)
    left, right = (np.round((mean + sign * split + play + random.normal(0.0, np.radians(0.3))
                             + random.normal(0.0, TABLE_NOISE, len(steering))) / np.radians(0.1)) * np.radians(0.1)
                   for sign in (1.0, -1.0))
    noisy = np.round((steering + random.normal(0.0, np.radians(1.0), len(steering))) / STEERING_STEP) * STEERING_STEP
    # The steering wheel is never exactly at its mark; the logged angle is the actual one.
    true_mean = noisy / car.steering_ratio - mean
    return Turntable(noisy, left + true_mean, right + true_mean,
                     ("to the left",) * len(half) + ("to the right",) * len(half))


def flat_plank(car: VehicleParameters, tyre: str, seed: int) -> FlatPlank:
    """Three loads, slip angles to 12 deg in steps of 1."""
    random = np.random.default_rng(seed)
    slip = np.tile(np.radians(np.arange(-12.0, 12.5, 1.0)), 3)
    load = np.repeat([3300.0, 4250.0, 5200.0], len(slip) // 3) + random.normal(0.0, LOAD_NOISE, len(slip))
    true = tyre_force(slip, load, getattr(car, tyre)._replace(lambda_ky=1.0))
    return FlatPlank(tyre, load, slip, true + random.normal(0.0, FORCE_NOISE, len(slip)), tyre)


def write_tables(car: VehicleParameters, folder: Path, seed: int = 2) -> dict[str, Path]:
    """Writes the four tables as CSV files for `st identify`."""
    folder.mkdir(parents=True, exist_ok=True)
    w, lift, table = weighings(car, seed), axle_lift(car, seed), turntable(car, seed)
    planks = [flat_plank(car, tyre, seed) for tyre in ("tyre_front", "tyre_rear")]
    rows = {
        "scales": ("weighing,front_left_kg,front_right_kg,rear_left_kg,rear_right_kg,driver",
                   [(name, *(f"{x:.1f}" for x in row), load) for name, row, load in
                    zip(w.names, w.readings, w.loads, strict=True)]),
        "cg_height": ("series,pitch_deg,rear_left_kg,rear_right_kg,front_radius_m,rear_radius_m",
                      [(name, f"{np.degrees(p):.2f}", f"{0.5 * m:.2f}", f"{0.5 * m:.2f}", f"{f:.4f}", f"{r:.4f}")
                       for name, p, m, f, r in zip(lift.lifts, lift.pitch, lift.rear_load, lift.front_radius,
                                                   lift.rear_radius, strict=True)]),
        "steering_ratio": ("series,steering_wheel_deg,left_wheel_deg,right_wheel_deg",
                           [(name, *(f"{np.degrees(x):.2f}" for x in row)) for name, *row in
                            zip(table.sweeps, table.steering, table.left, table.right, strict=True)]),
        "flat_plank": ("tyre,load_n,slip_angle_deg,lateral_force_n",
                       [(p.tyre.removeprefix("tyre_"), f"{f:.0f}", f"{np.degrees(a):.2f}", f"{y:.1f}") for p in planks
                        for f, a, y in zip(p.load, p.slip, p.force, strict=True)]),
    }
    files = {}
    for name, (header, cells) in rows.items():
        files[name] = folder / f"{name}.csv"
        files[name].write_text("\n".join([header, *(",".join(map(str, row)) for row in cells)]) + "\n")
    return files


if __name__ == "__main__":
    vehicle, folder = map(Path, sys.argv[1:3])
    write_tables(VehicleParameters.from_yaml(vehicle.read_text(), str(vehicle)), folder)
