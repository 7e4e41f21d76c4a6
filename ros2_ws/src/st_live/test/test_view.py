"""The live view: left is left, ghosts are as old as they say, and what it refuses."""

import math
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")
pytest.importorskip("st_msgs", reason="needs the built workspace")

from rich.console import Console
from st_core.palette import LABEL_AT, MODEL_COLOUR, label_index, rgb
from st_core.vehicle import VehicleParameters
from st_live.suite import SuiteError
from st_live.view import words
from st_live.view.geometry import grid, heading_up, north_up
from st_live.view.page import policy
from st_live.view.window import Window
from st_msgs.msg import ErrorStatistics
from st_predictor.map_drawing import GHOST_AGES, GHOST_TOLERANCE, History, car_outline, ribbon
from st_predictor.map_drawing import Path as PredictedPath
from support import ROOT

pytestmark = pytest.mark.ros
LEAF = ROOT / "config" / "vehicle" / "leaf.yaml"


@pytest.mark.parametrize("yaw", np.linspace(-3.0, 3.0, 7))
def test_a_point_to_the_left_is_on_the_left_and_one_ahead_is_up(yaw: float) -> None:
    """Screen y points down: up is negative."""
    pose = (120.0, -40.0, yaw)
    ahead = heading_up(120.0 + 10.0 * math.cos(yaw), -40.0 + 10.0 * math.sin(yaw), pose)
    left = heading_up(120.0 - 10.0 * math.sin(yaw), -40.0 + 10.0 * math.cos(yaw), pose)
    assert ahead == pytest.approx([0.0, -10.0], abs=1e-9)
    assert left == pytest.approx([-10.0, 0.0], abs=1e-9)


def test_on_the_map_north_is_up_and_east_is_right() -> None:
    pose = (5.0, 7.0, 1.0)
    assert north_up(5.0, 17.0, pose) == pytest.approx([0.0, -10.0])
    assert north_up(15.0, 7.0, pose) == pytest.approx([10.0, 0.0])
    assert north_up(np.zeros(4), np.zeros(4), pose).shape == (4, 2)


def test_grid_lines_stay_where_they_are_while_the_car_moves() -> None:
    for pose in ((3.0, -2.0, 0.0), (103.0, 55.0, 1.0)):
        lines = grid(pose, 20.0, 50.0)
        assert len(lines) == 10
        for x, y in lines:
            assert (x % 20.0 == 0.0).all() or (y % 20.0 == 0.0).all()


def test_the_outline_is_as_long_and_wide_as_the_car_and_points_ahead() -> None:
    car = VehicleParameters.from_yaml(LEAF.read_text(), "leaf")
    x, y = car_outline((10.0, 20.0, 0.5), car)
    forward = (x - 10.0) * math.cos(0.5) + (y - 20.0) * math.sin(0.5)
    left = (y - 20.0) * math.cos(0.5) - (x - 10.0) * math.sin(0.5)
    assert np.ptp(forward) == pytest.approx(car.length) and np.ptp(left) == pytest.approx(car.width)
    # Overhangs are equal, so both axles are as far from their ends; the INS of the Leaf is behind the CG.
    assert forward.max() - (car.cg_to_front_axle - car.cg_to_ins_x) == pytest.approx(0.5 * (car.length - car.wheelbase))
    assert left[forward.argmax()] == pytest.approx(0.0, abs=1e-9)


def straight(start_ns: int, speed: float = 10.0) -> PredictedPath:
    x = start_ns * 1e-9 * speed + speed * np.linspace(0.0, 5.0, 101)
    return PredictedPath(start_ns, 0.05, x, np.zeros(101))


def test_ghosts_are_the_predictions_of_one_to_five_seconds_ago() -> None:
    history = History()
    for k in range(80):
        history.add_path("linear", straight(k * 100_000_000))
    now_ns = 7_900_000_000
    ghosts = history.ghosts("linear", now_ns)
    assert [age for age, _ in ghosts] == list(GHOST_AGES)
    for age, path in ghosts:
        assert (now_ns - path.start_ns) * 1e-9 == pytest.approx(age, abs=GHOST_TOLERANCE)
        assert path.at(now_ns) == pytest.approx((79.0, 0.0))  # a car that did what was predicted is on all of them
    assert history.newest("linear").start_ns == now_ns
    assert history.expected("linear", now_ns) == pytest.approx((79.0, 0.0))
    assert history.expected("linear", 20_000_000_000) is None and history.expected("kinematic", now_ns) is None
    assert straight(0).at(5_100_000_000) is None and straight(10**9).at(0) is None


