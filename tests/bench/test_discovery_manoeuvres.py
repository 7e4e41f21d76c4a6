"""The virtual car and the benchmark drive the manoeuvres that `st discover` suggests.

Speed, duration and lateral acceleration agree; each has its own driver and its own equations.
"""

import numpy as np
import pytest
from st_cli.verbs.live import SCENARIOS as DEMO_SCENARIOS
from st_core.augmented import augment
from st_core.discovery.next_manoeuvre import simulate_drive
from st_core.manoeuvres import CATALOGUE
from st_core.vehicle import VehicleParameters
from st_sim.driver import SimulatedCar
from st_sim.dynamics import VX, YAW_RATE
from st_sim.run import check_arguments
from st_sim.scenarios import load_plan
from st_sim.settings import read_vehicle, resolve_settings
from support import LEAF as LEAF_FILE

from bench.plants import leaf, programmes

CAR = read_vehicle(LEAF_FILE)
LEAF = VehicleParameters.from_yaml(LEAF_FILE.read_text())
HEALTHY = resolve_settings("realistic")
COMPARED_DURATION, RAMP_DURATION = 20.0, 26.0  # s, from the start of a drive; the ramp reaches its limit later
SEED = 1
SPEED_TOLERANCE, LATERAL_TOLERANCE = 0.03, 0.15
"""Relative tolerances of mean speed and rms lateral acceleration between the three. The virtual car has lags of tyres
and steering, and its driver small steering motions; the driver of the benchmark overcorrects the heading."""


def manoeuvre_named(name: str):
    return next(m for m in CATALOGUE if m.name == name)


def compared_duration(manoeuvre) -> float:
    return RAMP_DURATION if manoeuvre.name == "ramp_to_limit" else COMPARED_DURATION


def drive_virtual_car(manoeuvre) -> np.ndarray:
    """Columns: speed [m/s], lateral acceleration v r [m/s^2], every 0.02 s."""
    car = SimulatedCar(CAR, HEALTHY, load_plan(manoeuvre.name), SEED)
    rows = []
    for time in np.arange(0.0, compared_duration(manoeuvre), 0.02):
        car.advance(time)
        truth = car.make_truth()
        rows.append((truth.velocity_x, truth.velocity_x * truth.yaw_rate))
    return np.array(rows)


def drive_model(manoeuvre) -> np.ndarray:
    log = simulate_drive(manoeuvre, augment("nonlinear", {}), LEAF)
    assert (log.ins_time_ns[-1] - log.ins_time_ns[0]) * 1e-9 == pytest.approx(manoeuvre.duration, abs=0.03)
    compared = log.ins_time_ns - log.ins_time_ns[0] < compared_duration(manoeuvre) * 1e9
    return np.column_stack((log.velocity_x, log.velocity_x * log.yaw_rate))[compared]


def drive_benchmark_car(manoeuvre) -> np.ndarray:
    part = programmes.suggested_part(manoeuvre.name)
    programme = programmes.make_programme(CAR, (SEED,), (part,))
    approach = programmes.Builder(CAR, np.random.default_rng(SEED), 10.0)
    approach.go_to(manoeuvre.speed)
    before = sum(row.shape[1] for row in approach.rows)
    steps = len(programme.steering_wheel) - before - round(programmes.STRAIGHT / programmes.DT)
    assert steps * programmes.DT == pytest.approx(manoeuvre.duration, abs=0.03)
    end = before + round(compared_duration(manoeuvre) / programmes.DT)
    rows = leaf.drive(CAR, HEALTHY, programme, SEED).rows[before:end]
    return np.column_stack((rows[:, VX], rows[:, VX] * rows[:, YAW_RATE]))


@pytest.mark.slow
@pytest.mark.parametrize("name", [m.name for m in CATALOGUE])
def test_three_implementations_drive_the_suggested_manoeuvre(name):
    manoeuvre = manoeuvre_named(name)
    drives = [drive(manoeuvre) for drive in (drive_virtual_car, drive_model, drive_benchmark_car)]
    time = np.arange(0.0, compared_duration(manoeuvre), 0.01)
    speeds = np.array([rows[:, 0].mean() for rows in drives])
    rms = np.array([np.sqrt(np.square(rows[:, 1]).mean()) for rows in drives])
    assert speeds == pytest.approx(float(manoeuvre.speed_at(time).mean()), rel=SPEED_TOLERANCE)
    assert np.ptp(rms) < LATERAL_TOLERANCE * rms.mean()
    if name == "ramp_to_limit":
        assert all(8.0 < np.abs(rows[:, 1]).max() < manoeuvre.lateral_acceleration for rows in drives)
    elif name == "sweep":
        # The response decreases at higher frequencies.
        slow = [rows[:len(rows) // 3, 1] for rows in drives]
        peaks = [np.abs(v).max() for v in slow]
        assert peaks == pytest.approx([manoeuvre.lateral_acceleration] * 3, rel=LATERAL_TOLERANCE)
    else:
        peaks = [np.percentile(np.abs(rows[:, 1]), 98) for rows in drives]
        assert peaks == pytest.approx([manoeuvre.lateral_acceleration] * 3, rel=0.2)


def test_simulated_drive_starts_in_a_steady_state():
    """As the drive of the virtual car, which settles before the recording: no step of steering at the start."""
    manoeuvre = manoeuvre_named("brake_in_turn")
    rows = drive_model(manoeuvre)
    assert rows[:100, 1] == pytest.approx(np.full(100, manoeuvre.lateral_acceleration), rel=0.05)
    assert np.ptp(rows[:100, 1]) < 0.02


@pytest.mark.parametrize("name", [m.name for m in CATALOGUE])
def test_every_suggested_manoeuvre_is_a_scenario_of_the_demo(name):
    check_arguments(["--vehicle", str(LEAF_FILE), "--scenario", name])
    assert name in DEMO_SCENARIOS.replace("S1 to S7", "S1").replace(",", " ").split()
