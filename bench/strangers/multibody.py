"""Drives the multi-body cars of `bench.discovery` on the roads of this benchmark; the rows are those of
`plants.drive`."""

from dataclasses import replace

import numpy as np
from st_sim.dynamics import STATES, VX, VY, YAW, YAW_RATE, X, Y

from ..discovery.compiled import Programme
from ..discovery.multibody import drive_multibody
from ..discovery.multibody_car import nominal_car, vehicle_of
from . import plants
from .vehicles import DUGOFF, ROLLING, Numbers, Stranger

PERIOD = 0.01
HEADING_GAIN = 0.3
PROXY = Numbers(0.0, 0.0, 0.0, 0.0, 0.55, 1.5, 0.0, 0.0, 1.0, DUGOFF, 1.0)


def numbers(car: Stranger) -> Numbers:
    """The parameters of a multi-body car with its settings: mass, inertia, lengths, stiffness and friction."""
    v = vehicle_of(car.package, dict(car.settings))
    return car.numbers._replace(
        mass=v.mass, inertia=v.yaw_inertia, wheelbase=v.wheelbase, front=v.cg_to_front_axle, height=v.cg_height,
        stiffness_front=v.cornering_stiffness_front, stiffness_rear=v.cornering_stiffness_rear,
        grip=dict(car.settings).get("friction_factor", 1.0))


def drive(car: Stranger, road: np.ndarray, seconds: float, wander: np.ndarray, seed: int) -> np.ndarray:
    """Rows as those of `plants.drive`.

    A simple car drives the road first; its steering, heading and speed are the programme of the multi-body car, and a
    driver keeps the heading.
    """
    v = nominal_car(car.package)
    proxy = PROXY._replace(
        mass=v.mass, inertia=v.yaw_inertia, wheelbase=v.wheelbase, front=v.cg_to_front_axle,
        stiffness_front=v.cornering_stiffness_front, stiffness_rear=v.cornering_stiffness_rear,
        drive_front=car.numbers.drive_front)
    proxy_rows = plants.drive(ROLLING, road, proxy, seconds, wander)[400::2]
    programme = Programme(proxy_rows[:, plants.WHEEL] * v.steering_ratio, proxy_rows[:, 2],
                          np.full(len(proxy_rows), HEADING_GAIN), proxy_rows[:, 3], proxy_rows[:, plants.AX])
    recording = drive_multibody(car.package, dict(car.settings), programme, seed)
    r, out = recording.rows, np.zeros((len(proxy_rows), plants.ROW))
    out[:, :6] = r[:, [X, Y, YAW, VX, VY, YAW_RATE]]
    out[:, plants.AX:plants.TURN + 1] = r[:, STATES:STATES + 3]
    out[:, plants.WHEEL] = recording.steering_wheel / v.steering_ratio
    fine = np.arange(2 * len(out) - 1) / 2
    return np.column_stack([np.interp(fine, np.arange(len(out)), column) for column in out.T])


def add_load(car: Stranger, mass: float, shift: float, inertia: float) -> Stranger:
    """The car with a load: factors on mass and yaw inertia, and the CG moved back by `shift` [m]."""
    settings = dict(car.settings)
    settings["mass_factor"] = settings.get("mass_factor", 1.0) * mass
    settings["yaw_inertia_factor"] = settings.get("yaw_inertia_factor", 1.0) * inertia
    settings["cg_shift"] = settings.get("cg_shift", 0.0) - shift
    return replace(car, settings=tuple(settings.items()))


def wear_tyres(car: Stranger, axle: str, factor: float) -> Stranger:
    settings, key = dict(car.settings), f"{axle}_stiffness_factor"
    return replace(car, settings=tuple({**settings, key: settings.get(key, 1.0) * factor}.items()))
