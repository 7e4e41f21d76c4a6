"""Apparent lags: periodic motion, steering that compensates an external yaw moment, course as yaw."""

from dataclasses import replace

import numpy as np
import pytest
from exact_drive import Noise, Sines, delay, exact_drive
from exact_faults import findings_by_name, position_point_moved, scaled
from st_core.checks import Severity, check, compare_runs
from st_core.checks.inertial import compare_series
from st_core.sideslip import with_steady_sideslip

SLALOM = {  # cornering drag varies the forward acceleration twice in each period of 2 s: 0.06 m/s^2
    "speed": Sines(10.0, ((0.01, 1.0, 0.3),)), "turning": Sines(0.0, ((0.3, 2.0, 0.0),)),
    "noise": Noise(velocity=0.005),
}
SEEDS = range(8)


def lag_findings(log, car=None):
    return {name: finding for name, finding in findings_by_name(log, car).items() if name.endswith("_lag")}


@pytest.mark.slow
def test_periodic_motion_gives_no_lag_finding(leaf):
    checked = [check(exact_drive(leaf, 60.0, **SLALOM, seed=seed), leaf) for seed in SEEDS]
    assert not [finding.name for each in checked for finding in each.findings if finding.name.endswith("_lag")]
    # The channel varies by more than its noise: it is compared, and its scale estimated.
    scales = [each.estimates["acceleration_x_scale"][0] for each in checked]
    assert scales == pytest.approx(np.ones(len(checked)), abs=0.1)


@pytest.mark.parametrize("seconds", [0.3, -0.3])
def test_lag_in_periodic_motion_is_found_and_the_other_possible_lags_are_named(leaf, seconds):
    log = delay(exact_drive(leaf, 60.0, **SLALOM), seconds, "acceleration_x")
    finding = lag_findings(log)["acceleration_x_lag"]
    assert finding.interval[0] < seconds < finding.interval[1]
    verb, other = ("lags", "leads by 0.70 s") if seconds > 0.0 else ("leads", "lags by 0.70 s")
    assert finding.text.startswith(f"acceleration_x {verb} velocity by ") and f" (or {other}" in finding.text
    assert finding.text.endswith(", which fits equally well: the motion is periodic)")


def test_nearly_periodic_signals_have_a_unique_lag():
    time = np.arange(0.0, 60.0, 0.02)

    def signal(t):
        return np.sin(2.0 * np.pi * t) * (1.0 + 0.5 * np.sin(t / 3.0)) + 0.5 * np.sin(t / 1.3)
    measured = signal(time - 0.9) + 0.1 * np.random.default_rng(0).standard_normal(len(time))
    found = compare_series(time, signal(time), time, measured, 1.5)
    assert found.lag.value == pytest.approx(0.9, abs=0.01) and found.other_lags == ()


@pytest.mark.parametrize("period", [1.03, 0.71])
def test_lag_does_not_depend_on_how_the_period_fits_the_search_grid(period):
    time = np.arange(0.0, 60.0, 0.02)
    for seed in SEEDS:
        noise = 0.02 * np.random.default_rng(seed).standard_normal(len(time))
        found = compare_series(time, np.sin(2.0 * np.pi * time / period), time,
                               np.sin(2.0 * np.pi * (time - 0.023) / period) + noise, 1.5)
        assert found.lag.value == pytest.approx(0.023, abs=0.005)
        periods = (np.array(found.other_lags) - 0.023) / period
        assert len(periods) and np.abs(periods - np.round(periods)).max() < 0.01 and np.abs(periods).min() > 0.5


def test_steering_that_compensates_an_external_yaw_moment_gives_no_lag_finding(leaf):
    """In a bend, braking turns the car further in, and the driver reduces the steering angle a moment later."""
    bend = exact_drive(leaf, 60.0, turning=Sines(0.3, ((0.02, 9.0, 0.0), (0.01, 3.1, 1.0))))
    angle = bend.road_wheel_angle
    compensated = replace(bend, road_wheel_angle=2.0 * angle.mean() - angle)
    assert lag_findings(delay(compensated, 0.4, "road_wheel_angle"), leaf) == {}
    assert "steering_lag" not in check(compensated, leaf).estimates
    found = lag_findings(delay(bend, 0.4, "road_wheel_angle"), leaf)
    assert found["steering_lag"].value == pytest.approx(0.4, abs=0.04)


def test_equal_steering_lag_in_several_sweeps_gives_one_consistent_finding(leaf):
    parts = tuple((0.1, period, period) for period in (9.0, 5.0, 3.1, 2.3, 1.7, 1.3))
    sweep = {"speed": Sines(15.0, ()), "turning": Sines(0.0, parts)}
    drives = [exact_drive(leaf, 60.0, **sweep, seed=seed) for seed in range(3)]
    runs = [check(delay(log, 0.3, "road_wheel_angle"), leaf) for log in drives]
    assert [[finding.name for finding in run.findings] for run in runs] == [["steering_lag"]] * 3
    (finding,) = compare_runs(runs)
    assert finding.name == "steering_lag" and finding.consistent and finding.mean == pytest.approx(0.3, abs=0.04)


