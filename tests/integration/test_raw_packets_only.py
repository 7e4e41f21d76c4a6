"""A recording of raw packets and frames only gives what one with all topics gives, to the last bit."""

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest
from bags import copy_topics
from support import ROOT

pytest.importorskip("rclpy", reason="needs ROS 2")
pytest.importorskip("st_msgs", reason="needs the built workspace")

from st_live.verification import verify
from st_recordings.runs.bag import read_bag

pytestmark = [pytest.mark.ros, pytest.mark.slow]
RAW = ("/ins/ncom", "/ins/origin", "/can/frames")
SAID = ("/predictor/", "/evaluator/")


def st(*words: str | Path) -> subprocess.CompletedProcess:
    return subprocess.run([ROOT / "st", *words], cwd=ROOT, capture_output=True, text=True, timeout=250, check=False)


@pytest.fixture(scope="module")
def everything(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with all topics recorded."""
    folder = tmp_path_factory.mktemp("demo") / "run"
    done = st("demo", "--duration", "16", "--record", "all", "--output", folder)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


@pytest.fixture(scope="module")
def raw(everything: Path) -> Path:
    folder = everything.parent / "raw"
    folder.mkdir()
    copy_topics(everything / "bag", RAW + SAID, folder / "bag.mcap")
    (folder / "errors").symlink_to(everything / "errors")
    return folder / "bag.mcap"


def test_the_drive_is_the_same(everything: Path, raw: Path) -> None:
    of_all, of_raw = read_bag(everything / "bag"), read_bag(raw)
    assert len(of_all.log.ins_time_ns) > 1500
    for name in ("ins_time_ns", "x", "y", "yaw", "velocity_x", "velocity_y", "yaw_rate", "steering_time_ns",
                 "steering_wheel_angle", "road_wheel_angle"):
        assert np.array_equal(getattr(of_all.log, name), getattr(of_raw.log, name)), name
    for name in ("wheel_speed", "ins_speed"):
        theirs, ours = getattr(of_all.auxiliary, name), getattr(of_raw.auxiliary, name)
        assert len(theirs.values) > 500
        assert np.array_equal(theirs.time_ns, ours.time_ns) and np.array_equal(theirs.values, ours.values), name


def test_verify_says_the_same(everything: Path, raw: Path) -> None:
    of_all, of_raw = verify(everything), verify(raw)
    assert of_all.n_starts > 200  # about 330 on an idle machine
    assert of_all.comparisons == of_raw.comparisons


def test_the_report_is_the_same(everything: Path, raw: Path, tmp_path: Path) -> None:
    found = []
    for name, bag in (("all", everything / "bag"), ("raw", raw)):
        done = st("evaluate", bag, "--figures", "", "--output", tmp_path / name)
        assert done.returncode == 0, done.stdout + done.stderr
        found.append(json.loads((tmp_path / name / "evaluation.json").read_text()))
    for key in ("all_runs", "bins_all_runs", "manoeuvres_all_runs"):
        assert found[0][key] == found[1][key], key
    (of_all,), (of_raw,) = (document["about"].values() for document in found)
    assert of_all["n_predictions"] > 50
    for key in ("n_predictions", "skipped", "incomplete", "findings", "duration", "overlap"):
        assert of_all[key] == of_raw[key], key


def test_what_was_made_again_is_not_played(everything: Path, tmp_path: Path) -> None:
    copy_topics(everything / "bag", ("/can/frames", "/ins/odometry"), tmp_path / "frames.mcap")
    done = st("replay", tmp_path / "frames.mcap", "--output", tmp_path / "run")
    assert done.returncode == 2
    assert "cannot be played: no st_msgs/msg/Steering" in done.stderr
