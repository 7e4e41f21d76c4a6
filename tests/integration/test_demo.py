"""The live suite as a user starts it: ./st demo in its own process, over UDP, CAN frames and DDS."""

import json
import os
import signal
import subprocess
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from bags import copy_topics, nanoseconds, read_messages
from command_line import st
from ros_processes import wait_for
from support import ROOT

pytest.importorskip("rclpy", reason="needs ROS 2")
pytest.importorskip("st_msgs", reason="needs the built workspace")

from st_live.verification import verify
from st_recordings.runs.bag import read_bag

pytestmark = [
    pytest.mark.ros, pytest.mark.slow,
    pytest.mark.timing("nodes run in real time; one that waits for its turn skips ticks"),
]
MODELS = ("kinematic", "linear", "nonlinear")
RAW = ("/ins/ncom", "/ins/origin", "/can/frames")
RESULTS = ("/predictor/", "/evaluator/")


def start_demo(*arguments: str) -> subprocess.Popen:
    return subprocess.Popen([str(ROOT / "st"), "demo", *arguments], stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
                            text=True, cwd=ROOT, start_new_session=True)


def descendants(process: subprocess.Popen) -> list[int]:
    """PIDs of all descendants of a process."""
    import psutil

    return [p.pid for p in psutil.Process(process.pid).children(recursive=True)]


@pytest.fixture(scope="module")
def circle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("demo") / "S3"
    process = start_demo("--scenario", "S3", "--duration", "20", "--output", str(folder))
    text, _ = process.communicate(timeout=150)
    assert process.returncode == 0, text
    return folder


def test_demo_writes_the_documented_files(circle: Path) -> None:
    for name in ("bag/metadata.yaml", "errors/metadata.yaml", "summary.json", "paths.png", "parameters.yaml"):
        assert (circle / name).stat().st_size > 100, name


def test_bag_has_raw_data_and_results_but_no_topics_that_can_be_reconstructed(circle: Path) -> None:
    from rosbags.highlevel import AnyReader

    with AnyReader([circle / "bag"]) as reader:
        topics = {c.topic for c in reader.connections if c.msgcount}
    assert {"/ins/ncom", "/ins/origin", "/can/frames", "/ins/odometry", "/ins/status", "/vehicle/steering", "/tf",
            "/predictor/linear/prediction", "/evaluator/errors", "/diagnostics"} <= topics
    assert not {"/ins/imu", "/ins/velocity", "/ins/nav_sat_fix", "/ins/time_reference", "/vehicle/wheel_speeds",
                "/vehicle/ins_on_can"} & topics


def test_at_least_99_percent_of_the_ticks_have_predictions(circle: Path) -> None:
    ticks = json.loads((circle / "summary.json").read_text())["ticks"]
    assert ticks["due"] > 150
    assert ticks["predicted"] >= 0.99 * ticks["due"]


def test_every_prediction_is_scored_in_forecast_and_hindsight(circle: Path) -> None:
    summary = json.loads((circle / "summary.json").read_text())
    predicted = summary["ticks"]["predicted"]
    for model in MODELS:
        for mode in ("forecast", "hindsight"):
            row = summary["models"][model][mode]
            assert row["n_starts"] + row["n_incomplete"] == predicted
            # Only starts in the last five seconds have an incomplete horizon.
            assert row["n_incomplete"] <= 5.0 / 0.1 + 3


def test_dynamic_models_beat_the_kinematic_one_on_the_circle(circle: Path) -> None:
    models = json.loads((circle / "summary.json").read_text())["models"]
    kinematic = models["kinematic"]["hindsight"]["lateral"]["rmse"]
    assert kinematic > 0.5
    for model in ("linear", "nonlinear"):
        assert models[model]["hindsight"]["lateral"]["rmse"] < 0.6 * kinematic


def test_bag_is_readable_with_rosbags_and_mcap_ros2(circle: Path) -> None:
    from mcap_ros2.reader import read_ros2_messages
    from rosbags.highlevel import AnyReader

    with AnyReader([circle / "bag"]) as reader:
        counts = {c.topic: c.msgcount for c in reader.connections}
    for topic in ("/ins/odometry", "/ins/ncom", "/vehicle/steering", "/predictor/linear/path",
                  "/predictor/linear/prediction"):
        assert counts.get(topic, 0) > 100, counts
    file = next((circle / "bag").glob("*.mcap"))
    odometry = [m.ros_msg.pose for m in read_ros2_messages(str(file), topics=["/ins/odometry"])]
    assert len(odometry) == counts["/ins/odometry"]


