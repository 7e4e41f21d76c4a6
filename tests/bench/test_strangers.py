"""Cars that share no tyre model with the project: they corner as their stiffness says, and their files can be read."""

import numpy as np
import pytest
from st_recordings.car import car_named, read_vehicle
from st_recordings.runs import find_runs, read

from bench.strangers.cars import CARS, GRAVITY, drives
from bench.strangers.cases import write


@pytest.mark.parametrize("name", CARS)
def test_a_gentle_bend_is_driven_as_the_axles_stiffness_says(name):
    """Road wheel angle of steady cornering: curvature (L + K v^2), K of mass, axle distances and stiffness."""
    car = CARS[name]
    rear = car.wheelbase - car.front
    path = drives(car, 90.0, 3)["motorway"]
    speed, rate, angle = path[:, 3], path[:, 5], path[:, 13]
    lateral = speed * rate
    steady = (np.abs(lateral) > 0.5) & (np.abs(lateral) < 2.5) & (np.abs(np.gradient(rate, 0.0025)) < 0.05)
    softness = (rear / car.stiffness_front - car.front / car.stiffness_rear) / car.wheelbase
    load = car.mass * rear / car.wheelbase
    expected = rate / speed * car.wheelbase + lateral * (car.mass * softness + load * car.compliance)
    assert steady.sum() > 2000 and np.abs(lateral).max() < 0.8 * GRAVITY
    assert np.polyfit(expected[steady], angle[steady], 1)[0] == pytest.approx(1.0, abs=0.1)


def test_the_files_are_those_of_a_user(tmp_path):
    runs, home = write("van_heading_offset", 15.0, tmp_path)
    vehicle = read_vehicle(car_named(str(home)).vehicle)
    logs = [read(source, vehicle).log for source in find_runs([runs])]
    assert len(logs) == 4 and {len(log.ins_time_ns) for log in logs} == {750}
