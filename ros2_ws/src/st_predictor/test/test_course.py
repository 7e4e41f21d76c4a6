"""A remembered course in the predictor: used, moved to the map of the run, left, refused; and its file at the start."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")
pytest.importorskip("st_msgs", reason="needs the built workspace")

import rclpy
from sensor_msgs.msg import NavSatFix
from st_core.course import Course, split_into_passes
from st_core.log import DriveLog
from st_core.prediction import Predictor, Start
from st_core.types import InsSample
from st_core.vehicle import VehicleParameters
from st_predictor import params
from st_predictor.nodes._future_inputs import CourseInput
from st_ros.parameters import ConfigurationError
from support import ROOT
from winding_road import RATE, Truth, winding_road

pytestmark = pytest.mark.ros
LEAF = ROOT / "config" / "vehicle" / "leaf.yaml"
CAR = VehicleParameters.from_yaml(LEAF.read_text(), "leaf")
HERE = (51.448, 5.490)  # deg
WARN = 1


@pytest.fixture(scope="module")
def road() -> np.ndarray:
    return winding_road(CAR, Truth(CAR.steering_wheel_offset, CAR.steering_ratio, 1.0), 45.0, 3, noise=0.0)


@pytest.fixture(scope="module")
def course(road: np.ndarray) -> Course:
    time, x, y, yaw, v_x, v_y, rate, steering = road.T
    time_ns = np.round(time * 1e9).astype(np.int64)
    angle = np.array([*map(CAR.road_wheel_angle, steering)])
    log = DriveLog("earlier", time_ns, x, y, yaw, v_x, v_y, rate, time_ns, angle)
    return Course(tuple(split_into_passes(log, ["digest"])), HERE)


@pytest.fixture
def node() -> Iterator:
    rclpy.init()
    one = rclpy.create_node("predictor")
    yield one
    one.destroy_node()
    rclpy.shutdown()


def drive(given: CourseInput, road: np.ndarray, jump: float = 0.0) -> tuple[list[bool], list[tuple[float, float]]]:
    """Whether each start used the course, and errors at 5 s (held, course) [m]. jump: to the side after 20 s [m]."""
    core = Predictor(CAR, ["linear"])
    used, errors = [], []
    for k, (t, x, y, yaw, v_x, v_y, rate, steering) in enumerate(road[:-600].tolist()):
        time_ns = round(t * 1e9)
        core.add_ins(InsSample(time_ns, x + (jump if t > 20.0 else 0.0), y, yaw, v_x, v_y, rate))
        core.add_steering(time_ns, CAR.road_wheel_angle(steering))
        if k % 10 == 0 and isinstance(start := core.find_start(time_ns), Start):
            inputs = given.find_inputs(core, start)
            used.append(inputs is not None)
            ends = [core.run(start, "linear", ahead).states[-1, :2] for ahead in (None, inputs)]
            after = k + round(5.0 * RATE)
            errors.append(tuple(float(np.hypot(*(end - road[after, 1:3]))) for end in ends))
    return used, errors


def given(node, course: Course, at: tuple[float, float] | None = None) -> CourseInput:
    """at: origin of the map of this run [deg]."""
    one = CourseInput(node, course, CAR, 5.0, 0.05)
    if at:
        one._move_course(NavSatFix(latitude=at[0], longitude=at[1]))
    return one


def test_the_course_takes_most_of_the_error_of_held_inputs(node, course: Course, road: np.ndarray) -> None:
    one = given(node, course)
    used, errors = drive(one, road)
    held, remembered = np.array(errors)[50:].mean(axis=0)
    assert np.mean(used) > 0.9 and remembered < 0.45 * held
    assert one.make_check(True).level == 0 and "weight in curvature" in one.make_check(True).message
    assert "not used" in one.make_check(False).message


def test_a_course_from_another_origin_of_the_map_is_moved(node, course: Course, road: np.ndarray) -> None:
    elsewhere = replace(course.shift(300.0, -200.0), origin=(HERE[0] + 200.0 / 111_250.0, HERE[1] - 300.0 / 69_480.0))
    used, errors = drive(given(node, elsewhere, HERE), road)
    assert np.mean(used) > 0.9 and np.mean([e[1] for e in errors[50:]]) < 0.45 * np.mean([e[0] for e in errors[50:]])


@pytest.mark.parametrize(("fault", "level", "reason"), [
    ("another place", WARN, "recorded elsewhere: the map origins are 11.1 km apart"),
    ("origin unknown", WARN, "the origin of the map (nan, "),
    ("other direction", 0, "no earlier drive near the car in its direction"),
    ("too far to the side", 0, "no earlier drive near the car"),
])
def test_a_course_that_does_not_fit_leaves_inputs_held(node, course: Course, road: np.ndarray, fault: str, level: int,
                                                       reason: str) -> None:
    at = None
    if fault == "another place":  # although its coordinates are those of the drive
        at = (HERE[0] + 0.1, HERE[1])
    elif fault == "origin unknown":
        at = (float("nan"), HERE[1])
    elif fault == "other direction":
        backwards = course.passes[0].points[::-1] * (1, 1, 1, -1, 1) + (0, 0, np.pi, 0, 0)
        course = Course((replace(course.passes[0], points=backwards),), HERE)
    else:
        course = course.shift(500.0, 500.0)
    one = given(node, course, at)
    used, _ = drive(one, road)
    assert not any(used) and not one.is_used
    check = one.make_check(True)
    assert check.level == level and "held" in check.message and reason in check.message


def test_after_a_jump_of_the_position_inputs_are_held(node, course: Course, road: np.ndarray) -> None:
    used, _ = drive(given(node, course), road, jump=60.0)
    assert np.mean(used[:180]) > 0.9 and not any(used[-150:])


@pytest.mark.parametrize(("text", "reason"), [
    (None, "No such file"), ("", "not a course file"), ("schema: 1", "missing"),
    ("empty", "passes: empty; build the course from at least one recording"), ("cut", "was edited or cut off"),
])
def test_a_file_that_is_no_course_stops_the_start_with_file_and_reason(course: Course, tmp_path: Path, text: str | None,
                                                                       reason: str) -> None:
    file = tmp_path / "course.yaml"
    if text is not None:
        whole = course.to_yaml()
        file.write_text({"empty": Course(()).to_yaml(), "cut": whole[:len(whole) // 2]}.get(text, text))
    with pytest.raises(ConfigurationError) as caught:
        params.read_file(SimpleNamespace(course_file=str(file), where="predictor."), "course_file", Course.from_yaml)
    assert str(file) in str(caught.value) and reason in str(caught.value) and "\n" not in str(caught.value)
