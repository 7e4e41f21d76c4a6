"""The page of a running suite does not disturb it; the view of a recording, the markers and the relay are correct."""

import asyncio
import json
import os
import re
import signal
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import numpy as np
import psutil
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")
pytest.importorskip("st_msgs", reason="needs the built workspace")

from bags import nanoseconds, read_messages
from circle_feeder import pose_at
from ros_processes import Processes, wait_for
from support import LEAF, ROOT

pytestmark = [
    pytest.mark.ros, pytest.mark.slow,
    pytest.mark.timing("nodes run in real time; one that waits for its turn skips ticks"),
]
MODELS = ("kinematic", "linear", "nonlinear")
RADIUS, SPEED, ANGLE, DURATION = 30.0, 8.0, 0.09, 9.0


def descendants(process: subprocess.Popen, word: str) -> list[psutil.Process]:
    """Descendants of a process with `word` in their command line."""
    children = psutil.Process(process.pid).children(recursive=True)
    return [p for p in children if any(word in part for part in p.cmdline())]


def listen_addresses(process: psutil.Process) -> set[str]:
    return {c.laddr.ip for c in process.net_connections(kind="inet") if c.status == psutil.CONN_LISTEN}


def test_hung_and_killed_passenger_page_does_not_reduce_the_prediction_rate(tmp_path: Path) -> None:
    run = tmp_path / "run"
    command = [str(ROOT / "st"), "demo", "--view", "--scenario", "S2", "--duration", "15", "--output", str(run)]
    demo = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
                            start_new_session=True)
    try:
        wait_for((run / "truth").exists, 90, "data flow")
        (page,) = descendants(demo, "st_live.nodes.passenger")
        (port,) = (c.laddr.port for c in page.net_connections() if c.status == psutil.CONN_LISTEN)
        assert listen_addresses(page) == {"127.0.0.1"}
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/frames", timeout=30) as stream:
            assert stream.readline().startswith(b"data: ")
            time.sleep(3.0)
            processes = psutil.Process(demo.pid).children(recursive=True)
            page.send_signal(signal.SIGSTOP)
            stopped_ns = time.time_ns()
            time.sleep(4.0)
            page.send_signal(signal.SIGKILL)
            killed_ns = time.time_ns()
            text, _ = demo.communicate(timeout=120)
    finally:
        if demo.poll() is None:
            os.kill(demo.pid, signal.SIGINT)
            demo.communicate(timeout=60)
    assert demo.returncode == 0, text
    assert "the page server stopped during the run" in text
    topic = "/predictor/linear/prediction"
    issued = np.array([nanoseconds(m.issued_at) for m in read_messages(run / "bag", [topic])[topic]])
    parts = np.split(issued, np.searchsorted(issued, [stopped_ns, killed_ns]))
    rates = [(len(part) - 1) / ((part[-1] - part[0]) * 1e-9) for part in parts]
    # The rate is unchanged to the end of the drive.
    assert min(rates[1:]) > 0.9 * rates[0] and len(parts[2]) > 25, rates
    scored = json.loads((run / "summary.json").read_text())["models"]["linear"]["hindsight"]["n_starts"]
    assert scored > 0.3 * len(issued)
    assert not [p for p in processes if p.is_running() and p.status() != psutil.STATUS_ZOMBIE]


def test_view_of_a_recording_uses_no_processor_time_and_cleans_up_after_a_signal(circle, tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="not available with a sourced ROS")
    command = [str(ROOT / "st"), "view", str(circle[1]), "--vehicle", str(LEAF)]
    view = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
                            env=os.environ | {"TMPDIR": str(tmp_path)}, start_new_session=True)
    wait_for(lambda: descendants(view, "--serve-web") and list(tmp_path.glob("st-view-*")), 90, "the server")

    def measure_share(seconds: float) -> float:
        """Used processor time as a fraction of a core."""
        before = sum(sum(p.cpu_times()[:2]) for p in find_family())
        time.sleep(seconds)
        return (sum(sum(p.cpu_times()[:2]) for p in find_family()) - before) / seconds

    def find_family() -> list[psutil.Process]:
        return [psutil.Process(view.pid), *psutil.Process(view.pid).children(recursive=True)]

    wait_for(lambda: measure_share(0.5) == 0.0, 90, "the end of the start")
    family, share = find_family(), measure_share(6.0)
    view.send_signal(signal.SIGTERM)
    view.communicate(timeout=30)
    assert share < 0.02, f"{100 * share:.1f} % of a core without a page open"
    assert not [p for p in family if p.is_running() and p.status() != psutil.STATUS_ZOMBIE]
    assert not list(tmp_path.glob("st-view-*"))


