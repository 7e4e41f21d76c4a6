"""Predictor, evaluator and recorder as processes over DDS, with inputs of a car on an exact circle."""

import math
import signal
import struct
import sys
from collections import defaultdict
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
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
from circle_feeder import pose_at
from mcap.reader import make_reader
from ros_processes import Processes, wait_for
from support import LEAF, ROOT

pytestmark = [pytest.mark.ros, pytest.mark.timing("nodes run in real time; one that waits for its turn skips ticks")]
MODELS = ("kinematic", "linear", "nonlinear")
RADIUS, SPEED, ANGLE = 30.0, 8.0, 0.09  # m, m/s, rad of the road wheels
DURATION = 12.0  # s
MIN_TICKS = 20  # of an overloaded machine; all other ticks are counted as skipped
WHEELBASE, CG_TO_REAR, CG_TO_INS = 2.7, 2.7 - 1.176, -0.398  # m, config/vehicle/leaf.yaml


@dataclass
class Run:
    zero_ns: int
    folder: Path
    statuses: dict[str, int]
    messages: dict[str, list[Any]] = field(default_factory=lambda: defaultdict(list))
    errors: dict[str, list[Any]] = field(default_factory=lambda: defaultdict(list))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    folder = tmp_path_factory.mktemp("circle")
    processes = Processes(folder)
    try:
        vehicle = f"vehicle_file:={LEAF}"
        metadata = """metadata_json:='{"drive": {"tyres": 4}}'"""
        nodes = {
            "predictor": processes.node("st_predictor", "predictor", vehicle),
            "evaluator": processes.node("st_predictor", "evaluator", vehicle, f"output_directory:={folder / 'errors'}"),
            "recorder": processes.node("st_predictor", "recorder", f"output_directory:={folder / 'bag'}",
                                       f"configuration_files:=[{LEAF}]", metadata),
        }
        received = {f"predictor/{m}/{kind}": count for m in MODELS for kind, count in (("path", 1), ("prediction", 2))}
        feeder = processes.start([
            sys.executable, str(ROOT / "tests" / "circle_feeder.py"), "--subscribers", "3", "--duration", str(DURATION),
            "--radius", str(RADIUS), "--speed", str(SPEED), "--angle", str(ANGLE),
            *(f"--wait-for={topic}:{count}" for topic, count in received.items())], "feeder")
        assert feeder.wait(60) == 0, processes.log("feeder")
        statuses = {name: processes.stop(process) for name, process in nodes.items()}
    finally:
        processes.close()
    return Run(int(processes.log("feeder").split()[1]), folder, statuses, read_messages(folder / "bag"),
               read_messages(folder / "errors"))


def test_nodes_end_with_status_0_and_closed_files(run: Run) -> None:
    from st_recordings.recovery import recover

    assert run.statuses == {"predictor": 0, "evaluator": 0, "recorder": 0}
    assert all(part.is_intact for part in recover(run.folder / "bag").files)
    assert all(part.is_intact for part in recover(run.folder / "errors").files)


def test_every_tick_has_three_predictions_and_paths(run: Run) -> None:
    """Checked from the first tick after the recorder has discovered all six publishers."""
    ticks, *others = trim_to_common_start(
        *(stamps(run.messages[f"/predictor/{m}/{kind}"]) for m in MODELS for kind in ("prediction", "path")))
    assert all(other == ticks for other in others)
    assert len(set(ticks)) == len(ticks) > MIN_TICKS
    status = run.messages["/predictor/status"][-1]
    assert 0 <= status.predicted - len(ticks) <= count_ticks_before(ticks[0], run.zero_ns)
    assert status.due == status.predicted + status.skipped_stale + status.skipped_overrun + status.skipped_slow


def test_path_starts_at_the_ins_point(run: Run) -> None:
    for model in MODELS:
        for path in run.messages[f"/predictor/{model}/path"]:
            stamp = nanoseconds(path.header.stamp)
            assert path.header.frame_id == "map"
            assert len(path.poses) == 101
            x, y, yaw = pose_at((stamp - run.zero_ns) * 1e-9, RADIUS, SPEED)
            first = path.poses[0].pose
            # Interpolation between two samples gives a point on the chord, up to 0.03 mm inside the circle.
            assert (first.position.x, first.position.y) == pytest.approx((x, y), abs=5e-5)
            yaw_error = 2 * math.atan2(first.orientation.z, first.orientation.w) - yaw
            assert math.remainder(yaw_error, 2 * math.pi) == pytest.approx(0.0, abs=1e-6)


def test_poses_of_a_path_are_stamped_with_each_step(run: Run) -> None:
    path = run.messages["/predictor/linear/path"][3]
    assert stamps(path.poses) == [nanoseconds(path.header.stamp) + k * 50_000_000 for k in range(101)]
    assert {pose.header.frame_id for pose in path.poses} == {"map"}


