"""Arguments that st demo and st live reject before the start, and their terminal view."""

import errno
import importlib.util
import math
import os
import shutil
import socket
import sys
import time
from io import StringIO
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
import typer
from matplotlib.figure import Figure
from support import LEAF, ROOT
from typer.testing import CliRunner

pytest.importorskip("st_msgs", reason="needs the built workspace")

import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rich.console import Console
from st_cli.verbs import live, raw_logs, replay
from st_live import configuration, report, session
from st_live.nodes.monitor import Monitor, Status, SuiteState, render_health, render_progress
from st_live.nodes.player import Player
from st_live.suite import Processes, SuiteError, claim_domain, merge_parameters, read_domain_id
from st_msgs.msg import ErrorStatistics, ErrorSummary, Prediction, PredictorStatus
from st_recordings.paths import new_folder
from st_recordings.results import Results, Track
from st_ros.diagnostics import Diagnostics

from tools import develop

pytestmark = pytest.mark.ros


def run(verb, *arguments: object):
    app = typer.Typer()
    app.command(context_settings={"allow_extra_args": True, "ignore_unknown_options": verb is develop.shell})(verb)
    return CliRunner().invoke(app, [str(a) for a in arguments])


@pytest.mark.parametrize(("arguments", "fragments"), [
    (["--scenario", "S66"], ["--scenario S66", "choose S1, S2"]),
    (["--model", ROOT / "README.md"], ["README.md: not valid YAML"]),
    (["--effect", "friction=0.8"], ["friction: unknown setting", "friction_factor"]),
    (["--effect", "friction_factor=7"], ["friction_factor: 7.0 is not within 0.05 to 2\n"]),
    (["--ncom-rate", "200"], ["--ncom-rate", "choose from 100, 250"]),
    (["--plant", "nowhere.yaml"], ["--plant nowhere.yaml: not a file, and not a preset"]),
    (["--drive", ROOT / "README.md"], ["README.md", "column t is missing"]),
    (["--drive", ROOT / "README.md", "--scenario", "S3"], ["--scenario: not allowed with argument --drive"]),
])
def test_demo_rejects_wrong_arguments_in_one_line_and_makes_no_folder(tmp_path: Path, arguments, fragments) -> None:
    result = run(live.demo, *arguments, "--output", tmp_path / "run")
    assert result.exit_code == 2
    assert result.stderr.startswith("st demo: ") and result.stderr.count("\n") == 1
    for fragment in fragments:
        assert fragment in result.stderr
    assert not (tmp_path / "run").exists()


def test_a_node_is_ready_when_it_publishes_diagnostics() -> None:
    """The predictor is in the graph while it compiles its models; a demo started then had no predictions for 15 s."""
    with claim_domain(None) as domain, Monitor(domain) as monitor:
        context = rclpy.Context()
        rclpy.init(context=context, domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)
        node = Node("predictor", context=context)
        while "predictor" not in monitor.find_node_names():
            time.sleep(0.05)
        assert monitor.wait_for_nodes({"predictor"}, 0.5) == {"predictor"}
        Diagnostics(node, "", list)
        assert monitor.wait_for_nodes({"predictor"}, 30.0) == set()
        node.destroy_node()
        rclpy.try_shutdown(context=context)


def test_stop_signal_ends_the_wait_for_subscribers_without_an_error() -> None:
    player = Player.__new__(Player)  # without a node
    player._stop_requested = lambda: True
    player._clock = Mock(topic_name="/clock", get_subscription_count=lambda: 0)
    assert player._wait_for_subscribers([])


