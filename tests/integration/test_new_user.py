"""Discovery for a car with equations unlike those of the project, whose vehicle file has a wrong steering ratio."""

import pytest
from st_core.discovery import DiscoverySettings, discover
from st_offline.discovery.drives import Request, pool_sensor_estimates, read_drives
from st_offline.discovery.vehicle_update import update_vehicle
from st_recordings.car import read_vehicle
from st_recordings.runs import ReadSettings, find_runs

from bench.strangers import score
from bench.strangers.cases import Case
from bench.strangers.recordings import write_case
from bench.strangers.roads import ROADS

RATIO_ERROR = 0.08  # relative; the ratio in the file is too large

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def discovery(tmp_path_factory):
    """(truth, discovery, vehicle update) of a front-wheel-drive car with brush tyres at 2.5 m/s^2, recorded as CSV."""
    folder = tmp_path_factory.mktemp("new_user")
    guess = {"yaw_inertia": 2500.0, "cornering_stiffness_front": 112e3, "cornering_stiffness_rear": 128e3,
             "cg_height": 0.52}
    drives = tuple((road, 2.5, 60.0) for road in ROADS[:4])
    truth = write_case(Case("new_user", "hatchback", {"ratio": RATIO_ERROR}, guess, {}, drives, seed=3), folder)
    file = folder / "car" / "vehicle.yaml"
    vehicle = read_vehicle(file)
    loaded = read_drives(find_runs([folder / "drives"]), vehicle, ReadSettings(), 1, lambda: None)
    request = Request("nonlinear", vehicle, str(file), file.read_text(), DiscoverySettings(), drives=loaded)
    found = discover([d.log for d in loaded], vehicle, settings=request.settings,
                     sensor_estimates=pool_sensor_estimates(loaded))
    return truth, found, update_vehicle(found, request)


def test_steering_ratio_is_found_and_its_interval_contains_the_true_value(discovery):
    _, found, _ = discovery
    (ratio,) = [e.parameters["factor"] for e in found.effects if e.name == "steering_ratio"]
    assert ratio.value == pytest.approx(1.0 / (1.0 + RATIO_ERROR), rel=0.005)
    assert ratio.interval[0] <= 1.0 / (1.0 + RATIO_ERROR) <= ratio.interval[1]


def test_no_effect_is_named_that_the_car_does_not_have(discovery):
    truth, found, _ = discovery
    statements = score.list_statements({"truth": truth, "answer": found.document()})
    assert [line["effect"] for line in statements if not line["in_car"]] == []


def test_update_keeps_correct_values_of_the_vehicle_file(discovery):
    _, _, update = discovery
    assert update.text and "steering_ratio" in update.changes
    assert not {"mass", "cornering_stiffness_front", "cornering_stiffness_rear", "cg_to_front_axle",
                "yaw_inertia"} & set(update.changes)
