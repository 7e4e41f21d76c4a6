"""Courses from earlier drives: construction, file, tracking, deviation, and rejection of unusable courses."""

import functools
import math
from dataclasses import replace

import numpy as np
import pytest
from st_core.course import Course, CourseTracker, EgoMotion, Pass, predict_course_inputs, split_into_passes
from st_core.errors import ConfigurationError, StCoreError
from st_core.log import DriveLog
from st_core.log_evaluation import EvaluationSettings, evaluate_log

T0 = 1_700_000_000_000_000_000


@functools.cache
def lap(seconds=60.0, pace=1.0, shift=0.0, reverse=False, name="lap", origin=0.0) -> DriveLog:
    """Closed winding road, 1.2 km, driven at pace times 8 to 16 m/s by a kinematic car with 2.7 m wheelbase."""
    dt, length = 0.01, 1200.0
    distance = np.zeros(int(seconds / dt))
    speed = np.empty_like(distance)
    for k in range(len(distance)):
        speed[k] = pace * (12.0 + 4.0 * math.sin(2.0 * math.pi * distance[k] / 300.0))
        if k + 1 < len(distance):
            distance[k + 1] = distance[k] + speed[k] * dt
    curvature = 2.0 * math.pi / length + 0.02 * np.sin(2.0 * math.pi * distance / 150.0)
    heading = (2.0 * math.pi * distance / length
               + 3.0 / (2.0 * math.pi) * (1.0 - np.cos(2.0 * math.pi * distance / 150.0)))
    x = origin + np.cumsum(speed * np.cos(heading) * dt) - shift * np.sin(heading)
    y = np.cumsum(speed * np.sin(heading) * dt) + shift * np.cos(heading)
    if reverse:
        x, y, heading, speed, curvature = x[::-1], y[::-1], heading[::-1] + math.pi, speed[::-1], -curvature[::-1]
    time = T0 + np.round(np.arange(len(distance)) * dt * 1e9).astype(np.int64)
    return DriveLog(name, time, x, y, heading, speed, np.zeros_like(speed), speed * curvature, time,
                    np.arctan(2.7 * curvature))


def make_course(*logs: DriveLog) -> Course:
    return Course(tuple(course_pass for log in logs for course_pass in split_into_passes(log, [log.name])))


def mean_errors(leaf, log: DriveLog, course: Course) -> tuple[float, float]:
    """Mean position error [m] at 5 s of the kinematic model with constant inputs and with the course."""
    settings = EvaluationSettings(interval=0.2)
    signals = settings.signals(log)
    ahead = functools.partial(predict_course_inputs, course, signals, leaf, 5.0, 0.05)
    result = evaluate_log(["kinematic"], leaf, signals, settings, future_inputs={"course": ahead})
    constant, from_course = (result.errors["kinematic", mode] for mode in ("forecast", "course"))
    both = constant.complete & from_course.complete
    return tuple(float(np.hypot(*one.at_seconds[both][:, 4, :2].T).mean()) for one in (constant, from_course))


def track(course: Course, log: DriveLog, leaf, every=10):
    tracker = CourseTracker(course, leaf)
    columns = [getattr(log, name)[::every].tolist() for name in ("ins_time_ns", *EgoMotion._fields[1:7])]
    gain = np.gradient(log.velocity_x, 0.01)[::every].tolist()
    columns += [gain, log.road_wheel_angle[::every].tolist()]
    return [tracker.update(EgoMotion(*row)) for row in zip(*columns, strict=True)]


@pytest.mark.parametrize(("logs", "maximum_share"), [
    (lambda: [lap(150.0)], 0.25), (lambda: [lap(100.0, 0.8), lap(100.0, 1.2), lap(100.0, reverse=True)], 0.25),
    (lambda: [lap(150.0, shift=1.5)], 0.35)], ids=["same", "other speeds", "other line"])
def test_course_reduces_the_input_error(leaf, logs, maximum_share):
    constant, from_course = mean_errors(leaf, lap(40.0, name="new"), make_course(*logs()))
    assert constant > 3.0 and from_course < maximum_share * constant


