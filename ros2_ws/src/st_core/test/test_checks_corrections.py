"""Faults in a drive in closed form: each is found, its interval contains the true value, its correction removes it.

Corrections are applied as from run.yaml or the vehicle file: a wrong sign would double the fault.
"""

from dataclasses import replace

import numpy as np
import pytest
import yaml
from driven import drive, weave
from exact_drive import Noise, Sines, exact_drive
from exact_faults import (
    axes_exchanged,
    biased,
    corrected_drive,
    delayed,
    findings_by_name,
    ins_moved,
    ins_rotated,
    position_point_moved,
    scaled,
    steering_scaled,
    steering_wheel_turned,
    time_unit_misread,
    yaw_from_north,
)
from scipy.signal import lfilter
from st_core.checks import AuxiliaryData, Series, Severity, check
from st_core.handling import stability_factor
from st_core.log import DriveLog

DEG_PER_RAD, G = 180.0 / np.pi, 9.80665
RATIO = 17.3  # steering ratio of the Leaf
POSITION, VELOCITY, STEERING = ("x", "y"), ("velocity_x", "velocity_y"), ("road_wheel_angle",)
# (finding, true value [SI], fault). Positive: late, left, forward, too large. Factors above 1: reads too large.
FAULTS = [
    ("x_scale", 0.964, scaled(0.964, "x")),
    ("y_scale", 1.03, scaled(1.03, "y")),
    ("x_scale", 1.003, scaled(1.003, "x")),
    ("x_scale", 3.0, scaled(3.0, "x")),
    ("position_scale", 3.0, scaled(3.0, *POSITION)),
    ("position_scale", 3.28084, scaled(3.28084, *POSITION)),
    ("position_scale", 0.001, scaled(0.001, *POSITION)),
    ("position_lag", 0.1, delayed(0.1, *POSITION)),
    ("position_lag", -0.05, delayed(-0.05, *POSITION)),
    ("position_reference", 1.5, position_point_moved(1.5)),
    ("position_reference", -0.6, position_point_moved(-0.6)),
    ("velocity_scale", 3.6, scaled(3.6, *VELOCITY)),
    ("velocity_scale", 1.0 / 3.6, scaled(1.0 / 3.6, *VELOCITY)),
    ("velocity_scale", 1.02 * 3.6, scaled(1.02 * 3.6, *VELOCITY)),
    ("velocity_scale", 0.97, scaled(0.97, *VELOCITY)),
    ("velocity_x_scale", 3.6, scaled(3.6, "velocity_x")),
    ("velocity_x_scale", 0.8, scaled(0.8, "velocity_x")),
    ("velocity_y_scale", 3.0, scaled(3.0, "velocity_y")),
    ("velocity_y_scale", 0.5, scaled(0.5, "velocity_y")),
    ("velocity_lag", 0.2, delayed(0.2, *VELOCITY)),
    ("velocity_lag", -0.1, delayed(-0.1, *VELOCITY)),
    ("velocity_x_bias", 0.4, biased(0.4, "velocity_x")),
    ("velocity_y_bias", -0.5, biased(-0.5, "velocity_y")),
    ("yaw_scale", DEG_PER_RAD, scaled(DEG_PER_RAD, "yaw")),
    ("yaw_scale", 0.8, scaled(0.8, "yaw")),
    ("yaw_scale", 1.04, scaled(1.04, "yaw")),
    ("yaw_offset", 0.02, biased(0.02, "yaw")),
    ("yaw_offset", -0.15, biased(-0.15, "yaw")),
    ("yaw_offset", 0.5 * np.pi + 0.05, biased(0.5 * np.pi + 0.05, "yaw")),
    ("yaw_offset", -0.6, biased(-0.6, "yaw")),
    ("yaw_lag", 0.2, delayed(0.2, "yaw")),
    ("yaw_lag", -0.2, delayed(-0.2, "yaw")),
    ("yaw_rate_scale", DEG_PER_RAD, scaled(DEG_PER_RAD, "yaw_rate")),
    ("yaw_rate_scale", -1.0, scaled(-1.0, "yaw_rate")),
    ("yaw_rate_scale", -1.05 * DEG_PER_RAD, scaled(-1.05 * DEG_PER_RAD, "yaw_rate")),
    ("yaw_rate_scale", 0.9, scaled(0.9, "yaw_rate")),
    ("yaw_rate_bias", 0.012, biased(0.012, "yaw_rate")),
    ("yaw_rate_bias", -0.004, biased(-0.004, "yaw_rate")),
    ("yaw_rate_lag", 0.31, delayed(0.31, "yaw_rate")),
    ("yaw_rate_lag", -0.08, delayed(-0.08, "yaw_rate")),
    ("acceleration_y_scale", 1.0 / G, scaled(1.0 / G, "acceleration_y")),
    ("acceleration_x_scale", 1.6, scaled(1.6, "acceleration_x")),
    ("acceleration_y_bias", -0.6, biased(-0.6, "acceleration_y")),
    ("acceleration_x_bias", 0.4, biased(0.4, "acceleration_x")),
    ("acceleration_y_lag", 0.3, delayed(0.3, "acceleration_y")),
    ("acceleration_x_lag", -0.3, delayed(-0.3, "acceleration_x")),
    ("steering_scale", DEG_PER_RAD, steering_scaled(DEG_PER_RAD)),
    ("steering_scale", RATIO, steering_scaled(RATIO)),
    ("steering_scale", -1.0 / DEG_PER_RAD, steering_scaled(-1.0 / DEG_PER_RAD)),
    ("steering_sign", -1.0, steering_scaled(-1.0)),
    ("steering_lag", 0.25, delayed(0.25, *STEERING)),
    ("steering_lag", -0.3, delayed(-0.3, *STEERING)),
    ("heading_misaligned", 0.0098, ins_rotated(0.0098)),
]
GROSS_SCALES = {"yaw_scale", "yaw_rate_scale", "steering_scale", "velocity_scale", "velocity_y_scale"}
"""Scale errors by a factor of 2 or more in these channels are errors: no parameter is fitted to them."""
# Faults of units, axes and conventions, without an estimate other than the factor.
CONVENTION_FAULTS = [
    ("time_unit", time_unit_misread(10**3)), ("position_axes", axes_exchanged()),
    ("position_axes", axes_exchanged(-1.0)),
    ("position_axes", scaled(-1.0, "x")), ("position_axes", scaled(-1.0, "y")),
    ("velocity_x_scale", scaled(-1.0, "velocity_x")), ("velocity_y_scale", scaled(-1.0, "velocity_y")),
    ("yaw_convention", yaw_from_north(DEG_PER_RAD)), ("yaw_convention", scaled(-1.0, "yaw")),
    ("position_axes", lambda log: axes_exchanged()(yaw_from_north()(log))),
    ("velocity_axes", lambda log: replace(log, velocity_x=log.velocity_y, velocity_y=log.velocity_x)),
    *(("velocity_axes", ins_rotated(angle)) for angle in (0.5 * np.pi, -0.5 * np.pi, 1.2)),
]


