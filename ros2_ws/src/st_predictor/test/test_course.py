"""A course in the predictor: used, shifted to the map of the run, not applicable; and invalid course files."""

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
from support import LEAF
from winding_road import RATE, Truth, winding_road

pytestmark = pytest.mark.ros
CAR = VehicleParameters.from_yaml(LEAF.read_text(), "leaf")
MAP_ORIGIN = (51.448, 5.490)  # latitude, longitude, deg
WARNING = 1


@pytest.fixture(scope="module")
def road() -> np.ndarray:
    return winding_road(CAR, Truth(CAR.steering_wheel_offset, CAR.steering_ratio, 1.0), 45.0, 3, noise=0.0)


@pytest.fixture(scope="module")
def course(road: np.ndarray) -> Course:
    time, x, y, yaw, v_x, v_y, rate, steering = road.T
    time_ns = np.round(time * 1e9).astype(np.int64)
    angle = np.array([*map(CAR.road_wheel_angle, steering)])
    log = DriveLog("earlier", time_ns, x, y, yaw, v_x, v_y, rate, time_ns, angle)
    return Course(tuple(split_into_passes(log, ["digest"])), MAP_ORIGIN)


@pytest.fixture
def node() -> Iterator:
    rclpy.init()
    node = rclpy.create_node("predictor")
    yield node
    node.destroy_node()
    rclpy.shutdown()


def drive(course_input: CourseInput, road: np.ndarray,
          jump: float = 0.0, scored: bool = True) -> tuple[list[bool], list[tuple[float, float]]]:
    """Whether each start used the course, and, if scored, position errors at 5 s (held inputs, course) [m].

    jump: of the measured x after 20 s [m].
    """
    core = Predictor(CAR, ["linear"])
    used, errors = [], []
    for k, (t, x, y, yaw, v_x, v_y, rate, steering) in enumerate(road[:-600].tolist()):
        time_ns = round(t * 1e9)
        core.add_ins(InsSample(time_ns, x + (jump if t > 20.0 else 0.0), y, yaw, v_x, v_y, rate))
        core.add_steering(time_ns, CAR.road_wheel_angle(steering))
        if k % 10 == 0 and isinstance(start := core.find_start(time_ns), Start):
            inputs = course_input.find_inputs(core, start)
            used.append(inputs is not None)
            if scored:
                ends = [core.run(start, "linear", ahead).states[-1, :2] for ahead in (None, inputs)]
                after = k + round(5.0 * RATE)
                errors.append(tuple(float(np.hypot(*(end - road[after, 1:3]))) for end in ends))
    return used, errors


def make_course_input(node, course: Course, at: tuple[float, float] | None = None) -> CourseInput:
    """at: latitude and longitude of the map origin of this run [deg]."""
    course_input = CourseInput(node, course, CAR, 5.0, 0.05)
    if at:
        course_input._shift_course(NavSatFix(latitude=at[0], longitude=at[1]))
    return course_input


def test_course_reduces_the_error_of_held_inputs(node, course: Course, road: np.ndarray) -> None:
    course_input = make_course_input(node, course)
    used, errors = drive(course_input, road)
    held_error, course_error = np.array(errors)[50:].mean(axis=0)
    assert np.mean(used) > 0.9 and course_error < 0.45 * held_error
    assert course_input.make_check(True).level == 0 and "weight in curvature" in course_input.make_check(True).message
    assert "not used" in course_input.make_check(False).message


def test_course_with_another_map_origin_is_shifted(node, course: Course, road: np.ndarray) -> None:
    latitude, longitude = MAP_ORIGIN
    origin = (latitude + 200.0 / 111_250.0, longitude - 300.0 / 69_480.0)  # m, and m per degree
    shifted = replace(course.shift(300.0, -200.0), origin=origin)
    used, errors = drive(make_course_input(node, shifted, MAP_ORIGIN), road)
    held_error, course_error = np.array(errors)[50:].mean(axis=0)
    assert np.mean(used) > 0.9 and course_error < 0.45 * held_error


@pytest.mark.parametrize(("fault", "level", "reason"), [
    ("another place", WARNING, "recorded elsewhere: the map origins are 11.1 km apart"),
    ("origin unknown", WARNING, "the origin of the map (nan, "),
    ("other direction", 0, "no earlier drive near the car in its direction"),
    ("too far to the side", 0, "no earlier drive near the car"),
])
def test_inputs_are_held_without_a_suitable_course(node, course: Course, road: np.ndarray, fault: str, level: int,
                                                       reason: str) -> None:
    at = None
    if fault == "another place":  # with the same map coordinates as the drive
        at = (MAP_ORIGIN[0] + 0.1, MAP_ORIGIN[1])
    elif fault == "origin unknown":
        at = (float("nan"), MAP_ORIGIN[1])
    elif fault == "other direction":
        backwards = course.passes[0].points[::-1] * (1, 1, 1, -1, 1) + (0, 0, np.pi, 0, 0)
        course = Course((replace(course.passes[0], points=backwards),), MAP_ORIGIN)
    else:
        course = course.shift(500.0, 500.0)
    course_input = make_course_input(node, course, at)
    used, _ = drive(course_input, road, scored=False)
    assert not any(used) and not course_input.is_used
    check = course_input.make_check(True)
    assert check.level == level and "held" in check.message and reason in check.message


def test_inputs_are_held_after_a_position_jump(node, course: Course, road: np.ndarray) -> None:
    used, _ = drive(make_course_input(node, course), road, jump=60.0, scored=False)
    assert np.mean(used[:180]) > 0.9 and not any(used[-150:])


@pytest.mark.parametrize(("text", "reason"), [
    (None, "No such file"), ("", "not a course file"), ("schema: 1", "missing"),
    ("empty", "passes: empty; build the course from at least one recording"), ("cut", "was edited or cut off"),
])
def test_invalid_course_file_is_rejected_with_file_and_reason(course: Course, tmp_path: Path, text: str | None,
                                                                       reason: str) -> None:
    file = tmp_path / "course.yaml"
    if text is not None:
        whole = course.to_yaml()
        file.write_text({"empty": Course(()).to_yaml(), "cut": whole[:len(whole) // 2]}.get(text, text))
    with pytest.raises(ConfigurationError) as caught:
        values = SimpleNamespace(course_file=str(file), message_prefix="predictor.")
        params.read_file(values, "course_file", Course.from_yaml)
    assert str(file) in str(caught.value) and reason in str(caught.value) and "\n" not in str(caught.value)
