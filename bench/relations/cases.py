"""Cases of blocks L, M and N: a relation outside the library, an effect removed from the library, or neither."""

from dataclasses import dataclass, replace

import numpy as np
from st_core.discovery.settings import DiscoverySettings
from st_core.effects import find_applicable_effects
from st_core.log import DriveLog
from st_core.vehicle import VehicleParameters

from ..discovery.cases import seed_of
from ..discovery.effects import is_similar
from ..plants.record import LEAF, PLANTS, HealthyCar, RunPlan, has_setting, healthy_car, record_run, vehicle_of
from ..plants.resimulated import draw_seed, resimulate
from .hidden import RELATIONS, REMOVED, Hidden

CASES_EACH, CASES_WITHOUT = 5, 60
COUNTS = {"L": CASES_EACH * len(RELATIONS), "M": CASES_EACH * len(REMOVED), "N": CASES_WITHOUT}
RUNS, HELD_OUT = 4, 2
FILE_FACTORS = {"front_stiffness_factor": 1.15, "steering_ratio_factor": 0.94, "yaw_inertia_factor": 1.2}
"""Factors on the vehicle file in half of block N; the library describes all of them."""


@dataclass(frozen=True)
class RelationCase:
    """A case of block L, M or N. hidden: None in N. car: the healthy car. scale: factor on the size of the relation.
    wrong: whether the vehicle file has wrong values."""

    set_: str
    block: str
    index: int
    hidden: Hidden | None
    car: HealthyCar
    scale: float = 1.0
    wrong: bool = False

    @property
    def seed(self) -> int:
        return seed_of(self.set_, self.block, self.index)

    @property
    def settings(self) -> DiscoverySettings:
        """Settings of the discovery, which does not have the removed effect and similar ones."""
        effects = None
        if self.hidden and self.hidden.removed:
            effects = tuple(n for n in find_applicable_effects("nonlinear") if not is_similar(n, self.hidden.removed))
        return DiscoverySettings(effects=effects, locate_errors=False)


@dataclass(frozen=True)
class RelationDrives:
    """Drives with the relation (suspect, held_out), and without it (healthy, healthy_held_out; empty in block N)."""

    suspect: list[DriveLog]
    held_out: list[DriveLog]
    healthy: list[DriveLog]
    healthy_held_out: list[DriveLog]
    vehicle: VehicleParameters


def cases_of(set_: str, block: str) -> list[RelationCase]:
    """All cases of a block, with the relations in turn."""
    return [_make_case(set_, block, i) for i in range(COUNTS[block])]


def _make_case(set_: str, block: str, index: int) -> RelationCase:
    draw = np.random.default_rng(seed_of(set_, block, index, "law"))
    pool = {"L": RELATIONS, "M": REMOVED}.get(block)
    hidden = pool[index % len(pool)] if pool else None
    cycle = index // len(pool) if pool else index
    # Every other case has a multi-body car, in turn, if that has the setting.
    plant = PLANTS[1 + cycle % (len(PLANTS) - 1)] if (cycle + index) % 2 else LEAF
    if hidden and not all(has_setting(plant, name) for name in hidden.settings_in(plant)):
        plant = LEAF
    car = healthy_car(plant, (seed_of(set_, block, index, "car"),))
    return RelationCase(set_, block, index, hidden, car, float(draw.choice([1.0, 0.7])),
                        block == "N" and index % 2 == 1)


def drives_of(case: RelationCase) -> RelationDrives:
    """Drives the cars of a case."""
    car, hidden = case.car, case.hidden
    own = vehicle_of(car.plant, car.settings)
    file_values = {name: car.settings[name] * factor for name, factor in FILE_FACTORS.items()} if case.wrong else {}
    vehicle = vehicle_of(car.plant, {**car.settings, **file_values})

    def drive(with_relation: bool, first: int, count: int) -> list[DriveLog]:
        return [_record_case_run(case, own if hidden is None else vehicle, with_relation, first + i)
                for i in range(count)]

    if hidden is None:
        logs = [resimulate(log, own, draw_seed(case.seed, k, 7))
                for k, log in enumerate((*drive(False, 0, RUNS), *drive(False, 200, HELD_OUT)))]
        logs = [log.with_steering(vehicle) for log in logs]
        return RelationDrives(logs[:RUNS], logs[RUNS:], [], [], vehicle)
    return RelationDrives(drive(True, 0, RUNS), drive(True, 200, HELD_OUT), drive(False, 0, RUNS),
                          drive(False, 200, HELD_OUT), vehicle)


def _record_case_run(case: RelationCase, vehicle: VehicleParameters, with_relation: bool, number: int) -> DriveLog:
    plant, hidden, settings = case.car.plant, case.hidden, dict(case.car.settings)
    plan = RunPlan(f"run_{number + 1}", (case.seed, number), settings)
    if not with_relation:
        return record_run(plant, vehicle, plan)
    for name, change in hidden.settings_in(plant).items():
        settings[name] += case.scale * change
    relation = hidden.relation_in(plant)
    relation = relation._replace(size=case.scale * relation.size)
    log = record_run(plant, vehicle, replace(plan, settings=settings, relation=relation))
    return hidden.change(log, vehicle, case.scale * hidden.size) if hidden.change else log
