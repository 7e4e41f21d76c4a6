"""Healthy cars of both plants, the virtual Leaf and the multi-body cars, their vehicle files and their drives."""

from dataclasses import dataclass, field, replace

import numpy as np
from st_core.log import DriveLog
from st_core.tyres import magic_formula_stiffness
from st_core.vehicle import VehicleParameters
from st_sim.settings import REALISTIC, SETTINGS, Settings, read_vehicle

from .._drives import LEAF_FILE, leaf
from . import multibody_car, programmes
from .leaf import NO_RELATION, DriveFailed, Programme, drive
from .multibody import log_multibody
from .multibody_car import SUPPORTED_SETTINGS, nominal_car
from .relation_equations import Relation, reshape_rear_tyre
from .sensing import make_log

LEAF = "leaf"
PLANTS = (LEAF, *multibody_car.CARS)
NOMINAL = read_vehicle(LEAF_FILE)
LEAF_VEHICLE = leaf()
MAX_LATERAL_VELOCITY = 6.0  # m/s; a higher one shows that the car has spun

# Standard deviations, relative to the nominal value or in its unit.
_RELATIVE = {
    "mass_factor": 0.03, "yaw_inertia_factor": 0.05, "front_stiffness_factor": 0.04, "rear_stiffness_factor": 0.04,
    "friction_factor": 0.03, "steering_ratio_factor": 0.02, "relaxation_length": 0.15, "steering_lag": 0.2,
    "steering_compliance": 0.2, "roll_gradient": 0.1, "velocity_scale": 0.001, "yaw_rate_scale": 0.002,
    "drag_area": 0.1, "rolling_resistance": 0.1,
}
_ABSOLUTE = {
    "steering_offset": 0.001, "cg_shift": 0.02, "ins_misalignment": 0.002, "ins_lever_error": 0.01,
    "lateral_acceleration_bias": 0.02, "roll_steer": 0.01,
}


@dataclass(frozen=True)
class HealthyCar:
    """A car of a plant (one of PLANTS), with the seed of its deviations and the settings of plant and sensors."""

    plant: str
    seed: tuple[int, ...]
    settings: Settings = field(compare=False)


def healthy_car(plant: str, seed: tuple[int, ...], **others: float) -> HealthyCar:
    """A car with random deviations. others: settings without a deviation."""
    generator = np.random.default_rng(seed)
    leaf = plant == LEAF
    values = dict(REALISTIC if leaf else multibody_car.HEALTHY)
    for table, apply in ((_RELATIVE, lambda a, b: a * (1.0 + b)), (_ABSOLUTE, lambda a, b: a + b)):
        for name, spread in table.items():
            drawn = spread * np.clip(generator.standard_normal(), -2.5, 2.5)
            if leaf or name in SUPPORTED_SETTINGS:
                values[name] = apply(values[name], drawn)
    values |= others
    # The programmes already contain the tremor of the driver.
    values["driver_tremor"] = 0.0
    return HealthyCar(plant, seed, {n: _clip(n, float(v)) for n, v in values.items()})


def has_setting(plant: str, setting: str) -> bool:
    return setting in (SETTINGS if plant == LEAF else SUPPORTED_SETTINGS)


def _clip(name: str, value: float) -> float:
    limits = SETTINGS.get(name)
    return value if limits is None or name in ("roll_gradient", "pitch_gradient") else min(
        max(value, limits.low), limits.high)


@dataclass(frozen=True)
class RunPlan:
    """Specification of a run."""

    name: str
    seed: tuple[int, ...]
    settings: Settings  # of plant and sensors
    parts: tuple[programmes.Part, ...] | None = None
    factors: tuple[float, float] = (1.0, 1.0)  # on speed and lateral acceleration
    # Settings before the fraction `change_at` of the run, None for no change.
    before: Settings | None = None
    change_at: float = 0.0
    east: float = 0.0  # position of the site [m]
    relation: Relation = NO_RELATION  # see `relation_equations`


def record_run(plant: str, vehicle: VehicleParameters, plan: RunPlan) -> DriveLog:
    """Drives a run, and repeats it with another seed if the car spins or stops. Raises DriveFailed after twenty
    attempts."""
    for attempt in range(20):
        tried = (*plan.seed, attempt)
        noise = int(np.random.default_rng(tried).integers(2**31))
        car = NOMINAL if plant == LEAF else nominal_car(plant)
        programme = programmes.make_programme(car, tried, plan.parts, *plan.factors)
        try:
            log = _record_once(plant, vehicle, plan, programme, noise)
        except DriveFailed:
            continue
        if np.abs(log.velocity_y).max() < MAX_LATERAL_VELOCITY:
            return replace(log, x=log.x + plan.east)
    raise DriveFailed(f"{plan.name}: the car spun or stopped in twenty attempts")


def _record_once(plant: str, vehicle: VehicleParameters, plan: RunPlan, programme: Programme, noise: int) -> DriveLog:
    first, later = plan.settings, None
    if plan.before is not None:
        first, later = plan.before, (plan.settings, round(plan.change_at * len(programme.steering_wheel)))
    if plant != LEAF:
        return log_multibody(plan.name, plant, _select_known(first), programme, noise, vehicle,
                             later and (_select_known(later[0]), later[1]), plan.relation)
    car = replace(NOMINAL, tyre_rear=reshape_rear_tyre(NOMINAL.tyre_rear, plan.relation))
    recording = drive(car, first, programme, noise, later, plan.relation)
    return make_log(plan.name, recording, NOMINAL, vehicle, first, noise, later)


def _select_known(settings: Settings) -> Settings:
    return {name: value for name, value in settings.items() if name in SUPPORTED_SETTINGS}


def vehicle_of(plant: str, settings: Settings) -> VehicleParameters:
    """The vehicle file of the car with these settings."""
    if plant != LEAF:
        return multibody_car.vehicle_of(plant, _select_known(settings))
    s, car = settings, LEAF_VEHICLE
    ratio = car.steering_ratio * s["steering_ratio_factor"]
    tyres = {f"tyre_{axle}": tyre._replace(lambda_ky=tyre.lambda_ky * s[f"{axle}_stiffness_factor"],
                                           lambda_muy=s["friction_factor"])
             for axle, tyre in (("front", car.tyre_front), ("rear", car.tyre_rear))}
    car = replace(
        car, mass=car.mass * s["mass_factor"], yaw_inertia=car.yaw_inertia * s["yaw_inertia_factor"],
        cg_to_front_axle=car.cg_to_front_axle - s["cg_shift"],
        cg_to_ins_x=car.cg_to_ins_x - s["cg_shift"] + s["ins_lever_error"], steering_ratio=ratio,
        steering_wheel_offset=car.steering_wheel_offset - s["steering_offset"] * ratio, **tyres)
    loads = {"front": car.static_tyre_load_front, "rear": car.static_tyre_load_rear}
    return replace(car, **{f"cornering_stiffness_{axle}": 2.0 * abs(
        magic_formula_stiffness(load, tyres[f"tyre_{axle}"])) for axle, load in loads.items()})
