"""A recording of raw packets and frames gives bit-identical results to one of all topics."""

import json
from pathlib import Path

import numpy as np
import pytest
from bags import copy_topics
from command_line import st
from st_process import run_st

pytest.importorskip("rclpy", reason="needs ROS 2")
pytest.importorskip("st_msgs", reason="needs the built workspace")

from st_live.verification import verify
from st_recordings.runs.bag import read_bag

pytestmark = [
    pytest.mark.ros, pytest.mark.slow,
    pytest.mark.timing("nodes run in real time; one that waits for its turn skips ticks"),
]
RAW = ("/ins/ncom", "/ins/origin", "/can/frames")
RESULTS = ("/predictor/", "/evaluator/")


@pytest.fixture(scope="module")
def complete(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with all topics recorded."""
    folder = tmp_path_factory.mktemp("demo") / "run"
    run_st("demo", "--duration", "16", "--record", "all", "--output", folder)
    return folder


@pytest.fixture(scope="module")
def raw(complete: Path) -> Path:
    folder = complete.parent / "raw"
    folder.mkdir()
    copy_topics(complete / "bag", RAW + RESULTS, folder / "bag.mcap")
    (folder / "errors").symlink_to(complete / "errors")
    return folder / "bag.mcap"


def test_drive_and_auxiliary_signals_are_identical(complete: Path, raw: Path) -> None:
    of_all, of_raw = read_bag(complete / "bag"), read_bag(raw)
    assert len(of_all.log.ins_time_ns) > 1500
    for name in ("ins_time_ns", "x", "y", "yaw", "velocity_x", "velocity_y", "yaw_rate", "steering_time_ns",
                 "steering_wheel_angle", "road_wheel_angle"):
        assert np.array_equal(getattr(of_all.log, name), getattr(of_raw.log, name)), name
    for name in ("wheel_speed", "ins_speed"):
        recorded, reconstructed = getattr(of_all.auxiliary, name), getattr(of_raw.auxiliary, name)
        assert len(recorded.values) > 500
        assert np.array_equal(recorded.time_ns, reconstructed.time_ns), name
        assert np.array_equal(recorded.values, reconstructed.values), name


def test_verification_has_identical_comparisons(complete: Path, raw: Path) -> None:
    of_all, of_raw = verify(complete), verify(raw)
    assert of_all.n_starts > 30  # not empty; about 330 on an idle machine, 72 on a very busy one
    assert of_all.comparisons == of_raw.comparisons


def test_evaluation_is_identical(complete: Path, raw: Path, tmp_path: Path) -> None:
    documents = []
    for name, bag in (("all", complete / "bag"), ("raw", raw)):
        run_st("evaluate", bag, "--figures", "", "--output", tmp_path / name)
        documents.append(json.loads((tmp_path / name / "evaluation.json").read_text()))
    for key in ("all_runs", "bins_all_runs", "manoeuvres_all_runs"):
        assert documents[0][key] == documents[1][key], key
    (of_all,), (of_raw,) = (document["about"].values() for document in documents)
    assert of_all["n_predictions"] > 50
    for key in ("n_predictions", "skipped", "incomplete", "findings", "duration", "overlap"):
        assert of_all[key] == of_raw[key], key


def test_reconstructed_topics_are_not_replayed(complete: Path, tmp_path: Path) -> None:
    copy_topics(complete / "bag", ("/can/frames", "/ins/odometry"), tmp_path / "frames.mcap")
    result = st("replay", tmp_path / "frames.mcap", "--output", tmp_path / "run")
    assert result.exit_code == 2 and "cannot be played: no st_msgs/msg/Steering" in result.output