def test_a_gap_in_the_predictions_has_no_ghosts_and_a_step_back_in_time_begins_anew() -> None:
    history = History()
    for k in (0, 1, 60, 61):
        history.add_path("linear", straight(k * 100_000_000))
    assert [age for age, _ in history.ghosts("linear", 6_100_000_000)] == []
    history.add_pose(6_100_000_000, 1.0, 2.0)
    history.add_pose(6_050_000_000, 3.0, 4.0)  # late: dropped
    assert len(history.track) == 1
    history.add_pose(1_000_000_000, 5.0, 6.0)  # a replay begins again
    assert list(history.track) == [(1_000_000_000, 5.0, 6.0)] and history.models == ()


def test_a_ribbon_is_as_wide_as_its_band_and_reaches_beyond_the_path() -> None:
    x, zero = np.linspace(0.0, 10.0, 11), np.zeros(11)
    east = ribbon(0.9, (x, zero, zero), 0.2 * x, 0.1 * x)
    assert east.left[:-1] == pytest.approx(np.stack([x, 0.1 * x], axis=1))
    assert east.right[-1] == pytest.approx([12.0, -1.0])
    for stride in (1, 4):  # a triangle to the end of the path, a rectangle beyond it
        a, b, c = np.moveaxis(east.triangles(stride), 1, 0)
        area = 0.5 * np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]).sum()
        assert area == pytest.approx(0.5 * 10.0 * 2.0 + 2.0 * 2.0)
    north = ribbon(0.5, (zero, x, zero + np.pi / 2), 0.2 * x, 0.1 * x)
    assert north.left[5] == pytest.approx([-0.5, 5.0]) and north.right[-1] == pytest.approx([1.0, 12.0])


def test_names_of_models_that_predict_the_same_do_not_cover_each_other() -> None:
    places = [label_index(model, 0.05, 101) for model in LABEL_AT]
    assert LABEL_AT.keys() == MODEL_COLOUR.keys()
    assert min(np.abs(np.diff(sorted(places)))) >= 10  # half a second of driving apart
    assert label_index("kinematic", 0.05, 21) == 20  # a shorter horizon: at its end
    assert rgb("#1f77b4") == (31, 119, 180) and rgb("#000000", 0.5) == (128, 128, 128)


def test_the_table_on_the_page_has_a_row_per_model_and_mode_and_names_what_is_wrong() -> None:
    rows = [ErrorStatistics(model=m, mode=k, n_starts=7, longitudinal_rmse=1.234, lateral_rmse=float("nan"))
            for m in ("kinematic", "linear") for k in ("forecast", "hindsight")]
    text = words.page(rows, "Ticks 9", [(0, "a", "fine"), (1, "b", "late"), (2, "c", "silent")])
    assert [text.count(f"| {mode} | 7 | 1.23 | - |") for mode in ("forecast", "hindsight")] == [2, 2]
    assert text.index("**error**: c: silent") < text.index("warning: b: late") and "fine" not in text
    assert "Waiting" in words.page([], "", []) and "All nodes well." in words.page([], "", [(0, "a", "fine")])


def test_the_page_may_ask_nobody_but_this_machine() -> None:
    for directive in policy(4711).split("; "):
        for source in directive.split()[1:]:
            assert source.startswith("'") or source in ("data:", "blob:", "http://127.0.0.1:4711"), directive


@pytest.mark.parametrize(("name", "words"), [
    ("view.txt", "ends in .rrd"), ("there.rrd", "exists already"), ("no/where.rrd", "cannot be made"),
])
def test_a_recording_that_cannot_be_written_is_refused(tmp_path: Path, name: str, words: str) -> None:
    pytest.importorskip("rerun", reason="not beside a sourced ROS")
    (tmp_path / "there.rrd").write_bytes(b"")
    with pytest.raises(SuiteError, match=words):
        Window(page=True, save=tmp_path / name)


