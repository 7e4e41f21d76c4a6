"""Predictions with the inputs of a course and of a plan in one demo: publication, scores, replay and verification.

The course is built from a recording of an earlier drive of the virtual Leaf; the plan is that of the MPC example.
"""

import json
import os
import signal
import subprocess
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")
pytest.importorskip("st_msgs", reason="needs the built workspace")
pytest.importorskip("casadi", reason="casadi is not installed")

from bags import health, nanoseconds, read_messages
from command_line import st
from raw_drives import write_drives
from st_process import run_st
from support import ROOT

pytestmark = [
    pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(600),
    pytest.mark.timing("nodes run in real time; one that waits for its turn skips ticks"),
]

TOPICS = (*(f"/predictor/linear/{kind}" for kind in ("prediction", "plan", "course")), "/plan/inputs",
          "/evaluator/errors", "/diagnostics")


@pytest.fixture(scope="module")
def course_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    base = tmp_path_factory.mktemp("course")
    write_drives(base / "first", {}, 0, (("S6", 36.0),))
    for words in (("import", base / "first" / "S6", "--output", base / "bag"),
                  ("course", "build", base / "bag", "-o", base / "course.yaml")):
        done = st(*words)
        assert done.exit_code == 0, done.output
    return base / "course.yaml"


@pytest.fixture(scope="module")
def folder(course_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A live run with course and plan, and its replay."""
    base = tmp_path_factory.mktemp("planned_inputs")
    domain = {"ROS_DOMAIN_ID": str(10 + os.getpid() % 80)}
    planner = subprocess.Popen([str(ROOT / "st"), "shell", "--", "python", "examples/mpc/plan_node.py"], cwd=ROOT,
                               stdout=subprocess.PIPE, text=True, env={**os.environ, **domain})
    try:
        run_st("demo", "--scenario", "S6", "--duration", 26, "--seed", 3, "--course", course_file,
               "--output", base / "live", **domain)
    finally:
        planner.send_signal(signal.SIGINT)
        output, _ = planner.communicate(timeout=30)
    (base / "planner.txt").write_text(output)
    run_st("replay", base / "live", "--fast", "--output", base / "replayed")
    return base


def position_errors(messages: dict[str, list], modes: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Position errors of the linear model at the end of the horizon [m] by mode, for starts that all modes have."""
    errors = {mode: {nanoseconds(e.header.stamp): np.hypot(e.longitudinal[-1], e.lateral[-1])
                     for e in messages["/evaluator/errors"] if (e.model, e.mode, e.complete) == ("linear", mode, True)}
              for mode in modes}
    common = set.intersection(*map(set, errors.values()))
    return {mode: np.array([by_start[start] for start in common]) for mode, by_start in errors.items()}


@pytest.mark.parametrize("run", ["live", "replayed"])
def test_course_inputs_reduce_the_position_error_of_constant_inputs(folder: Path, run: str) -> None:
    messages = read_messages(folder / run / "bag", TOPICS)
    published = messages["/predictor/linear/course"]
    starts = {nanoseconds(m.header.stamp) for m in messages["/predictor/linear/prediction"]}
    assert len(published) > 150 and {nanoseconds(m.header.stamp) for m in published} <= starts
    assert all(not nanoseconds(m.plan_stamp) for m in published)
    errors = position_errors(messages, ("forecast", "course"))
    assert len(errors["course"]) > 100
    assert errors["course"].mean() < 0.45 * errors["forecast"].mean()
    assert json.loads((folder / run / "summary.json").read_text())["models"]["linear"]["course"]["n_starts"] > 100
    assert any("weight in curvature" in text for _, level, text in health(messages)["predictor: course"] if level == 0)


@pytest.mark.parametrize("run", ["live", "replayed"])
def test_planned_inputs_reduce_the_position_error_of_constant_inputs(folder: Path, run: str) -> None:
    messages = read_messages(folder / run / "bag", TOPICS)
    assert len(messages["/plan/inputs"]) > 100, (folder / "planner.txt").read_text()
    published = messages["/predictor/linear/plan"]
    assert len(published) > 100 and all(nanoseconds(m.plan_stamp) <= nanoseconds(m.header.stamp) for m in published)
    errors = position_errors(messages, ("forecast", "plan", "hindsight"))
    assert len(errors["plan"]) > 60
    forecast, plan, hindsight = (errors[mode].mean() for mode in ("forecast", "plan", "hindsight"))
    assert plan < 0.25 * forecast and plan < hindsight + 1.0


@pytest.mark.parametrize("run", ["live", "replayed"])
def test_predictions_and_scores_with_planned_inputs_are_verified(folder: Path, run: str) -> None:
    text = run_st("verify", folder / run)
    assert "more with inputs of a plan or course, and" in text and "live equals offline" in text


def test_invalid_course_is_rejected_in_one_line_before_a_node_starts(course_file: Path, tmp_path: Path) -> None:
    for content, reason in ((course_file.read_text()[:-400], "edited or cut off"), ("", "not a course")):
        file = tmp_path / "course.yaml"
        file.write_text(content)
        result = st("demo", "--course", file, "--output", tmp_path / "run")
        text = result.output.strip()
        assert result.exit_code == 2 and str(file) in text and reason in text and len(text.splitlines()) == 1, text
