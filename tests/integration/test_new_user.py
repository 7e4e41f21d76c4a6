"""What a new user gets: a car of other equations than the project, its file right but for the steering ratio."""

import pytest
from st_core.discovery import DiscoverySettings, discover
from st_offline.discovery.discover_command import sensor_estimates
from st_offline.discovery.drives import Request, read_drives
from st_offline.discovery.vehicle_update import update_vehicle
from st_recordings.car import read_vehicle
from st_recordings.runs import ReadSettings, find_runs

from bench.strangers import score
from bench.strangers.cases import Case
from bench.strangers.recordings import write_case
from bench.strangers.roads import ROADS

RATIO = 0.08  # of the file, too large

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def answered(tmp_path_factory):
    """(truth, answer, vehicle update) of a front-wheel-drive car with brush tyres on mild drives, recorded as CSV."""
    folder = tmp_path_factory.mktemp("new_user")
    guess = {"yaw_inertia": 2500.0, "cornering_stiffness_front": 112e3, "cornering_stiffness_rear": 128e3,
             "cg_height": 0.52}
    drives = tuple((road, 2.5, 75.0) for road in ROADS[:5])
    truth = write_case(Case("new_user", "hatchback", {"ratio": RATIO}, guess, {}, drives, seed=3), folder)
    file = folder / "car" / "vehicle.yaml"
    vehicle = read_vehicle(file)
    read = read_drives(find_runs([folder / "drives"]), vehicle, ReadSettings(), 1, lambda: None)
    request = Request("nonlinear", vehicle, str(file), file.read_text(), DiscoverySettings(), drives=read)
    found = discover([d.log for d in read], vehicle, settings=request.settings, sensor_estimates=sensor_estimates(read))
    return truth, found, update_vehicle(found, request)


def test_ratio_is_found_and_its_interval_holds_it(answered):
    _, found, _ = answered
    (ratio,) = [e.parameters["factor"] for e in found.effects if e.name == "steering_ratio"]
    assert ratio.value == pytest.approx(1.0 / (1.0 + RATIO), rel=0.005)
    assert ratio.interval[0] <= 1.0 / (1.0 + RATIO) <= ratio.interval[1]


def test_nothing_is_named_that_the_car_does_not_have(answered):
    truth, found, _ = answered
    stated = score.list_statements({"truth": truth, "answer": found.document()})
    assert [line["effect"] for line in stated if not line["in_car"]] == []


def test_true_values_of_the_file_are_not_rewritten(answered):
    _, _, update = answered
    assert update.text and "steering_ratio" in update.changes
    assert not {"mass", "cornering_stiffness_front", "cornering_stiffness_rear", "cg_to_front_axle",
                "yaw_inertia"} & set(update.changes)