def test_kinematic_path_is_the_arc_of_the_steering_angle(run: Run) -> None:
    """Held inputs at constant speed: a circle in closed form, at the INS point."""
    beta = math.atan(CG_TO_REAR / WHEELBASE * math.tan(ANGLE))
    curvature = math.cos(beta) * math.tan(ANGLE) / WHEELBASE
    for path in run.messages["/predictor/kinematic/path"][5::20]:
        time_ns = nanoseconds(path.header.stamp)
        x, y, yaw0 = pose_at((time_ns - run.zero_ns) * 1e-9, RADIUS, SPEED)
        cg = np.array([x - CG_TO_INS * math.cos(yaw0), y - CG_TO_INS * math.sin(yaw0)])
        yaw = yaw0 + SPEED * curvature * 0.05 * np.arange(101)
        course, course0 = yaw + beta, yaw0 + beta
        arc = np.column_stack([np.sin(course) - np.sin(course0), np.cos(course0) - np.cos(course)]) / curvature
        ins = cg + arc + CG_TO_INS * np.column_stack([np.cos(yaw), np.sin(yaw)])
        points = [(p.pose.position.x, p.pose.position.y) for p in path.poses]
        np.testing.assert_allclose(points, ins, atol=1e-4)


def test_prediction_contains_state_inputs_and_configuration(run: Run) -> None:
    hashes = set()
    for model in MODELS:
        for message in run.messages[f"/predictor/{model}/prediction"][5:]:
            assert message.model == model
            assert message.road_wheel_angle == pytest.approx(ANGLE, abs=1e-9)
            assert message.velocity_x_dot == pytest.approx(0.0, abs=1e-6)
            assert message.velocity_x[0] == pytest.approx(SPEED, abs=1e-9)
            # v_y is 0 at the INS point; the CG is 0.398 m ahead of it.
            assert message.velocity_y[0] == pytest.approx(SPEED / RADIUS * -CG_TO_INS, abs=1e-9)
            assert message.yaw_rate[0] == pytest.approx(SPEED / RADIUS, abs=1e-9)
            assert (message.cg_to_ins_x, message.cg_to_ins_y) == (CG_TO_INS, 0.0)
            for name in ("x", "y", "velocity_x", "velocity_y", "yaw", "yaw_rate"):
                assert len(getattr(message, name)) == 101
            assert message.compute_time > 0.0
            assert nanoseconds(message.issued_at) > nanoseconds(message.header.stamp)
            hashes.add(message.configuration_hash)
    assert [len(h) for h in hashes] == [64]


def test_forecast_errors_are_path_minus_circle(run: Run) -> None:
    """Longitudinal + ahead, lateral + left, along the true heading at each point."""
    paths = {(m, nanoseconds(p.header.stamp)): p for m in MODELS for p in run.messages[f"/predictor/{m}/path"]}
    checked = 0
    for error in run.errors["/evaluator/errors"]:
        start_ns = nanoseconds(error.header.stamp)
        if error.mode != "forecast" or not error.complete:
            continue
        path = paths[error.model, start_ns]
        t = (start_ns - run.zero_ns) * 1e-9 + 0.05 * np.arange(101)
        truth = np.array([pose_at(k, RADIUS, SPEED) for k in t])
        deviation = np.array([(p.pose.position.x, p.pose.position.y) for p in path.poses]) - truth[:, :2]
        cosine, sine = np.cos(truth[:, 2]), np.sin(truth[:, 2])
        np.testing.assert_allclose(error.longitudinal, deviation[:, 0] * cosine + deviation[:, 1] * sine, atol=2e-4)
        np.testing.assert_allclose(error.lateral, deviation[:, 1] * cosine - deviation[:, 0] * sine, atol=2e-4)
        assert error.lateral_mean == pytest.approx(np.mean(error.lateral))
        checked += 1
    assert checked > MIN_TICKS


def test_every_prediction_is_scored_twice(run: Run) -> None:
    """Checked from the first prediction that both evaluator and recorder receive."""
    predicted = [(m, nanoseconds(p.header.stamp)) for m in MODELS for p in run.messages[f"/predictor/{m}/prediction"]]
    for mode in ("forecast", "hindsight"):
        scored = [(e.model, nanoseconds(e.header.stamp)) for e in run.errors["/evaluator/errors"] if e.mode == mode]
        assert len(scored) == len(set(scored)) > MIN_TICKS * len(MODELS)
        scores, predictions = select_common_period(scored, predicted)
        assert scores == predictions
    last_ns = max(nanoseconds(m.header.stamp) for m in run.messages["/ins/odometry"])
    for error in run.errors["/evaluator/errors"]:
        horizon_passed = nanoseconds(error.header.stamp) + 5 * 10**9 <= last_ns
        assert error.complete == horizon_passed
        assert bool(error.incomplete_reason) != error.complete


def test_hindsight_equals_forecast_under_constant_inputs(run: Run) -> None:
    """Speed and steering are constant, so held and measured inputs are equal."""
    means = defaultdict(dict)
    for error in run.errors["/evaluator/errors"][30:]:
        if error.complete:
            means[error.model, nanoseconds(error.header.stamp)][error.mode] = error.lateral_mean
    assert len(means) > MIN_TICKS
    for by_mode in means.values():
        assert by_mode["forecast"] == pytest.approx(by_mode["hindsight"], abs=1e-3)


