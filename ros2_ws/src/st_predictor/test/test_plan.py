"""Plans on plan/inputs: published, recorded and scored as mode plan; refused with a reason if they cannot be used."""

import subprocess
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
from support import ROOT

LEAF = ROOT / "config" / "vehicle" / "leaf.yaml"
pytestmark = pytest.mark.ros
GOOD, FAULTY = 14.0, 2.0  # s, as tests/plan_feeder.py
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
def driven(tmp_path_factory: pytest.TempPathFactory) -> tuple[int, dict[str, list[Any]]]:
    return drive(tmp_path_factory.mktemp("plan"))


def errors(messages: dict[str, list[Any]], model: str, mode: str) -> np.ndarray:
    """Distance at the end of the horizon of every complete score [m]."""
    return np.array([np.hypot(e.longitudinal[-1], e.lateral[-1]) for e in messages["/evaluator/errors"]
                     if e.model == model and e.mode == mode and e.complete])


@live
@pytest.mark.slow
def test_a_plan_of_the_true_inputs_predicts_as_hindsight(driven) -> None:
    """The drive is that of the linear model: the remaining error is the 0.1 deg quantisation of the steering."""
    _, messages = driven
    planned, held, hindsight = (errors(messages, "linear", mode) for mode in ("plan", "forecast", "hindsight"))
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
@pytest.mark.parametrize(("place", "reason"), [
    (0, "road_wheel_angle is not finite"), (1, "header.frame_id is 'map', expected 'base_link'"), (2, "issued"),
    (3, "it ends"), (4, "check sign, frame and unit"), (5, "issued"),
])
def test_a_plan_that_cannot_be_used_is_refused_and_inputs_are_held(driven, place: int, reason: str) -> None:
    zero_ns, messages = driven
    begin = GOOD + place * FAULTY
    span = [(nanoseconds(m.header.stamp) - zero_ns) * 1e-9 for m in messages["/predictor/linear/prediction"]]
    planned = [(nanoseconds(m.header.stamp) - zero_ns) * 1e-9 for m in messages["/predictor/linear/plan"]]
    texts = [(level, text) for stamp, level, text in health(messages)["predictor: plan"]
             if begin + 0.9 < (stamp - zero_ns) * 1e-9 < begin + FAULTY + 0.3]
    assert [t for t in span if begin + 0.7 < t < begin + FAULTY]
    if place != 4:  # a sign is only wrong where the wheels are turned
        assert not [t for t in planned if begin + 0.7 < t < begin + FAULTY]
        assert any(level == 1 and "inputs are held" in text and reason in text for level, text in texts), texts


@pytest.fixture(scope="module")
def path_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a drive with plans of speed and curvature."""
    folder = tmp_path_factory.mktemp("path")
    drive(folder, "--path", "--good", "14")
    return folder


@live
@pytest.mark.slow
def test_a_recording_with_plans_is_verified_and_replayed(path_folder: Path, tmp_path: Path) -> None:
    replayed = tmp_path / "replayed"
    done = subprocess.run([str(ROOT / "st"), "replay", str(path_folder / "bag"), "--fast", "--vehicle", str(LEAF),
                           "--output", str(replayed)], capture_output=True, text=True, timeout=180, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    for recording in (path_folder / "bag", replayed):
        found = verify(recording, LEAF)
        assert found is not None and found.largest < 1.0e-6
        assert all(c.n_planned > 60 and c.n_scores["plan"] > 40 and not c.n_disagree for c in found.comparisons)


@live
@pytest.mark.slow
def test_a_plan_of_speed_and_curvature_predicts_far_better_than_held_inputs(path_folder: Path) -> None:
    messages = read_messages(path_folder / "bag")
    assert np.median(errors(messages, "linear", "plan")) < 0.3 * np.median(errors(messages, "linear", "forecast"))


@pytest.mark.parametrize(("changes", "reason"), [
    ({"speed": [1.0, 1.0]}, "value of one pair"), ({"velocity_x_dot": [0.0]}, "value of one pair"),
    ({"time": []}, "value of one pair"), ({"time": [0.0, float("nan")]}, "time is not finite"),
])
def test_a_malformed_message_is_refused(changes: dict[str, list[float]], reason: str) -> None:
    car = VehicleParameters.from_yaml(LEAF.read_text(), "leaf")
    values = {"time": [0.0, 0.1], "road_wheel_angle": [0.0, 0.1], "velocity_x_dot": [0.0, 0.0]} | changes
    message = InputPlan(**values)
    message.header.frame_id = "base_link"
    found = convert.read_planned_inputs(message, "base_link", car)
    assert isinstance(found, str) and reason in found