@pytest.fixture(scope="module")
def circle(tmp_path_factory: pytest.TempPathFactory) -> tuple[int, Path]:
    """(start of the circle [ns], bag) of a circle with the node markers."""
    folder = tmp_path_factory.mktemp("markers")
    processes = Processes(folder)
    try:
        vehicle = f"vehicle_file:={LEAF}"
        nodes = [processes.node("st_predictor", name, vehicle) for name in ("predictor", "evaluator", "markers")]
        nodes.append(processes.node("st_predictor", "recorder", f"output_directory:={folder / 'bag'}",
                                    "topics:=[ins/*, vehicle/*, predictor/*, evaluator/*, view/*]"))
        subscriptions = {f"predictor/{m}/prediction": 3 for m in MODELS} | {
            "evaluator/errors": 2, "view/markers": 1, "ins/odometry": 4}
        feeder = processes.start([
            sys.executable, str(ROOT / "tests" / "circle_feeder.py"), "--subscribers", "3", "--duration", str(DURATION),
            "--radius", str(RADIUS), "--speed", str(SPEED), "--angle", str(ANGLE),
            *(f"--wait-for={topic}:{count}" for topic, count in subscriptions.items())], "feeder")
        assert feeder.wait(90) == 0, processes.log("feeder")
        assert [processes.stop(node) for node in nodes] == [0] * len(nodes)
    finally:
        processes.close()
    return int(processes.log("feeder").split()[1]), folder / "bag"


@pytest.fixture(scope="module")
def recorded(circle) -> tuple[int, dict]:
    return circle[0], read_messages(circle[1])


def test_saved_view_of_a_recording_has_all_entities(circle, tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="not available with a sourced ROS")
    file = tmp_path / "view.rrd"
    command = [str(ROOT / "st"), "view", str(circle[1]), "--vehicle", str(LEAF), "--save", str(file)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT)
    assert int(re.search(r"(\d+) frames", done.stdout).group(1)) > 5 * DURATION
    entities = subprocess.run(["rerun", "rrd", "print", str(file)], capture_output=True, text=True, check=True).stdout
    expected = {f"/{root}/{what}" for root in ("map", "ahead") for what in ("car", "track", "ghosts", "errors")}
    expected |= {f"/{what}/{model}" for model in MODELS
                 for what in ("map/paths", "ahead/paths", "ahead/names", "plots/lateral")}
    expected |= {"/text", "/plots/steering/measured", "/plots/speed/measured", "/plots/lateral_acceleration/measured"}
    assert not {entity for entity in expected if entity not in entities}
    again = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
    assert again.returncode == 2 and "exists already" in again.stderr


def test_markers_have_the_pose_of_the_car_and_the_names_of_the_models(recorded) -> None:
    zero_ns, messages = recorded
    arrays = messages["/view/markers"]
    assert len(arrays) > 3 * DURATION
    # From the first prediction of every model on.
    first = next(k for k, array in enumerate(arrays) if {m.text for m in array.markers if m.ns == "names"} == {*MODELS})
    assert len(arrays) - first > 2 * DURATION
    for array in arrays[first:]:
        by_namespace = {}
        for marker in array.markers:
            assert marker.header.frame_id == "map"
            by_namespace.setdefault(marker.ns, []).append(marker)
        assert {m.text for m in by_namespace["names"]} == set(MODELS)
        (car,) = by_namespace["car"]
        x, y, yaw = pose_at((nanoseconds(car.header.stamp) - zero_ns) * 1e-9, RADIUS, SPEED)
        front_end = car.points[2]
        # The front end of the Leaf: half its length ahead of the centre of the wheelbase, relative to the INS [m].
        ahead = 1.176 - 0.5 * 2.7 + 0.5 * 4.445 + 0.398
        assert (front_end.x, front_end.y) == pytest.approx((x + ahead * np.cos(yaw), y + ahead * np.sin(yaw)), abs=0.01)