def test_last_summary_has_the_statistics_of_all_errors(run: Run) -> None:
    for messages in (run.errors, run.messages):
        summary = messages["/evaluator/summary"][-1]
        assert summary.pending == 0
        assert {(s.model, s.mode) for s in summary.statistics} == set(product(MODELS, ("forecast", "hindsight")))
        for row in summary.statistics:
            scores = [e for e in run.errors["/evaluator/errors"] if (e.model, e.mode) == (row.model, row.mode)]
            complete = np.array([(e.longitudinal_mean, e.lateral_mean, e.yaw_mean) for e in scores if e.complete])
            assert (row.n_starts, row.n_incomplete) == (len(complete), len(scores) - len(complete))
            for column, axis in zip(complete.T, ("longitudinal", "lateral", "yaw"), strict=True):
                assert getattr(row, f"{axis}_mean") == pytest.approx(column.mean())
                assert getattr(row, f"{axis}_max") == pytest.approx(np.abs(column).max())
                assert getattr(row, f"{axis}_rmse") == pytest.approx(np.sqrt(np.square(column).mean()))


def test_recorder_and_evaluator_record_equal_errors(run: Run) -> None:
    recorded = [(e.model, e.mode, nanoseconds(e.header.stamp)) for e in run.messages["/evaluator/errors"]]
    assert recorded == [(e.model, e.mode, nanoseconds(e.header.stamp)) for e in run.errors["/evaluator/errors"]]


def test_bag_contains_messages_and_configuration(run: Run) -> None:
    from mcap_ros2.decoder import DecoderFactory

    counts = defaultdict(int)
    with (run.folder / "bag" / "bag_0.mcap").open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        records = {record.name: record.metadata for record in reader.iter_metadata()}
        for _, channel, message, _ in reader.iter_decoded_messages():
            counts[channel.topic] += 1
            assert 0 <= message.log_time - message.publish_time < 60 * 10**9  # both of the same clock
    assert counts == {topic: len(messages) for topic, messages in run.messages.items()}
    # The recorder discovers topics at 4 Hz, so the first messages may be missing.
    assert counts["/ins/odometry"] > 100 * (DURATION - 0.6)
    assert records["configuration"]["leaf.yaml"] == LEAF.read_text()
    assert len(records["configuration"]["hash"]) == 64
    assert records["drive"] == {"tyres": "4"}


def test_qos_of_topics_is_recorded(run: Run) -> None:
    import yaml

    information = yaml.safe_load((run.folder / "bag" / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    topics = {t["topic_metadata"]["name"]: t["topic_metadata"] for t in information["topics_with_message_count"]}
    assert topics["/predictor/status"]["offered_qos_profiles"][0]["durability"] == "transient_local"
    assert topics["/ins/odometry"]["offered_qos_profiles"][0]["durability"] == "volatile"
    assert topics["/ins/odometry"]["type_description_hash"].startswith("RIHS01_")


def test_diagnostics_report_healthy_nodes(run: Run) -> None:
    output = {name: {(level, text) for _, level, text in lines} for name, lines in health(run.messages).items()}
    assert (0, "predicting") in output["predictor: prediction"]
    assert (0, "scoring") in output["evaluator: scoring"]
    assert {level for level, _ in output["recorder: recording"]} == {0}
    assert {level for level, _ in output["evaluator: recording"]} == {0}


def test_sigterm_closes_the_bag(processes: Processes) -> None:
    node = processes.node("st_predictor", "recorder", f"output_directory:={processes.folder / 'bag'}")
    wait_for(lambda: "recording into" in processes.log("recorder"), what="recorder up")
    assert processes.stop(node, signal.SIGTERM) == 0
    assert (processes.folder / "bag" / "metadata.yaml").exists()


def read_publish_times(file: Path, topic: str) -> dict[int, int]:
    """Publish time by header stamp of the messages of a topic [ns]."""
    with file.open("rb") as stream:
        return {sec * 10**9 + nanosec: message.publish_time
                for _, _, message in make_reader(stream).iter_messages([topic])
                for sec, nanosec in [struct.unpack_from("<iI", message.data, 4)]}


def test_predictions_are_published_before_paths_with_the_age_of_their_state(run: Run) -> None:
    (file,) = (run.folder / "bag").glob("*.mcap")
    last_prediction, first_path = "/predictor/nonlinear/prediction", "/predictor/kinematic/path"
    published = read_publish_times(file, last_prediction), read_publish_times(file, first_path)
    starts = published[0].keys() & published[1].keys()
    assert len(starts) > MIN_TICKS
    assert all(published[0][start] < published[1][start] for start in starts)
    issued = [nanoseconds(m.issued_at) - nanoseconds(m.header.stamp)
              for model in MODELS for m in run.messages[f"/predictor/{model}/prediction"]]
    ages = [status for status in run.messages["/predictor/status"] if math.isfinite(status.state_age)]
    assert ages and all(0.0 < status.state_age <= status.state_age_max for status in ages)
    assert max(status.state_age_max for status in ages) == pytest.approx(max(issued) * 1e-9, abs=1e-9)