@pytest.fixture(scope="module")
def log(leaf):
    return exact_drive(leaf)


def errors(log, car):
    return {finding.name: finding for finding in check(log, car).with_severity(Severity.ERROR)}


def equal_as_printed(line, entry):
    """Whether the values of the printed line equal those of the entry to five digits."""
    if isinstance(entry, dict):
        return set(line) == set(entry) and all(equal_as_printed(line[key], entry[key]) for key in entry)
    return line == (entry if isinstance(entry, str) else pytest.approx(entry, rel=1e-4))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_healthy_drive_has_no_findings(car, seed):
    assert check(exact_drive(car, seed=seed), car).findings == ()


@pytest.mark.slow
@pytest.mark.parametrize(("name", "value", "fault"), FAULTS, ids=[f"{name} {value:.4g}" for name, value, _ in FAULTS])
def test_fault_is_estimated_and_its_correction_removes_it(log, leaf, name, value, fault):
    wrong = fault(log)
    found = findings_by_name(wrong, leaf)
    assert list(found) == [name]
    low, high = found[name].interval
    assert low <= value <= high and low <= found[name].value <= high
    assert high - low < 0.35 * abs(value)
    if name == "steering_sign" or (name in GROSS_SCALES and not 0.5 < value < 2.0):
        assert found[name].severity is Severity.ERROR
    advice = found[name].advice
    assert advice.kind == "run.yaml" and equal_as_printed(yaml.safe_load(advice.line), advice.entry)
    assert findings_by_name(corrected_drive(wrong, advice.entry, leaf), leaf) == {}


