"""Geometry of the live views, ghosts, frames and server of the page, and rejected arguments."""

import json
import math
import socket
import threading
import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")
pytest.importorskip("st_msgs", reason="needs the built workspace")

import urllib.error
import urllib.request

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from nav_msgs.msg import Odometry
from ros_messages import STORE
from ros_messages import odometry as serialised_odometry
from rosbags.rosbag2 import StoragePlugin, Writer
from st_core.palette import LABEL_TIMES, MODEL_COLOUR, get_label_index, rgb
from st_core.vehicle import VehicleParameters
from st_live.nodes.monitor import Monitor, Status, SuiteState
from st_live.nodes.passenger import PassengerFrames, main
from st_live.page import PAGE, RERUN_POLICY, LiveView, PageServer, check_new_rerun_file
from st_live.recorded_view import draw_recording, format_results, make_grid_lines, to_screen
from st_live.suite import SuiteError, claim_domain
from st_msgs.msg import (
    Band,
    ErrorStatistics,
    ErrorSummary,
    InsStatus,
    PlannedPrediction,
    Prediction,
    PredictionError,
    PredictorStatus,
    Steering,
)
from st_predictor.map_drawing import GHOST_AGES, GHOST_TOLERANCE, History, Pose, make_car_outline, make_ribbon
from st_predictor.map_drawing import Path as PredictedPath
from st_recordings.runs.cdr import ODOMETRY
from st_recordings.runs.errors import RunError
from st_ros.polling import from_nanoseconds
from support import LEAF

pytestmark = pytest.mark.ros


@pytest.mark.parametrize("yaw", np.linspace(-3.0, 3.0, 7))
def test_heading_up_view_has_left_on_the_left_and_ahead_up(yaw: float) -> None:
    """Screen y points down: up is negative."""
    pose = Pose(120.0, -40.0, yaw)
    ahead = to_screen(pose, 120.0 + 10.0 * math.cos(yaw), -40.0 + 10.0 * math.sin(yaw))
    left = to_screen(pose, 120.0 - 10.0 * math.sin(yaw), -40.0 + 10.0 * math.cos(yaw))
    assert ahead == pytest.approx([0.0, -10.0], abs=1e-9)
    assert left == pytest.approx([-10.0, 0.0], abs=1e-9)