def test_path_starts_at_the_ins_point_in_the_map_frame(circle: Path) -> None:
    from st_recordings.results import read_results

    track = read_results(circle).track
    paths = read_messages(circle / "bag", ["/predictor/linear/path"])["/predictor/linear/path"]
    for path in paths[10:-10:20]:
        assert path.header.frame_id == "map"
        assert len(path.poses) == 101
        stamp = nanoseconds(path.header.stamp)
        for axis in ("x", "y"):
            expected = np.interp(stamp, track.time_ns, getattr(track, axis))
            assert getattr(path.poses[0].pose.position, axis) == pytest.approx(expected, abs=0.01)


class Interrupted(NamedTuple):
    """A suite that records all topics, interrupted after the first horizons; a second suite in its domain.

    status, text, remaining: of the first suite; remaining: its processes that still exist. folder: with first/.
    """

    folder: Path
    status: int
    text: str
    remaining: list[int]
    second_status: int
    second_text: str
    domain: int


@pytest.fixture(scope="module")
def interrupted(tmp_path_factory: pytest.TempPathFactory) -> Interrupted:
    from st_live.suite import claim_domain

    folder = tmp_path_factory.mktemp("interrupted")
    with claim_domain() as domain, pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", str(domain))
        first = start_demo("--scenario", "S6", "--duration", "120", "--record", "all", "--output",
                           str(folder / "first"))
        try:
            wait_for((folder / "first" / "truth").exists, 60)
            enough = time.monotonic() + 14.0  # of driving, for scores of 9 s of starts
            second = start_demo("--output", str(folder / "second"))
            second_text, _ = second.communicate(timeout=60)
            time.sleep(max(0.0, enough - time.monotonic()))
            pids = descendants(first)
            assert len(pids) >= 6
        finally:
            os.kill(first.pid, signal.SIGINT)
            text, _ = first.communicate(timeout=60)
    remaining = [pid for pid in pids if Path(f"/proc/{pid}").exists()]
    return Interrupted(folder, first.returncode, text, remaining, second.returncode, second_text, domain)


def test_second_suite_in_a_domain_is_rejected(interrupted: Interrupted) -> None:
    assert interrupted.second_status == 2
    assert f"ROS domain {interrupted.domain} already contains running nodes of the suite" in interrupted.second_text
    assert not (interrupted.folder / "second").exists()


def test_interrupt_ends_the_suite_with_complete_files(interrupted: Interrupted) -> None:
    from rosbags.highlevel import AnyReader

    assert interrupted.status == 0, interrupted.text
    assert not interrupted.remaining
    for name in ("bag", "errors"):
        with AnyReader([interrupted.folder / "first" / name]) as reader:
            assert reader.message_count > 0


# A recording of raw packets and frames gives bit-identical results to one of all topics.


@pytest.fixture(scope="module")
def complete(interrupted: Interrupted) -> Path:
    """A run with all topics recorded."""
    return interrupted.folder / "first"


@pytest.fixture(scope="module")
def raw(complete: Path) -> Path:
    folder = complete.parent / "raw"
    folder.mkdir()
    copy_topics(complete / "bag", RAW + RESULTS, folder / "bag.mcap")
    (folder / "errors").symlink_to(complete / "errors")
    return folder / "bag.mcap"


def test_drive_and_auxiliary_signals_are_identical(complete: Path, raw: Path) -> None:
    of_all, of_raw = read_bag(complete / "bag"), read_bag(raw)
    assert len(of_all.log.ins_time_ns) > 1000
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
    # Not empty: about 330 on an idle machine, 72 on a very busy one.
    assert sum(c.n_predictions["forecast"] for c in of_all.comparisons) > 30
    assert of_all.comparisons == of_raw.comparisons


def test_evaluation_is_identical(complete: Path, raw: Path, tmp_path: Path) -> None:
    documents = []
    for name, bag in (("all", complete / "bag"), ("raw", raw)):
        result = st("evaluate", bag, "--figures", "", "--output", tmp_path / name)
        assert result.exit_code == 0, result.output
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


def test_nonempty_output_folder_is_rejected(tmp_path: Path) -> None:
    (tmp_path / "precious.txt").write_text("x")
    result = st("demo", "--output", tmp_path)
    assert result.exit_code == 2 and "is not empty" in result.output


def test_interrupt_before_the_nodes_are_up_ends_cleanly(tmp_path: Path) -> None:
    process = start_demo("--output", str(tmp_path / "run"))
    wait_for((tmp_path / "run" / "logs" / "recorder.log").exists, 60)
    pids = descendants(process)
    os.kill(process.pid, signal.SIGINT)
    text, _ = process.communicate(timeout=60)
    assert process.returncode == 130, text
    assert "Traceback" not in text
    assert not [pid for pid in pids if Path(f"/proc/{pid}").exists()]