@pytest.mark.slow
@pytest.mark.parametrize(("name", "fault"), CONVENTION_FAULTS)
def test_wrong_unit_axis_or_convention_is_an_error_and_its_correction_removes_it(log, leaf, name, fault):
    wrong = fault(log)
    found = findings_by_name(wrong, leaf)
    assert list(found) == [name] and found[name].severity is Severity.ERROR
    advice = found[name].advice
    assert equal_as_printed(yaml.safe_load(advice.line.replace("  # and ", "\n")), advice.entry)
    assert findings_by_name(corrected_drive(wrong, advice.entry, leaf), leaf) == {}


def with_map_velocities(log):
    """Velocities along the axes of the map instead of the car."""
    over_ground = (log.velocity_x + 1j * log.velocity_y) * np.exp(1j * log.yaw)
    return replace(log, velocity_x=over_ground.real, velocity_y=over_ground.imag)


@pytest.mark.parametrize(("name", "fault"), [
    ("velocity_axes", with_map_velocities), ("position_scale", scaled(1.0 / 111e3, *POSITION)),
    ("velocity_axes", lambda log: replace(with_map_velocities(log), velocity_x=with_map_velocities(log).velocity_y,
                                          velocity_y=with_map_velocities(log).velocity_x))])
def test_fault_that_run_yaml_cannot_correct_is_an_error(log, leaf, name, fault):
    found = findings_by_name(fault(log), leaf)
    assert list(found) == [name] and found[name].severity is Severity.ERROR and found[name].advice.kind == "text"
    if name == "position_scale":
        assert found[name].value == pytest.approx(1.0 / 111e3, rel=1e-3)


@pytest.mark.parametrize("channel", ["road_wheel_angle", "yaw_rate"])
def test_clipped_channel_is_not_reported_as_frozen(log, leaf, channel):
    values = getattr(log, channel)
    low, high = np.percentile(values, [10, 90])
    found = findings_by_name(replace(log, steering_wheel_angle=None, **{channel: np.clip(values, low, high)}), leaf)
    assert "channel_clipped" in found and "channel_frozen" not in found
    assert found["channel_clipped"].channels == (channel,)


def test_steering_at_its_mechanical_stop_is_not_clipped(leaf):
    time = np.arange(0.0, 60.0, 0.01)
    angle = np.clip(1.5 * np.sin(2 * np.pi * time / 15.0), -0.55, 0.55)
    speed = 3.0 + np.sin(2 * np.pi * time / 7.0)
    rate = speed * np.tan(angle) / leaf.wheelbase
    yaw = np.cumsum(rate) * 0.01
    velocity_y = rate * (leaf.cg_to_rear_axle + leaf.cg_to_ins_x)
    x, y = (np.cumsum(v) * 0.01 for v in (speed * np.cos(yaw) - velocity_y * np.sin(yaw),
                                          speed * np.sin(yaw) + velocity_y * np.cos(yaw)))
    stamps = (time * 1e9).astype(np.int64)
    parked = DriveLog("parking", ins_time_ns=stamps, x=x, y=y, yaw=yaw, velocity_x=speed, velocity_y=velocity_y,
                      yaw_rate=rate, steering_time_ns=stamps, road_wheel_angle=angle, steering_wheel_angle=None)
    assert "channel_clipped" not in findings_by_name(parked, leaf)


def test_steering_unrelated_to_the_motion_is_found(log, leaf):
    found = findings_by_name(replace(log, steering_wheel_angle=None, road_wheel_angle=np.abs(log.road_wheel_angle)),
                             leaf)
    assert list(found) == ["steering_unrelated"]