@pytest.mark.parametrize(("logs", "reason"), [
    (lambda: [lap(150.0, origin=5000.0)], "no earlier drive near the car"),
    (lambda: [lap(150.0, reverse=True)], "no earlier drive near the car in its direction"),
    (list, "no earlier drive near the car"),
    (lambda: [lap(3.0)], "no earlier drive near the car|end within 1.2 horizons"),
], ids=["another place", "other direction", "empty", "short"])
def test_unusable_course_keeps_inputs_constant(leaf, logs, reason):
    log, course = lap(20.0, name="new"), make_course(*logs())
    for update in track(course, log, leaf):
        assert update.inputs is None and any(part in update.reason for part in reason.split("|"))
    constant, from_course = mean_errors(leaf, log, course)
    assert from_course == pytest.approx(constant, abs=1e-9)


def test_other_speed_profile_returns_to_constant_inputs(leaf):
    """First with the recorded speed profile, then at a constant 12 m/s through the same bends."""
    log, course = lap(60.0, name="new"), make_course(lap(150.0))
    same_speed = [update.speed_weight for update in track(course, log, leaf) if update.inputs is not None]
    time_ns = T0 + np.round(np.cumsum(log.velocity_x / 12.0 * 0.01) * 1e9).astype(np.int64)
    steady = replace(log, ins_time_ns=time_ns, velocity_x=np.full_like(log.velocity_x, 12.0),
                     yaw_rate=log.yaw_rate / log.velocity_x * 12.0, steering_time_ns=time_ns)
    other_speed = [update.speed_weight for update in track(course, steady, leaf) if update.inputs is not None]
    assert np.mean(same_speed[200:]) > 0.8 and np.mean(other_speed[200:]) < 0.2
    assert max(abs(np.diff(other_speed))) < 0.2  # smooth transition


def test_position_jump_restarts_the_tracker(leaf):
    log, course = lap(40.0, name="new"), make_course(lap(150.0))
    x = log.x.copy()
    x[2000:] += 30.0
    updates = track(course, replace(log, x=x), leaf)
    assert updates[199].inputs is not None and updates[200].inputs is None
    assert all(np.isfinite(update.inputs.road_wheel_angle).all() for update in updates if update.inputs is not None)
    unknown = CourseTracker(course, leaf).update(EgoMotion(T0, *[math.nan] * 8))
    assert unknown.inputs is None and "unknown" in unknown.reason


def test_file_round_trip_and_exclusion_of_a_recording():
    course = make_course(lap(60.0, name="a"), lap(60.0, shift=1.0, name="b"))
    text = course.to_yaml()
    reloaded = Course.from_yaml(text)
    for result, original in zip(reloaded.passes, course.passes, strict=True):
        assert (result.recording, result.digests) == (original.recording, original.digests)
        np.testing.assert_allclose(result.points, original.points, atol=0.006)
    assert [course_pass.recording for course_pass in reloaded.exclude(["a"]).passes] == ["b"]


@pytest.mark.parametrize(("change", "message"), [
    (lambda text: text.replace("lap", "lop", 1), "edited or cut off"),
    (lambda text: text[:len(text) // 2], "edited or cut off"),
    (lambda text: text.replace("schema: 1", "schema: 7"), "schema: 7"),
    (lambda text: "bands: []\n", "course.yaml: "),
    (lambda text: "", "not a course file"),
    (lambda text: Course(()).to_yaml(), "empty"),
    (lambda text: replace(Course.from_yaml(text), origin=(48.0,)).to_yaml(), "not a complete course file"),
])
def test_invalid_file_is_rejected_in_one_line(change, message):
    text = make_course(lap(60.0)).to_yaml()
    with pytest.raises(ConfigurationError, match=message) as caught:
        Course.from_yaml(change(text), "course.yaml")
    assert "\n" not in str(caught.value)


def test_gap_splits_a_drive_and_parked_car_has_no_pass():
    log = lap(60.0)
    keep = np.ones(len(log.x), bool)
    keep[2000:2100] = False
    assert len(split_into_passes(log.select_ins(keep), ["x"])) == 2
    zero = 0.0 * log.x
    parked = replace(log, name="parked", x=zero, y=zero, yaw=zero, velocity_x=zero, velocity_y=zero, yaw_rate=zero)
    with pytest.raises(StCoreError, match="parked: no 20 m of continuous driving"):
        split_into_passes(parked, ["x"])


def test_find_near_returns_one_visit_per_lap():
    course = make_course(lap(250.0))
    x, y, direction = course.passes[0].points[100, :3]
    visits = course.find_near(x, y, direction)
    assert [visit.pass_index for visit in visits] == [0, 0, 0] and np.ptp([visit.row for visit in visits]) > 2000
    assert isinstance(course.passes[0], Pass)
