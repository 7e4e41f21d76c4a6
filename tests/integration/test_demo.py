"""The whole live suite as a user starts it: ./st demo in a process of its own, over real UDP, CAN frames and DDS."""

import json
import os
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
from bags import read_messages
from support import EXAMPLES, ROOT

pytest.importorskip("rclpy", reason="needs ROS 2")
pytest.importorskip("st_msgs", reason="needs the built workspace")

pytestmark = [
    pytest.mark.ros, pytest.mark.slow,
    pytest.mark.timing("nodes run in real time; one that waits for its turn skips ticks"),
]
MODELS = ("kinematic", "linear", "nonlinear")


def start_demo(*arguments: str) -> subprocess.Popen:
    return subprocess.Popen(
        [str(ROOT / "st"), "demo", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        cwd=ROOT,
        start_new_session=True,
    )


def children(process: subprocess.Popen) -> list[int]:
    """PIDs of everything below a process."""
    import psutil

    return [p.pid for p in psutil.Process(process.pid).children(recursive=True)]


@pytest.fixture(scope="module")
def circle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("demo") / "S3"
    process = start_demo("--scenario", "S3", "--duration", "20", "--output", str(folder))
    text, _ = process.communicate(timeout=150)
    assert process.returncode == 0, text
    return folder


def test_leaves_the_promised_files(circle: Path) -> None:
    for name in ("bag/metadata.yaml", "errors/metadata.yaml", "summary.json", "paths.png", "parameters.yaml"):
        assert (circle / name).stat().st_size > 100, name


def test_the_bag_holds_what_cannot_be_made_again(circle: Path) -> None:
    topics = set(read_messages(circle / "bag"))
    assert {"/ins/ncom", "/ins/origin", "/can/frames", "/ins/odometry", "/ins/status", "/vehicle/steering", "/tf",
            "/predictor/linear/prediction", "/evaluator/errors", "/diagnostics"} <= topics
    assert not {"/ins/imu", "/ins/velocity", "/ins/nav_sat_fix", "/ins/time_reference", "/vehicle/wheel_speeds",
                "/vehicle/ins_on_can"} & topics


def test_nearly_every_tick_carries_three_predictions(circle: Path) -> None:
    ticks = json.loads((circle / "summary.json").read_text())["ticks"]
    assert ticks["due"] > 150
    assert ticks["predicted"] >= 0.99 * ticks["due"]


def test_every_complete_horizon_is_scored_twice(circle: Path) -> None:
    summary = json.loads((circle / "summary.json").read_text())
    predicted = summary["ticks"]["predicted"]
    for model in MODELS:
        for mode in ("forecast", "hindsight"):
            row = summary["models"][model][mode]
            assert row["n_starts"] + row["n_incomplete"] == predicted
            # Only the starts of the last five seconds can have no complete horizon.
            assert row["n_incomplete"] <= 5.0 / 0.1 + 3


def test_dynamic_models_beat_the_kinematic_one_on_the_circle(circle: Path) -> None:
    models = json.loads((circle / "summary.json").read_text())["models"]
    kinematic = models["kinematic"]["hindsight"]["lateral"]["rmse"]
    assert kinematic > 0.5
    for model in ("linear", "nonlinear"):
        assert models[model]["hindsight"]["lateral"]["rmse"] < 0.6 * kinematic


def test_bag_opens_in_both_independent_readers(circle: Path) -> None:
    from mcap_ros2.reader import read_ros2_messages
    from rosbags.highlevel import AnyReader

    with AnyReader([circle / "bag"]) as reader:
        counts = {c.topic: c.msgcount for c in reader.connections}
    for topic in (
        "/ins/odometry",
        "/ins/ncom",
        "/vehicle/steering",
        "/predictor/linear/path",
        "/predictor/linear/prediction",
    ):
        assert counts.get(topic, 0) > 100, counts
    file = next((circle / "bag").glob("*.mcap"))
    headings = [m.ros_msg.pose.pose.orientation.z for m in read_ros2_messages(str(file), topics=["/ins/odometry"])]
    assert len(headings) == counts["/ins/odometry"]


def test_path_is_at_the_ins_point_in_the_map_frame(circle: Path) -> None:
    """Path, prediction and odometry are three descriptions of one instant: the first pose is where the INS was."""
    from rosbags.highlevel import AnyReader
    from st_recordings.results import read_results

    track = read_results(circle).track
    with AnyReader([circle / "bag"]) as reader:
        connections = [c for c in reader.connections if c.topic == "/predictor/linear/path"]
        paths = [reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages(connections=connections)]
    for path in paths[10:-10:20]:
        assert path.header.frame_id == "map"
        assert len(path.poses) == 101
        stamp = path.header.stamp.sec * 10**9 + path.header.stamp.nanosec
        for axis in ("x", "y"):
            assert np.interp(stamp, track.time_ns, getattr(track, axis)) == pytest.approx(
                getattr(path.poses[0].pose.position, axis), abs=0.01
            )


def test_second_suite_in_one_domain_is_refused_and_interrupt_ends_the_first_with_files_closed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from rosbags.highlevel import AnyReader
    from st_live.suite import claim_domain

    with claim_domain() as domain:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
        first = start_demo("--scenario", "S2", "--duration", "120", "--output", str(tmp_path / "first"))
        try:
            wait_for((tmp_path / "first" / "truth").exists, 60)
            scored = time.monotonic() + 9.0  # a horizon later
            second = start_demo("--output", str(tmp_path / "second"))
            text, _ = second.communicate(timeout=60)
            assert second.returncode == 2
            assert f"another suite is running in ROS domain {domain}" in text
            assert not list((tmp_path / "second").iterdir())
            time.sleep(max(0.0, scored - time.monotonic()))
            below = children(first)
            assert len(below) >= 6
        finally:
            os.kill(first.pid, signal.SIGINT)
            text, _ = first.communicate(timeout=60)
    assert first.returncode == 0, text
    assert not [pid for pid in below if Path(f"/proc/{pid}").exists()]
    for name in ("bag", "errors"):
        with AnyReader([tmp_path / "first" / name]) as reader:
            assert reader.message_count > 0


def test_recorded_drive_on_the_wires(tmp_path: Path) -> None:
    process = start_demo(
        "--drive",
        str(EXAMPLES / "rfs_turn_a.csv"),
        "--vehicle",
        "config/vehicle/hyundai_genesis.yaml",
        "--duration",
        "14",
        "--output",
        str(tmp_path / "run"),
    )
    text, _ = process.communicate(timeout=120)
    assert process.returncode == 0, text
    models = json.loads((tmp_path / "run" / "summary.json").read_text())["models"]
    for model in MODELS:
        assert models[model]["hindsight"]["n_starts"] > 50
        assert models[model]["hindsight"]["lateral"]["rmse"] < 5.0


def test_full_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "precious.txt").write_text("x")
    process = start_demo("--output", str(tmp_path))
    text, _ = process.communicate(timeout=60)
    assert process.returncode == 2
    assert "is not empty" in text


def test_interrupt_before_the_nodes_are_up_ends_cleanly(tmp_path: Path) -> None:
    process = start_demo("--output", str(tmp_path / "run"))
    wait_for((tmp_path / "run" / "logs" / "recorder.log").exists, 60)
    below = children(process)
    os.kill(process.pid, signal.SIGINT)
    text, _ = process.communicate(timeout=60)
    assert process.returncode == 130, text
    assert "Traceback" not in text
    assert not [pid for pid in below if Path(f"/proc/{pid}").exists()]


def wait_for(condition, timeout: float) -> None:
    end = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < end, "timed out"
        time.sleep(0.1)
