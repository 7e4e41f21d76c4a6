"""Faults during a drive: missing inputs, NaN, a wrong frame, time jumps, overruns, a full disk, wrong parameters."""

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")
pytest.importorskip("st_msgs", reason="needs the built workspace")

from bags import (
    count_ticks_before,
    health,
    nanoseconds,
    read_messages,
    select_common_period,
    stamps,
    trim_to_common_start,
)
from ros_processes import Processes, executable, wait_for
from st_predictor.nodes.evaluator import EvaluatorNode
from st_predictor.nodes.predictor import PredictorNode
from st_predictor.nodes.recorder import RecorderNode
from support import LEAF, ROOT

pytestmark = [pytest.mark.ros, pytest.mark.timing("nodes run in real time; one that waits for its turn skips ticks")]
GENESIS = ROOT / "config" / "vehicle" / "hyundai_genesis.yaml"
MODELS = ("kinematic", "linear", "nonlinear")
NODES = {"predictor": PredictorNode, "evaluator": EvaluatorNode, "recorder": RecorderNode}
OK, WARNING, ERROR = 0, 1, 2


def feed(processes: Processes, *options: str) -> int:
    """Runs the feeder to its end; returns the stamp of its start."""
    feeder = processes.start([sys.executable, str(ROOT / "tests" / "circle_feeder.py"), *options], "feeder")
    assert feeder.wait(90) == 0, processes.log("feeder")
    return int(processes.log("feeder").split()[1])


# Evaluator and recorder have discovered all predictions.
WAIT_FOR_PREDICTIONS = [f"--wait-for=predictor/{model}/prediction:2" for model in MODELS]


def start_recorder(processes: Processes, **options: Any) -> tuple[subprocess.Popen, Path]:
    bag = processes.folder / "bag"
    return processes.node("st_predictor", "recorder", f"output_directory:={bag}", **options), bag