@pytest.mark.slow
@pytest.mark.parametrize("speed", [5.0, 20.0])
def test_course_as_yaw_gives_no_yaw_rate_lag(leaf, speed):
    parts = tuple((0.6 / speed, period, period) for period in (9.0, 5.0, 3.1, 2.3))
    log = exact_drive(leaf, 60.0, speed=Sines(speed, ()), turning=Sines(0.0, parts))
    course = replace(log, yaw=log.yaw + np.arctan2(log.velocity_y, log.velocity_x), acceleration_y=None,
                     velocity_x=np.hypot(log.velocity_x, log.velocity_y), velocity_y=np.zeros(len(log.x)))
    uncertain = lag_findings(course, leaf)["yaw_rate_lag"]  # l/v - K v: positive at low speed, negative at high speed
    assert uncertain.severity is Severity.NOTE and uncertain.advice.kind == "text"
    assert (uncertain.value > 0.0) == (speed < 10.0)
    assert not {"yaw_rate_lag", "steering_lag"} & {*check(course, leaf).estimates}  # discovery does not use it either
    corrected = with_steady_sideslip(course, leaf)  # as when reading a recording
    assert not corrected.sideslip_measured
    found = check(corrected, leaf)
    assert {finding.name for finding in found.findings if finding.severity is not Severity.NOTE} <= {"steering_lag"}
    assert found.estimates["yaw_rate_scale"][0] == pytest.approx(1.0, abs=0.01)
    scaled = findings_by_name(replace(corrected, yaw_rate=0.9 * corrected.yaw_rate), leaf)["yaw_rate_scale"]
    assert scaled.severity is not Severity.NOTE
    assert scaled.value == pytest.approx(0.9, abs=0.01)
    delayed = lag_findings(delay(course, 0.8, "yaw_rate"), leaf)["yaw_rate_lag"]
    assert delayed.severity is Severity.WARNING and delayed.advice.kind == "run.yaml"


@pytest.mark.slow
@pytest.mark.parametrize("seconds", [0.1, 0.3, -0.3])
@pytest.mark.parametrize(("name", "channels"), [
    ("velocity_lag", ("velocity_x", "velocity_y")), ("velocity_x_lag", ("velocity_x",))])
def test_lag_of_velocities_gives_no_lag_of_yaw_or_accelerations(leaf, name, channels, seconds):
    """Yaw and yaw rate differ by 30 ms, as in many INS: positions show that yaw does not lag."""
    slow = exact_drive(leaf, 60.0, speed=Sines(6.0, ((1.5, 21.0, 0.4), (0.5, 7.0, 1.1))))
    found = lag_findings(delay(delay(slow, 0.03, "yaw_rate"), seconds, *channels), leaf)
    assert found.keys() == {name, "yaw_rate_lag"}
    assert found[name].value == pytest.approx(seconds, abs=0.04) and found[name].channels == channels


@pytest.mark.parametrize("channels", [("velocity_x", "velocity_y"), ("velocity_x",)])
def test_lag_of_velocities_names_velocity_x_too_if_the_lateral_velocity_is_small(leaf, channels):
    straight = Sines(0.0, ((0.01, 23.0, 0.0), (0.005, 6.1, 0.7)))
    log = exact_drive(leaf, 60.0, speed=Sines(6.0, ((1.5, 21.0, 0.4), (0.5, 7.0, 1.1))), turning=straight)
    (finding,) = lag_findings(delay(log, 0.08, *channels), leaf).values()
    assert finding.name in ("velocity_lag", "velocity_x_lag") and finding.text.endswith(": both fit this drive")
    assert [*finding.advice.entry["correct"]] == ["velocity_x"]  # which lags in both cases
    assert not {"velocity_lag", "velocity_x_lag"} & check(delay(log, 0.08, *channels), leaf).estimates.keys()


@pytest.mark.slow
@pytest.mark.parametrize("rate", [1.0005, 0.9995])
def test_steering_clock_of_a_different_rate_is_not_a_steering_lag(leaf, rate):
    log = exact_drive(leaf, 400.0, rate=20.0)
    start = log.steering_time_ns[0]
    wrong = replace(log, steering_time_ns=start + np.round(rate * (log.steering_time_ns - start)).astype(np.int64))
    checked = check(wrong, leaf)
    (finding,) = checked.findings
    assert finding.name == "time_rate" and finding.channels == ("road_wheel_angle",)
    assert finding.interval[0] < rate < finding.interval[1] and "steering_lag" not in checked.estimates
    assert lag_findings(delay(log, 0.3, "road_wheel_angle"), leaf).keys() == {"steering_lag"}