def test_a_view_that_was_never_opened_ends_quietly() -> None:
    pytest.importorskip("rerun", reason="not beside a sourced ROS")
    window = Window(page=True)
    window.finish(Console(quiet=True))
    window.close()


def said(**changes: object) -> list[str]:
    values: dict = {"velocity_x": 10.0, "yaw_rate": -0.2, "road_wheel_angle": 0.05, "mode": "RTK integer",
                    "mode_age": 0.4, "health": words.light([(0, "a", "fine")]), "age": 0.12}
    return words.passenger(**values | changes).split("\n\n")


def test_the_passenger_reads_speed_steering_position_mode_and_one_light() -> None:
    assert said() == ["# 36 km/h", "## wheels 2.9° left · 2.0 m/s² right", "## RTK integer · all well",
                      "picture 0.1 s old"]
    assert "## wheels - · 2.0 m/s² right" in said(road_wheel_angle=None)
    assert "## wheels 0.0° · 2.0 m/s² right" in said(road_wheel_angle=-1e-4)
    assert "## RTK float (9 s ago) · all well" in said(mode="RTK float", mode_age=9.0)
    assert "## position mode not heard · all well" in said(mode="")
    assert not any("old" in line for line in said(age=None))  # a recording is as old as it is
    assert "## the picture stands: 3 s old" in said(age=3.2)


def test_the_light_is_that_of_the_worst_check_and_never_green_over_an_old_picture() -> None:
    health = [(0, "a", "fine"), (1, "b", "late"), (2, "c", "silent")]
    assert words.light(health) == ("error", "c: silent, and 1 more")
    assert words.light(health[:2]) == ("warning", "b: late")
    assert words.light(health[:1], 0.2) == ("all well", "") and words.light([]) == ("nothing heard", "")
    assert words.light(health[:1], 1.5)[0] == words.light([(3, "d", "gone")])[0] == "error"


def test_a_view_whose_odometry_stops_says_so(tmp_path: Path) -> None:
    rr = pytest.importorskip("rerun", reason="not beside a sourced ROS")
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
    from nav_msgs.msg import Odometry
    from st_live.view.feed import Feed
    from st_live.view.scene import Scene, recording
    from st_msgs.msg import InsStatus, Steering
    from st_ros.stamps import from_nanoseconds

    class Noted(Scene):
        """Draws, and keeps what the passenger was told."""

        def passenger(self, time_ns: int, markdown: str, light: str) -> None:
            super().passenger(time_ns, markdown, light)
            told.append((time_ns, markdown, light))

    told: list[tuple[int, str, str]] = []
    drawing = recording("test", 0.1, rr.FileSink(str(tmp_path / "view.rrd")))
    feed = Feed(Noted(drawing, VehicleParameters.from_yaml(LEAF.read_text(), "leaf")), "map")
    start, measured = 1_800_000_000_000_000_000, 1_700_000_000_000_000_000  # of another clock than the host's
    odometry, status = Odometry(), InsStatus(position_mode=6, position_mode_text="RTK integer")
    odometry.header.frame_id, odometry.twist.twist.linear.x = "map", 10.0
    for k in range(60):
        now = start + k * 100_000_000
        odometry.header.stamp = status.header.stamp = from_nanoseconds(measured + k * 100_000_000)
        if k % 10 == 0:
            feed.take("ins/status", status, now)
            feed.take("/diagnostics", DiagnosticArray(status=[DiagnosticStatus(name="a")]), now)
        feed.take("vehicle/steering", Steering(road_wheel_angle=0.1), now)
        if k < 40:
            feed.take("ins/odometry", odometry, now)
        feed.draw(now + 20_000_000)
    drawing.flush()
    drawing.disconnect()
    moving = [(text, light) for time_ns, text, light in told if time_ns < measured + 3_800_000_000]
    assert {light for _, light in moving} == {"all well"} and all("picture 0.0 s old" in text for text, _ in moving)
    assert 8 <= len(moving) <= 12 and "# 36 km/h" in moving[0][0] and "## RTK integer" in moving[0][0]
    assert told[-1][2] == "error" and "the picture stands: 2 s old" in told[-1][1] and "no position" in told[-1][1]
    assert (tmp_path / "view.rrd").stat().st_size > 1000
