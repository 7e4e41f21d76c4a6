"""What `st discover` suggests is what the virtual car and the benchmark drive.

The same speed, duration and lateral acceleration, each by its own hands and its own equations.
"""

import numpy as np
import pytest
from st_cli.verbs.live import SCENARIOS as OFFERED
from st_core.augmented import augment
from st_core.discovery.next_manoeuvre import simulate_drive
from st_core.manoeuvres import CATALOGUE
from st_core.vehicle import VehicleParameters
from st_sim.car import read_car
from st_sim.dynamics import VX, YAW_RATE
from st_sim.run import check_arguments
from st_sim.scenarios import load_plan
from st_sim.settings import resolve_settings
from st_sim.simulation import SimulatedCar
from support import ROOT

from bench.discovery import compiled, programmes

LEAF_FILE = ROOT / "config" / "vehicle" / "leaf.yaml"
CAR = read_car(LEAF_FILE)
LEAF = VehicleParameters.from_yaml(LEAF_FILE.read_text())
HEALTHY = resolve_settings("realistic")
SHORT = 20.0
"""s looked at of every drive; of the ramp, whose limit comes later, RAMP."""
RAMP = 26.0
SEED = 1
SPEED, LATERAL = 0.03, 0.15
"""Shares by which mean speed and root mean square of the lateral acceleration may differ between two of the three: the
virtual car's tyres and steering lag behind, its hand is never still, and the benchmark's driver holds the heading in a
lane change a little too eagerly."""


def suggested(name: str):
    return next(m for m in CATALOGUE if m.name == name)


def looked_at(manoeuvre) -> float:
    return RAMP if manoeuvre.name == "ramp_to_limit" else SHORT


def by_the_virtual_car(manoeuvre) -> np.ndarray:
    """Columns: speed, lateral acceleration v r, every 0.02 s."""
    car = SimulatedCar(CAR, HEALTHY, load_plan(manoeuvre.name), SEED)
    rows = []
    for time in np.arange(0.0, looked_at(manoeuvre), 0.02):
        car.advance(time)
        truth = car.make_truth()
        rows.append((truth.velocity_x, truth.velocity_x * truth.yaw_rate))
    return np.array(rows)


def by_the_model(manoeuvre) -> np.ndarray:
    log = simulate_drive(manoeuvre, augment("nonlinear", {}), LEAF)
    assert (log.ins_time_ns[-1] - log.ins_time_ns[0]) * 1e-9 == pytest.approx(manoeuvre.duration, abs=0.03)
    kept = log.ins_time_ns - log.ins_time_ns[0] < looked_at(manoeuvre) * 1e9
    return np.column_stack((log.velocity_x, log.velocity_x * log.yaw_rate))[kept]


def by_the_benchmark(manoeuvre) -> np.ndarray:
    part = programmes.suggested_part(manoeuvre.name)
    programme = programmes.make_programme(CAR, (SEED,), (part,))
    empty = programmes.Builder(CAR, np.random.default_rng(SEED), 10.0)
    empty.go_to(manoeuvre.speed)
    before = sum(row.shape[1] for row in empty.rows)
    left = len(programme.steering_wheel) - before - round(programmes.STRAIGHT / programmes.DT)
    assert left * programmes.DT == pytest.approx(manoeuvre.duration, abs=0.03)
    rows = compiled.drive(CAR, HEALTHY, programme, SEED).rows[before:][:round(looked_at(manoeuvre) / programmes.DT)]
    return np.column_stack((rows[:, VX], rows[:, VX] * rows[:, YAW_RATE]))


@pytest.mark.slow
@pytest.mark.parametrize("name", [m.name for m in CATALOGUE])
def test_suggestion_is_what_the_three_drive(name):
    one = suggested(name)
    drives = [source(one) for source in (by_the_virtual_car, by_the_model, by_the_benchmark)]
    time = np.arange(0.0, looked_at(one), 0.01)
    speeds = np.array([rows[:, 0].mean() for rows in drives])
    sizes = np.array([np.sqrt(np.square(rows[:, 1]).mean()) for rows in drives])
    assert speeds == pytest.approx(float(one.speed_at(time).mean()), rel=SPEED)
    assert np.ptp(sizes) < LATERAL * sizes.mean()
    if name == "ramp_to_limit":
        assert all(8.0 < np.abs(rows[:, 1]).max() < one.lateral for rows in drives)
    elif name == "sweep":
        # While it is slow the car follows; later less and less.
        slow = [rows[:len(rows) // 3, 1] for rows in drives]
        assert [np.abs(v).max() for v in slow] == pytest.approx([one.lateral] * 3, rel=LATERAL)
    else:
        assert [np.percentile(np.abs(rows[:, 1]), 98) for rows in drives] == pytest.approx([one.lateral] * 3, rel=0.2)


def test_simulated_drive_begins_steadily():
    """As that of the virtual car, which drives some seconds unseen: no step of steering that nobody asked for."""
    one = suggested("brake_in_turn")
    rows = by_the_model(one)
    assert rows[:100, 1] == pytest.approx(np.full(100, one.lateral), rel=0.05)
    assert np.ptp(rows[:100, 1]) < 0.02


@pytest.mark.parametrize("name", [m.name for m in CATALOGUE])
def test_every_suggestion_is_a_scenario_of_the_demo(name):
    check_arguments(["--vehicle", str(LEAF_FILE), "--scenario", name])
    assert name in OFFERED.replace("S1 to S7", "S1").replace(",", " ").split()
