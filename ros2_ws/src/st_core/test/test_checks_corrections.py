"""A fault put into a drive in closed form: it is named, its value lies inside its interval, its cure removes it.

The cure is applied as run.yaml and vehicle file would be: a wrong sign of an estimate or of a cure doubles the fault.
"""

from dataclasses import replace

import numpy as np
import pytest
import yaml
from exact_drive import Sines, exact_drive
from exact_faults import (
    askew,
    compass,
    corrected_drive,
    counted,
    delayed,
    exchanged,
    mounted,
    plus,
    point_of_positions,
    steered,
    times,
    wheel_turned,
)
from st_core.checks import AuxiliaryData, Series, Severity, check
from st_core.log import DriveLog

DEGREE, G = 180.0 / np.pi, 9.80665
RATIO = 17.3  # of the Leaf's steering
POSITION, VELOCITY, STEERING = ("x", "y"), ("velocity_x", "velocity_y"), ("road_wheel_angle",)
# (finding, its true value, the fault); late, left, high, ahead and too large are positive or above 1.
FAULTS = [
    ("x_scale", 0.964, times(0.964, "x")),
    ("y_scale", 1.03, times(1.03, "y")),
    ("x_scale", 1.003, times(1.003, "x")),
    ("position_scale", 3.28084, times(3.28084, *POSITION)),
    ("position_scale", 0.001, times(0.001, *POSITION)),
    ("position_lag", 0.1, delayed(0.1, *POSITION)),
    ("position_lag", -0.05, delayed(-0.05, *POSITION)),
    ("position_reference", 1.5, point_of_positions(1.5)),
    ("position_reference", -0.6, point_of_positions(-0.6)),
    ("velocity_scale", 3.6, times(3.6, *VELOCITY)),
    ("velocity_scale", 1.0 / 3.6, times(1.0 / 3.6, *VELOCITY)),
    ("velocity_scale", 1.02 * 3.6, times(1.02 * 3.6, *VELOCITY)),
    ("velocity_scale", 0.97, times(0.97, *VELOCITY)),
    ("velocity_x_scale", 3.6, times(3.6, "velocity_x")),
    ("velocity_lag", 0.2, delayed(0.2, *VELOCITY)),
    ("velocity_lag", -0.1, delayed(-0.1, *VELOCITY)),
    ("velocity_x_bias", 0.4, plus(0.4, "velocity_x")),
    ("velocity_y_bias", -0.5, plus(-0.5, "velocity_y")),
    ("yaw_scale", DEGREE, times(DEGREE, "yaw")),
    ("yaw_offset", 0.02, plus(0.02, "yaw")),
    ("yaw_offset", -0.15, plus(-0.15, "yaw")),
    ("yaw_offset", 0.5 * np.pi + 0.05, plus(0.5 * np.pi + 0.05, "yaw")),
    ("yaw_offset", -0.6, plus(-0.6, "yaw")),
    ("yaw_lag", 0.2, delayed(0.2, "yaw")),
    ("yaw_lag", -0.2, delayed(-0.2, "yaw")),
    ("yaw_rate_scale", DEGREE, times(DEGREE, "yaw_rate")),
    ("yaw_rate_scale", -1.0, times(-1.0, "yaw_rate")),
    ("yaw_rate_scale", -1.05 * DEGREE, times(-1.05 * DEGREE, "yaw_rate")),
    ("yaw_rate_scale", 0.9, times(0.9, "yaw_rate")),
    ("yaw_rate_bias", 0.012, plus(0.012, "yaw_rate")),
    ("yaw_rate_bias", -0.004, plus(-0.004, "yaw_rate")),
    ("yaw_rate_lag", 0.31, delayed(0.31, "yaw_rate")),
    ("yaw_rate_lag", -0.08, delayed(-0.08, "yaw_rate")),
    ("acceleration_y_scale", 1.0 / G, times(1.0 / G, "acceleration_y")),
    ("acceleration_x_scale", 1.6, times(1.6, "acceleration_x")),
    ("acceleration_y_bias", -0.6, plus(-0.6, "acceleration_y")),
    ("acceleration_x_bias", 0.4, plus(0.4, "acceleration_x")),
    ("acceleration_y_lag", 0.3, delayed(0.3, "acceleration_y")),
    ("acceleration_x_lag", -0.3, delayed(-0.3, "acceleration_x")),
    ("steering_scale", DEGREE, steered(DEGREE)),
    ("steering_scale", RATIO, steered(RATIO)),
    ("steering_scale", -1.0 / DEGREE, steered(-1.0 / DEGREE)),
    ("steering_sign", -1.0, steered(-1.0)),
    ("steering_lag", 0.25, delayed(0.25, *STEERING)),
    ("steering_lag", -0.3, delayed(-0.3, *STEERING)),
    ("heading_misaligned", 0.0098, askew(0.0098)),
]
# Those that have no estimate, or none but the factor.
FORMS = [
    ("time_unit", counted(10**3)), ("position_axes", exchanged()), ("position_axes", exchanged(-1.0)),
    ("position_axes", times(-1.0, "x")), ("position_axes", times(-1.0, "y")),
    ("velocity_x_scale", times(-1.0, "velocity_x")), ("velocity_y_scale", times(-1.0, "velocity_y")),
    ("yaw_convention", compass(DEGREE)), ("yaw_convention", times(-1.0, "yaw")),
    ("position_axes", lambda log: exchanged()(compass()(log))),
    ("velocity_axes", lambda log: replace(log, velocity_x=log.velocity_y, velocity_y=log.velocity_x)),
]