def test_missing_viewer_is_reported_with_one_prefix(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    result = run(replay.view, tmp_path)
    assert result.exit_code == 2 and result.stderr.startswith("st view: rerun-sdk is not installed")


def test_too_short_run_is_rejected_with_the_unit() -> None:
    for verb, seconds in ((live.demo, "2"), (live.demo, "nan"), (live.live, "0.5")):
        result = run(verb, "--duration", seconds)
        assert result.exit_code == 2 and f"{seconds} s is below the minimum of" in result.stderr


def test_run_is_over_after_the_shortest_duration() -> None:
    assert session.make_timer(None, 60.0)()[1:] == (60.0, False) and session.make_timer(None)()[1:] == (None, False)
    assert session.make_timer(60.0, -1.0)()[1:] == (-1.0, True)


def test_only_a_player_that_succeeds_may_end_during_a_run(tmp_path: Path) -> None:
    with Processes(tmp_path) as processes:
        for code in ("pass", "raise SystemExit('no subscriber')"):
            processes.check()
            processes.start("player", [sys.executable, "-c", code], may_end=True).process.wait(20)
        with pytest.raises(SuiteError, match="player ended with status 1: no subscriber"):
            processes.check()


def test_end_of_a_node_by_a_signal_is_not_explained_by_an_earlier_line_of_its_log(tmp_path: Path) -> None:
    shown: list[Status] = []
    monitor = SimpleNamespace(state=SimpleNamespace(health={}), add_statuses=shown.extend)
    with Processes(tmp_path) as processes:
        for code in ("import os; print('recording', flush=True); os.abort()", "raise SystemExit('no car')"):
            supervisor = session.Supervisor(processes, monitor, [("a", "node")])
            processes.start("node", [sys.executable, "-c", code]).process.wait(20)
            supervisor.update()
        code = "import os; print('recording', flush=True); os.kill(os.getpid(), 9)"
        processes.start("node", [sys.executable, "-c", code]).process.wait(20)
        with pytest.raises(SuiteError, match=r"node ended with status -9: signal 9, Killed\n"):
            processes.check()
    assert [status.message for status in shown] == ["not ready; failed once: ended with status -6 (signal 6, Aborted)",
                                                 "not ready; failed once: ended with status 1 (no car)"]


def test_supervision_continues_if_the_folder_of_the_run_is_removed(tmp_path: Path) -> None:
    shown: list[Status] = []
    monitor = SimpleNamespace(state=SimpleNamespace(health={}), add_statuses=shown.extend)
    with Processes(tmp_path / "run") as processes:
        processes.start_node = lambda package, name: processes.start(name, [sys.executable, "-c", "pass"])
        supervisor = session.Supervisor(processes, monitor, [("a", "node")])
        processes.start_node("a", "node").process.wait(20)
        shutil.rmtree(tmp_path / "run")
        end = time.monotonic() + 20
        while supervisor.restarts.get("node", 0) < 2:
            assert time.monotonic() < end
            supervisor.update()
            time.sleep(0.05)
    assert f"No such file or directory: '{tmp_path / 'run' / 'logs' / 'node.log'}'" in shown[-1].message


def test_cause_is_listed_before_checks_that_are_stale_because_of_it() -> None:
    now = time.monotonic()
    levels = {"evaluator: input INS": 3, "oxts_bridge: stream": 2, "oxts_bridge: solution": 1, "recorder: topics": 0}
    state = SuiteState(health={name: Status(name, level, "text", now) for name, level in levels.items()})
    assert [line.partition(":")[0] for line in render_health(state).plain.splitlines()] == ["error", "stale", "warning"]


def test_table_is_printed_if_the_disk_is_full(tmp_path: Path, monkeypatch) -> None:
    def fail(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(report, "replace_file", fail)
    monkeypatch.setattr(report, "read_results", lambda folder: None)
    monkeypatch.setattr(report, "summarise", lambda results, extra: {"models": {}})
    with StringIO() as stream, pytest.raises(OSError, match="No space left"):
        try:
            outcome = session.Outcome({"recorder": 1}, interrupted=False)
            report.report_results(tmp_path, outcome, {"title": "live"}, Console(file=stream))
        finally:
            assert "live: mean error over each horizon" in stream.getvalue()


def test_restarts_are_reported_in_one_line(tmp_path: Path) -> None:
    with StringIO() as stream:
        outcome = session.Outcome({}, interrupted=False, problem="no car", restarts={"predictor": 2, "recorder": 1})
        report.report_results(tmp_path, outcome, {"title": "live"}, Console(file=stream))
        lines = [line for line in stream.getvalue().splitlines() if "bag_2" in line]
    assert len(lines) == 1 and lines[0].startswith("number of restarts: predictor (2), recorder (1); a recorder")
    with StringIO() as stream:
        outcome = session.Outcome({}, interrupted=False, restarts={"predictor": 2})
        report.report_results(tmp_path, outcome, {"title": "live"}, Console(file=stream))
        assert stream.getvalue().startswith("number of restarts: predictor (2)\n")


def test_published_errors_are_printed_if_the_bag_cannot_be_read(tmp_path: Path) -> None:
    statistics = [ErrorStatistics(model="linear", mode="hindsight", n_starts=7, lateral_rmse=0.123)]
    state = SuiteState(ErrorSummary(statistics=statistics), PredictorStatus(due=9, predicted=8))
    with StringIO() as stream:
        outcome = session.Outcome({}, interrupted=False, restarts={"recorder": 1}, state=state)
        assert report.report_results(tmp_path, outcome, {"title": "live"}, Console(file=stream)) == 1
        lines = stream.getvalue().splitlines()
    assert lines[1].startswith(f"{tmp_path / 'bag'}") and any("linear" in line and "0.12" in line for line in lines)
    assert lines[-1].startswith("predictions due 9, made 8")


@pytest.mark.parametrize(("restarts", "end"), [
    ({}, ""), ({"predictor": 1}, " since the last start of the predictor, as recorded in bag/")])
def test_tick_counts_after_a_restart_are_those_since_it(restarts: dict, end: str, tmp_path: Path, monkeypatch) -> None:
    summary = {"models": {}, "ticks": {"due": 9, "predicted": 8, "skipped": 1}}
    monkeypatch.setattr(report, "read_results", lambda folder: Results(np.zeros((0, 3)), {}, {}, {}, "", []))
    monkeypatch.setattr(report, "summarise", lambda results, extra: summary)
    monkeypatch.setattr(report, "draw_paths", lambda *_: None)
    monkeypatch.setattr(report, "make_headline", lambda _: "")
    with StringIO() as stream:
        outcome = session.Outcome({}, interrupted=False, restarts=restarts)
        report.report_results(tmp_path, outcome, {"title": "live"}, Console(file=stream, width=100))
        assert f"predictions due 9, made 8, skipped 1{end}\n" in stream.getvalue()


@pytest.mark.parametrize("restarts", [{}, {"predictor": 1}])
def test_predictions_that_the_evaluator_did_not_receive_are_counted(tmp_path: Path, monkeypatch, restarts) -> None:
    errors = {axis: dict.fromkeys(("mean", "max", "rmse"), 0.1) for axis in ("longitudinal", "lateral")}
    models = {"linear": {mode: {"n_starts": 87, "n_incomplete": 15, **errors} for mode in ("hindsight", "forecast")}}
    ticks = {"due": 154, "predicted": 154, "skipped": 0}
    monkeypatch.setattr(report, "read_results", lambda folder: SimpleNamespace(bands=[]))
    monkeypatch.setattr(report, "summarise", lambda results, extra: {"models": models, "ticks": ticks})
    monkeypatch.setattr(report, "draw_paths", Mock())
    with StringIO() as stream:
        outcome = session.Outcome({}, interrupted=True, restarts=restarts, state=SuiteState())
        outcome.statuses["recorder"] = 0
        report.report_results(tmp_path, outcome, {"title": "live"}, Console(file=stream, width=100))
        line = "predictions that the evaluator did not receive, usually before it was ready: 52"
        assert (line in stream.getvalue()) == (not restarts)


def test_figure_on_a_full_disk_leaves_no_file(tmp_path: Path, monkeypatch) -> None:
    def fail(_, file: Path, **__: object) -> None:
        file.write_bytes(b"")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Figure, "savefig", fail)
    track = Track(np.empty(0, np.int64), *(np.empty(0),) * 3)
    with pytest.raises(OSError, match="No space left"):
        report.draw_paths(Results(track, {}, {}, {}, "", []), "title", tmp_path / "paths.png")
    assert not list(tmp_path.iterdir())


def test_output_of_a_run_that_did_not_start_can_be_used_again(tmp_path: Path) -> None:
    for number in (1, 2):
        folder = new_folder(tmp_path / "today", "live")
        (folder / "logs").mkdir()
        message = rf"no car in {folder}.dbc \(log: {folder}_failed_{number}/logs\)"
        with pytest.raises(SuiteError, match=message), session.set_aside_on_failure(folder):
            raise SuiteError(f"no car in {folder}.dbc (log: {folder / 'logs'})")
    new_folder(tmp_path / "today", "live")
    with StringIO() as stream:
        status = report.report_results(folder, session.Outcome({}, interrupted=True), {}, Console(file=stream))
        assert status == 130 and stream.getvalue().endswith(f"logs: {folder}_failed_3/logs\n")


def test_starts_without_a_complete_horizon_are_counted_by_mode() -> None:
    models = {model: {mode: {"n_incomplete": count} for mode in ("forecast", "hindsight")}
              for model, count in (("linear", 50), ("augmented", 51))}
    assert report.describe_incomplete(models) == "hindsight 50 to 51, forecast 50 to 51"
    assert report.describe_incomplete({"linear": models["linear"]}) == "hindsight 50, forecast 50"
    assert report.describe_incomplete({"linear": {"hindsight": {"n_incomplete": 0}}}) == ""


@pytest.mark.parametrize("verb", [live.demo, live.live])
@pytest.mark.parametrize(("before", "after", "fragment"), [
    ("\nmass:", "\nmasss:", "masss: unknown key, did you mean mass?"),
    ("unit: kg,", "unit: g,", "mass: unit 'g' is not kg"),
    ("value: 1590.0", "value: 15.9", "mass: 15.9 kg does not fit a car with a wheelbase of 2.7 m"),
])
def test_invalid_vehicle_file_is_rejected_before_the_start(tmp_path: Path, verb, before, after, fragment) -> None:
    text = LEAF.read_text()
    assert before in text
    vehicle = tmp_path / "car.yaml"
    vehicle.write_text(text.replace(before, after, 1))
    result = run(verb, "--vehicle", vehicle, "--output", tmp_path / "run")
    assert result.exit_code == 2
    assert f"{vehicle}: {fragment}" in result.stderr
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("verb", [live.demo, live.live])
def test_existing_or_impossible_output_is_rejected(tmp_path: Path, verb) -> None:
    (tmp_path / "precious.txt").write_text("x")
    for output in (tmp_path, tmp_path / "precious.txt", tmp_path / "precious.txt" / "run"):
        result = run(verb, "--output", output)
        assert result.exit_code == 2 and str(output) in result.stderr and result.stderr.count("\n") == 1
    assert (tmp_path / "precious.txt").read_text() == "x"


@pytest.fixture
def parameters_of_runs(monkeypatch) -> list[dict]:
    """Node parameters of every start; the start itself is rejected."""
    parameters_of_runs = []

    def refuse_start(_folder, parameters, *_arguments, **_more):
        parameters_of_runs.append(parameters)
        raise SuiteError("not now")
    monkeypatch.setattr(session, "run", refuse_start)
    return parameters_of_runs


def test_steering_options_override_the_nodes_file(tmp_path: Path, monkeypatch, parameters_of_runs) -> None:
    nodes = tmp_path / "nodes.yaml"
    nodes.write_text((ROOT / "config/nodes.yaml").read_text().replace("steering_latency: 0.0", "steering_latency: 0.05")
                     .replace("steering_sign: 1", "steering_sign: -1"))
    config = configuration.config
    monkeypatch.setattr(configuration, "config", lambda name: nodes if name == "nodes.yaml" else config(name))
    for number, options in enumerate(([], ["--steering-latency", "0", "--steering-sign", "1"])):
        notice, refusal = run(live.live, "--output", tmp_path / str(number), *options).stderr.splitlines()
        assert "no car was given" in notice and refusal == "st live: not now"
    buses = [nodes["canedge_bridge"] for nodes in parameters_of_runs]
    assert [(bus["steering_sign"], bus["steering_latency"]) for bus in buses] == [(-1, 0.05), (1, 0.0)]


def test_live_accepts_the_folder_of_a_car(tmp_path: Path, parameters_of_runs) -> None:
    car = tmp_path / "mycar"
    car.mkdir()
    for name in ("vehicle.yaml", "can.dbc", "signals.yaml"):
        (car / name).write_bytes((ROOT / "config/car/leaf" / name).read_bytes())
    (car / "car.yaml").write_text("steering_sign: -1\nsteering_latency: 0.03\n")
    for number, options in enumerate(([], ["--steering-sign", "1", "--dbc", ROOT / "config/car/leaf/can.dbc"])):
        result = run(live.live, "--car", car, "--output", tmp_path / str(number), *options)
        assert result.stderr == "st live: not now\n"
    buses = [nodes["canedge_bridge"] for nodes in parameters_of_runs]
    assert [(bus["steering_sign"], bus["steering_latency"]) for bus in buses] == [(-1, 0.03), (1, 0.03)]
    assert [bus["dbc_file"] for bus in buses] == [str(car / "can.dbc"), str(ROOT / "config/car/leaf/can.dbc")]
    assert all(bus["signals_file"] == str(car / "signals.yaml") for bus in buses)
    assert all(nodes["predictor"]["vehicle_file"] == str(car / "vehicle.yaml") for nodes in parameters_of_runs)


def test_vehicle_name_is_that_of_its_folder_or_file(tmp_path: Path) -> None:
    assert configuration.find_vehicle_name(ROOT / "config/car/leaf/vehicle.yaml") == "leaf"
    assert configuration.find_vehicle_name(tmp_path / "winter.yaml") == "winter"


def test_live_rejects_a_car_without_a_dbc(tmp_path: Path) -> None:
    result = run(live.live, "--car", "hyundai_genesis", "--output", tmp_path / "run")
    assert result.exit_code == 2 and "can.dbc" in result.stderr and "--dbc" in result.stderr
    assert result.stderr.count("\n") == 1 and not (tmp_path / "run").exists()


def test_recording_is_not_overwritten_by_its_own_csv(tmp_path: Path) -> None:
    recording = tmp_path / "drive.ncom"
    recording.write_bytes(b"\xe7" * 720)
    (tmp_path / "link.csv").symlink_to(recording)
    for options in (["--csv", recording], ["--csv", tmp_path / "link.csv"],
                    ["--csv", tmp_path / "a.csv", "--status", recording]):
        result = run(raw_logs.ncom, recording, *options)
        assert result.exit_code == 2 and "is the recording itself" in result.stderr
    assert "name two different files" in run(raw_logs.ncom, recording, "--csv", "a.csv", "--status", "a.csv").stderr
    assert recording.read_bytes() == b"\xe7" * 720


def test_missing_command_of_shell_is_reported() -> None:
    result = run(develop.shell, "no-such-command")
    assert result.exit_code == 127 and "st shell: no-such-command: No such file" in result.stderr


@pytest.mark.parametrize("text", ["abc", "-1", "233", "1.5"])
def test_invalid_ros_domain_is_rejected(monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", text)
    with pytest.raises(SuiteError, match=r"ROS_DOMAIN_ID: .* from 0 to 232"):
        read_domain_id()


@pytest.mark.parametrize("home", [None, "/proc"])
def test_log_directory_of_ros_exists_without_a_home(monkeypatch: pytest.MonkeyPatch, home: str | None) -> None:
    from st_cli import cli

    for name in ("ROS_LOG_DIR", "ROS_HOME", "HOME"):
        monkeypatch.delenv(name, raising=False)
    if home:
        monkeypatch.setenv("HOME", home)
    cli._ensure_log_directory()
    assert Path(os.environ["ROS_LOG_DIR"]).parent.is_dir()


def test_ros_domain_is_claimed_exclusively() -> None:
    with claim_domain() as first, claim_domain() as second:
        assert first != second
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe, pytest.raises(OSError, match="in use"):
            probe.bind(("", 7400 + 250 * first + 10))


@pytest.mark.parametrize(("text", "message"), [
    ("a: {ros__parameters: {x: 1}}\na: {ros__parameters: {x: 2}}\n", "a: given twice"),
    ("a: {x: 1}\n", "expected sections"),
    ("a: {ros__parameters: {x: 1\n", "not valid YAML"),
])
def test_invalid_parameter_file_is_rejected(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "nodes.yaml").write_text(text)
    with pytest.raises(SuiteError, match=message):
        merge_parameters(tmp_path / "nodes.yaml", {})


def test_every_node_has_one_section_in_the_parameter_file() -> None:
    assert merge_parameters(ROOT / "config" / "nodes.yaml", {}).keys() == {
        "oxts_bridge", "canedge_bridge", "predictor", "evaluator", "recorder", "markers", "identifier"}


def render_lines(state: SuiteState) -> list[str]:
    console = Console(width=80, force_terminal=True, color_system=None)
    with console.capture() as captured:
        console.print(render_progress(state, 12.0, 60.0, "S6"))
    return [line.rstrip() for line in captured.get().splitlines()]


def test_progress_table_has_one_line_per_model_and_mode_in_eighty_columns() -> None:
    values = {f"{axis}_{kind}": -23.456 if kind == "mean" else 98.765
              for axis in ("longitudinal", "lateral") for kind in ("mean", "max", "rmse")}
    statistics = [ErrorStatistics(model=m, mode=k, n_starts=12345, **values)
                  for m in ("kinematic", "linear", "nonlinear", "augmented") for k in ("forecast", "hindsight")]
    ticks = PredictorStatus(due=130, predicted=128, skipped_stale=2)
    lines = render_lines(SuiteState(ErrorSummary(statistics=statistics), ticks))
    rows = [line for line in lines if "forecast" in line or "hindsight" in line]
    assert len(rows) == 8 and max(map(len, lines)) <= 80
    for row in rows:
        assert row.count("-23.46") == 2 and row.count("98.77") == 4 and "12345" in row
    assert "predictions due 130, made 128, skipped 2" in lines


def test_band_coverage_is_printed_below_the_table() -> None:
    rows = [ErrorStatistics(model="linear", mode=mode, n_starts=9, n_bands=count, coverage_50=0.25, coverage_90=0.875)
            for mode, count in (("forecast", 8), ("hindsight", 0))]
    lines = render_lines(SuiteState(ErrorSummary(statistics=rows)))
    (line,) = [line for line in lines if "band" in line]
    assert line == "inside the 90 | 50 % band, forecast: linear 88 % | 25 % of 8 scores"


def test_faults_are_printed_with_the_most_severe_first() -> None:
    now = time.monotonic()
    health = [Status("a: one", 1, "not so good", now), Status("b: two", 2, "[bad]", now),
              Status("c: three", 0, "fine", now)]
    lines = render_lines(SuiteState(ErrorSummary(statistics=[ErrorStatistics(model="linear", mode="forecast")]), None,
                                {s.name: s for s in health}))
    assert lines[1:4] == [
        "no prediction yet", "waiting for the end of the first prediction", "predictor: no status yet"]
    assert lines[4:6] == ["error: b: two: [bad]", "warning: a: one: not so good"]


def test_motion_line_states_the_steering_direction() -> None:
    turning = Prediction(model="linear", velocity_x=[10.0, 9.0], yaw_rate=[0.2, 0.1],
                         road_wheel_angle=math.radians(3.0), compute_time=0.002)
    line = "10.0 m/s, wheels 3.0 deg left, v_x r +2.0 m/s², linear took 2.0 ms"
    assert render_lines(SuiteState(prediction=turning))[1] == line
    turning.road_wheel_angle, turning.yaw_rate = -0.1, [-0.2, 0.0]
    assert "5.7 deg right, v_x r -2.0 m/s²" in render_lines(SuiteState(prediction=turning))[1]
