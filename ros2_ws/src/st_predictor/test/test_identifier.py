"""The node identifier over DDS: estimates, reasons for missing ones, and resets."""

import math
import sys

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")

from bags import health, read_messages
from ros_processes import Processes, wait_for
from st_core.vehicle import VehicleParameters
from support import LEAF, ROOT

pytestmark = [
    pytest.mark.ros, pytest.mark.slow,
    pytest.mark.timing("nodes run in real time; one that waits for its turn skips ticks"),
]
TRUTH = {"steering_wheel_offset": math.radians(-4.0), "steering_ratio": 16.6, "stiffness_scale": 0.85}
UNESTIMATED, ESTIMATED = 0, 1


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory):
    """A winding road of 140 s, then the vehicle file with a comment, an invalid and another steering ratio."""
    folder = tmp_path_factory.mktemp("identifier")
    vehicle = folder / "car.yaml"
    vehicle.write_text(LEAF.read_text())
    processes = Processes(folder)
    try:
        nodes = [processes.node("st_predictor", "identifier", f"vehicle_file:={vehicle}"),
                 processes.node("st_predictor", "recorder", f"output_directory:={folder / 'bag'}")]
        wait_for(lambda: "estimates" in processes.log("identifier") and "[recorder]" in processes.log("recorder"),
                 what="nodes up")
        feeder = processes.start([sys.executable, str(ROOT / "tests" / "winding_feeder.py"), "--vehicle", str(vehicle),
                                  "--seconds", "140"], "feeder")
        assert feeder.wait(120) == 0, processes.log("feeder")
        wait_for(lambda: "stiffness_scale estimated" in processes.log("identifier"), what="estimates")
        vehicle.write_text(LEAF.read_text() + "# noted\n")
        vehicle.write_text(LEAF.read_text().replace("17.3", "170.3"))
        wait_for(lambda: "170.3 is outside" in processes.log("identifier"), what="invalid file reported")
        vehicle.write_text(LEAF.read_text().replace("17.3", "16.6"))
        wait_for(lambda: "all estimates are reset" in processes.log("identifier"), what="reset")
        assert [processes.stop(node) for node in nodes] == [0, 0], processes.log("identifier")
    finally:
        processes.close()
    return read_messages(folder / "bag")


def estimates(message) -> dict:
    return {one.parameter: one for one in message.parameters}


def test_last_estimates_before_the_change_are_correct(run):
    messages = [m for m in run["/identifier/parameters"] if not m.resets]
    last = estimates(messages[-1])
    assert messages[-1].seconds_used > 130.0
    for name, truth in TRUTH.items():
        assert last[name].status == ESTIMATED, last[name].reason
        assert abs(last[name].value - truth) < 3.0 * last[name].standard_deviation, name
    assert last["steering_ratio"].vehicle_file_value == 17.3 and last["stiffness_scale"].vehicle_file_value == 1.0
    assert messages[-1].vehicle_hash == VehicleParameters.from_yaml(LEAF.read_text()).hash


def test_first_message_has_no_estimates(run):
    first = estimates(run["/identifier/parameters"][0])
    assert {one.status for one in first.values()} == {UNESTIMATED}
    assert all(one.reason for one in first.values())


def test_changed_file_resets_the_estimates_but_an_invalid_one_does_not(run):
    messages = run["/identifier/parameters"]
    assert sorted({m.resets for m in messages}) == [0, 1]
    last = messages[-1]
    assert last.seconds_used == 0.0 and {one.status for one in last.parameters} == {UNESTIMATED}
    assert estimates(last)["steering_ratio"].vehicle_file_value == 16.6


def test_diagnostics_report_contradicted_and_invalid_vehicle_file(run):
    output = {name: {(level, text) for _, level, text in lines} for name, lines in health(run).items()}
    assert any(level == 1 and "the estimate contradicts the vehicle file" in text
               for level, text in output["identifier: steering_ratio"])
    assert any(level == 1 and "170.3" in text for level, text in output["identifier: vehicle file"])


def test_no_other_node_uses_the_estimates():
    """Published, never applied: predictor and bridges do not subscribe to the estimates."""
    sources = [path for path in (ROOT / "ros2_ws" / "src").rglob("*.py")
               if not {"test", "documentation"} & set(path.parts)]
    users = {path.relative_to(ROOT / "ros2_ws" / "src").as_posix() for path in sources
             if "TrackedParameters" in path.read_text() or "identifier/parameters" in path.read_text()}
    assert users == {"st_predictor/st_predictor/nodes/identifier.py"}