@pytest.fixture(scope="module")
def log(leaf):
    return exact_drive(leaf)


def findings(log, car):
    found = check(log, car).findings
    assert len({one.name for one in found}) == len(found)
    return {one.name: one for one in found}


def same_to_print(line, entry):
    """A line to be pasted says what the entry holds, to five digits."""
    if isinstance(entry, dict):
        return set(line) == set(entry) and all(same_to_print(line[key], entry[key]) for key in entry)
    return line == (entry if isinstance(entry, str) else pytest.approx(entry, rel=1e-4))


@pytest.mark.parametrize("seed", range(4))
def test_nothing_is_found_on_a_healthy_drive(car, seed):
    assert check(exact_drive(car, seed=seed), car).findings == ()


@pytest.mark.parametrize(("name", "value", "fault"), FAULTS, ids=[f"{name} {value:.4g}" for name, value, _ in FAULTS])
def test_a_fault_is_measured_and_its_cure_removes_it(log, leaf, name, value, fault):
    wrong = fault(log)
    found = findings(wrong, leaf)
    assert list(found) == [name]
    low, high = found[name].interval
    assert low <= value <= high and low <= found[name].value <= high
    assert high - low < 0.35 * abs(value)
    advice = found[name].advice
    assert advice.kind == "run.yaml" and same_to_print(yaml.safe_load(advice.line), advice.entry)
    assert findings(corrected_drive(wrong, advice.entry, leaf), leaf) == {}


@pytest.mark.parametrize(("name", "fault"), FORMS)
def test_a_wrong_form_is_an_error_and_its_cure_removes_it(log, leaf, name, fault):
    wrong = fault(log)
    found = findings(wrong, leaf)
    assert list(found) == [name] and found[name].severity is Severity.ERROR
    advice = found[name].advice
    assert same_to_print(yaml.safe_load(advice.line.replace("  # and ", "\n")), advice.entry)
    assert findings(corrected_drive(wrong, advice.entry, leaf), leaf) == {}


def of_map(log):
    over_ground = (log.velocity_x + 1j * log.velocity_y) * np.exp(1j * log.yaw)
    return replace(log, velocity_x=over_ground.real, velocity_y=over_ground.imag)


