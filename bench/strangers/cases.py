"""The cases: car, hidden errors, guesses of the owner, and drives; each half is drawn from one seed."""

import math
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np

from . import multibody
from .roads import ROADS
from .vehicles import CARS, DEVELOPMENT, MULTI_BODY, SEALED, Car

HALVES = {"development": (DEVELOPMENT, 20261125), "sealed": (SEALED, 31415926)}
NEW_USER = "new_user"
"""The case of a new user: front-wheel drive, brush tyres, a vehicle file that is correct except for the steering ratio,
and six drives with mild cornering."""
VDRIFT, VDRIFT_FRESH = "vdrift", "vdrift_fresh"
"""Ten cars by the equations of VDrift, chosen before the first search, with everyday drives; three chosen later."""
USER_ROADS = (("town", 3.0, 80.0), ("country", 4.0, 80.0), ("slalom", 4.5, 70.0), ("roundabouts", 3.5, 80.0))
CAN_DELAY = 0.015  # s, of the steering on the bus, of the cars VDRIFT
VDRIFT_ERRORS: dict[str, tuple[tuple[str, Mapping[str, float]], ...]] = {
    VDRIFT: (("m3", {"ratio": 0.06}), ("mi", {"lever": 0.3}), ("350z", {"cg": 0.08}), ("co", {"mass": -0.1}),
             ("ns", {"worn_rear": 0.8}), ("tl2", {"delay": 0.06}), ("rs2", {"rear_angle": math.radians(0.4)}),
             ("gtv6", {"rear_steer": -0.05}), ("att", {"trailer": 900.0}), ("cs", {})),
    VDRIFT_FRESH: (("xm", {"worn_rear": 0.78}), ("sv", {"worn_rear": 0.85}), ("xs", {"ratio": -0.05}),
                   ("xm", {"worn_front": 0.8, "worn_rear": 0.55}))}
LOAD_DISTANCE = 0.3  # m, of the load, ahead of the rear axle
SINGLE = {"ratio": 6, "offset": 4, "load": 4, "lever": 4, "worn_front": 4, "worn_rear": 4, "compliance": 3, "delay": 3,
          "gyro_scale": 2, "gyro_bias": 1, "heading": 1}
PAIRS = (("ratio", "offset"), ("lever", "delay"), ("heading", "offset"), ("ratio", "worn_rear"))
HEALTHY = 20
SIZE_RANGES = {  # smallest and largest size in SI units; the sign of those in SIGNED is random
    "ratio": (0.04, 0.09), "offset": (math.radians(1.0), math.radians(2.5)), "load": (170.0, 320.0),
    "lever": (0.25, 0.5), "worn_front": (0.74, 0.87), "worn_rear": (0.74, 0.87), "compliance": (1.5e-6, 3.0e-6),
    "delay": (0.06, 0.15), "gyro_scale": (0.015, 0.03), "gyro_bias": (math.radians(0.15), math.radians(0.4)),
    "heading": (math.radians(0.5), math.radians(1.0))}
SIGNED = ("ratio", "offset", "lever", "gyro_scale", "gyro_bias", "heading")


@dataclass(frozen=True)
class Case:
    """A car with its hidden errors, its vehicle file and its drives."""

    name: str
    car: str
    # Error -> size in SI units. ratio, mass: in the file over true, minus 1; lever: true minus in the file; cg: CG to
    # front axle, in the file minus true; load, trailer: mass; worn_*: factor on the stiffness; compliance: in
    # addition to that of the car; rear_angle, rear_steer: parameters of the car.
    hidden: Mapping[str, float]
    guess: Mapping[str, float]  # values of the vehicle file that were not measured
    uncertainty: Mapping[str, float]  # standard deviations in the file
    # (road, lateral acceleration that the driver accepts [m/s^2], duration [s]).
    drives: tuple[tuple[str, float, float], ...]
    seed: int = 0
    sensors: Mapping[str, float] = field(default_factory=dict)  # errors of sensors and their mounting


def is_possible(car: Car, faults: tuple[str, ...]) -> bool:
    """Whether a car can have these errors; cars with compliance, and multi-body cars, get no additional one."""
    compliant = car.parameters.compliance > 0 or car.parameters.column > 0
    return "compliance" not in faults or not (compliant or car.equations == MULTI_BODY)


@cache
def cases(half: str) -> dict[str, Case]:
    """Cases of a half, or those of NEW_USER or VDRIFT, by name.

    Each half has 60 cases: 20 without an error except guesses, 36 with one error, and 4 with two.
    """
    if half == NEW_USER:
        return {NEW_USER: make_new_user()}
    if half in VDRIFT_ERRORS:
        drawn = [_draw_frozen(car, hidden, number) for number, (car, hidden) in enumerate(VDRIFT_ERRORS[half])]
        return {case.name: case for case in drawn}
    cars, seed = HALVES[half]
    rng = np.random.default_rng(seed)
    faults = [(), *[()] * (HEALTHY - 1), *[(name,) for name, count in SINGLE.items() for _ in range(count)], *PAIRS]
    faults = [faults[i] for i in rng.permutation(len(faults))]
    found: dict[str, Case] = {}
    for number in range(len(faults)):
        car = cars[number % len(cars)]
        fitting = [f for f in faults if is_possible(car, f)]
        new = [f for f in fitting if f"{car.name}_{'_and_'.join(f) or 'healthy'}" not in found]
        chosen = next(iter(new or fitting), None)
        if chosen is None:  # this car can have none of the remaining errors
            car = next(one for one in cars if is_possible(one, faults[0]))
            chosen = faults[0]
        faults.remove(chosen)
        base = f"{car.name}_{'_and_'.join(chosen) or 'healthy'}"
        name = next(n for n in (base, *(f"{base}_{k}" for k in range(2, 60))) if n not in found)
        found[name] = _draw_case(name, car, chosen, number, zlib.crc32(f"{half} {name}".encode()))
    return found