@pytest.mark.parametrize("seconds", [2.0, -3.0, 6.0])
def test_steering_delayed_by_seconds_is_found(log, leaf, seconds):
    delayed_log = replace(log, steering_time_ns=log.steering_time_ns + round(seconds * 1e9))
    assert {"steering_lag", "steering_unrelated"} & findings_by_name(delayed_log, leaf).keys()


def test_yaw_and_its_rate_are_in_degrees_where_sideslip_makes_gon_fit_the_course(log, leaf):
    """In a fast lane change, the course turns 14 % less than the car."""
    found = errors(scaled(1.16 * DEG_PER_RAD, "yaw", "yaw_rate")(log), leaf)
    assert found["yaw_rate_scale"].text.endswith("is its unit deg/s?")


def test_geographic_positions_show_that_yaw_and_yaw_rate_are_clockwise(log, leaf):
    geographic = AuxiliaryData(geographic=True)
    wrong = replace(yaw_from_north()(log), yaw_rate=-log.yaw_rate)
    (found,) = check(wrong, leaf, geographic).findings
    assert found.name == "yaw_convention" and equal_as_printed(yaml.safe_load(found.advice.line), found.advice.entry)
    assert check(corrected_drive(wrong, found.advice.entry, leaf), leaf, geographic).findings == ()


def test_longitude_positive_to_the_west_is_not_mistaken_for_a_compass_heading(log, leaf):
    geographic = AuxiliaryData(geographic=True)
    wrong = replace(log, x=-log.x)
    (found,) = check(wrong, leaf, geographic).findings
    assert found.name == "position_axes" and found.advice.entry == {"correct": {"x": {"scale": -1.0}}}
    assert check(corrected_drive(wrong, found.advice.entry, leaf), leaf, geographic).findings == ()


@pytest.mark.slow
@pytest.mark.parametrize(("channels", "name"), [(POSITION, "position_scale"), (VELOCITY, "velocity_scale")])
@pytest.mark.parametrize("factor", [1.05, 0.95])
def test_wheel_speeds_decide_between_wrong_positions_and_wrong_velocity(log, leaf, channels, name, factor):
    wheels = AuxiliaryData(wheel_speed=Series(log.ins_time_ns, log.velocity_x))
    (found,) = check(scaled(factor, *channels)(log), leaf, wheels).findings
    assert found.name == name and found.interval[0] <= factor <= found.interval[1]
    assert check(corrected_drive(scaled(factor, *channels)(log), found.advice.entry, leaf), leaf, wheels).findings == ()


@pytest.mark.parametrize("unit", [1.0, 1.0 / G])
@pytest.mark.parametrize(("sign_x", "sign_y", "text"), [
    (1.0, 1.0, "left)"), (1.0, -1.0, "and acceleration_y has the opposite sign: the sensor is rotated by 90 deg"),
    (-1.0, 1.0, "and acceleration_x has the opposite sign: the sensor is rotated by 90 deg"),
    (-1.0, -1.0, "and acceleration_y and acceleration_x have the opposite sign")])
def test_turned_accelerometer_is_found_and_its_correction_removes_it(log, leaf, sign_x, sign_y, text, unit):
    wrong = replace(log, acceleration_x=unit * sign_x * log.acceleration_y,
                    acceleration_y=unit * sign_y * log.acceleration_x)
    found = findings_by_name(wrong, leaf)
    assert list(found) == ["acceleration_axes"]
    assert text in found["acceleration_axes"].text and ("unit g" in found["acceleration_axes"].text) == (unit != 1.0)
    advice = found["acceleration_axes"].advice
    assert equal_as_printed(yaml.safe_load(advice.line.replace("  # and ", "\n")), advice.entry)
    assert findings_by_name(corrected_drive(wrong, advice.entry, leaf), leaf) == {}


