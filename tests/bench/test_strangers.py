"""Cars that share no equation with the project: axle force at small slip angles, cases, files."""

import numpy as np
import pytest
from st_recordings.car import load_car, read_vehicle
from st_recordings.runs import find_runs, read

from bench.strangers import simulation
from bench.strangers.cases import HALVES, cases, true_car
from bench.strangers.recordings import write_case
from bench.strangers.truth import straight_line
from bench.strangers.vehicles import CARS, GRAVITY, MULTI_BODY


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name, car in CARS.items() if car.equations != MULTI_BODY])
def test_axle_force_at_small_slip_angle_has_the_cornering_stiffness(name):
    """F = C alpha in steady circles to both sides at 0.4 m/s^2; some curves deviate by a tenth there.

    Half the difference of both circles is without ply steer; toe would steer the axle with the load transfer.
    """
    n, equations = CARS[name].parameters._replace(toe_front=0.0, toe_rear=0.0), CARS[name].equations
    rows = np.zeros((2, simulation.ROW))
    force = simulation.DRAG * 15.0**2 + simulation.ROLLING_RESISTANCE * n.mass * GRAVITY
    for row, wheel in zip(rows, (0.006, -0.006), strict=True):
        q, k, mid = np.zeros(simulation.STATES), np.zeros((4, simulation.STATES)), np.zeros(simulation.STATES)
        q[3] = 15.0
        for _ in range(4000):
            simulation.step(equations, q, wheel, force, n, 0.0025, k, mid)
        row[:simulation.STATES], row[simulation.WHEEL] = q, wheel
        row[simulation.VX_DOT:simulation.YAW_RATE_DOT + 1] = k[0, 3:6]
    slip_f, force_f, slip_r, force_r = (float(left - right) / 2 for left, right in simulation.axle_forces(rows, n))
    assert force_f > 0 and 0.2 < rows[0, 3] * rows[0, 5] < 0.7
    compliance = n.compliance + n.column * n.trail
    assert 0.85 < -force_f / (slip_f + compliance * force_f) / n.stiffness_front < 1.05
    assert 0.85 < -force_r / (slip_r + n.compliance_rear * force_r) / n.stiffness_rear < 1.1


@pytest.mark.parametrize(("name", "expected"), [("cs_healthy", 0.0), ("rs2_rear_angle", 0.007)])
def test_cars_of_vdrift_drive_straight_with_the_stated_steering(name, expected):
    """Ply steer turns the body against its course by 0.0027 rad; a rear angle turns body and front wheels."""
    crab, steered = straight_line(true_car(cases("vdrift")[name]))
    assert steered == pytest.approx(expected, abs=1e-4) and crab == pytest.approx(0.0027 + expected, abs=1e-4)


@pytest.mark.parametrize("half", HALVES)
def test_a_third_of_the_cases_has_no_hidden_change(half):
    drawn = list(cases(half).values())
    assert len(drawn) == 60 and sum(not case.hidden for case in drawn) == 20
    assert sum(bool(case.uncertainty) for case in drawn) == 20


def test_files_of_a_case_are_readable_and_its_truth_is_stated(tmp_path):
    case = cases("development")["van_offset"]
    truth = write_case(case, tmp_path, shorten=0.3)
    vehicle = read_vehicle(load_car(str(tmp_path / "car")).vehicle)
    logs = [read(source, vehicle).log for source in find_runs([tmp_path / "drives"])]
    assert len(logs) == len(case.drives) and vehicle.mass == true_car(case).parameters.mass
    low, high = truth["effects"]["steering_offset"]
    assert low == high == -case.hidden["offset"] / true_car(case).ratio
    assert len(truth["axles"]["front"]["slip"]) > 5