def make_new_user() -> Case:
    """The case NEW_USER: the steering ratio in the file is 8 % too large."""
    n = CARS["own_car"].parameters
    known = {"yaw_inertia": n.inertia, "cornering_stiffness_front": n.stiffness_front,
             "cornering_stiffness_rear": n.stiffness_rear, "cg_height": n.height}
    drives = tuple((name, 2.2 + 0.2 * k, 75.0) for k, name in enumerate(ROADS))
    return Case(NEW_USER, "own_car", {"ratio": 0.08}, known, {}, drives, 7, {})


def _draw_frozen(car: str, hidden: Mapping[str, float], number: int) -> Case:
    """A case with given errors on USER_ROADS; only the guesses of the owner are drawn."""
    name, drawn = f"{car}_{'_and_'.join(hidden) or 'healthy'}", tuple(fault for fault in hidden if fault in SIZE_RANGES)
    case = _draw_case(name, CARS[car], drawn, number, zlib.crc32(name.encode()))
    sensors = {**_sensor_errors(hidden), "delay": CAN_DELAY + hidden.get("delay", 0.0)}
    return replace(case, hidden=hidden, drives=USER_ROADS, sensors=sensors)


def _draw_case(name: str, car: Car, faults: tuple[str, ...], number: int, seed: int) -> Case:
    rng = np.random.default_rng(seed)
    hidden = {fault: float(rng.uniform(*SIZE_RANGES[fault])) * (rng.choice((-1, 1)) if fault in SIGNED else 1)
              for fault in faults}
    n = multibody.parameters(car) if car.equations == MULTI_BODY else car.parameters
    softening = 1 + n.stiffness_front * (n.compliance + n.column * n.trail)
    stiffness_factors = np.exp(rng.normal(0.0, 0.16, 2))
    # For worn tyres, the file contains the stiffness of the new ones.
    stiffness_factors = [1.0 if f"worn_{axle}" in faults else value
                         for axle, value in zip(("front", "rear"), stiffness_factors, strict=True)]
    inertia = n.mass * n.front * (n.wheelbase - n.front) * rng.choice((1.0, 0.92, 1.08))
    guess = {"yaw_inertia": float(round(inertia, -1)),
             "cornering_stiffness_front": float(round(n.stiffness_front / softening * stiffness_factors[0], -3)),
             "cornering_stiffness_rear": float(round(n.stiffness_rear * stiffness_factors[1], -3)),
             "cg_height": float(rng.choice((0.5, 0.55, 0.6)) + (0.1 if n.height > 0.65 else 0.0))}
    uncertainty = {}
    if number % 3 == 1:
        uncertainty = {"mass": 0.02 * n.mass if "load" in faults else 0.01 * n.mass, "cg_to_front_axle": 0.02,
                       "cg_height": 0.06, "yaw_inertia": 0.15 * guess["yaw_inertia"], "wheelbase": 0.005,
                       "cornering_stiffness_front": 0.25 * guess["cornering_stiffness_front"],
                       "cornering_stiffness_rear": 0.25 * guess["cornering_stiffness_rear"],
                       "steering_ratio": 0.03 * car.ratio}
    count = int(rng.integers(4, 7))
    names = [ROADS[i] for i in rng.permutation(len(ROADS))[:count]]
    base = rng.uniform(2.2, 4.2)  # mild to brisk
    drives = tuple((one, float(base * rng.uniform(0.85, 1.5)), float(rng.integers(60, 91))) for one in names)
    return Case(name, car.name, hidden, guess, uncertainty, drives, seed, _sensor_errors(hidden))


def _sensor_errors(hidden: Mapping[str, float]) -> dict[str, float]:
    sensors = {name: hidden[name] for name in ("heading", "lever", "delay", "offset") if name in hidden}
    if "gyro_scale" in hidden:
        sensors["yaw_rate_scale"] = 1.0 + hidden["gyro_scale"]
    if "gyro_bias" in hidden:
        sensors["yaw_rate_bias"] = hidden["gyro_bias"]
    return sensors


def file_car(case: Case) -> Car:
    """The car as its owner measured it: without the load, and with new tyres."""
    car = CARS[case.car]
    return replace(car, parameters=multibody.parameters(car)) if car.equations == MULTI_BODY else car


def true_car(case: Case) -> Car:
    """The car of the drives."""
    car, n = file_car(case), file_car(case).parameters
    load = case.hidden.get("load", 0.0)
    arm = n.wheelbase - LOAD_DISTANCE - n.front  # of the load, behind the CG of the empty car
    shift = load * arm / (n.mass + load)
    inertia = n.inertia + n.mass * shift**2 + load * (arm - shift) ** 2
    changed = {key: case.hidden[key] for key in ("rear_angle", "rear_steer", "trailer") if key in case.hidden}
    front, rear = case.hidden.get("worn_front", 1.0), case.hidden.get("worn_rear", 1.0)
    if car.equations == MULTI_BODY:
        if load:
            car = multibody.add_load(car, (n.mass + load) / n.mass, shift, inertia / n.inertia)
        for axle, factor in (("front", front), ("rear", rear)):
            car = multibody.wear_tyres(car, axle, factor) if factor != 1.0 else car
        return replace(car, parameters=multibody.parameters(car), ins=car.ins + shift)
    return replace(car, ins=car.ins + shift, parameters=n._replace(
        mass=n.mass + load, front=n.front + shift, inertia=inertia, stiffness_front=n.stiffness_front * front,
        stiffness_rear=n.stiffness_rear * rear, compliance=n.compliance + case.hidden.get("compliance", 0.0),
        **changed))
