"""st import, replay and verify on one drive: files of the virtual Leaf through the real nodes, and the library."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from support import ROOT

pytest.importorskip("rclpy", reason="needs ROS 2")
pytest.importorskip("st_msgs", reason="needs the built workspace")

pytestmark = [
    pytest.mark.ros, pytest.mark.slow,
    pytest.mark.timing("nodes run in real time; one that waits for its turn skips ticks"),
]
SECONDS = 16


def st(*arguments: object) -> subprocess.CompletedProcess:
    command = [str(ROOT / "st"), *map(str, arguments)]
    environment = {**os.environ, "COLUMNS": "140"}
    return subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=240, check=False, env=environment)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An imported recording: measurements only."""
    from st_sim.run import main

    base = tmp_path_factory.mktemp("replay")
    assert main(["--scenario", "S6", "--vehicle", str(ROOT / "config/vehicle/leaf.yaml"), "--duration", str(SECONDS),
                 "--to-files", str(base / "S6")]) == 0
    done = st("import", base / "S6", "--output", base / "S6_bag")
    assert done.returncode == 0, done.stdout + done.stderr
    return base / "S6_bag"


def test_a_recording_that_means_nothing_is_not_played(recording, tmp_path):
    done = st("import", recording.parent / "S6", "--steering-sign", "-1", "--force", "--output", tmp_path / "bag")
    assert done.returncode == 0, done.stdout + done.stderr
    for verb in ("replay", "verify"):
        refused = st(verb, tmp_path / "bag", "--output", tmp_path / verb)
        assert refused.returncode == 2 and "steering_sign" in refused.stderr and "--force" in refused.stderr
        assert not (tmp_path / verb).exists()
    played = st("replay", tmp_path / "bag", "--fast", "--force", "--output", tmp_path / "played")
    assert played.returncode == 0 and "error: " in played.stdout, played.stdout + played.stderr
    findings = json.loads((tmp_path / "played" / "summary.json").read_text())["findings"]
    assert "steering_sign" in {one["name"] for one in findings if one["severity"] == "error"}


def test_live_equals_offline_to_a_millimetre(recording, tmp_path):
    done = st("verify", recording, "--output", tmp_path / "played")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "live equals offline" in done.stdout
    # 160 ticks; a busy machine may lose a few, and the last horizon is incomplete.
    models = ("kinematic", "linear", "nonlinear")
    rows = [line.split() for line in done.stdout.splitlines() if line.strip().startswith(models)]
    assert len(rows) == 3 and all(int(row[1]) > 120 for row in rows)
    assert (tmp_path / "played" / "errors" / "metadata.yaml").exists()


def in_process(*arguments: object) -> subprocess.CompletedProcess:
    """As `st`, with the Python of the tests."""
    command = [sys.executable, "-m", "st_cli.cli", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=240, check=False)


@pytest.fixture(scope="module")
def foreign(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same drive as another recorder has it: odometry in a frame `odom`, the angle as a bare Float64, a text."""
    from rosbags.highlevel import AnyReader
    from rosbags.rosbag2 import StoragePlugin, Writer
    from st_recordings.runs.bag import definitions_folder
    from st_recordings.runs.cdr import load_typestore

    base, store = tmp_path_factory.mktemp("foreign"), load_typestore(definitions_folder())
    odometry, number, text = "nav_msgs/msg/Odometry", "std_msgs/msg/Float64", "std_msgs/msg/String"
    types = {"/localization": odometry, "/steer": number, "/chatter": text}
    with (AnyReader([recording], default_typestore=store) as reader,
          Writer(base / "foreign", version=9, storage_plugin=StoragePlugin.MCAP) as writer):
        made = {topic: writer.add_connection(topic, name, typestore=store) for topic, name in types.items()}
        wanted = [c for c in reader.connections if c.topic in ("/ins/odometry", "/vehicle/steering")]
        for connection, log_ns, data in reader.messages(connections=wanted):
            message = reader.deserialize(data, connection.msgtype)
            if connection.msgtype == odometry:
                message.header.frame_id, topic = "odom", "/localization"
            else:
                message, topic = store.types[number](data=float(message.road_wheel_angle)), "/steer"
            writer.write(made[topic], log_ns, bytes(store.serialize_cdr(message, types[topic])))
        writer.write(made["/chatter"], log_ns, bytes(store.serialize_cdr(store.types[text](data="x"), text)))
    return base / "foreign"


def test_a_recording_of_another_make_goes_through_the_nodes(foreign, tmp_path):
    refused = in_process("replay", foreign, "--output", tmp_path / "no")
    assert refused.returncode == 2 and "--steering-topic" in refused.stderr, refused.stderr
    played = in_process("replay", foreign, "--steering-topic", "/steer", "--rate", "2", "--output", tmp_path / "yes")
    assert played.returncode == 0, played.stdout + played.stderr
    assert "of unknown type and not played: /chatter (std_msgs/msg/String)" in played.stdout
    evaluated = in_process("evaluate", foreign, "--steering-topic", "/steer", "--figures", "", "--output",
                           tmp_path / "evaluated")
    assert evaluated.returncode == 0, evaluated.stdout + evaluated.stderr
    summary = json.loads((tmp_path / "yes" / "summary.json").read_text())["models"]
    (offline,) = json.loads((tmp_path / "evaluated" / "evaluation.json").read_text())["runs"].values()
    for model in ("kinematic", "linear", "nonlinear"):
        scored = summary[model]["hindsight"]
        assert scored["n_starts"] > 80
        for axis in ("longitudinal", "lateral"):
            assert scored[axis]["rmse"] == pytest.approx(offline[model]["hindsight"][axis]["rmse"], rel=0.1, abs=0.01)