def test_wrong_scale_of_positions_does_not_raise_the_severity_of_the_heading(leaf):
    log = ins_rotated(0.0055)(exact_drive(leaf, 120.0, speed=Sines(8.0, ((2.0, 41.0, 0.4), (1.0, 13.0, 1.1)))))
    log = replace(log, acceleration_x=None, acceleration_y=None)
    for fault in (scaled(1.0, *POSITION), scaled(1.25, *POSITION)):
        assert findings_by_name(fault(log), leaf)["heading_misaligned"].severity is Severity.NOTE


def test_sideslip_that_a_banked_road_may_cause_is_not_corrected(leaf):
    log = exact_drive(leaf, 60.0)
    small, large = (findings_by_name(ins_rotated(angle)(log), leaf)["heading_misaligned"] for angle in (0.0055, 0.0098))
    assert small.advice.kind == "text" and small.text.endswith(", or the road is banked: both fit this drive")
    assert large.advice.kind == "run.yaml" and "banked" not in large.text


@pytest.mark.slow
@pytest.mark.parametrize("factor", [1.25, 3.0])
def test_wrong_position_scale_does_not_move_the_reference_point(leaf, factor):
    """Without accelerations, the scale is attributed to the velocity, which then moves the point that it gives."""
    log = replace(exact_drive(leaf, 120.0, speed=Sines(8.0, ((2.0, 41.0, 0.4), (1.0, 13.0, 1.1)))),
                  acceleration_x=None, acceleration_y=None)
    found = findings_by_name(scaled(factor, *POSITION)(log), leaf)
    assert found.keys() == {"velocity_scale"}
    assert "measuring_point" in findings_by_name(scaled(0.8, *VELOCITY)(ins_moved(1.5)(log)), leaf)


@pytest.mark.parametrize("angle", [0.5, -0.7])
def test_steering_wheel_offset_is_corrected_in_the_vehicle_file(log, leaf, angle):
    wrong = steering_wheel_turned(angle)(log).with_steering(leaf)
    finding = findings_by_name(wrong, leaf)["steering_offset"]
    low, high = finding.interval
    assert finding.advice.kind == "vehicle" and low <= angle / RATIO <= high
    corrected = replace(leaf, **finding.advice.entry)
    assert findings_by_name(wrong.with_steering(corrected), corrected) == {}


