"""The live suite as a user starts it: ./st demo in its own process, over UDP, CAN frames and DDS."""

import json
import os
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
from bags import nanoseconds, read_messages
from command_line import st
from ros_processes import wait_for
from support import ROOT

pytest.importorskip("rclpy", reason="needs ROS 2")
pytest.importorskip("st_msgs", reason="needs the built workspace")

pytestmark = [
    pytest.mark.ros, pytest.mark.slow,
    pytest.mark.timing("nodes run in real time; one that waits for its turn skips ticks"),
]
MODELS = ("kinematic", "linear", "nonlinear")


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
    topics = set(read_messages(circle / "bag"))
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


def test_second_suite_in_a_domain_is_rejected_and_interrupt_ends_the_first_with_complete_files(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from rosbags.highlevel import AnyReader
    from st_live.suite import claim_domain

    with claim_domain() as domain:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
        first = start_demo("--scenario", "S2", "--duration", "120", "--output", str(tmp_path / "first"))
        try:
            wait_for((tmp_path / "first" / "truth").exists, 60)
            first_scores = time.monotonic() + 9.0  # after the first horizon
            second = start_demo("--output", str(tmp_path / "second"))
            text, _ = second.communicate(timeout=60)
            assert second.returncode == 2
            assert f"ROS domain {domain} already contains running nodes of the suite" in text
            assert not (tmp_path / "second").exists()
            time.sleep(max(0.0, first_scores - time.monotonic()))
            pids = descendants(first)
            assert len(pids) >= 6
        finally:
            os.kill(first.pid, signal.SIGINT)
            text, _ = first.communicate(timeout=60)
    assert first.returncode == 0, text
    assert not [pid for pid in pids if Path(f"/proc/{pid}").exists()]
    for name in ("bag", "errors"):
        with AnyReader([tmp_path / "first" / name]) as reader:
            assert reader.message_count > 0


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
