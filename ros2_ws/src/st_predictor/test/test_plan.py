"""Plans on plan/inputs: published, recorded and scored as mode plan; rejected with a reason if they cannot be used."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")
pytest.importorskip("st_msgs", reason="needs the built workspace")

from bags import health, nanoseconds, read_messages
from ros_processes import Processes
from st_core.vehicle import VehicleParameters
from st_live.verification import verify
from st_msgs.msg import InputPlan
from st_predictor import convert
from support import LEAF, ROOT

pytestmark = pytest.mark.ros
VALID_SECONDS, FAULT_SECONDS = 14.0, 2.0  # of tests/plan_feeder.py: valid plans, then each fault
live = pytest.mark.timing("nodes run in real time; one that waits for its turn skips ticks")


def drive(folder: Path, *options: str) -> tuple[int, dict[str, list[Any]]]:
    """(start [ns], recorded messages) of a drive with plans through predictor, evaluator and recorder."""
    processes = Processes(folder)
    try:
        nodes = [processes.node("st_predictor", name, f"vehicle_file:={LEAF}") for name in ("predictor", "evaluator")]
        nodes.append(processes.node("st_predictor", "recorder", f"output_directory:={folder / 'bag'}"))
        feeder = processes.start([sys.executable, str(ROOT / "tests" / "plan_feeder.py"), "--vehicle", str(LEAF),
                                  *options], "feeder")
        assert feeder.wait(120) == 0, processes.log("feeder")
        assert [processes.stop(node) for node in nodes] == [0, 0, 0]
    finally:
        processes.close()
    return int(processes.log("feeder").split()[1]), read_messages(folder / "bag")


@pytest.fixture(scope="module")
def recorded_drive(tmp_path_factory: pytest.TempPathFactory) -> tuple[int, dict[str, list[Any]]]:
    return drive(tmp_path_factory.mktemp("plan"))


def get_final_errors(messages: dict[str, list[Any]], mode: str) -> np.ndarray:
    """Position error of the linear model at the end of the horizon, of every complete score [m]."""
    return np.array([np.hypot(e.longitudinal[-1], e.lateral[-1]) for e in messages["/evaluator/errors"]
                     if e.model == "linear" and e.mode == mode and e.complete])


@live
@pytest.mark.slow
def test_plan_of_the_true_inputs_is_as_accurate_as_hindsight(recorded_drive) -> None:
    """The drive is that of the linear model: the remaining error is the 0.1 deg quantisation of the steering."""
    _, messages = recorded_drive
    planned, held, hindsight = (get_final_errors(messages, mode) for mode in ("plan", "forecast", "hindsight"))
    assert len(planned) > 80
    assert np.median(held) > 2.0
    assert np.median(planned) < 0.3 and np.median(planned) < 0.1 * np.median(held)
    assert abs(np.median(planned) - np.median(hindsight)) < 0.15
    published = messages["/predictor/linear/plan"]
    for message in published[::20]:
        assert len(message.road_wheel_angle) == len(message.velocity_x_dot) == 2 * len(message.x) - 1
        assert 0 <= nanoseconds(message.header.stamp) - nanoseconds(message.plan_stamp) < 500_000_000
    starts = {nanoseconds(m.header.stamp) for m in messages["/predictor/linear/prediction"]}
    assert {nanoseconds(m.header.stamp) for m in published} <= starts  # always together with a held forecast


@live
@pytest.mark.slow
@pytest.mark.parametrize(("fault_number", "reason"), [
    (0, "road_wheel_angle is not finite"), (1, "header.frame_id is 'map', expected 'base_link'"), (2, "issued"),
    (3, "not the whole horizon"), (4, "check sign, frame and unit"), (5, "issued"),
])
def test_unusable_plan_is_rejected_and_inputs_are_held(recorded_drive, fault_number: int, reason: str) -> None:
    zero_ns, messages = recorded_drive
    begin = VALID_SECONDS + fault_number * FAULT_SECONDS
    span = [(nanoseconds(m.header.stamp) - zero_ns) * 1e-9 for m in messages["/predictor/linear/prediction"]]
    planned = [(nanoseconds(m.header.stamp) - zero_ns) * 1e-9 for m in messages["/predictor/linear/plan"]]
    texts = [(level, text) for stamp, level, text in health(messages)["predictor: plan"]
             if begin + 0.9 < (stamp - zero_ns) * 1e-9 < begin + FAULT_SECONDS + 0.3]
    assert [t for t in span if begin + 0.7 < t < begin + FAULT_SECONDS]
    if fault_number != 4:  # a wrong sign has an effect only while the wheels are steered
        assert not [t for t in planned if begin + 0.7 < t < begin + FAULT_SECONDS]
        assert any(level == 1 and "inputs are held" in text and reason in text for level, text in texts), texts


@pytest.fixture(scope="module")
def path_drive(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, list[Any]]]:
    """Folder and messages of a drive with plans of speed and curvature."""
    folder = tmp_path_factory.mktemp("path")
    return folder, drive(folder, "--path", "--good", "12")[1]


@live
@pytest.mark.slow
def test_recording_with_plans_is_verified(path_drive: tuple[Path, dict[str, list[Any]]]) -> None:
    result = verify(path_drive[0] / "bag", LEAF)
    assert result is not None and result.largest_difference < 1.0e-6
    for c in result.comparisons:
        assert c.n_predictions["plan"] > 60 and c.n_scores["plan"] > 40 and not c.n_one_sided


@live
@pytest.mark.slow
def test_plan_of_speed_and_curvature_reduces_the_error_of_held_inputs(
        path_drive: tuple[Path, dict[str, list[Any]]]) -> None:
    planned, held = (np.median(get_final_errors(path_drive[1], mode)) for mode in ("plan", "forecast"))
    assert planned < 0.3 * held


@pytest.mark.parametrize(("changes", "reason"), [
    ({"speed": [1.0, 1.0]}, "one value per time for one pair"),
    ({"velocity_x_dot": [0.0]}, "one value per time for one pair"),
    ({"time": []}, "one value per time for one pair"),
    ({"time": [0.0, float("nan")]}, "time is not finite"),
    ({"time": [0.1, 0.0]}, "plan: the times are not increasing"),
    ({"time": [0.0], "road_wheel_angle": [0.0], "velocity_x_dot": [0.0]}, "plan: 1 point(s); at least two are needed"),
])
def test_malformed_plan_is_rejected(changes: dict[str, list[float]], reason: str) -> None:
    car = VehicleParameters.from_yaml(LEAF.read_text(), "leaf")
    values = {"time": [0.0, 0.1], "road_wheel_angle": [0.0, 0.1], "velocity_x_dot": [0.0, 0.0]} | changes
    message = InputPlan(**values)
    message.header.frame_id = "base_link"
    result = convert.read_planned_inputs(message, "base_link", car)
    assert isinstance(result, str) and reason in result