@pytest.mark.parametrize("seconds", [0.1, -0.1])
@pytest.mark.parametrize("ahead", [1.5, -1.5])
def test_lag_of_yaw_is_found_with_positions_of_a_different_point(leaf, ahead, seconds):
    found = findings_by_name(delay(position_point_moved(ahead)(exact_drive(leaf)), seconds, "yaw"), leaf)
    assert found.keys() == {"yaw_lag", "position_reference"}
    assert found["yaw_lag"].value == pytest.approx(seconds, abs=0.01)
    assert found["position_reference"].value == pytest.approx(ahead, abs=0.1)
    found = findings_by_name(delay(position_point_moved(ahead)(exact_drive(leaf)), seconds, "yaw_rate"), leaf)
    assert found.keys() == {"yaw_rate_lag", "position_reference"}


@pytest.mark.parametrize("channel", ["yaw", "yaw_rate"])
def test_lag_of_yaw_or_yaw_rate_names_both_if_a_different_point_has_the_same_effect(leaf, channel):
    log = delay(position_point_moved(1.5)(exact_drive(leaf, speed=Sines(12.0, ()))), 0.1, channel)
    found = findings_by_name(log, leaf)
    ambiguous = {name for name, finding in found.items() if finding.alternatives}
    # Estimates are those that st discover takes for measurements of a sensor.
    assert not (ambiguous | {"yaw_lag"}) & check(log, leaf).estimates.keys()
    assert found["yaw_rate_lag"].alternatives[0].findings == ("yaw_lag",)
    assert found["yaw_rate_lag"].text.endswith(" fit this drive") and "or yaw l" in found["yaw_rate_lag"].text
    named = [found[name] for name in ("yaw_rate_lag", "position_reference", "position_lag") if name in found]
    assert len(named) == 2 and all(finding.advice.kind == "text" for finding in named)


def test_small_yaw_rate_lag_is_not_mistaken_for_a_yaw_lag_where_velocity_y_is_wrong(leaf):
    log = scaled(0.8, "velocity_y")(delay(exact_drive(leaf), 0.04, "yaw_rate"))
    assert findings_by_name(log, leaf).keys() == {"velocity_y_scale", "yaw_rate_lag"}


MOTORWAY = {"speed": Sines(30.0, ((1.0, 41.0, 0.0),))}


@pytest.mark.parametrize(("degrees", "factor"), [(2.0, 1.0), (4.0, 1.0), (8.0, 3.0)])
def test_steering_play_is_an_alternative_where_the_car_hardly_steers(leaf, degrees, factor):
    turning = Sines(0.0, ((factor * 0.01, 19.0, 0.0), (factor * 0.008, 7.3, 1.0), (factor * 0.006, 4.1, 2.0)))
    log = exact_drive(leaf, 120.0, turning=turning, **MOTORWAY)
    half, angle = np.radians(0.5 * degrees) / leaf.steering_ratio, log.road_wheel_angle.copy()
    for k in range(1, len(angle)):
        angle[k] = np.clip(angle[k - 1], angle[k] - half, angle[k] + half)
    found = findings_by_name(replace(log, road_wheel_angle=angle, steering_wheel_angle=None), leaf)
    assert found and found.keys() <= {"steering_lag", "steering_scale"}
    assert all(finding.advice.kind == "text" and "or the steering has play" in finding.text
               for finding in found.values())
    found = findings_by_name(delay(exact_drive(leaf), 0.3, "road_wheel_angle"), leaf)["steering_lag"]
    assert "play" not in found.text and found.advice.kind == "run.yaml"


@pytest.mark.parametrize(("gain", "severity"), [(-1.0, Severity.ERROR), (1.0 / 57.3, Severity.WARNING)])
def test_play_does_not_hide_a_wrong_sign_or_unit_where_the_car_hardly_steers(leaf, gain, severity):
    turning = Sines(0.0, ((0.01, 19.0, 0.0), (0.008, 7.3, 1.0), (0.006, 4.1, 2.0)))
    log = exact_drive(leaf, 120.0, turning=turning, **MOTORWAY)
    found = check(replace(log, road_wheel_angle=gain * log.road_wheel_angle, steering_wheel_angle=None), leaf)
    (finding,) = [one for one in found.findings if one.name in ("steering_scale", "steering_sign")]
    assert finding.severity is severity and finding.value == pytest.approx(gain, rel=0.1)
    assert ("play" in finding.text) == (severity is Severity.WARNING)


@pytest.mark.parametrize("seed", range(4))
def test_yaw_noise_is_not_a_yaw_rate_lag_on_a_motorway(leaf, seed):
    turning = Sines(0.0, ((0.006, 11.0, 0.0), (0.004, 5.3, 1.0)))
    assert findings_by_name(exact_drive(leaf, 120.0, turning=turning, **MOTORWAY, seed=seed), leaf) == {}