@pytest.mark.parametrize(("name", "fault"), [
    ("velocity_axes", of_map), ("position_scale", times(1.0 / 111e3, *POSITION)),
    ("velocity_axes", lambda log: replace(of_map(log), velocity_x=of_map(log).velocity_y,
                                          velocity_y=of_map(log).velocity_x))])
def test_what_no_run_yaml_mends_is_an_error_all_the_same(log, leaf, name, fault):
    found = findings(fault(log), leaf)
    assert list(found) == [name] and found[name].severity is Severity.ERROR and found[name].advice.kind == "look"
    if name == "position_scale":
        assert found[name].value == pytest.approx(1.0 / 111e3, rel=1e-3)


@pytest.mark.parametrize("channel", ["road_wheel_angle", "yaw_rate"])
def test_a_clipped_channel_is_not_frozen(log, leaf, channel):
    values = getattr(log, channel)
    low, high = np.percentile(values, [10, 90])
    found = findings(replace(log, steering_wheel_angle=None, **{channel: np.clip(values, low, high)}), leaf)
    assert "channel_clipped" in found and "channel_frozen" not in found
    assert found["channel_clipped"].channels == (channel,)


def test_steering_at_its_mechanical_stop_is_not_clipped(log, leaf):
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
    assert "channel_clipped" not in findings(parked, leaf)


def test_steering_that_does_not_follow_the_motion(log, leaf):
    found = findings(replace(log, steering_wheel_angle=None, road_wheel_angle=np.abs(log.road_wheel_angle)), leaf)
    assert list(found) == ["steering_unrelated"]


@pytest.mark.parametrize("seconds", [2.0, -3.0, 6.0])
def test_steering_with_the_stamps_of_another_clock(log, leaf, seconds):
    late = replace(log, steering_time_ns=log.steering_time_ns + round(seconds * 1e9))
    assert {"steering_lag", "steering_unrelated"} & findings(late, leaf).keys()


def test_latitude_and_longitude_decide_that_yaw_and_yaw_rate_count_clockwise(log, leaf):
    known = AuxiliaryData(geographic=True)
    wrong = replace(compass()(log), yaw_rate=-log.yaw_rate)
    (found,) = check(wrong, leaf, known).findings
    assert found.name == "yaw_convention" and same_to_print(yaml.safe_load(found.advice.line), found.advice.entry)
    assert check(corrected_drive(wrong, found.advice.entry, leaf), leaf, known).findings == ()


def test_a_longitude_that_counts_west_is_no_compass_heading(log, leaf):
    known = AuxiliaryData(geographic=True)
    wrong = replace(log, x=-log.x)
    (found,) = check(wrong, leaf, known).findings
    assert found.name == "position_axes" and found.advice.entry == {"correct": {"x": {"scale": -1.0}}}
    assert check(corrected_drive(wrong, found.advice.entry, leaf), leaf, known).findings == ()


@pytest.mark.parametrize(("channels", "name"), [(POSITION, "position_scale"), (VELOCITY, "velocity_scale")])
@pytest.mark.parametrize("factor", [1.05, 0.95])
def test_wheels_decide_between_positions_and_velocity(log, leaf, channels, name, factor):
    wheels = AuxiliaryData(wheel_speed=Series(log.ins_time_ns, log.velocity_x))
    (found,) = check(times(factor, *channels)(log), leaf, wheels).findings
    assert found.name == name and found.interval[0] <= factor <= found.interval[1]
    assert check(corrected_drive(times(factor, *channels)(log), found.advice.entry, leaf), leaf, wheels).findings == ()


@pytest.mark.parametrize("angle", [0.5, -0.7])
def test_a_hand_wheel_that_is_turned_is_cured_in_the_vehicle_file(log, leaf, angle):
    wrong = wheel_turned(angle)(log).with_steering(leaf)
    one = findings(wrong, leaf)["steering_offset"]
    low, high = one.interval
    assert one.advice.kind == "vehicle" and low <= angle / RATIO <= high
    corrected = replace(leaf, **one.advice.entry)
    assert findings(wrong.with_steering(corrected), corrected) == {}