@pytest.mark.parametrize("factor", [-1.0, DEG_PER_RAD, -DEG_PER_RAD])
@pytest.mark.parametrize("angle", [-0.047, 0.3])
def test_correction_of_a_steering_wheel_angle_keeps_its_offset(log, leaf, factor, angle):
    car = replace(leaf, steering_wheel_offset=angle)
    wheel = factor * car.steering_wheel_angle(log.road_wheel_angle)
    found = errors(wrong := replace(log, steering_wheel_angle=wheel).with_steering(car), car)
    assert len(found) == 1 and not {"steering_offset"} & findings_by_name(wrong, car).keys()
    corrected = corrected_drive(wrong, next(iter(found.values())).advice.entry, car)
    np.testing.assert_allclose(corrected.road_wheel_angle, log.road_wheel_angle, atol=1e-5)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_correction_of_a_road_wheel_angle_read_as_steering_wheel_angle_restores_the_offset(log, leaf, sign):
    car = replace(leaf, steering_wheel_offset=0.3)
    wrong = replace(log, steering_wheel_angle=sign * log.road_wheel_angle).with_steering(car)
    corrected = corrected_drive(wrong, errors(wrong, car)["steering_scale"].advice.entry, car)
    np.testing.assert_allclose(corrected.road_wheel_angle, log.road_wheel_angle, atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("factor", [1.0, -1.0, DEG_PER_RAD])
@pytest.mark.parametrize("angle", [0.04, -0.03])
def test_road_wheel_offset_is_corrected_in_run_yaml(log, leaf, factor, angle):
    wrong = steering_scaled(factor, factor * angle)(log)
    found = findings_by_name(wrong, leaf)
    assert "steering_offset" in found
    entry = {}
    for finding in found.values():
        advice = finding.advice
        assert advice.kind == "run.yaml" and equal_as_printed(yaml.safe_load(advice.line), advice.entry)
        entry |= advice.entry["correct"]["road_wheel_angle"]
    assert entry["add"] == pytest.approx(-angle, abs=0.002)
    assert findings_by_name(corrected_drive(wrong, {"correct": {"road_wheel_angle": entry}}, leaf), leaf) == {}


@pytest.mark.parametrize("ahead", [1.5, -0.8])
def test_displaced_reference_point_is_corrected_in_the_vehicle_file(log, leaf, ahead):
    wrong = ins_moved(ahead)(log)
    finding = findings_by_name(wrong, leaf)["measuring_point"]
    low, high = finding.interval
    assert finding.advice.kind == "vehicle" and low <= ahead <= high
    assert f"value: {finding.advice.entry['cg_to_ins_x']:.2f}" in finding.advice.line
    assert findings_by_name(wrong, replace(leaf, **finding.advice.entry)) == {}


def test_low_velocity_is_not_a_scale_of_both_axes_if_the_projection_is_spherical(log, leaf):
    """The axes differ by 0.45 %, and by 0.0056 after division by the scale of the velocity."""
    wrong = scaled(0.8, *VELOCITY)(scaled(0.9955, "x")(log))
    assert "velocity_scale" in findings_by_name(wrong, leaf)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_velocity_scale_is_not_a_scale_of_both_axes_if_they_differ_only_by_noise(log, leaf, seed):
    noise = lfilter([0.2], [1.0, -0.98], np.random.default_rng(seed).normal(size=(2, len(log.x))))  # 1 m, 0.5 s
    wrong = scaled(1.04, *VELOCITY)(replace(log, x=log.x + noise[0], y=log.y + noise[1]))
    found = findings_by_name(wrong, leaf)
    assert "velocity_scale" in found and not found.keys() & {"x_scale", "y_scale"}


def test_sign_and_scale_of_the_lateral_velocity_are_a_single_finding(log, leaf):
    finding = findings_by_name(scaled(-2.0, "velocity_y")(log), leaf)["velocity_y_scale"]
    assert finding.interval[0] <= -2.0 <= finding.interval[1]
    assert "has the opposite sign" in finding.text and ": it is -2.0" in finding.text


def test_positions_five_times_too_large_are_not_in_web_mercator(log, leaf):
    text = findings_by_name(scaled(5.0, *POSITION)(log), leaf)["position_scale"].text
    assert text.endswith("which agrees with the accelerations: is the scale of the projection wrong?")


@pytest.mark.parametrize("ahead", [1.5, -1.5])
def test_scale_of_the_lateral_velocity_is_found_together_with_the_reference_point(log, leaf, ahead):
    """Their effects nearly cancel for one sign, and the rest resembles lags."""
    found = findings_by_name(position_point_moved(ahead)(scaled(3.0, "velocity_y")(log)), leaf)
    assert found.keys() == {"velocity_y_scale", "position_reference"}
    for name, value in (("velocity_y_scale", 3.0), ("position_reference", ahead)):
        assert found[name].interval[0] <= value <= found[name].interval[1]


def test_scale_of_yaw_and_yaw_rate_are_alternatives_if_positions_are_too_noisy(leaf):
    coarse = exact_drive(leaf, 30.0, noise=Noise(position=3.0))
    for channel in ("yaw", "yaw_rate"):
        finding = findings_by_name(scaled(1.05, channel)(coarse), leaf)["yaw_rate_scale"]
        assert finding.channels == ("yaw_rate", "yaw") and finding.advice.kind == "text"
        assert finding.text.endswith("times its true value: both fit this drive")
        assert finding.alternatives[0].findings == ("yaw_scale",)
        assert not {"yaw_scale", "yaw_rate_scale"} & check(scaled(1.05, channel)(coarse), leaf).estimates.keys()


@pytest.mark.slow
@pytest.mark.parametrize("ahead", [-0.4, -1.52])
@pytest.mark.parametrize("drift", [0.05, 0.1, 0.3])  # m/s, root mean square, with a time constant of 5 s
def test_drift_of_the_lateral_velocity_is_not_a_scale_error(leaf, ahead: float, drift: float):
    """Noise in a regressor biases its coefficient, here towards a velocity_y that is several times too large."""
    car = replace(leaf, cg_to_ins_x=ahead)
    log, random = exact_drive(car, 120.0), np.random.default_rng(1)
    decay = np.exp(-0.01 / 5.0)
    noise = lfilter([drift * np.sqrt(1.0 - decay**2)], [1.0, -decay], random.normal(size=len(log.velocity_y)))
    assert findings_by_name(replace(log, velocity_y=log.velocity_y + noise), car) == {}


def test_reference_point_is_not_corrected_if_rear_wheels_steer_with_speed(leaf):
    """The rear wheels, steered against the front ones at low speed and with them at high speed, turn the heading."""
    log = exact_drive(leaf, 120.0)
    time, speed = log.ins_time_ns, log.velocity_x
    angle = np.interp(speed, [speed.min(), speed.max()], [-0.3, 0.2]) * np.interp(
        time, log.steering_time_ns, log.road_wheel_angle)
    velocity = (speed + 1j * log.velocity_y) * np.exp(1j * angle)
    steered = replace(log, yaw=log.yaw - angle, velocity_x=velocity.real, velocity_y=velocity.imag,
                      yaw_rate=log.yaw_rate - np.gradient(angle, time * 1e-9))
    finding = findings_by_name(steered, leaf)["measuring_point"]
    assert finding.advice.kind == "text" and "does not fit the rear slip of the vehicle file" in finding.text


@pytest.mark.slow
@pytest.mark.parametrize(("first", "second"), [
    (scaled(1.05, "yaw_rate"), biased(0.05, "yaw_rate")), (scaled(DEG_PER_RAD, "yaw_rate"), delayed(0.3, "yaw_rate")),
    (scaled(DEG_PER_RAD, "yaw"), scaled(DEG_PER_RAD, "yaw_rate")),
    (yaw_from_north(DEG_PER_RAD), scaled(DEG_PER_RAD, "yaw_rate")),
    (scaled(1.01 * 3.28084, *POSITION), biased(0.05, "yaw")),
    (biased(0.02, "yaw"), delayed(0.1, *POSITION)),
])
def test_two_faults_give_two_findings_whose_corrections_combine(log, leaf, first, second):
    wrong = second(first(log))
    found = findings_by_name(wrong, leaf)
    assert len(found) >= 2
    entry = {}
    for finding in found.values():
        for channel, fields in finding.advice.entry["correct"].items():
            entry.setdefault(channel, {}).update(fields)
    assert findings_by_name(corrected_drive(wrong, {"correct": entry}, leaf), leaf) == {}


def test_steering_and_acceleration_to_the_right_are_an_alternative_to_axes_of_a_north_east_map(log, leaf):
    wrong = scaled(-1.0, "acceleration_y")(steering_scaled(-1.0)(log))
    (finding,) = check(wrong, leaf).findings
    assert finding.name == "position_axes" and "yaw a compass heading, or steering and acceleration_y" in finding.text
    assert check(corrected_drive(wrong, finding.advice.entry, leaf), leaf).findings == ()


@pytest.mark.parametrize("speed", [4.0, -4.0])
def test_axes_and_heading_are_distinguished_in_either_direction_of_travel(leaf, speed):
    log = exact_drive(leaf, speed=Sines(speed, ((1.0, 20.0, 0.0),)))
    clockwise = scaled(-1.0, "yaw_rate")(yaw_from_north()(log))
    assert set(findings_by_name(clockwise, leaf)) == {"yaw_convention"}
    assert set(findings_by_name(axes_exchanged()(log), leaf)) == {"position_axes"}
    assert findings_by_name(log, leaf) == {}


@pytest.mark.slow
@pytest.mark.parametrize(("name", "fault", "severity"), [
    ("x_scale", scaled(1.003, "x"), "note"), ("x_scale", scaled(0.964, "x"), "warning"),
    ("yaw_rate_bias", biased(0.004, "yaw_rate"), "note"), ("yaw_rate_bias", biased(0.012, "yaw_rate"), "warning"),
    ("velocity_scale", scaled(3.6, *VELOCITY), "error"),
])
def test_severity_depends_on_the_effect_on_the_predicted_position(log, leaf, name, fault, severity):
    finding = findings_by_name(fault(log), leaf)[name]
    assert finding.severity == severity
    if name == "x_scale":
        error = abs(finding.value - 1.0)
        # 5 s at 12 m/s are 60 m; only the part along x is affected.
        assert 0.4 * error * 60.0 < finding.effect < error * 60.0


@pytest.mark.parametrize("shear", [0.03, -0.03])
def test_map_shear_is_estimated(leaf, shear):
    winding = exact_drive(leaf, 90.0, turning=Sines(0.05, ((0.16, 23.0, 0.0), (0.07, 6.1, 0.7))))
    low, high = findings_by_name(replace(winding, x=winding.x + shear * winding.y), leaf)["map_shear"].interval
    assert low <= shear <= high


@pytest.mark.parametrize("rate", [4e-4, -4e-4])
def test_yaw_drift_is_no_error_of_the_velocities(leaf, rate):
    winding = exact_drive(leaf, 150.0, turning=Sines(0.05, ((0.16, 23.0, 0.0), (0.07, 6.1, 0.7))))
    time = 1e-9 * (winding.ins_time_ns - winding.ins_time_ns[0])
    found = findings_by_name(replace(winding, yaw=winding.yaw + rate * time), leaf)
    low, high = found["yaw_drift"].interval
    assert low <= rate <= high
    assert found.keys() <= {"yaw_drift", "yaw_rate_bias"}


def test_yaw_offset_of_a_drifting_yaw_is_its_mean(leaf):
    winding = exact_drive(leaf, 150.0, turning=Sines(0.05, ((0.16, 23.0, 0.0), (0.07, 6.1, 0.7))))
    time = 1e-9 * (winding.ins_time_ns - winding.ins_time_ns[0])
    found = findings_by_name(replace(winding, yaw=winding.yaw + 0.02 + 1e-4 * time), leaf)
    assert found["yaw_offset"].value == pytest.approx(0.0275, abs=0.0005) and "yaw_drift" in found


def test_findings_that_affect_predictions_come_first(log, leaf):
    found = check(biased(0.6, "acceleration_y")(scaled(0.97, "x")(log)), leaf).findings
    assert [finding.name for finding in found if finding.severity == "warning"] == ["x_scale", "acceleration_y_bias"]


def test_steering_sign_is_found_in_bends_too_wide_for_a_scale(leaf):
    fast = drive(leaf, 24.0, weave(0.009), 40.0)
    assert np.sqrt(np.mean(np.square(leaf.wheelbase * fast.yaw_rate / fast.velocity_x))) < 0.006
    assert errors(fast, leaf) == {}
    negated = replace(fast, road_wheel_angle=-fast.road_wheel_angle, steering_wheel_angle=-fast.steering_wheel_angle)
    assert set(errors(negated, leaf)) == {"steering_sign"}


def test_understeer_at_high_speed_is_not_mistaken_for_a_wrong_steering_unit(leaf):
    soft = replace(leaf, cornering_stiffness_front=0.6 * leaf.cornering_stiffness_front)
    fast = drive(soft, 24.0, weave(0.03), 40.0)
    assert 24.0**2 * stability_factor(soft) > 0.8
    assert errors(fast, soft) == {}
    oversteering = replace(soft, cornering_stiffness_front=120e3, cornering_stiffness_rear=90e3)  # a wrong vehicle file
    assert stability_factor(oversteering) < 0.0
    assert errors(fast, oversteering) == {}
    finding = errors(replace(fast, road_wheel_angle=fast.steering_wheel_angle), soft)["steering_scale"]
    assert "the angle of the steering wheel" in finding.text
    scale = finding.advice.entry["correct"]["road_wheel_angle"]["scale"]
    assert scale == pytest.approx(1.0 / soft.steering_ratio, rel=1e-4)
