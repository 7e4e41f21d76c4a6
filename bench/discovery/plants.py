"""Drives and vehicle files of both plants, the virtual Leaf and the multi-body cars, through one interface."""

from dataclasses import dataclass, replace

import numpy as np
from st_core.log import DriveLog
from st_core.tyres import magic_formula_stiffness
from st_core.vehicle import VehicleParameters
from st_sim.settings import Settings, read_vehicle

from .._cars import LEAF_FILE, leaf
from . import cars, programmes
from .compiled import NO_RELATION, DriveFailed, Programme, drive
from .multibody import log_multibody
from .multibody_car import SUPPORTED_SETTINGS, nominal_car
from .multibody_car import vehicle_of as multibody_vehicle
from .relation_equations import Relation, reshape_rear_tyre
from .sensing import make_log

NOMINAL = read_vehicle(LEAF_FILE)
LEAF = leaf()
MAX_LATERAL_VELOCITY = 6.0  # m/s; a higher one shows that the car has spun


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
        car = NOMINAL if plant == cars.LEAF else nominal_car(plant)
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
    if plant != cars.LEAF:
        return log_multibody(plan.name, plant, _select_known(first), programme, noise, vehicle,
                             later and (_select_known(later[0]), later[1]), plan.relation)
    car = replace(NOMINAL, tyre_rear=reshape_rear_tyre(NOMINAL.tyre_rear, plan.relation))
    recording = drive(car, first, programme, noise, later, plan.relation)
    return make_log(plan.name, recording, NOMINAL, vehicle, first, noise, later)


def _select_known(settings: Settings) -> Settings:
    return {name: value for name, value in settings.items() if name in SUPPORTED_SETTINGS}


def vehicle_of(plant: str, settings: Settings) -> VehicleParameters:
    """The vehicle file of the car with these settings."""
    if plant != cars.LEAF:
        return multibody_vehicle(plant, _select_known(settings))
    s = settings
    ratio = LEAF.steering_ratio * s["steering_ratio_factor"]
    tyres = {f"tyre_{axle}": getattr(LEAF, f"tyre_{axle}")._replace(
        lambda_ky=getattr(LEAF, f"tyre_{axle}").lambda_ky * s[f"{axle}_stiffness_factor"],
        lambda_muy=s["friction_factor"]) for axle in ("front", "rear")}
    car = replace(
        LEAF, mass=LEAF.mass * s["mass_factor"], yaw_inertia=LEAF.yaw_inertia * s["yaw_inertia_factor"],
        cg_to_front_axle=LEAF.cg_to_front_axle - s["cg_shift"],
        cg_to_ins_x=LEAF.cg_to_ins_x - s["cg_shift"] + s["ins_lever_error"], steering_ratio=ratio,
        steering_wheel_offset=LEAF.steering_wheel_offset - s["steering_offset"] * ratio, **tyres)
    loads = {"front": car.static_tyre_load_front, "rear": car.static_tyre_load_rear}
    return replace(car, **{f"cornering_stiffness_{axle}": 2.0 * abs(
        magic_formula_stiffness(load, tyres[f"tyre_{axle}"])) for axle, load in loads.items()})