def test_missing_lateral_velocity_is_named_with_the_reference_point_that_it_implies(leaf):
    log = exact_drive(leaf, speed=Sines(6.0, ((1.5, 21.0, 0.4), (0.5, 7.0, 1.1))))
    finding = findings_by_name(replace(log, velocity_y=np.zeros(len(log.x))))["position_reference"]
    assert finding.value > 0.0 and "velocity_y is missing or 0" in finding.text


def test_steering_of_a_car_that_may_be_unstable_has_no_lag(leaf):
    """Its yaw rate has no delay: near the critical speed, the vehicle file gives several seconds."""
    oversteering = replace(leaf, cornering_stiffness_front=3.5 * leaf.cornering_stiffness_front)
    assert not lag_findings(exact_drive(leaf, 120.0, **MOTORWAY), oversteering)


@pytest.mark.parametrize("gain", [0.5, 0.55])
def test_steered_rear_wheels_are_an_alternative_of_a_small_steering_gain(leaf, gain):
    log = exact_drive(leaf, 120.0)
    log = replace(log, road_wheel_angle=gain * log.road_wheel_angle, steering_wheel_angle=None)
    found = check(log, leaf)
    (finding,) = [one for one in found.findings if one.name == "steering_scale"]
    assert finding.severity is Severity.WARNING and finding.value == pytest.approx(gain, rel=0.1)
    assert "or the rear wheels also steer" in finding.text and finding.advice.kind == "text"
    assert not {"steering_scale", "steering_sign"} & found.estimates.keys()


@pytest.mark.parametrize("phase", [0.45, 0.5])
def test_slope_of_the_road_in_a_slalom_is_no_lag_of_the_acceleration(leaf, phase):
    speed = Sines(16.0, ((1.6, 40.0, 0.0), (0.01, 1.25, 0.3)))
    log = exact_drive(leaf, 100.0, speed=speed, turning=Sines(0.0, ((0.3, 2.5, 0.0),)))
    slope = 0.25 * np.sin(2e-9 * np.pi * (log.ins_time_ns - log.ins_time_ns[0]) / 40.0 + phase)
    assert lag_findings(replace(log, acceleration_x=log.acceleration_x + slope)) == {}


@pytest.mark.parametrize("bias", [0.008, 0.02])
def test_bias_of_the_velocity_is_no_lag_at_a_constant_acceleration(leaf, bias):
    speed = Sines(9.0, ((6.0, 400.0, -0.8),))
    circle = exact_drive(leaf, 100.0, speed=speed, turning=Sines(0.3, ((0.02, 31.0, 0.0),)), noise=Noise())
    assert lag_findings(replace(circle, velocity_x=circle.velocity_x + bias)) == {}


def test_scale_of_an_acceleration_as_small_as_that_of_a_slope_is_not_judged(leaf):
    for deviation, findings in ((0.2, set()), (0.4, {"acceleration_x_scale"})):
        speed = Sines(12.0, ((deviation * np.sqrt(2.0) * 23.0 / (2.0 * np.pi), 23.0, 0.0),))
        log = scaled(1.7, "acceleration_x")(exact_drive(leaf, 100.0, speed=speed))
        assert findings_by_name(log).keys() == findings


def test_steering_ratio_near_one_is_no_other_unit(leaf):
    """The gain of an understeering kart is that of its ratio."""
    kart = replace(leaf, steering_ratio=1.2)
    log = exact_drive(leaf, 100.0)
    log = replace(log, road_wheel_angle=-1.15 * log.road_wheel_angle, steering_wheel_angle=None)
    assert "steering_sign" in findings_by_name(log, kart)


def test_opposite_sign_of_the_steering_in_a_slalom_is_no_lag_of_half_a_period(leaf):
    log = exact_drive(leaf, 60.0, **SLALOM)
    found = findings_by_name(replace(log, road_wheel_angle=-log.road_wheel_angle, steering_wheel_angle=None), leaf)
    assert "steering_sign" in found and "steering_lag" not in found


@pytest.mark.parametrize("slip", [0.003, 0.007, 0.012])  # per forward acceleration [s^2/m]
def test_slip_of_a_wheel_speed_is_no_lead_of_the_velocity(leaf, slip):
    log = exact_drive(leaf, 120.0, rate=20.0)
    acceleration = np.gradient(log.velocity_x, (log.ins_time_ns - log.ins_time_ns[0]) * 1e-9)
    slipping = replace(log, velocity_x=log.velocity_x * (1.0 + slip * acceleration))
    assert not lag_findings(slipping)  # of the acceleration neither
    assert {"velocity_lag", "velocity_x_lag"} & lag_findings(delay(log, -0.1, "velocity_x")).keys()
