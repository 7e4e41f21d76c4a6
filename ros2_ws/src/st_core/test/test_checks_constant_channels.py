"""Channels that are constant throughout a recording, and recordings with nearly all time stamps invalid."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from exact_drive import Sines, exact_drive
from exact_faults import findings_by_name, ins_rotated
from st_core.checks import AuxiliaryData, Finding, Severity, check
from st_core.checks.finding import merge_findings
from st_core.log import INS_SIGNALS, OPTIONAL_INS_SIGNALS

CHANNELS = ("x", "y", "yaw", "velocity_x", "velocity_y", "yaw_rate", "acceleration_x", "acceleration_y",
            "road_wheel_angle")
# Paths can be predicted and scored without lateral velocity and without accelerations.
OPTIONAL = {"velocity_y", "acceleration_x", "acceleration_y"}


@pytest.fixture(scope="module")
def log(leaf):
    return replace(exact_drive(leaf), steering_wheel_angle=None)


def with_constant(log, *names, value=0.0):
    return replace(log, **{name: np.full_like(getattr(log, name), value) for name in names})


@pytest.mark.slow
@pytest.mark.parametrize("value", [0.0, 0.3])
@pytest.mark.parametrize("name", CHANNELS)
def test_constant_channel_is_reported(log, leaf, name, value):
    finding = findings_by_name(with_constant(log, name, value=value), leaf)["channel_frozen"]
    assert finding.severity is (Severity.WARNING if name in OPTIONAL else Severity.ERROR)
    assert finding.channels == (name,)
    assert finding.advice.kind == "text"  # leaving out the complete drive is not a correction


@pytest.mark.parametrize("name", [name for name in CHANNELS if name not in ("velocity_y", "road_wheel_angle")])
def test_constant_channel_has_no_consequences(log, leaf, name):
    assert [finding.name for finding in check(with_constant(log, name, value=0.3), leaf).findings] == ["channel_frozen"]


@pytest.mark.parametrize(("name", "turning"), [
    ("x", Sines(0.1 * np.pi, ())), ("y", Sines(0.1 * np.pi, ())), ("yaw", Sines(0.0, ((0.3, 10.0, 0.0),)))])
def test_constant_channel_is_reported_if_the_car_returns(leaf, name, turning):
    lap = exact_drive(leaf, speed=Sines(8.0, ((0.5, 15.0, 0.0),)), turning=turning)
    assert [f.name for f in check(with_constant(lap, name), leaf).findings] == ["channel_frozen"]


@pytest.mark.parametrize("value", [0.0, 0.3])
def test_constant_yaw_rate_with_noise_of_yaw_is_reported(leaf, value):
    """On a straight road, yaw varies by its noise alone, and does not correlate with the yaw rate."""
    straight = exact_drive(leaf, turning=Sines(0.0, ()))
    yaw = straight.yaw + 0.01 * np.random.default_rng(0).standard_normal(len(straight.yaw))
    frozen = with_constant(replace(straight, yaw=yaw), "yaw_rate", value=value)
    assert "yaw_rate" in findings_by_name(frozen, leaf)["channel_frozen"].channels


@pytest.mark.parametrize(("first", "period"), [(0.0, 60.0), (24.0, 60.0), (0.0, 2.0)])
def test_constant_positions_of_a_drive_to_the_north_have_no_direction(leaf, first, period):
    """They are constant throughout, after `first` [s], or for a `period` [s] at a time."""
    east = exact_drive(leaf, turning=Sines(0.0, ((0.05, 8.0, 0.3),)))
    time = (east.ins_time_ns - east.ins_time_ns[0]) * 1e-9
    held = np.where(time < first, time, first + np.floor((time - first) / period) * period)
    rows = np.searchsorted(time, held - 1e-9)
    constant = replace(east, x=-east.y[rows], y=east.x[rows], yaw=east.yaw + np.pi / 2.0)
    names = findings_by_name(constant, leaf).keys()
    assert names & {"channel_frozen", "samples_repeated"} and not names & {"yaw_offset", "x_scale", "y_scale"}


@pytest.mark.slow
@pytest.mark.parametrize("names", list(combinations(CHANNELS, 2)), ids=" and ".join)
def test_two_constant_channels_are_an_error_unless_both_are_optional(log, leaf, names):
    errors = check(with_constant(log, *names), leaf).with_severity(Severity.ERROR)
    assert bool(errors) == (not OPTIONAL.issuperset(names))


def test_duplicate_time_stamps_are_reported_for_few_samples_too(log, leaf):
    stamps = np.repeat(log.ins_time_ns[:30], 20)
    found, = check(log.select_ins(np.arange(30)), leaf, AuxiliaryData({"INS": stamps})).findings
    assert found.name == "time_duplicates" and found.value == pytest.approx(0.95, abs=0.01)


def test_gaps_are_measured_in_the_corrected_time_unit(log, leaf):
    slow = replace(log, ins_time_ns=1000 * log.ins_time_ns, steering_time_ns=1000 * log.steering_time_ns)
    assert [finding.name for finding in check(slow, leaf).with_severity(Severity.ERROR)] == ["time_unit"]
    kept = np.ones(len(log.x), bool)
    kept[100:101] = False
    assert "time_gaps" not in {finding.name for finding in check(slow.select_ins(kept), leaf).findings}


def test_only_findings_of_equal_severity_are_merged():
    finding = Finding("channel_frozen", Severity.WARNING, ("velocity_y",), "velocity_y is constant", 0.0)
    other = replace(finding, severity=Severity.ERROR, channels=("yaw_rate",), statement="yaw_rate is constant")
    assert merge_findings([finding, other]) == [finding, other]
    (merged,) = merge_findings([finding, replace(other, severity=Severity.WARNING)])
    assert merged.channels == ("velocity_y", "yaw_rate")


def test_long_standstill_gives_no_finding_about_velocity_axes(log, leaf):
    rows = len(log.x)
    constant = {name: np.concatenate([np.full(2 * rows, getattr(log, name)[0]), getattr(log, name)])
             for name in ("x", "y", "yaw", "road_wheel_angle")}
    moving = {name: np.concatenate([np.zeros(2 * rows), getattr(log, name)])
              for name in ("velocity_x", "velocity_y", "yaw_rate", "acceleration_x", "acceleration_y")}
    times = log.ins_time_ns[0] + 10_000_000 * np.arange(3 * rows)
    long = replace(log, ins_time_ns=times, steering_time_ns=times + 5_000_000, **constant, **moving)
    found = check(long, leaf).findings
    assert "velocity_axes" not in [finding.name for finding in found]


def test_jumping_acceleration_is_not_also_reported_as_constant(log, leaf):
    """It is left out, so that no rows of other channels are left out for its constant part."""
    time = (log.ins_time_ns - log.ins_time_ns[0]) * 1e-9
    jumping = log.acceleration_y + 25.0 * (np.floor(time / 2.0) % 2)
    jumping[time > 0.6 * time[-1]] = 12.0
    faulty = check(replace(log, acceleration_y=jumping), leaf)
    names = {finding.name for finding in faulty.findings if "acceleration_y" in finding.channels}
    assert "channel_jumps" in names and "channel_frozen" not in names
    estimates = check(replace(log, acceleration_y=None), leaf).estimates
    assert {name: faulty.estimates[name] for name in estimates} == estimates


def test_model_car_on_circles_of_constant_steering_has_no_error(log, leaf):
    """Bends of 3 rad/s: in a second, the path is far longer than the distance between its ends. With increasing speed,
    the tyres increase the radius, and the speed passes the limit below which the curvature is not judged."""
    time = (log.ins_time_ns - log.ins_time_ns[0]) * 1e-9
    speed = 1.2 + 1.4 * time / time[-1]
    yaw_rate = speed / (0.6 * (1.0 + 0.03 * speed**2))
    yaw = np.concatenate(([0.0], np.cumsum(np.diff(time) * 0.5 * (yaw_rate[1:] + yaw_rate[:-1]))))
    x, y = (np.concatenate(([0.0], np.cumsum(np.diff(time) * 0.5 * (v[1:] + v[:-1]))))
            for v in (speed * np.cos(yaw), speed * np.sin(yaw)))
    angle = np.full_like(log.road_wheel_angle, 0.3)
    circles = replace(log, x=x, y=y, yaw=yaw, velocity_x=speed, velocity_y=np.zeros_like(x), yaw_rate=yaw_rate,
                      acceleration_x=None, acceleration_y=None, road_wheel_angle=angle)
    found = {finding.name: finding for finding in check(circles, leaf).findings}
    assert not found.keys() & {"velocity_scale", "velocity_x_scale", "x_scale", "y_scale", "position_scale"}, found
    assert "road_wheel_angle" not in [channel for finding in found.values() if finding.name == "channel_frozen"
                                      for channel in finding.channels]


def test_constant_position_of_a_stationary_car_is_not_a_fault(log, leaf):
    """A receiver reports 0.3 m/s while the car waits for 20 s."""
    first = 600
    wait = {name: np.insert(getattr(log, name), first, np.full(2000, getattr(log, name)[first]))
            for name in ("x", "y", "yaw", "velocity_x", "velocity_y", "yaw_rate", "acceleration_x", "acceleration_y",
                         "road_wheel_angle")}
    wait["velocity_x"][first:first + 2000] = 0.3
    times = log.ins_time_ns[0] + 10_000_000 * np.arange(len(wait["x"]))
    found = check(replace(log, ins_time_ns=times, steering_time_ns=times, **wait), leaf).findings
    assert not [f for f in found if f.name == "channel_frozen" and {"x", "y"} & set(f.channels)], found


@pytest.mark.parametrize("name", ["x", "y"])
def test_altitude_in_place_of_a_horizontal_axis_is_one_error(log, leaf, name):
    time = (log.ins_time_ns - log.ins_time_ns[0]) * 1e-9
    altitude = 3.0 * np.sin(time / 10.0) + 0.01 * np.random.default_rng(0).standard_normal(len(time))
    (error,) = check(replace(log, **{name: altitude}), leaf).with_severity(Severity.ERROR)
    assert (error.name, error.channels) == ("position_axes", (name,)) and "altitude" in error.text
    assert not findings_by_name(replace(log, **{name: 0.001 * getattr(log, name)}), leaf).keys() & {"position_axes"}


@pytest.mark.parametrize("seconds", [0.5, 2.0])
def test_rows_that_repeat_the_previous_one_are_frozen_and_no_jumps(log, leaf, seconds):
    time, row = (log.ins_time_ns - log.ins_time_ns[0]) * 1e-9, np.arange(len(log.x))
    source = np.maximum.accumulate(np.where(time % 20.0 > 20.0 - seconds, 0, row))
    held = {name: getattr(log, name)[source] for name in (*INS_SIGNALS, *OPTIONAL_INS_SIGNALS)}
    (finding,) = check(replace(log, **held), leaf).findings
    assert (finding.name, finding.channels) == ("channel_frozen", INS_SIGNALS)
    assert finding.severity is Severity.WARNING and finding.advice.entry.keys() == {"leave_out"}
    turned = ins_rotated(0.03)(log)  # the rear axle is still compared with the rest of the drive
    held = {name: getattr(turned, name)[source] for name in held}
    assert findings_by_name(replace(turned, **held), leaf).keys() == {"channel_frozen", "heading_misaligned"}