@pytest.fixture(scope="module")
def drive_with_faults(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """One drive of 22 s with several faults in sequence, each temporary."""
    processes = Processes(tmp_path_factory.mktemp("trouble"))
    try:
        nodes = [processes.node("st_predictor", name, f"vehicle_file:={LEAF}") for name in ("predictor", "evaluator")]
        recording, bag = start_recorder(processes)
        zero_ns = feed(processes, *WAIT_FOR_PREDICTIONS, "--subscribers", "3", "--duration", "22",
                       "--silent-steering", "6:7.5", "--nan", "11:12.5", "--silent-odometry", "13.5:15",
                       "--invalid-steering", "16:17.5", "--jump", "18.5:20:-3")
        statuses = [processes.stop(node) for node in (*nodes, recording)]
    finally:
        processes.close()
    return {"zero_ns": zero_ns, "statuses": statuses, "messages": read_messages(bag)}


@pytest.mark.slow
def test_nodes_end_with_status_0(drive_with_faults: dict[str, Any]) -> None:
    assert drive_with_faults["statuses"] == [0, 0, 0]


@pytest.mark.slow
@pytest.mark.parametrize(("begin", "end", "fragments"), [
    (6.0, 7.5, ("steering", "s old")),
    (11.0, 12.5, ("INS", "s old", "NaN or infinite")),
    (13.5, 15.0, ("INS", "s old")),
    (16.0, 17.5, ("steering", "s old", "marked invalid")),
    (18.5, 20.0, ("INS", "3.", "s old")),
])
def test_no_prediction_without_valid_inputs_and_the_reason_is_reported(
    drive_with_faults: dict[str, Any], begin: float, end: float, fragments: tuple[str, ...]
) -> None:
    """No prediction is issued from 0.2 s after the loss of a signal until the signal returns."""
    zero_ns, messages = drive_with_faults["zero_ns"], drive_with_faults["messages"]
    issued = [(nanoseconds(m.issued_at) - zero_ns) * 1e-9 for m in messages["/predictor/linear/prediction"]]
    assert not [t for t in issued if begin + 0.35 < t < end]
    assert [t for t in issued if begin - 0.6 < t <= begin + 0.1]
    assert [t for t in issued if end < t < end + 0.7]
    output = [(level, text) for stamp, level, text in health(messages)["predictor: prediction"]
              if begin + 0.3 < (stamp - zero_ns) * 1e-9 < end]
    assert any(level == ERROR and all(fragment in text for fragment in fragments) for level, text in output), output


@pytest.mark.slow
def test_skipped_ticks_are_counted(drive_with_faults: dict[str, Any]) -> None:
    last = drive_with_faults["messages"]["/predictor/status"][-1]
    assert last.skipped_stale > 30
    assert last.due == last.predicted + last.skipped_stale + last.skipped_overrun + last.skipped_slow
    recorded = stamps(drive_with_faults["messages"]["/predictor/nonlinear/prediction"])
    assert 0 <= last.predicted - len(recorded) <= count_ticks_before(recorded[0], drive_with_faults["zero_ns"])
    reasons = {m.reason for m in drive_with_faults["messages"]["/predictor/status"]}
    assert any("steering" in reason for reason in reasons)


@pytest.mark.slow
def test_scores_across_a_gap_are_incomplete(drive_with_faults: dict[str, Any]) -> None:
    zero_ns, messages = drive_with_faults["zero_ns"], drive_with_faults["messages"]
    counts = {"forecast": 0, "hindsight": 0}
    for error in messages["/evaluator/errors"]:
        start = (nanoseconds(error.header.stamp) - zero_ns) * 1e-9
        if 1.2 < start < 5.8:
            # The steering is missing from 6 to 7.5 s; only hindsight uses it.
            assert error.complete == (error.mode == "forecast")
            assert error.complete or error.incomplete_reason.startswith("steering: ")
        if 7.6 < start < 10.9:
            assert not error.complete
            assert error.incomplete_reason.startswith("INS: ")
        counts[error.mode] += 1
    assert min(counts.values()) > 200


@pytest.mark.slow
def test_pending_predictions_are_scored_incomplete_when_time_jumps_back(drive_with_faults: dict[str, Any]) -> None:
    """Each prediction is scored once per mode, from the first one that evaluator and recorder both receive."""
    messages = drive_with_faults["messages"]
    assert any("jumped back" in e.incomplete_reason for e in messages["/evaluator/errors"])
    predicted = [(m, stamp) for m in MODELS for stamp in stamps(messages[f"/predictor/{m}/prediction"])]
    for mode in ("forecast", "hindsight"):
        scored = [(e.model, nanoseconds(e.header.stamp)) for e in messages["/evaluator/errors"] if e.mode == mode]
        scores, predictions = select_common_period(scored, predicted)
        assert scores == predictions
        assert predictions[0][1] < drive_with_faults["zero_ns"] + 5 * 10**9  # before the first fault


@pytest.fixture(scope="module")
def drive_in_another_frame(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Predictor and recorder: odometry in the frame `odom`, then a predictor that stands still and continues."""
    processes = Processes(tmp_path_factory.mktemp("frame"))
    try:
        predictor = processes.node("st_predictor", "predictor", f"vehicle_file:={LEAF}")
        recording, bag = start_recorder(processes)
        feed(processes, "--subscribers", "2", "--duration", "3", "--frame", "odom")
        predictor.send_signal(signal.SIGSTOP)  # its publishers stay matched
        wait_for(lambda: "nothing recorded from predictor" in processes.log("recorder"), what="report of the silence")
        predictor.send_signal(signal.SIGCONT)
        wait_for(lambda: "no silent publisher found" in processes.log("recorder"), what="report of its end")
        statuses = [processes.stop(node) for node in (predictor, recording)]
    finally:
        processes.close()
    return {"statuses": statuses, "messages": read_messages(bag)}


@pytest.mark.slow
def test_odometry_in_another_frame_is_rejected(drive_in_another_frame: dict[str, Any]) -> None:
    messages = drive_in_another_frame["messages"]
    assert drive_in_another_frame["statuses"] == [0, 0]
    assert "/predictor/linear/prediction" not in messages
    output = [text for _, level, text in health(messages)["predictor: prediction"] if level == ERROR]
    assert any("'odom'" in text and "expected 'map'" in text for text in output)


@pytest.mark.slow
def test_recorder_reports_the_silent_node(drive_in_another_frame: dict[str, Any]) -> None:
    output = health(drive_in_another_frame["messages"])["recorder: publishers"]
    assert {level for _, level, _ in output} == {OK, WARNING}
    assert not [text for _, level, text in output if level == WARNING and "predictor" not in text]


@pytest.mark.slow
def test_overrun_skips_ticks_and_queues_none(processes: Processes) -> None:
    """6000 steps of three models do not fit into 20 ms; the evaluator detects that its vehicle file differs."""
    predictor = processes.node("st_predictor", "predictor", f"vehicle_file:={LEAF}", "horizon:=60.0", "step:=0.01",
                               "rate:=50.0")
    evaluator = processes.node("st_predictor", "evaluator", f"vehicle_file:={GENESIS}")
    recording, bag = start_recorder(processes)
    feed(processes, *WAIT_FOR_PREDICTIONS, "--subscribers", "3", "--duration", "3")
    assert [processes.stop(p) for p in (predictor, evaluator, recording)] == [0, 0, 0]
    messages = read_messages(bag)
    status = messages["/predictor/status"][-1]
    assert status.skipped_overrun > status.predicted > 0
    assert status.due == status.predicted + status.skipped_overrun + status.skipped_stale + status.skipped_slow
    ticks, others = trim_to_common_start(
        *(stamps(messages[f"/predictor/{model}/prediction"]) for model in ("nonlinear", "kinematic")))
    assert ticks == sorted(set(ticks)) == others
    warnings = {name: [text for _, level, text in output if level == WARNING]
                for name, output in health(messages).items()}
    assert any("skipped by overrun" in text for text in warnings["predictor: timing"])
    assert any("a different vehicle" in text for text in warnings["evaluator: scoring"])


@pytest.mark.slow
def test_simulated_time_may_restart(processes: Processes) -> None:
    """A replay in a loop: stamps and /clock of 1970, back to their start after four seconds."""
    nodes = [processes.node("st_predictor", name, f"vehicle_file:={LEAF}", "use_sim_time:=true")
             for name in ("predictor", "evaluator")]
    recording, bag = start_recorder(processes)
    feed(processes, *WAIT_FOR_PREDICTIONS, "--subscribers", "3", "--duration", "8", "--loop", "4",
         "--zero", str(1000 * 10**9))
    assert [processes.stop(p) for p in (*nodes, recording)] == [0, 0, 0]
    messages = read_messages(bag)
    times = [(s - 1000 * 10**9) * 1e-9 for s in stamps(messages["/predictor/linear/prediction"])]
    assert min(times) >= 0.0
    assert max(times) < 4.0
    backwards = [k for k in range(1, len(times)) if times[k] < times[k - 1]]
    assert len(backwards) == 1
    rounds = [times[a:b] for a, b in zip([0, *backwards], [*backwards, None], strict=True)]
    assert all(len(one) > 25 for one in rounds)
    for message in messages["/predictor/linear/prediction"]:
        # Both are on the same clock; a measurement may arrive just before its /clock.
        assert abs(nanoseconds(message.issued_at) - nanoseconds(message.header.stamp)) < 10**9


@pytest.mark.slow
def test_recorder_reports_a_full_disk_and_continues(processes: Processes) -> None:
    """A limit of the file size emulates the full disk; a second recorder records the diagnostics."""
    bag = processes.folder / "full"
    command = [executable("st_predictor", "recorder"), "--ros-args", "-p", f"output_directory:={bag}"]
    limited = processes.start(["bash", "-c", 'ulimit -f 60; exec "$@"', "bash", *command], "limited")
    watching, seen = start_recorder(processes, arguments=("-r", "__node:=watcher"))
    feed(processes, "--subscribers", "2", "--duration", "5", "--rate", "250")
    assert limited.poll() is None
    assert processes.stop(limited) == 1
    assert processes.stop(watching) == 0
    output = [text for _, level, text in health(read_messages(seen))["recorder: recording"] if level == ERROR]
    assert output
    # Without number_if_exists, recording does not resume.
    assert all("File too large" in text and "resumes" not in text for text in output)
    messages = read_messages(bag)
    assert len(messages["/ins/odometry"]) > 200
    assert (bag / "full_0.mcap").stat().st_size <= 60 * 1024


@pytest.mark.slow
def test_killed_recorder_loses_at_most_a_second(processes: Processes) -> None:
    from st_recordings.recovery import recover

    node, bag = start_recorder(processes)
    feeder = processes.start([sys.executable, str(ROOT / "tests" / "circle_feeder.py"), "--duration", "20"], "feeder")
    wait_for(lambda: "feeding" in processes.log("feeder"), what="feeding")
    time.sleep(4.0)
    killed_ns = time.time_ns()
    os.kill(node.pid, signal.SIGKILL)
    node.wait(10)
    processes.stop(feeder)
    report = recover(bag)
    assert not all(part.is_intact for part in report.files)
    assert killed_ns - report.files[0].end_ns < 1_000_000_000
    received = stamps(read_messages(bag)["/ins/odometry"])
    assert len(received) > 250
    assert all(after - before == 10_000_000 for before, after in pairwise(received))


REFUSED = [
    ("predictor", ["vehicle_file:=nowhere.yaml"], "vehicle_file: nowhere.yaml: No such file"),
    ("predictor", [], "vehicle_file: not set"),
    ("predictor", ["horizont:=5.0"], "unknown parameter horizont; known:"),
    ("predictor", ["rate:=1000.0"], "rate: 1000.0 is outside 0.1 to 100 Hz"),
    ("predictor", ["rate:=fast"], "rate: 'fast' has type str, not float"),
    ("predictor", [f"vehicle_file:={LEAF}", "horizon:=5.01"], "horizon: 5.01 s is not a whole number of steps"),
    ("predictor", [f"vehicle_file:={LEAF}", "models:=[linear, cubic]"], "unknown model 'cubic'; known:"),
    ("evaluator", [f"vehicle_file:={LEAF}", f"output_directory:={ROOT}"], "contains files"),
    ("evaluator", [f"vehicle_file:={LEAF}", f"output_directory:={LEAF}/errors"], "output_directory:"),
    ("recorder", [], "output_directory: not set"),
    ("recorder", ["output_directory:=/proc/bag"], "output_directory: /proc/bag"),
    ("recorder", ["output_directory:=x", "configuration_files:=[nowhere.yaml]"], "configuration_files: nowhere.yaml"),
    ("recorder", ["output_directory:=x", "metadata_json:='[1]'"], "metadata_json:"),
]


@pytest.mark.parametrize(("node", "parameters", "message"), REFUSED, ids=[f"{n}-{w[:25]}" for n, _, w in REFUSED])
def test_wrong_parameters_are_rejected_in_one_line(
    refuse: Callable[..., str], node: str, parameters: list[str], message: str
) -> None:
    line = refuse(NODES[node], *parameters)
    assert line.startswith(f"{node}.") or line.startswith(f"{node}: ")
    assert message in line


def test_wrong_value_in_a_parameter_file_is_rejected_with_file_key_and_limit(processes: Processes) -> None:
    text = (ROOT / "config" / "nodes.yaml").read_text()
    file = processes.folder / "mine.yaml"
    file.write_text(text.replace("stale_after: 0.2", "stale_after: 20.0"))
    process = processes.node("st_predictor", "predictor", arguments=("--params-file", str(file)))
    assert process.wait(30) == 2
    assert processes.log("predictor").strip() == f"{file}: predictor.stale_after: 20.0 is outside 0.001 to 10 s"


def test_vehicle_file_with_a_wrong_unit_is_rejected(processes: Processes) -> None:
    file = processes.folder / "car.yaml"
    shutil.copy(LEAF, file)
    file.write_text(file.read_text().replace("unit: kg,", "unit: lb,"))
    process = processes.node("st_predictor", "evaluator", f"vehicle_file:={file}")
    assert process.wait(30) == 2
    (line,) = processes.log("evaluator").splitlines()
    assert str(file) in line
    assert "mass" in line
    assert "kg" in line
