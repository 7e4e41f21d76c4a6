"""A remembered course: built, kept in a file, followed, left, and refused where it is of no use."""

import math

import numpy as np
import pytest
from st_core.course import Course, Pass, split_into_passes
from st_core.course_tracker import CourseTracker, EgoMotion, course_inputs
from st_core.errors import ConfigurationError, StCoreError
from st_core.log import DriveLog
from st_core.log_evaluation import EvaluationSettings, evaluate_log

T0 = 1_700_000_000_000_000_000


def lap(seconds=60.0, pace=1.0, shift=0.0, reverse=False, name="lap", origin=0.0) -> DriveLog:
    """A closed winding road of 1.2 km, driven by a kinematic car of 2.7 m at 8 to 16 m/s times `pace`."""
    dt, length = 0.01, 1200.0
    way = np.zeros(int(seconds / dt))
    speed = np.empty_like(way)
    for k in range(len(way)):
        speed[k] = pace * (12.0 + 4.0 * math.sin(2.0 * math.pi * way[k] / 300.0))
        if k + 1 < len(way):
            way[k + 1] = way[k] + speed[k] * dt
    bend = 2.0 * math.pi / length + 0.02 * np.sin(2.0 * math.pi * way / 150.0)
    heading = 2.0 * math.pi * way / length + 3.0 / (2.0 * math.pi) * (1.0 - np.cos(2.0 * math.pi * way / 150.0))
    x = origin + np.cumsum(speed * np.cos(heading) * dt) - shift * np.sin(heading)
    y = np.cumsum(speed * np.sin(heading) * dt) + shift * np.cos(heading)
    if reverse:
        x, y, heading, speed, bend = x[::-1], y[::-1], heading[::-1] + math.pi, speed[::-1], -bend[::-1]
    time = T0 + np.round(np.arange(len(way)) * dt * 1e9).astype(np.int64)
    return DriveLog(name, time, x, y, heading, speed, np.zeros_like(speed), speed * bend, time, np.arctan(2.7 * bend))


def build(*logs: DriveLog) -> Course:
    return Course(tuple(one for log in logs for one in split_into_passes(log, [log.name])))


def errors(leaf, log: DriveLog, course: Course) -> tuple[float, float]:
    """Mean distance at 5 s of the kinematic model with held inputs and with the course [m]."""
    settings = EvaluationSettings(interval=0.2)
    signals = settings.signals(log)
    ahead = course_inputs(course, signals, leaf, 5.0, 0.05)
    result = evaluate_log(["kinematic"], leaf, signals, settings, future_inputs={"course": ahead})
    held, remembered = (result.errors["kinematic", mode] for mode in ("forecast", "course"))
    both = held.complete & remembered.complete
    return tuple(float(np.hypot(*one.at_seconds[both][:, 4, :2].T).mean()) for one in (held, remembered))


def follow(course: Course, log: DriveLog, leaf, every=10):
    tracker = CourseTracker(course, leaf)
    columns = [getattr(log, name)[::every].tolist() for name in ("ins_time_ns", *EgoMotion._fields[1:7])]
    gain = np.gradient(log.velocity_x, 0.01)[::every].tolist()
    columns += [gain, log.road_wheel_angle[::every].tolist()]
    return [tracker.update(EgoMotion(*row)) for row in zip(*columns, strict=True)]


@pytest.mark.parametrize(("course", "most"), [
    ([lap(150.0)], 0.25), ([lap(100.0, 0.8), lap(100.0, 1.2), lap(100.0, reverse=True)], 0.25),
    ([lap(150.0, shift=1.5)], 0.35)], ids=["same", "other speeds", "other line"])
def test_a_course_takes_most_of_the_input_error(leaf, course, most):
    held, remembered = errors(leaf, lap(40.0, name="new"), build(*course))
    assert held > 3.0 and remembered < most * held


@pytest.mark.parametrize(("course", "reason"), [
    (build(lap(150.0, origin=5000.0)), "no earlier drive near the car"),
    (build(lap(150.0, reverse=True)), "no earlier drive near the car in its direction"),
    (Course(()), "no earlier drive near the car"),
    (build(lap(3.0)), "no earlier drive near the car|ends within the horizon"),
], ids=["another place", "other direction", "empty", "short"])
def test_a_course_of_no_use_leaves_inputs_held(leaf, course, reason):
    log = lap(20.0, name="new")
    found = follow(course, log, leaf)
    assert all(one.inputs is None and any(part in one.reason for part in reason.split("|")) for one in found)
    held, remembered = errors(leaf, log, course)
    assert remembered == pytest.approx(held, abs=1e-9)


