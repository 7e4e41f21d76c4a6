"""Drives of the virtual Leaf for identification: simulated once, measured as often as one likes with other noise."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter
from st_core.log import DriveLog
from st_offline.paths import config
from st_sim.car import Car, read_car
from st_sim.path import straight, turn
from st_sim.scenarios import Plan, RoadPlan, load
from st_sim.sensors import NOISE, ROUGH_SPEED, Ins
from st_sim.settings import resolve
from st_sim.simulation import SimulatedCar

T0 = 1_756_900_800_000_000_000
INTERVAL_MS = 10
RESOLUTION = np.deg2rad(0.1)  # of the steering angle on the Leaf's CAN bus
SENSORS = ("ins_noise=1", "steering_sensor_noise=0.0005")
COLUMNS = ("x", "y", "yaw", "velocity_x", "velocity_y", "rate_z", "force_x", "force_y")
LEAF_FILE = config("vehicle/leaf.yaml")


@dataclass(frozen=True)
class Simulated:
    """One drive as faultless sensors see it, every INTERVAL_MS; columns as COLUMNS. hand: the true hand wheel [rad]."""

    name: str
    car: Car
    settings: dict[str, float]
    readings: np.ndarray
    hand: np.ndarray


def simulate(name: str, plan: Plan, settings: dict[str, float], seconds: float, seed: int) -> Simulated:
    """seed: of the driver's tremor."""
    car = read_car(LEAF_FILE)
    drive = SimulatedCar(car, settings, plan, seed)
    ins = Ins(car, {**settings, "ins_noise": 0.0}, INTERVAL_MS / 1000, seed)
    rows, hand = [], []
    for k in range(round(seconds * 1000 / INTERVAL_MS)):
        drive.advance(k * INTERVAL_MS / 1000)
        r = ins.read(drive.truth())
        rows.append((r.x, r.y, r.yaw, r.velocity_x, r.velocity_y, r.rates[2], *r.specific_force[:2]))
        hand.append(drive.driver.steering_wheel_angle)
    return Simulated(name, car, settings, np.array(rows), np.array(hand))


def measure(drive: Simulated, seed: int) -> DriveLog:
    """What INS and steering sensor record of it; seed: of their noise, which is that of the virtual car's sensors."""
    generator = np.random.default_rng([seed, *drive.name.encode()])
    rough = 0.1 + 0.9 * np.minimum(np.abs(drive.readings[:, COLUMNS.index("velocity_x")]) / ROUGH_SPEED, 1.0)
    columns = {}
    for name, values in zip(COLUMNS, drive.readings.T, strict=True):
        white, slow, time = (drive.settings["ins_noise"] ** power * v
                             for power, v in zip((1, 1, 0), NOISE[name], strict=True))
        memory = np.exp(-INTERVAL_MS / 1000 / time)
        kicks = slow * generator.standard_normal(len(values))
        kicks[1:] *= np.sqrt(1.0 - memory**2)
        wander = lfilter([1.0], [1.0, -memory], kicks)
        shaken = rough if name.startswith(("rate", "force")) else 1.0
        columns[name] = values + wander + white * shaken * generator.standard_normal(len(values))
    hand = drive.hand + drive.car.steering_wheel_offset
    hand = hand + drive.settings["steering_sensor_noise"] * generator.standard_normal(len(hand))
    hand = np.round(hand / RESOLUTION) * RESOLUTION
    time_ns = T0 + np.arange(len(hand), dtype=np.int64) * INTERVAL_MS * 1_000_000
    return DriveLog(
        drive.name, time_ns, columns["x"], columns["y"], np.unwrap(columns["yaw"]), columns["velocity_x"],
        columns["velocity_y"], columns["rate_z"], time_ns,
        (hand - drive.car.steering_wheel_offset) / drive.car.steering_ratio, hand, columns["force_x"],
        columns["force_y"])


def bends(radius: float, speed: float, angle: float = 150.0) -> Plan:
    """Left and right in turn, with short straights between."""
    blend = 0.3 * radius
    return RoadPlan([*straight(15, speed), *turn(radius, angle, speed, blend), *straight(15, speed),
                     *turn(radius, -angle, speed, blend)])


def road(speed: float) -> Plan:
    return RoadPlan(straight(1000.0, speed))


STIFFNESS_RUNS: Sequence[tuple[str, Callable[[], Plan]]] = (
    ("S3", lambda: load("S3")), ("S6", lambda: load("S6")), ("S7", lambda: load("S7")),
    ("lane change", lambda: load("lane_change")), ("slalom", lambda: load(str(config("manoeuvres/slalom.yaml")))),
    ("bends 20 m", lambda: bends(20.0, 6.5)), ("bends 35 m", lambda: bends(35.0, 9.0)),
    ("bends 60 m", lambda: bends(60.0, 13.0)), ("bends 100 m", lambda: bends(100.0, 16.0)),
    ("bends 45 m", lambda: bends(45.0, 11.5)))
STRAIGHT_RUNS = tuple((f"straight {speed} m/s", lambda speed=speed: road(speed)) for speed in (8.0, 10.0, 12.0, 14.0))
SLOW_RUNS = (("figure eight", lambda: load("S1")), ("bends 8 m", lambda: bends(8.0, 2.5, 200.0)),
             ("bends 12 m", lambda: bends(12.0, 4.0)), ("bends 18 m", lambda: bends(18.0, 6.0)),
             ("bends 25 m", lambda: bends(25.0, 7.5)), ("slow U-turns", lambda: load("S6")))
TRANSIENT_RUNS = (("sweep", lambda: load("sweep")), ("step", lambda: load("step")),
                  ("lane change", lambda: load("lane_change")),
                  ("slalom", lambda: load(str(config("manoeuvres/slalom.yaml")))))


def simulate_all(runs: Sequence[tuple[str, Callable[[], Plan]]], plant: str, effects: Sequence[str] = (),
                 seconds: float = 60.0, driver_seeds: Sequence[int] = (1,)) -> list[list[Simulated]]:
    """Every run with every driver: [driver][run]."""
    settings = resolve(plant, (*SENSORS, "driver_tremor=0.01", *effects))
    return [[simulate(name, plan(), settings, seconds, 100 * driver + number)
             for number, (name, plan) in enumerate(runs)] for driver in driver_seeds]
