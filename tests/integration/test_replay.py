"""st import, replay and verify on one drive of the virtual Leaf: the nodes agree with the library."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import st
from support import LEAF, ROOT

pytest.importorskip("rclpy", reason="needs ROS 2")
pytest.importorskip("st_msgs", reason="needs the built workspace")

pytestmark = [
    pytest.mark.ros, pytest.mark.slow,
    pytest.mark.timing("nodes run in real time; one that waits for its turn skips ticks"),
]
SECONDS = 16


def run_st(*arguments: object) -> subprocess.CompletedProcess:
    command = [str(ROOT / "st"), *map(str, arguments)]
    environment = {**os.environ, "COLUMNS": "140"}
    return subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=240, check=False, env=environment)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An imported recording, which has measurements only."""
    from st_sim.run import main

    base = tmp_path_factory.mktemp("replay")
    assert main(["--scenario", "S6", "--vehicle", str(LEAF), "--duration", str(SECONDS),
                 "--to-files", str(base / "S6")]) == 0
    done = st("import", base / "S6", "--output", base / "S6_bag")
    assert done.exit_code == 0, done.output
    return base / "S6_bag"


def test_recording_with_wrong_steering_sign_is_replayed_only_by_force(recording, tmp_path):
    done = st("import", recording.parent / "S6", "--steering-sign", "-1", "--force", "--output", tmp_path / "bag")
    assert done.exit_code == 0, done.output
    for verb in ("replay", "verify"):
        result = st(verb, tmp_path / "bag", "--output", tmp_path / verb)
        assert result.exit_code == 2 and "steering_sign" in result.stderr and "--force" in result.stderr
        assert not (tmp_path / verb).exists()
    played = run_st("replay", tmp_path / "bag", "--fast", "--force", "--output", tmp_path / "played")
    assert played.returncode == 0 and "error: " in played.stdout, played.stdout + played.stderr
    findings = json.loads((tmp_path / "played" / "summary.json").read_text())["findings"]
    assert "steering_sign" in {finding["name"] for finding in findings if finding["severity"] == "error"}


def test_live_equals_offline_to_a_millimetre(recording, tmp_path):
    done = run_st("verify", recording, "--output", tmp_path / "played")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "live equals offline" in done.stdout
    # 160 ticks; a busy machine may skip some, and the last horizon is incomplete.
    models = ("kinematic", "linear", "nonlinear")
    rows = [line.split() for line in done.stdout.splitlines() if line.strip().startswith(models)]
    assert len(rows) == 3 and all(int(row[1]) > 120 for row in rows)
    assert (tmp_path / "played" / "errors" / "metadata.yaml").exists()


def run_module(*arguments: object) -> subprocess.CompletedProcess:
    """As `run_st`, with the Python of the tests."""
    command = [sys.executable, "-m", "st_cli.cli", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=240, check=False)


@pytest.fixture(scope="module")
def external(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The drive as of another recorder: odometry in the frame `odom`, the road wheel angle as Float64, a text topic."""
    from rosbags.highlevel import AnyReader
    from rosbags.rosbag2 import StoragePlugin, Writer
    from st_recordings.runs.cdr import load_typestore

    base, store = tmp_path_factory.mktemp("external"), load_typestore()
    odometry, number, text = "nav_msgs/msg/Odometry", "std_msgs/msg/Float64", "std_msgs/msg/String"
    types = {"/localization": odometry, "/steer": number, "/chatter": text}
    with (AnyReader([recording], default_typestore=store) as reader,
          Writer(base / "external", version=9, storage_plugin=StoragePlugin.MCAP) as writer):
        connections = {topic: writer.add_connection(topic, name, typestore=store) for topic, name in types.items()}
        used = [c for c in reader.connections if c.topic in ("/ins/odometry", "/vehicle/steering")]
        for connection, log_ns, data in reader.messages(connections=used):
            message = reader.deserialize(data, connection.msgtype)
            if connection.msgtype == odometry:
                message.header.frame_id, topic = "odom", "/localization"
            else:
                message, topic = store.types[number](data=float(message.road_wheel_angle)), "/steer"
            writer.write(connections[topic], log_ns, bytes(store.serialize_cdr(message, types[topic])))
        writer.write(connections["/chatter"], log_ns, bytes(store.serialize_cdr(store.types[text](data="x"), text)))
    return base / "external"


def test_recording_of_another_recorder_is_replayed_and_scored_as_offline(external, tmp_path):
    result = st("replay", external, "--output", tmp_path / "refused")
    assert result.exit_code == 2 and "--steering-topic" in result.stderr, result.stderr
    played = run_module("replay", external, "--steering-topic", "/steer", "--rate", "2", "--output",
                        tmp_path / "played")
    assert played.returncode == 0, played.stdout + played.stderr
    assert "topics of unknown type, not played: /chatter (std_msgs/msg/String)" in played.stdout
    evaluated = run_module("evaluate", external, "--steering-topic", "/steer", "--figures", "", "--output",
                           tmp_path / "evaluated")
    assert evaluated.returncode == 0, evaluated.stdout + evaluated.stderr
    summary = json.loads((tmp_path / "played" / "summary.json").read_text())["models"]
    (offline,) = json.loads((tmp_path / "evaluated" / "evaluation.json").read_text())["runs"].values()
    for model in ("kinematic", "linear", "nonlinear"):
        scored = summary[model]["hindsight"]
        assert scored["n_starts"] > 80
        for axis in ("longitudinal", "lateral"):
            assert scored[axis]["rmse"] == pytest.approx(offline[model]["hindsight"][axis]["rmse"], rel=0.1, abs=0.01)
