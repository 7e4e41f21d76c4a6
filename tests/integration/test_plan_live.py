"""A plan of the MPC example over real DDS: published, scored, recorded, replayed and verified."""

import os
import signal
import subprocess
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")
pytest.importorskip("st_msgs", reason="needs the built workspace")
pytest.importorskip("casadi", reason="casadi is not installed")

from bags import nanoseconds, read_messages
from support import ROOT

pytestmark = [
    pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(600),
    pytest.mark.timing("nodes run in real time; one that waits for its turn skips ticks"),
]
MODE_ERRORS = ("forecast", "plan", "hindsight")


def st(*arguments: object, **environment: str) -> str:
    done = subprocess.run([str(ROOT / "st"), *map(str, arguments)], check=False, capture_output=True, text=True,
                          cwd=ROOT, timeout=240, env={**os.environ, **environment})
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    base = tmp_path_factory.mktemp("plan")
    domain = {"ROS_DOMAIN_ID": str(10 + os.getpid() % 80)}
    planner = subprocess.Popen([str(ROOT / "st"), "shell", "--", "python", "examples/mpc/plan_node.py"], cwd=ROOT,
                               stdout=subprocess.PIPE, text=True, env={**os.environ, **domain})
    try:
        st("demo", "--scenario", "S6", "--duration", 24, "--output", base / "run", **domain)
    finally:
        planner.send_signal(signal.SIGINT)
        said, _ = planner.communicate(timeout=30)
    (base / "planner.txt").write_text(said)
    st("replay", base / "run", "--fast", "--output", base / "replayed")
    return base


@pytest.mark.parametrize("run", ["run", "replayed"])
def test_the_plan_is_published_scored_and_better_than_held_inputs(folder: Path, run: str) -> None:
    messages = read_messages(folder / run / "bag")
    assert len(messages["/plan/inputs"]) > 100, (folder / "planner.txt").read_text()
    published = messages["/predictor/linear/plan"]
    assert len(published) > 100 and all(nanoseconds(m.plan_stamp) <= nanoseconds(m.header.stamp) for m in published)
    errors = {mode: {nanoseconds(e.header.stamp): np.hypot(e.longitudinal[-1], e.lateral[-1])
                     for e in messages["/evaluator/errors"] if (e.model, e.mode, e.complete) == ("linear", mode, True)}
              for mode in MODE_ERRORS}
    common = set.intersection(*(set(errors[mode]) for mode in MODE_ERRORS))
    assert len(common) > 60
    held, plan, hindsight = (np.mean([errors[mode][k] for k in common]) for mode in MODE_ERRORS)
    assert plan < 0.25 * held and plan < hindsight + 1.0


@pytest.mark.parametrize("run", ["run", "replayed"])
def test_predictions_and_scores_with_the_plan_are_verified(folder: Path, run: str) -> None:
    text = st("verify", folder / run)
    assert "more with inputs of a plan or course, and" in text and "live equals offline" in text
