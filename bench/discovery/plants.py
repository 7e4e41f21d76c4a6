"""One interface for the plants of the benchmark, virtual Leaf and multi-body cars: their drives and vehicle files."""

from dataclasses import dataclass, replace

import numpy as np
from st_core.log import DriveLog
from st_core.tyres import magic_formula_stiffness
from st_core.vehicle import VehicleParameters
from st_sim.settings import Settings, read_vehicle

from .._cars import LEAF_FILE, leaf
from . import cars
from . import programmes as m
from .compiled import NO_RELATION, Programme, Stopped, drive
from .multibody import log_multibody
from .multibody_car import SUPPORTED_SETTINGS, nominal_car
from .multibody_car import vehicle_of as multibody_vehicle
from .relation_equations import REAR_CURVE, Relation
from .sensing import make_log

NOMINAL = read_vehicle(LEAF_FILE)
LEAF = leaf()
MAX_LATERAL_VELOCITY = 6.0  # m/s; at a higher one the car has spun, and the drive is not used


@dataclass(frozen=True)
class Order:
    """A run to drive."""

    name: str
    seed: tuple[int, ...]
    settings: Settings  # those of plant and sensors
    parts: tuple[m.Part, ...] | None = None
    factors: tuple[float, float] = (1.0, 1.0)  # on speed and lateral acceleration
    # Settings until the fraction `from_` of the run, None for the same settings throughout.
    before: Settings | None = None
    from_: float = 0.0
    moved: float = 0.0  # distance of the site to the east [m]
    relation: Relation = NO_RELATION  # see `relation_equations`


def record_run(plant: str, vehicle: VehicleParameters, order: Order) -> DriveLog:
    """Drives a run, and repeats it with another seed if the car spins or stops. Raises Stopped after twenty
    attempts."""
    for attempt in range(20):
        tried = (*order.seed, attempt)
        noise = int(np.random.default_rng(tried).integers(2**31))
        car = NOMINAL if plant == cars.LEAF else nominal_car(plant)
        programme = m.make_programme(car, tried, order.parts, *order.factors)
        try:
            log = _record_once(plant, vehicle, order, programme, noise)
        except Stopped:
            continue
        if np.abs(log.velocity_y).max() < MAX_LATERAL_VELOCITY:
            return replace(log, x=log.x + order.moved)
    raise Stopped(f"{order.name}: the car spun or stopped in twenty attempts")


def _record_once(plant: str, vehicle: VehicleParameters, order: Order, programme: Programme, noise: int) -> DriveLog:
    first, later = order.settings, None
    if order.before is not None:
        first, later = order.before, (order.settings, round(order.from_ * len(programme.steering_wheel)))
    if plant != cars.LEAF:
        return log_multibody(order.name, plant, _select_known(first), programme, noise, vehicle,
                             later and (_select_known(later[0]), later[1]), order.relation)
    recording = drive(_with_rear_curve(order.relation), first, programme, noise, later, order.relation)
    return make_log(order.name, recording, NOMINAL, vehicle, first, noise, later)


def _with_rear_curve(relation: Relation) -> VehicleParameters:
    """The virtual Leaf; for the relation REAR_CURVE its rear tyres have another shape, with the same stiffness and
    friction."""
    if relation.kind != REAR_CURVE:
        return NOMINAL
    rear = NOMINAL.tyre_rear
    return replace(NOMINAL, tyre_rear=rear._replace(p_cy1=rear.p_cy1 * (1.0 - relation.size),
                                                    p_ey1=rear.p_ey1 - 4.0 * relation.size))


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
