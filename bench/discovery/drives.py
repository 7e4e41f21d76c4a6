"""The drives of a case, and the inputs of `discover`."""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from st_core.channels import CHANNELS
from st_core.discovery.settings import DiscoverySettings
from st_core.log import DriveLog
from st_core.vehicle import VehicleParameters
from st_sim.settings import Settings

from ..plants.record import HealthyCar, RunPlan, record_run, vehicle_of
from ..plants.resimulated import draw_seed, resimulate
from .cases import SITE_DISTANCE, Case
from .effects import Values, null_value, true_values
from .oracle import Oracle

RUNS, HELD_OUT = 3, 2
IDENTIFIED = ("front_stiffness", "rear_stiffness", "friction", "steering_ratio", "steering_offset")
"""Quantities that block C identifies on other drives of the car."""
MAX_ERROR = {"factor": 0.02, "angle": 0.0005}
"""Maximum error of a correct identified value [1, rad]."""


@dataclass(frozen=True)
class Drives:
    """The drives of a case."""

    reference: tuple[DriveLog, ...]  # reference, suspect and vehicle are the input of `discover`
    suspect: tuple[DriveLog, ...]
    held_out: tuple[DriveLog, ...]  # further drives of the suspect car
    healthy_held_out: tuple[DriveLog, ...]  # the same programmes, driven by the healthy car
    vehicle: VehicleParameters
    truth: Values  # values, relative to the vehicle file, of all effects for which the plant has a setting
    wrong_in_file: tuple[str, ...] = ()  # effects of which the identified file has a wrong value


def settings_of(case: Case) -> DiscoverySettings:
    channels = tuple(channel for channel in CHANNELS if case.with_vy or channel != "velocity_y")
    return DiscoverySettings(channels=channels, effects=case.effects, locate_errors=False)


def drives_of(case: Case) -> Drives:
    """Drives the cars of a case."""
    vehicle, file_errors = _make_file(case)
    suspect = _suspect(case, vehicle)
    held_out = _held_out(case, vehicle, case.settings)
    if case.kind == "base":
        suspect, held_out = ([resimulate(log, vehicle, draw_seed(case.seed, i, 7)) for i, log in enumerate(logs)]
                             for logs in (suspect, held_out))
    if not case.with_vy:
        suspect = [without_vy(log) for log in suspect]
    reference: tuple[DriveLog, ...] = ()
    if case.reference:
        reference = _reference(case.car, tuple(sorted(case.file.items())), case.with_vy)
    healthy_held_out = _held_out(case, vehicle, case.car.settings) if case.block in "DE" else []
    truth = true_values(case.settings, case.file or case.settings, vehicle) | file_errors
    wrong = tuple(n for n, values in file_errors.items() for p, v in values.items()
                  if abs(v - null_value(n, p)) > MAX_ERROR[p])
    return Drives(reference, tuple(suspect), tuple(held_out), tuple(healthy_held_out), vehicle, truth, wrong)


def record_more(case: Case, vehicle: VehicleParameters, plans: list[RunPlan]) -> tuple[DriveLog, ...]:
    """Records further drives of the car of a case."""
    logs = [record_run(case.car.plant, vehicle, plan) for plan in plans]
    return tuple(log if case.with_vy else without_vy(log) for log in logs)


def without_vy(log: DriveLog) -> DriveLog:
    """The log without measured v_y, which is set to zero, so that it cannot be used by accident."""
    return replace(log, velocity_y=np.zeros_like(log.velocity_y))


def _make_file(case: Case) -> tuple[VehicleParameters, Values]:
    """(vehicle file, its errors). The file is that of the case, or is identified on separate drives, where an axle with
    compliance appears softer than its tyres."""
    if case.file is not None:
        return vehicle_of(case.car.plant, case.file), {}
    start = vehicle_of(case.car.plant, case.car.settings)
    logs = [record_run(case.car.plant, start, RunPlan(f"identified_{i + 1}", (case.seed, 400 + i), case.settings))
            for i in range(RUNS)]
    model = Oracle(logs, start, IDENTIFIED, {}, DiscoverySettings(locate_errors=False)).best.model
    ratio = start.steering_ratio * model.values["steering_ratio"]["factor"]
    offset = start.steering_wheel_offset - model.values["steering_offset"]["angle"] * ratio
    errors = {n: {"factor": 1.0 / model.values[n]["factor"]} for n in IDENTIFIED if n != "steering_offset"}
    errors["steering_offset"] = {"angle": -model.values["steering_offset"]["angle"]}
    return replace(model.effective_vehicle(start), steering_ratio=ratio, steering_wheel_offset=offset), errors


def _suspect(case: Case, vehicle: VehicleParameters) -> list[DriveLog]:
    draw = np.random.default_rng([case.seed, 9])
    logs = []
    for i in range(RUNS):
        factors = _factors(draw) if case.shifted else (1.0, 1.0)
        at_other_site = case.other_site is not None and i % 2 == 1
        plan = RunPlan(f"suspect_{i + 1}", (case.seed, i), case.other_site if at_other_site else case.settings,
                       case.parts, factors, case.car.settings if case.change_at else None, case.change_at,
                       SITE_DISTANCE if at_other_site else 0.0)
        logs.append(record_run(case.car.plant, vehicle, plan))
    return logs


def _factors(draw: np.random.Generator) -> tuple[float, float]:
    return float(draw.choice([draw.uniform(0.8, 0.9), draw.uniform(1.1, 1.2)])), float(draw.uniform(0.7, 1.1))


def _held_out(case: Case, vehicle: VehicleParameters, settings: Settings) -> list[DriveLog]:
    return [record_run(case.car.plant, vehicle, RunPlan(
        f"held_out_{i + 1}", (*case.car.seed, 200 + i), settings, factors=((1.0, 0.9)[i], 1.0)))
            for i in range(HELD_OUT)]


@lru_cache(maxsize=2)
def _reference(car: HealthyCar, file: tuple, with_vy: bool) -> tuple[DriveLog, ...]:
    vehicle = vehicle_of(car.plant, dict(file))
    logs = [record_run(car.plant, vehicle, RunPlan(f"reference_{i + 1}", (*car.seed, 100 + i), car.settings))
            for i in range(RUNS)]
    return tuple(log if with_vy else without_vy(log) for log in logs)