def test_bag_without_steering_is_drawn_and_one_without_odometry_rejected(tmp_path: Path) -> None:
    for topic in ("/ins/odometry", "/odom"):
        with Writer(tmp_path / topic[1:4], version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            connection = writer.add_connection(topic, ODOMETRY, typestore=STORE)
            for k in range(20):
                writer.write(connection, k * 50_000_000, serialised_odometry(
                        k * 50_000_000, 0.1 * k, 0.0, 0.0, 2.0))
    assert draw_recording(tmp_path / "ins", tmp_path / "view.rrd", LEAF) == 10
    with pytest.raises(RunError, match="it has no topic ins/odometry, which the view requires; play it with"):
        draw_recording(tmp_path / "odo", tmp_path / "other.rrd", LEAF)


def test_north_up_view_has_east_on_the_right() -> None:
    pose = Pose(5.0, 7.0, math.pi / 2)
    assert to_screen(pose, 5.0, 17.0) == pytest.approx([0.0, -10.0])
    assert to_screen(pose, 15.0, 7.0) == pytest.approx([10.0, 0.0])
    assert to_screen(pose, np.zeros(4), np.zeros(4)).shape == (4, 2)


def test_grid_lines_are_fixed_in_the_map() -> None:
    for pose in (Pose(3.0, -2.0, 0.0), Pose(103.0, 55.0, 1.0)):
        lines = make_grid_lines(pose, 20.0, 50.0)
        assert len(lines) == 10
        for x, y in lines:
            assert (x % 20.0 == 0.0).all() or (y % 20.0 == 0.0).all()


def test_car_outline_has_the_size_and_heading_of_the_car() -> None:
    car = VehicleParameters.from_yaml(LEAF.read_text(), "leaf")
    x, y = make_car_outline(Pose(10.0, 20.0, 0.5), car)
    forward = (x - 10.0) * math.cos(0.5) + (y - 20.0) * math.sin(0.5)
    left = (y - 20.0) * math.cos(0.5) - (x - 10.0) * math.sin(0.5)
    assert np.ptp(forward) == pytest.approx(car.length) and np.ptp(left) == pytest.approx(car.width)
    # The overhangs at front and rear are equal; the INS of the Leaf is behind the CG.
    assert forward.max() - (car.cg_to_front_axle - car.cg_to_ins_x) == pytest.approx(0.5 * (car.length - car.wheelbase))
    assert left[forward.argmax()] == pytest.approx(0.0, abs=1e-9)


def straight(start_ns: int, speed: float = 10.0) -> PredictedPath:
    x = start_ns * 1e-9 * speed + speed * np.linspace(0.0, 5.0, 101)
    return PredictedPath(start_ns, 0.05, x, np.zeros(101))


def test_ghosts_are_predictions_from_one_to_five_seconds_ago() -> None:
    history = History()
    for k in range(80):
        history.add_path("linear", straight(k * 100_000_000))
    now_ns = 7_900_000_000
    ghosts = history.find_ghosts("linear", now_ns)
    assert [age for age, _ in ghosts] == list(GHOST_AGES)
    for age, path in ghosts:
        assert (now_ns - path.start_ns) * 1e-9 == pytest.approx(age, abs=GHOST_TOLERANCE)
        assert path.find_position(now_ns) == pytest.approx((79.0, 0.0))  # the car follows all predictions
    assert history.find_newest("linear", now_ns).start_ns == now_ns
    assert history.find_newest("linear", now_ns + 2 * 10**9) is None  # stale
    assert history.find_predicted_position("linear", now_ns) == pytest.approx((79.0, 0.0))
    assert history.find_predicted_position("linear", 20_000_000_000) is None
    assert history.find_predicted_position("kinematic", now_ns) is None
    assert straight(0).find_position(5_100_000_000) is None and straight(10**9).find_position(0) is None


def test_gap_has_no_ghosts_and_step_back_in_time_clears_the_history() -> None:
    history = History()
    for k in (0, 1, 60, 61):
        history.add_path("linear", straight(k * 100_000_000))
    assert [age for age, _ in history.find_ghosts("linear", 6_100_000_000)] == []
    history.add_pose(6_100_000_000, 1.0, 2.0)
    history.add_pose(6_050_000_000, 3.0, 4.0)  # late: dropped
    assert len(history.track) == 1
    history.add_pose(1_000_000_000, 5.0, 6.0)  # a replay restarts
    assert list(history.track) == [(1_000_000_000, 5.0, 6.0)] and history.models == ()


def test_ribbon_has_the_width_of_its_band_and_extends_beyond_the_path() -> None:
    x, zero = np.linspace(0.0, 10.0, 11), np.zeros(11)
    east = make_ribbon(0.9, (x, zero, zero), 0.2 * x, 0.1 * x)
    assert east.left[:-1] == pytest.approx(np.stack([x, 0.1 * x], axis=1))
    assert east.right[-1] == pytest.approx([12.0, -1.0])
    for stride in (1, 4):  # a triangle up to the end of the path, a rectangle beyond it
        a, b, c = np.moveaxis(east.make_triangles(stride), 1, 0)
        area = 0.5 * np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]).sum()
        assert area == pytest.approx(0.5 * 10.0 * 2.0 + 2.0 * 2.0)
    north = make_ribbon(0.5, (zero, x, zero + np.pi / 2), 0.2 * x, 0.1 * x)
    assert north.left[5] == pytest.approx([-0.5, 5.0]) and north.right[-1] == pytest.approx([1.0, 12.0])


def test_labels_of_coinciding_predictions_do_not_overlap() -> None:
    places = [get_label_index(model, 0.05, 101) for model in LABEL_TIMES]
    assert LABEL_TIMES.keys() == MODEL_COLOUR.keys()
    assert min(np.abs(np.diff(sorted(places)))) >= 10  # half a second of driving apart
    assert get_label_index("kinematic", 0.05, 21) == 20  # a shorter horizon: at its end
    assert rgb("#1f77b4") == (31, 119, 180) and rgb("#000000", 0.5) == (128, 128, 128)


