"""Drives of the compiled virtual Leaf for identification, with steering tremor and sensor noise."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
from st_core.identification.result import ParameterEstimate
from st_core.log import DriveLog
from st_core.vehicle import FILE_QUANTITIES, VehicleParameters
from st_sim.settings import read_vehicle, resolve_settings

from .._drives import LEAF_FILE, leaf
from ..plants.leaf import Recording, drive
from ..plants.programmes import DT, Builder
from ..plants.sensing import make_log

SECONDS = 60.0
SENSORS = ("ins_noise=1", "steering_sensor_noise=0.0005")
LEVER_ERROR, MISALIGNMENT = 0.06, 0.008
"""Errors of the INS mounting in the slow drives [m, rad]."""


def with_stiffness(car: VehicleParameters, front: float, rear: float) -> VehicleParameters:
    """The car with other cornering stiffnesses of the axles [N/rad] and the lambda_ky derived from them."""
    return replace(car, cornering_stiffness_front=front, cornering_stiffness_rear=rear).with_derived_scales()


def apply_estimates(car: VehicleParameters, estimates: Iterable[ParameterEstimate]) -> VehicleParameters:
    """The car with the estimates of quantities of the vehicle file and the lambda_ky derived from them."""
    values = {e.parameter: e.value for e in estimates if e.parameter in FILE_QUANTITIES}
    return car.with_values(values).with_derived_scales()


def bends(speed: float, lateral: float) -> Callable[[Builder], None]:
    """Bends to the left and right, of 4 s at a lateral acceleration [m/s^2] with ramps of 1 s, and straights of 2 s."""
    def build(road: Builder) -> None:
        curvature = lateral / speed**2
        angle = curvature * (road.car.wheelbase + 0.004 * speed**2)
        ramp = np.linspace(0.0, 1.0, round(1.0 / DT))
        turn = angle * np.concatenate((ramp, np.ones(round(4.0 / DT)), ramp[::-1]))
        road.go_to(speed)
        for side in (1.0, -1.0):
            road.add(side * turn)
            road.add(np.zeros(round(2.0 / DT)), closed=True)
    return build


def drive_straight(road: Builder) -> None:
    road.add(np.zeros(round(SECONDS / DT)), closed=True)


def steps(angle: float) -> Callable[[Builder], None]:
    """Steps of the road wheel angle [rad] to the left, back, to the right, and back."""
    def build(road: Builder) -> None:
        for side in (1.0, 0.0, -1.0, 0.0):
            road.add(np.full(round(1.5 / DT), side * angle))
    return build


def sweep(angle: float) -> Callable[[Builder], None]:
    """Sine sweep of the road wheel angle [rad] from 0.3 to 2.5 Hz within 20 s."""
    def build(road: Builder) -> None:
        t = np.arange(0.0, 20.0, DT)
        rate = np.log(2.5 / 0.3) / 20.0
        road.add(angle * np.sin(2 * np.pi * 0.3 / rate * (np.exp(rate * t) - 1.0)))
        road.add(np.zeros(round(1.0 / DT)), closed=True)
    return build


Run = tuple[str, float, Callable[[Builder], None]]
"""Name, initial speed [m/s] and manoeuvre, which is repeated."""
Runs = Sequence[Run]


def _bends(*conditions: tuple[float, float]) -> Runs:
    """Runs with bends. conditions: speed [m/s] and lateral acceleration [m/s^2] of each run."""
    return tuple((f"bends {v:g} m/s, {a:g} m/s^2", v, bends(v, a)) for v, a in conditions)


BENDS = _bends((9.0, 2.0), (10.0, 2.2), (11.0, 2.5), (12.0, 1.5), (12.0, 3.0), (13.0, 3.3), (14.0, 2.0), (14.5, 3.2),
               (15.0, 3.5), (16.0, 2.5))
"""Bends with radii of 40 to 100 m."""
TIGHT_BENDS = _bends((6.0, 1.5), (6.5, 2.2), (7.0, 2.5), (7.5, 3.0), (8.0, 3.3), (8.5, 3.5))
"""Bends with radii of 19 to 24 m."""
STRAIGHTS: Runs = tuple((f"straight {v:g} m/s", v, drive_straight) for v in (7.0, 9.0, 11.0, 13.0))
SLOW: Runs = tuple((f"slow {v:g} m/s", v, bends(v, a)) for v, a in (
    (2.5, 0.6), (3.5, 1.2), (4.5, 1.0), (5.5, 1.8), (6.5, 1.5), (8.0, 2.0)))
TRANSIENTS: Runs = (("steps 10 m/s", 10.0, steps(0.05)), ("steps 14 m/s", 14.0, steps(0.03)),
                    ("sweep 12 m/s", 12.0, sweep(0.03)), ("sweep 16 m/s", 16.0, sweep(0.018)))


def record(runs: Runs, plant: str, seed: int, effects: Sequence[str] = (), seconds: float = SECONDS,
           sensors: Sequence[str] = SENSORS) -> list[DriveLog]:
    """Logs of the runs; the seed determines steering tremor and sensor noise."""
    settings = resolve_settings(plant, ("driver_tremor=0", *sensors, *effects))
    car, vehicle = read_vehicle(LEAF_FILE), leaf()
    return [make_log(run[0], _drive_run(run, number, plant, seed, seconds), car, vehicle, settings,
                     1000 * seed + number) for number, run in enumerate(runs)]


@lru_cache(maxsize=60)
def _drive_run(run: Run, number: int, plant: str, seed: int, seconds: float) -> Recording:
    _, speed, manoeuvre = run
    car = read_vehicle(LEAF_FILE)
    road = Builder(car, np.random.default_rng([seed, number]), speed)
    count = 0
    while count * DT < seconds:
        manoeuvre(road)
        count = sum(row.shape[1] for row in road.rows)
    road.rows[-1] = road.rows[-1][:, :road.rows[-1].shape[1] - max(0, count - round(seconds / DT))]
    return drive(car, resolve_settings(plant, ("driver_tremor=0",)), road.programme(), seed)


def record_all(plant: str, seed: int, sensors: Sequence[str] = SENSORS,
               seconds: float = SECONDS) -> Mapping[str, list[DriveLog]]:
    """All drives of an identification: bends, straight, slow and transient."""
    mounting = (f"ins_lever_error={LEVER_ERROR}", f"ins_misalignment={MISALIGNMENT}")
    kinds: Mapping[str, tuple[Runs, tuple[str, ...]]] = {
        "bends": (BENDS, ()), "straight": (STRAIGHTS, ()), "slow": (SLOW, mounting), "transient": (TRANSIENTS, ())}
    return {kind: record(runs, plant, seed, effects, seconds, sensors) for kind, (runs, effects) in kinds.items()}