@pytest.mark.parametrize("factor", [1.0, -1.0, DEGREE])
@pytest.mark.parametrize("angle", [0.04, -0.03])
def test_road_wheels_that_are_not_straight_are_cured_in_the_run(log, leaf, factor, angle):
    wrong = steered(factor, factor * angle)(log)
    found = findings(wrong, leaf)
    assert "steering_offset" in found
    entry = {}
    for one in found.values():
        assert one.advice.kind == "run.yaml" and same_to_print(yaml.safe_load(one.advice.line), one.advice.entry)
        entry |= one.advice.entry["correct"]["road_wheel_angle"]
    assert entry["add"] == pytest.approx(-angle, abs=0.002)
    assert findings(corrected_drive(wrong, {"correct": {"road_wheel_angle": entry}}, leaf), leaf) == {}


@pytest.mark.parametrize("ahead", [1.5, -0.8])
def test_a_measuring_point_elsewhere_is_cured_in_the_vehicle_file(log, leaf, ahead):
    wrong = mounted(ahead)(log)
    one = findings(wrong, leaf)["measuring_point"]
    low, high = one.interval
    assert one.advice.kind == "vehicle" and low <= ahead <= high
    assert f"value: {one.advice.entry['cg_to_ins_x']:.2f}" in one.advice.line
    assert findings(wrong, replace(leaf, **one.advice.entry)) == {}


@pytest.mark.parametrize(("first", "second"), [
    (times(1.05, "yaw_rate"), plus(0.05, "yaw_rate")), (times(DEGREE, "yaw_rate"), delayed(0.3, "yaw_rate")),
    (times(DEGREE, "yaw"), times(DEGREE, "yaw_rate")), (compass(DEGREE), times(DEGREE, "yaw_rate")),
    (times(1.01 * 3.28084, *POSITION), plus(0.05, "yaw")),
    (plus(0.02, "yaw"), delayed(0.1, *POSITION)), (steered(-1.0), times(-1.0, "acceleration_y")),
])
def test_two_faults_are_two_findings_and_their_cures_go_together(log, leaf, first, second):
    wrong = second(first(log))
    found = findings(wrong, leaf)
    assert len(found) >= 2
    entry = {}
    for one in found.values():
        for channel, fields in one.advice.entry["correct"].items():
            entry.setdefault(channel, {}).update(fields)
    assert findings(corrected_drive(wrong, {"correct": entry}, leaf), leaf) == {}


@pytest.mark.parametrize(("name", "fault", "least"), [
    ("x_scale", times(1.003, "x"), "note"), ("x_scale", times(0.964, "x"), "warning"),
    ("yaw_rate_bias", plus(0.004, "yaw_rate"), "note"), ("yaw_rate_bias", plus(0.012, "yaw_rate"), "warning"),
    ("velocity_scale", times(3.6, *VELOCITY), "error"),
])
def test_severity_goes_by_what_it_does_to_the_position(log, leaf, name, fault, least):
    one = findings(fault(log), leaf)[name]
    assert one.severity == least
    if name == "x_scale":
        error = abs(one.value - 1.0)
        # Five seconds at 12 m/s, along both axes in turn.
        assert 0.4 * error * 60.0 < one.effect < error * 60.0


@pytest.mark.parametrize("shear", [0.03, -0.03])
def test_a_sheared_map_is_measured(leaf, shear):
    winding = exact_drive(leaf, 90.0, turning=Sines(0.05, ((0.16, 23.0, 0.0), (0.07, 6.1, 0.7))))
    low, high = findings(replace(winding, x=winding.x + shear * winding.y), leaf)["map_shear"].interval
    assert low <= shear <= high


def test_what_no_prediction_depends_on_is_not_the_gravest(log, leaf):
    found = check(plus(0.6, "acceleration_y")(times(0.97, "x")(log)), leaf).findings
    assert [one.name for one in found if one.severity == "warning"] == ["x_scale", "acceleration_y_bias"]
