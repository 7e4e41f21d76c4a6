"""What looks late and is not: a drive that repeats itself, and steering against what else turns the car."""

from dataclasses import replace

import numpy as np
import pytest
from exact_drive import Noise, Sines, exact_drive, late
from st_core.checks import Severity, check, compare_runs
from st_core.checks.agreement import compare_series
from st_core.sideslip import with_steady_sideslip

SLALOM = {  # cornering brakes the car twice in each weave of 2 s: 0.06 m/s^2
    "speed": Sines(10.0, ((0.01, 1.0, 0.3),)), "turning": Sines(0.0, ((0.3, 2.0, 0.0),)),
    "noise": Noise(velocity=0.005),
}
SEEDS = range(8)


def lags(log, car=None):
    return {one.name: one for one in check(log, car).findings if one.name.endswith("_lag")}


def test_what_repeats_is_not_called_late(leaf):
    drives = [exact_drive(leaf, 60.0, **SLALOM, seed=seed) for seed in SEEDS]
    assert [lags(log, leaf) for log in drives] == [{} for _ in SEEDS]
    # The channel does vary above its noise: it is compared, and its size found.
    sizes = [check(log).estimates["acceleration_x_scale"][0] for log in drives]
    assert sizes == pytest.approx(np.ones(len(drives)), abs=0.1)


@pytest.mark.parametrize("seconds", [0.3, -0.3])
def test_a_late_channel_is_still_found_and_the_other_answers_are_named(leaf, seconds):
    log = late(exact_drive(leaf, 60.0, **SLALOM), seconds, "acceleration_x")
    one = lags(log)["acceleration_x_lag"]
    assert one.interval[0] < seconds < one.interval[1]
    said, other = ("lags", "leads by 0.70 s") if seconds > 0.0 else ("leads", "lags by 0.70 s")
    assert one.text.startswith(f"acceleration_x {said} velocity by ") and f" (or {other}" in one.text
    assert one.text.endswith(", which fits equally well: the motion is periodic)")


def test_what_repeats_but_once_in_a_while_differs_keeps_its_one_lag():
    time = np.arange(0.0, 60.0, 0.02)

    def varied(t):
        return np.sin(2.0 * np.pi * t) * (1.0 + 0.5 * np.sin(t / 3.0)) + 0.5 * np.sin(t / 1.3)
    measured = varied(time - 0.9) + 0.1 * np.random.default_rng(0).standard_normal(len(time))
    found = compare_series(time, varied(time), time, measured, 1.5)
    assert found.lag.value == pytest.approx(0.9, abs=0.01) and found.other_lags == ()


@pytest.mark.parametrize("period", [1.03, 0.71])
def test_a_period_beside_the_grid_of_the_search_decides_nothing(period):
    time = np.arange(0.0, 60.0, 0.02)
    for seed in SEEDS:
        noise = 0.02 * np.random.default_rng(seed).standard_normal(len(time))
        found = compare_series(time, np.sin(2.0 * np.pi * time / period), time,
                               np.sin(2.0 * np.pi * (time - 0.023) / period) + noise, 1.5)
        assert found.lag.value == pytest.approx(0.023, abs=0.005)
        periods = (np.array(found.other_lags) - 0.023) / period
        assert len(periods) and np.abs(periods - np.round(periods)).max() < 0.01 and np.abs(periods).min() > 0.5


def test_steering_against_what_else_turns_the_car_is_not_late(leaf):
    """On one bend brakes turn the car further in, and the driver opens the steering a moment later."""
    bend = exact_drive(leaf, 60.0, turning=Sines(0.3, ((0.02, 9.0, 0.0), (0.01, 3.1, 1.0))))
    angle = bend.road_wheel_angle
    answered = replace(bend, road_wheel_angle=2.0 * angle.mean() - angle)
    assert lags(late(answered, 0.4, "road_wheel_angle"), leaf) == {}
    assert "steering_lag" not in check(answered, leaf).estimates
    assert lags(late(bend, 0.4, "road_wheel_angle"), leaf)["steering_lag"].value == pytest.approx(0.4, abs=0.04)


@pytest.mark.parametrize(("channel", "name", "seconds"), [
    ("yaw_rate", "yaw_rate_lag", 0.36), ("road_wheel_angle", "steering_lag", 0.3)])
def test_one_lag_in_several_sweeps_is_one_finding_of_the_sensor(leaf, channel, name, seconds):
    parts = tuple((0.1, period, period) for period in (9.0, 5.0, 3.1, 2.3, 1.7, 1.3))
    sweep = {"speed": Sines(15.0, ()), "turning": Sines(0.0, parts)}
    runs = [check(late(exact_drive(leaf, 60.0, **sweep, seed=seed), seconds, channel), leaf) for seed in range(3)]
    assert [[one.name for one in run.findings] for run in runs] == [[name]] * 3
    (one,) = compare_runs(runs)
    assert one.name == name and one.consistent and one.mean == pytest.approx(seconds, abs=0.04)


@pytest.mark.parametrize("speed", [5.0, 20.0])
def test_a_yaw_that_is_the_course_does_not_make_the_yaw_rate_late(leaf, speed):
    parts = tuple((0.6 / speed, period, period) for period in (9.0, 5.0, 3.1, 2.3))
    log = exact_drive(leaf, 60.0, speed=Sines(speed, ()), turning=Sines(0.0, parts))
    course = replace(log, yaw=log.yaw + np.arctan2(log.velocity_y, log.velocity_x), acceleration_y=None,
                     velocity_x=np.hypot(log.velocity_x, log.velocity_y), velocity_y=np.zeros(len(log.x)))
    unknown = lags(course, leaf)["yaw_rate_lag"]  # l/v - K v: positive in slow driving, negative in fast
    assert unknown.severity is Severity.NOTE and unknown.advice.kind == "look"
    assert (unknown.value > 0.0) == (speed < 10.0)
    assert not {"yaw_rate_lag", "steering_lag"} & {*check(course, leaf).estimates}  # nor does discovery use it
    read = with_steady_sideslip(course, leaf)  # as the recordings are read
    assert not read.sideslip_measured
    found = check(read, leaf)
    assert {one.name for one in found.findings if one.severity is not Severity.NOTE} <= {"steering_lag"}
    assert found.estimates["yaw_rate_scale"][0] == pytest.approx(1.0, abs=0.01)
    scaled = {one.name: one for one in check(replace(read, yaw_rate=0.9 * read.yaw_rate), leaf).findings}
    assert scaled["yaw_rate_scale"].severity is not Severity.NOTE
    assert scaled["yaw_rate_scale"].value == pytest.approx(0.9, abs=0.01)
    worse = lags(late(course, 0.8, "yaw_rate"), leaf)["yaw_rate_lag"]
    assert worse.severity is Severity.WARNING and worse.advice.kind == "run.yaml"
