"""Drives the multi-body cars of `bench.discovery` on the roads of this benchmark."""

from dataclasses import replace

import numpy as np
from st_sim.dynamics import STATES, VX, VY, YAW, YAW_RATE, X, Y

from ..plants.leaf import Programme
from ..plants.multibody import drive_multibody
from ..plants.multibody_car import nominal_car, vehicle_of
from . import simulation
from .vehicles import DUGOFF, ROLLING, Car, Parameters

PERIOD = 0.01
HEADING_GAIN = 0.3
SIMPLE_CAR = Parameters(0.0, 0.0, 0.0, 0.0, 0.55, 1.5, 0.0, 0.0, 1.0, DUGOFF, 1.0)


def parameters(car: Car) -> Parameters:
    """Parameters of a multi-body car with its settings: mass, inertia, lengths, stiffness and friction."""
    v = vehicle_of(car.package, dict(car.settings))
    return car.parameters._replace(
        mass=v.mass, inertia=v.yaw_inertia, wheelbase=v.wheelbase, front=v.cg_to_front_axle, height=v.cg_height,
        stiffness_front=v.cornering_stiffness_front, stiffness_rear=v.cornering_stiffness_rear,
        grip=dict(car.settings).get("friction_factor", 1.0))


def drive(car: Car, road: np.ndarray, seconds: float, wander: np.ndarray, seed: int) -> np.ndarray:
    """Rows as those of `simulation.drive`.

    A simple car drives the road first; its steering, heading and speed are the programme of the multi-body car, whose
    driver controls the heading.
    """
    v = nominal_car(car.package)
    simple_car = SIMPLE_CAR._replace(
        mass=v.mass, inertia=v.yaw_inertia, wheelbase=v.wheelbase, front=v.cg_to_front_axle,
        stiffness_front=v.cornering_stiffness_front, stiffness_rear=v.cornering_stiffness_rear,
        drive_front=car.parameters.drive_front)
    simple_rows = simulation.drive(ROLLING, road, simple_car, seconds, wander)[400::2]
    programme = Programme(simple_rows[:, simulation.WHEEL] * v.steering_ratio, simple_rows[:, 2],
                          np.full(len(simple_rows), HEADING_GAIN), simple_rows[:, 3], simple_rows[:, simulation.VX_DOT])
    recording = drive_multibody(car.package, dict(car.settings), programme, seed)
    r, out = recording.rows, np.zeros((len(simple_rows), simulation.ROW))
    out[:, :6] = r[:, [X, Y, YAW, VX, VY, YAW_RATE]]
    out[:, simulation.VX_DOT:simulation.YAW_RATE_DOT + 1] = r[:, STATES:STATES + 3]
    out[:, simulation.WHEEL] = recording.steering_wheel / v.steering_ratio
    fine = np.arange(2 * len(out) - 1) / 2
    return np.column_stack([np.interp(fine, np.arange(len(out)), column) for column in out.T])


def add_load(car: Car, mass: float, shift: float, inertia: float) -> Car:
    """The car with factors on mass and yaw inertia due to a load, and the CG further back by `shift` [m]."""
    settings = dict(car.settings)
    settings["mass_factor"] = settings.get("mass_factor", 1.0) * mass
    settings["yaw_inertia_factor"] = settings.get("yaw_inertia_factor", 1.0) * inertia
    settings["cg_shift"] = settings.get("cg_shift", 0.0) - shift
    return replace(car, settings=tuple(settings.items()))


def wear_tyres(car: Car, axle: str, factor: float) -> Car:
    settings, key = dict(car.settings), f"{axle}_stiffness_factor"
    return replace(car, settings=tuple({**settings, key: settings.get(key, 1.0) * factor}.items()))