def test_error_lines_end_at_the_position_predicted_a_horizon_earlier(recorded) -> None:
    _, messages = recorded
    predictions = {nanoseconds(p.header.stamp): p for p in messages["/predictor/linear/prediction"]}
    checked = 0
    for array in messages["/view/markers"]:
        now_ns = nanoseconds(array.markers[0].header.stamp)
        lines = [m for m in array.markers if m.ns == "errors" and m.id == MODELS.index("linear")]
        old = [start for start in predictions if 4.5 < (now_ns - start) * 1e-9 <= 5.0]
        if not lines or not old or now_ns - min(predictions) < 5.2e9:
            continue
        end = lines[0].points[1]
        p, age = predictions[min(old)], (now_ns - min(old)) * 1e-9
        x, y, yaw = (np.interp(age / p.step, np.arange(len(p.x)), v) for v in (p.x, p.y, p.yaw))
        expected = x + p.cg_to_ins_x * np.cos(yaw), y + p.cg_to_ins_x * np.sin(yaw)
        # If the markers did not receive that prediction, they use the next one, 0.1 m away.
        checked += np.hypot(end.x - expected[0], end.y - expected[1]) < 0.01
    assert checked > 5


def test_plotted_errors_equal_those_of_the_evaluator(recorded) -> None:
    _, messages = recorded
    scores = {(m.model, nanoseconds(m.header.stamp)): m for m in messages["/evaluator/errors"]
              if m.mode == "forecast" and m.complete}
    for model in MODELS:
        plotted = messages[f"/view/{model}/error"]
        assert len(plotted) > 10
        for error in plotted:
            score = scores[model, nanoseconds(error.header.stamp)]
            assert (error.vector.x, error.vector.y) == (score.longitudinal_mean, score.lateral_mean)


def test_relay_serves_messages_and_schema_on_loopback_only(tmp_path: Path) -> None:
    from st_recordings.runs.cdr import load_typestore

    processes = Processes(tmp_path)
    try:
        processes.node("st_predictor", "predictor", f"vehicle_file:={LEAF}")
        relay = processes.start([sys.executable, "-m", "st_live.nodes.relay", "--port", "0"], "relay")
        wait_for(lambda: "/predictor/status (" in processes.log("relay"), 60, "topic found")
        port = int(re.search(r"serving on 127.0.0.1:(\d+)", processes.log("relay")).group(1))
        assert listen_addresses(psutil.Process(relay.pid)) == {"127.0.0.1"}
        channel, data = asyncio.run(asyncio.wait_for(first_message(port, "/predictor/status"), 60))
        assert processes.stop(relay) == 0
    finally:
        processes.close()
    assert (channel["encoding"], channel["schemaEncoding"]) == ("cdr", "ros2msg")
    assert "uint64 predicted" in channel["schema"]
    status = load_typestore().deserialize_cdr(data, channel["schemaName"])
    assert status.reason == "INS: nothing received yet" and status.predicted == 0


async def first_message(port: int, topic: str) -> tuple[dict, bytes]:
    """Subscribes as Foxglove does; returns the advertised channel and its first message."""
    from tornado.websocket import websocket_connect

    socket = await websocket_connect(f"ws://127.0.0.1:{port}", subprotocols=["foxglove.sdk.v1"])
    channel = None
    while True:
        message = await socket.read_message()
        if isinstance(message, str):
            advertised = json.loads(message).get("channels", [])
            found = [c for c in advertised if c.get("topic") == topic]
            if found and channel is None:
                channel = found[0]
                request = {"op": "subscribe", "subscriptions": [{"id": 1, "channelId": channel["id"]}]}
                await socket.write_message(json.dumps(request))
        elif message[0] == 1:  # message data: subscription id, receive time, payload
            socket.close()
            return channel, message[13:]