def test_a_driver_who_leaves_the_remembered_speed_gets_held_inputs_back(leaf):
    """First on the remembered profile, then at constant speed through the same bends."""
    log, course = lap(60.0, name="new"), build(lap(150.0))
    shares = [one.speed_share for one in follow(course, log, leaf) if one.inputs is not None]
    steady = lap(60.0, name="steady")
    even = np.full_like(steady.velocity_x, 12.0)
    other = DriveLog("even", T0 + np.round(np.cumsum(steady.velocity_x / 12.0 * 0.01) * 1e9).astype(np.int64), steady.x,
                     steady.y, steady.yaw, even, steady.velocity_y, steady.yaw_rate / steady.velocity_x * 12.0,
                     T0 + np.round(np.cumsum(steady.velocity_x / 12.0 * 0.01) * 1e9).astype(np.int64),
                     steady.road_wheel_angle)
    left = [one.speed_share for one in follow(course, other, leaf) if one.inputs is not None]
    assert np.mean(shares[200:]) > 0.8 and np.mean(left[200:]) < 0.2
    assert max(abs(np.diff(left))) < 0.2  # smoothly


def test_a_position_jump_restarts_the_tracker(leaf):
    log, course = lap(40.0, name="new"), build(lap(150.0))
    x = log.x.copy()
    x[2000:] += 30.0
    jumped = DriveLog("jumped", log.ins_time_ns, x, log.y, log.yaw, log.velocity_x, log.velocity_y, log.yaw_rate,
                      log.steering_time_ns, log.road_wheel_angle)
    found = follow(course, jumped, leaf)
    assert found[199].inputs is not None and found[200].inputs is None
    assert all(np.isfinite(one.inputs.road_wheel_angle).all() for one in found if one.inputs is not None)
    nothing = CourseTracker(course, leaf).update(EgoMotion(T0, *[math.nan] * 8))
    assert nothing.inputs is None and "unknown" in nothing.reason


def test_a_file_is_read_back_and_a_run_is_never_predicted_from_itself():
    course = build(lap(60.0, name="a"), lap(60.0, shift=1.0, name="b"))
    text = course.to_yaml()
    again = Course.from_yaml(text)
    for one, other in zip(again.passes, course.passes, strict=True):
        assert (one.recording, one.digests) == (other.recording, other.digests)
        np.testing.assert_allclose(one.points, other.points, atol=0.006)
    assert [one.recording for one in again.exclude(["a"]).passes] == ["b"]


@pytest.mark.parametrize(("change", "words"), [
    (lambda text: text.replace("lap", "lop", 1), "edited or cut off"),
    (lambda text: text[:len(text) // 2], "edited or cut off"),
    (lambda text: text.replace("schema: 1", "schema: 7"), "schema: 7"),
    (lambda text: "bands: []\n", "course.yaml: "),
    (lambda text: "", "not a course file"),
    (lambda text: Course(()).to_yaml(), "empty"),
])
def test_a_bad_file_is_refused_in_one_line(change, words):
    text = build(lap(60.0)).to_yaml()
    with pytest.raises(ConfigurationError, match=words) as caught:
        Course.from_yaml(change(text), "course.yaml")
    assert "\n" not in str(caught.value)


def test_pauses_gaps_and_jumps_split_a_drive_and_a_parked_car_has_no_pass():
    log = lap(60.0)
    keep = np.ones(len(log.x), bool)
    keep[2000:2100] = False
    assert len(split_into_passes(log.select_ins(keep), ["x"])) == 2
    parked = DriveLog("parked", log.ins_time_ns, 0 * log.x, 0 * log.y, 0 * log.yaw, 0 * log.x, 0 * log.x, 0 * log.x,
                      log.steering_time_ns, log.road_wheel_angle)
    with pytest.raises(StCoreError, match="parked: no 20 m of continuous driving"):
        split_into_passes(parked, ["x"])


def test_a_pass_without_neighbours_is_found_once_a_lap():
    course = build(lap(250.0))
    x, y, direction = course.passes[0].points[100, :3]
    visits = course.find_near(x, y, direction)
    assert [visit.pass_index for visit in visits] == [0, 0, 0] and np.ptp([visit.row for visit in visits]) > 2000
    assert isinstance(course.passes[0], Pass)