def test_error_table_has_a_row_per_model_and_mode_and_lists_faults(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")  # the text must not contain codes of a terminal
    rows = [ErrorStatistics(model=m, mode=k, n_starts=7, longitudinal_rmse=1.234, lateral_rmse=float("nan"))
            for m in ("kinematic", "linear") for k in ("forecast", "hindsight")]
    health = {name: Status(name, level, text, math.inf)
              for level, name, text in ((0, "a", "fine"), (1, "b", "late"), (2, "c", "silent"))}
    lines = format_results(SuiteState(ErrorSummary(statistics=rows), PredictorStatus(due=9), health)).splitlines()
    assert max(map(len, lines)) <= 72 and lines[0] == lines[-1] == "```" and "\x1b" not in "".join(lines)
    table = [line.split() for line in lines if " | 1.23" in line]
    assert [row[:3] for row in table] == [
        [mode, model, "7"] for mode in ("hindsight", "forecast") for model in ("kinematic", "linear")]
    assert all(row[3:8] == ["0.00", "|", "0.00", "|", "1.23"] and row[-1] == "-" for row in table)
    text = "\n".join(lines)
    assert "due 9" in text and "fine" not in text
    assert text.index("error: c: silent") < text.index("warning: b: late")
    assert "waiting" in format_results(SuiteState())
    assert "all nodes OK" in format_results(SuiteState(health={"a": health["a"]}))


def test_policy_of_the_rerun_page_allows_no_external_requests() -> None:
    for directive in RERUN_POLICY.split("; "):
        for source in directive.split()[1:]:
            assert source.startswith("'") or source in ("data:", "blob:"), directive


@pytest.mark.parametrize(("name", "text"), [
    ("view.txt", "must end in .rrd"), ("there.rrd", "exists already"), ("no/where.rrd", "cannot be written"),
])
def test_invalid_rerun_file_is_rejected(tmp_path: Path, name: str, text: str) -> None:
    pytest.importorskip("rerun", reason="not installed with a sourced ROS")
    (tmp_path / "there.rrd").write_bytes(b"")
    with pytest.raises(SuiteError, match=text):
        check_new_rerun_file("--view-save", tmp_path / name)


@pytest.mark.parametrize("address", ["127.0.0.1:http", "127.0.0.1:99999", "192.0.2.7:8080", "a..b:0"])
def test_unusable_address_is_rejected_before_the_run(address: str) -> None:
    with pytest.raises(SuiteError, match="--view-address"):
        LiveView(True, address)


def test_occupied_port_is_rejected_before_the_run() -> None:
    with socket.create_server(("127.0.0.1", 0)) as other, pytest.raises(SuiteError, match="in use"):
        LiveView(True, f"127.0.0.1:{other.getsockname()[1]}")


def test_port_alone_does_not_open_the_page_to_the_network() -> None:
    assert LiveView(True, ":8080")._host == "127.0.0.1"


def odometry(time_s: float, x: float, y: float, yaw: float, speed: float, yaw_rate: float) -> Odometry:
    message = Odometry()
    message.header.frame_id, message.header.stamp = "map", from_nanoseconds(round(time_s * 1e9))
    message.pose.pose.position.x, message.pose.pose.position.y = x, y
    message.pose.pose.orientation.z, message.pose.pose.orientation.w = math.sin(yaw / 2), math.cos(yaw / 2)
    message.twist.twist.linear.x, message.twist.twist.angular.z = speed, yaw_rate
    return message


@pytest.fixture
def passenger() -> PassengerFrames:
    """3 s to the north at 10 m/s with the INS 0.4 m behind the CG; a prediction that bends to the left."""
    car = VehicleParameters.from_yaml(LEAF.read_text(), "leaf")
    frames = PassengerFrames(car, "map")
    for k in range(31):
        frames.take("ins/odometry", odometry(1000 + 0.1 * k, 7.0, k, math.pi / 2, 10.0, 0.2), 50 + 0.1 * k)
    north = 30 - car.cg_to_ins_x + np.linspace(0.0, 50.0, 101)
    prediction = Prediction(model="linear", step=0.05, x=7.0 - 0.002 * (north - north[0]) ** 2, y=north,
                            yaw=np.full(101, math.pi / 2), velocity_x=np.full(101, 10.0), velocity_y=np.zeros(101),
                            yaw_rate=np.zeros(101))
    zeros, across = [0.0] * 101, np.linspace(0.0, 2.0, 101).tolist()
    prediction.bands = [Band(mode="forecast", level=0.9, along=zeros, across=across, yaw=zeros)]
    frames.take("predictor/linear/prediction", prediction, 53.0)
    frames.take("vehicle/steering", Steering(road_wheel_angle=0.1, valid=True), 53.0)
    frames.take("ins/status", InsStatus(position_mode_text="RTK integer"), 52.5)
    return frames


def test_vehicle_file_in_another_encoding_is_reported(tmp_path: Path, monkeypatch, capsys) -> None:
    file = tmp_path / "vehicle.yaml"
    file.write_bytes("name: Citroën".encode("cp1252"))
    options = {"vehicle": str(file), "map_frame": "map", "title": "run", "address": "127.0.0.1", "port": 0}
    monkeypatch.setattr("sys.argv", ["passenger", json.dumps(options)])
    assert main() == 2 and capsys.readouterr().err.startswith(f"{file}: cannot be read: 'utf-8' codec can't decode")


def test_frame_is_in_the_axes_of_the_car(passenger: PassengerFrames) -> None:
    frame = passenger.make_frame(53.1)
    json.dumps(frame, allow_nan=False)
    assert frame["received"] == pytest.approx(53.0) and frame["mode"] == "RTK integer"
    assert frame["speed"] == 10.0 and frame["steering"] == 0.1
    track = np.array(frame["track"])
    assert np.abs(track[:, 1]).max() < 0.01 and track[0, 0] == pytest.approx(-30.0, abs=0.01)
    path = frame["paths"]["linear"]
    points = np.array(path["points"])
    assert points[0] == pytest.approx([0.0, 0.0], abs=0.01)  # the prediction starts at the CG
    assert points[-1] == pytest.approx([50.0, 5.0], abs=0.01)  # left is positive
    assert path["step"] == pytest.approx(0.1) and path["band"][-1] == 2.0 and len(points) == 51
    late = passenger.make_frame(54.5)
    assert "linear" not in late["paths"] and late["steering"] is None  # stale data are not drawn


def test_course_prediction_replaces_held_inputs_while_in_use(passenger: PassengerFrames) -> None:
    held = passenger._predictions["forecast"]["linear"][1]
    held.bands = [Band(mode=mode, level=0.9, along=[0.0] * len(held.x), across=[width] * len(held.x),
                       yaw=[0.0] * len(held.x)) for mode, width in (("forecast", 2.0), ("course", 1.0))]
    course = PlannedPrediction(model="linear", step=0.05, x=held.x, y=held.y, yaw=held.yaw, velocity_x=held.velocity_x,
                               velocity_y=held.velocity_y, yaw_rate=held.yaw_rate)
    course.header.stamp = held.header.stamp
    for mode, error in (("forecast", 4.0), ("course", 1.5)):
        passenger.take("evaluator/errors", PredictionError(model="linear", mode=mode, complete=True, horizon=[0.0, 5.0],
                                                        longitudinal=[0.0, error], lateral=[0.0, 0.0]), 53.0)
    passenger.take("predictor/linear/course", course, 53.0)
    frame = passenger.make_frame(53.1)
    assert frame["paths"]["linear"]["inputs"] == "of the course" and frame["paths"]["linear"]["band"][-1] == 1.0
    assert frame["errors"]["linear"]["longitudinal"] == 1.5
    passenger.take("predictor/linear/prediction", held, 55.0)  # the driver has left the course
    frame = passenger.make_frame(55.1)
    assert frame["paths"]["linear"]["inputs"] == "held" and frame["paths"]["linear"]["band"][-1] == 2.0
    assert frame["errors"]["linear"]["longitudinal"] == 4.0


def test_displayed_error_is_that_at_the_end_of_the_horizon(passenger: PassengerFrames) -> None:
    score = PredictionError(model="linear", mode="forecast", complete=True, horizon=[0.0, 5.0],
                            longitudinal=[0.0, -1.5], lateral=[0.0, 0.8])
    passenger.take("evaluator/errors", score, 53.0)
    passenger.take("evaluator/errors", PredictionError(model="kinematic", mode="hindsight", complete=True), 53.0)
    assert passenger.make_frame(53.1)["errors"] == {
        "linear": {"longitudinal": -1.5, "lateral": 0.8, "horizon": 5.0, "age": 0.1}}
    passenger.take("ins/odometry", odometry(1.0, 0.0, 0.0, 0.0, 1.0, 0.0), 53.2)  # a replay restarts
    frame = passenger.make_frame(53.2)
    assert frame["errors"] == {} and len(frame["track"]) == 1


@pytest.mark.parametrize(("levels", "light", "text"), [
    ([0, 0], "ok", "all checks OK"), ([0, 1], "warning", "b: text"), ([2, 1], "error", "a: text, and 1 more"),
    ([3, 0], "error", "a: text"), ([], "none", "no diagnostics"),
])
def test_light_shows_the_most_severe_check(passenger: PassengerFrames, levels, light, text) -> None:
    status = [DiagnosticStatus(name=n, level=bytes([k]), message="text") for n, k in zip("ab", levels, strict=False)]
    summary = DiagnosticStatus(name="suite", level=bytes([max(levels, default=3)]), message="summary")
    passenger.take("/diagnostics_agg", DiagnosticArray(status=[summary, *status]), 53.0)
    frame = passenger.make_frame(53.1)
    assert (frame["light"], frame["text"]) == (light, text)
    silent = passenger.make_frame(57.0)
    assert (silent["light"], silent["text"]) == (("error", "no diagnostics for 4 s") if levels else (light, text))


def test_status_is_silent_after_five_seconds_or_three_reporting_intervals() -> None:
    assert not Status("a", 0, "", 10.0).is_silent(15.0) and Status("a", 0, "", 10.0).is_silent(15.1)
    slow = Status("a", 0, "", 10.0, (10.0,))  # as in a replay at a tenth of the speed
    assert not slow.is_silent(39.0) and slow.is_silent(41.0)


def test_extra_report_in_a_slow_replay_does_not_make_a_status_silent(monkeypatch) -> None:
    monitor = Monitor.__new__(Monitor)  # without a node
    monitor.state, monitor._lock = SuiteState(), threading.Lock()
    report = DiagnosticArray(status=[DiagnosticStatus(name="a", level=bytes([0]), message="")])
    for now in (30.0, 40.0, 50.0, 51.0):
        monkeypatch.setattr(time, "monotonic", lambda now=now: now)
        monitor._on_diagnostics(report)
    status = monitor.state.health["a"]
    assert not status.is_silent(80.0) and status.is_silent(82.0)


def test_silent_check_is_stale_in_the_aggregate() -> None:
    with claim_domain(None) as domain, Monitor(domain) as monitor:
        received: list[DiagnosticArray] = []
        monitor._node.create_subscription(DiagnosticArray, "/diagnostics_agg", received.append, 10)
        now = time.monotonic()
        monitor.add_statuses([Status("a", 0, "fine", now + 60.0), Status("b", 0, "fine", now - 60.0)])
        end = now + 10.0
        while not received and time.monotonic() < end:
            time.sleep(0.05)
    suite, a, b = received[0].status
    assert [status.level[0] for status in (suite, a, b)] == [3, 0, 3] and suite.name == "suite"
    assert a.message == "fine" and b.message.startswith("silent for 6")


def test_prediction_with_unequal_lengths_is_ignored(passenger: PassengerFrames) -> None:
    passenger.take("predictor/kinematic/prediction", Prediction(model="kinematic", step=0.05, x=[0.0, 1.0]), 53.0)
    assert list(passenger.make_frame(53.1)["paths"]) == ["linear"]


@pytest.fixture
def server():
    running = PageServer("127.0.0.1", 0, {"title": "</script>", "models": {}, "car": {"length": 4.4, "width": 1.8}})
    threading.Thread(target=running.serve_forever, daemon=True).start()
    yield running
    running.stop()


def request(server: PageServer, path: str, host: str = "127.0.0.1"):
    port = server.server_port
    message = urllib.request.Request(f"http://127.0.0.1:{port}{path}", headers={"Host": f"{host}:{port}"})
    return urllib.request.urlopen(message, timeout=10)


def test_page_is_small_and_loads_no_external_content(server: PageServer) -> None:
    with request(server, "/") as answer:
        page, headers = answer.read().decode(), answer.headers
    assert len(page) < 200_000 and "default-src 'none'" in headers["Content-Security-Policy"]
    assert "</script>:" not in page and page.count("<script>") == page.count("</script>") == 1
    assert "http" not in PAGE.read_text().replace('<html lang="en">', "")
    with pytest.raises(urllib.error.HTTPError, match="404"):
        request(server, "/etc/passwd")
    with pytest.raises(urllib.error.HTTPError, match="403"):
        request(server, "/", host="elsewhere.example")


def test_slow_client_receives_the_newest_frame(server: PageServer) -> None:
    with request(server, "/frames") as stream:
        while not server.client_count:
            time.sleep(0.01)
        server.publish({"number": 1})
        assert stream.readline() == b'data: {"number":1}\n'
        assert stream.readline() == b"\n"
        with request(server, "/clock") as answer:
            assert abs(json.load(answer) - time.monotonic()) < 5.0
    number = server.wait_for_frame(0)[1]
    server.publish({"number": 2})
    server.publish({"number": 3})
    assert server.wait_for_frame(number)[0] == b'data: {"number":3}\n\n'
    assert server.wait_for_frame(number + 2) == (b":\n\n", number + 2)  # no new frame
