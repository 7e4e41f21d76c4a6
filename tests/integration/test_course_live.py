"""A course over real DDS: from a recording of the virtual Leaf, used in a demo, recorded, replayed and verified."""

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")
pytest.importorskip("st_msgs", reason="needs the built workspace")

from bags import health, nanoseconds, read_messages
from raw_drives import write_drives
from support import ROOT

pytestmark = [
    pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(600),
    pytest.mark.timing("nodes run in real time; one that waits for its turn skips ticks"),
]


def st(*arguments: object, status: int = 0) -> str:
    done = subprocess.run([str(ROOT / "st"), *map(str, arguments)], check=False, capture_output=True, text=True,
                          cwd=ROOT, timeout=240)
    assert done.returncode == status, done.stdout + done.stderr
    return done.stdout + done.stderr


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    base = tmp_path_factory.mktemp("course")
    write_drives(base / "first", {}, 0, (("S6", 36.0),))
    st("import", base / "first" / "S6", "--output", base / "bag")
    st("course", "build", base / "bag", "-o", base / "course.yaml")
    st("demo", "--duration", 26, "--seed", 3, "--course", base / "course.yaml", "--output", base / "second")
    st("replay", base / "second", "--fast", "--output", base / "replayed")
    return base


@pytest.mark.parametrize("run", ["second", "replayed"])
def test_the_course_is_published_scored_and_better_than_held_inputs(folder: Path, run: str) -> None:
    messages = read_messages(folder / run / "bag")
    published = messages["/predictor/linear/course"]
    held = {nanoseconds(m.header.stamp) for m in messages["/predictor/linear/prediction"]}
    assert len(published) > 150 and {nanoseconds(m.header.stamp) for m in published} <= held
    assert all(not nanoseconds(m.plan_stamp) for m in published)
    errors = {mode: {nanoseconds(e.header.stamp): np.hypot(e.longitudinal[-1], e.lateral[-1])
                     for e in messages["/evaluator/errors"] if (e.model, e.mode, e.complete) == ("linear", mode, True)}
              for mode in ("forecast", "course")}
    common = errors["forecast"].keys() & errors["course"].keys()
    assert len(common) > 100
    assert sum(errors["course"][k] for k in common) < 0.45 * sum(errors["forecast"][k] for k in common)
    assert json.loads((folder / run / "summary.json").read_text())["models"]["linear"]["course"]["n_starts"] > 100
    assert any("weight in curvature" in text for _, level, text in health(messages)["predictor: course"] if level == 0)


@pytest.mark.parametrize("run", ["second", "replayed"])
def test_predictions_and_scores_with_the_course_are_verified(folder: Path, run: str) -> None:
    text = st("verify", folder / run)
    assert "more with inputs of a plan or course, and" in text and "live equals offline" in text


def test_a_file_that_is_no_course_is_refused_in_one_line_before_a_node_starts(folder: Path, tmp_path: Path) -> None:
    for content, reason in (((folder / "course.yaml").read_text()[:-400], "edited or cut off"), ("", "not a course")):
        file = tmp_path / "course.yaml"
        file.write_text(content)
        text = st("demo", "--course", file, "--output", tmp_path / "run", status=2).strip()
        assert str(file) in text and reason in text and len(text.splitlines()) == 1, text
