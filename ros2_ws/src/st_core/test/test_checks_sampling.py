"""How a recording was sampled: rounding, held and frozen channels, stamps, gaps, rows without a value, jumps, age."""

import re
from dataclasses import replace

import numpy as np
import pytest
from exact_drive import SPEED, Noise, Sines, exact_drive
from st_core.checks import AuxiliaryData, Severity, check
from st_core.checks.sampling import resolution
from st_core.corrections import apply_corrections


@pytest.fixture(scope="module")
def log(leaf):
    return exact_drive(leaf, 40.0)


def found(log, car=None, auxiliary=None):
    return {one.name: one for one in check(log, car, auxiliary).findings}


@pytest.mark.parametrize("step", [1e-4, 0.02, 3.0])
def test_resolution_of_rounded_values(step):
    time = np.arange(0.0, 20.0, 0.01)
    values = 30.0 * step * np.sin(time) + step * np.random.default_rng(0).standard_normal(len(time))
    assert resolution(time, np.round(values / step) * step) == pytest.approx(step, rel=1e-6)
    assert resolution(time, values) == 0.0


@pytest.mark.parametrize(("rate", "expected"), [(1.0, True), (5.0, True), (10.0, False), (20.0, False)])
def test_a_recording_that_is_too_slow_for_predictions_is_named(leaf, rate, expected):
    found = [one.text for one in check(exact_drive(leaf, seconds=120.0, rate=rate), leaf).findings
             if one.name == "time_gaps"]
    assert bool(found) == expected and all("predictions need one in 0.1 s: nothing is scored" in t for t in found)



def test_an_even_motion_is_not_rounded():
    time = np.arange(0.0, 20.0, 0.01)
    assert resolution(time, 12.3 * time) == 0.0
    assert resolution(time, np.sin(time)) == 0.0
    assert resolution(time, np.zeros(len(time))) == 0.0
    noise = np.random.default_rng(0).normal(0.0, 1e-3, len(time))
    lost = np.delete(np.arange(len(time)), np.arange(5, len(time), 11))  # as packets of a UDP stream
    assert resolution(time[lost], (12.3 * time + noise)[lost]) == 0.0


def test_channels_say_what_was_recorded(leaf):
    drive = exact_drive(leaf, 40.0, rate=50.0, noise=Noise(yaw_rate=0.004))
    known = check(drive, auxiliary=AuxiliaryData(missing={"yaw_rate": 7})).channels
    assert known["yaw_rate"].rate == pytest.approx(50.0) and known["yaw_rate"].samples == 2000
    assert known["yaw_rate"].noise == pytest.approx(0.004, rel=0.1) and known["yaw_rate"].missing == 7
    assert known["x"].gaps == 0 and known["x"].longest_gap == pytest.approx(0.02)
    assert known["yaw_rate"].unit == "rad/s" and known["road_wheel_angle"].repeated < 0.01


@pytest.mark.parametrize(("channel", "coarse", "fine"), [
    ("x", 0.5, 0.01), ("yaw", np.deg2rad(1.0), np.deg2rad(0.01)), ("velocity_x", 0.2, 0.005)])
def test_rounding_that_matters_is_told(log, channel, coarse, fine):
    def rounded(step):
        return replace(log, **{channel: np.round(getattr(log, channel) / step) * step})
    one = found(rounded(coarse))["resolution_coarse"]
    assert one.channels == (channel,) and one.value == pytest.approx(coarse, rel=1e-6)
    assert "resolution_coarse" not in found(rounded(fine))


@pytest.mark.parametrize(("every", "severity"), [(4, Severity.NOTE), (10, Severity.WARNING)])
def test_a_channel_held_at_a_lower_rate(log, every, severity):
    rows = np.arange(len(log.x)) // every * every
    one = found(replace(log, acceleration_y=log.acceleration_y[rows]))["samples_repeated"]
    assert one.channels == ("acceleration_y",) and one.severity is severity
    assert one.value == pytest.approx(1.0 - 1.0 / every, abs=0.01)
    assert f"{100.0 / every:.3g} Hz" in one.text


def frozen(log, channel, begin, end):
    values = getattr(log, channel).copy()
    steering = channel == "road_wheel_angle"
    time_ns = log.steering_time_ns if steering else log.ins_time_ns
    since = (time_ns - log.ins_time_ns[0]) * 1e-9
    inside = (since >= begin) & (since <= end)
    values[inside] = values[inside][0]
    return replace(log, **{channel: values}, **({"steering_wheel_angle": None} if steering else {}))


@pytest.mark.parametrize("channel", ["x", "yaw", "velocity_x", "yaw_rate", "acceleration_y", "road_wheel_angle"])
def test_a_channel_that_stands_still_while_the_car_moves(log, leaf, channel):
    one = found(frozen(log, channel, 10.0, 16.0), leaf)["channel_frozen"]
    assert one.channels == (channel,) and one.value == pytest.approx(6.0, abs=0.05)
    assert one.where == (pytest.approx((10.0, 16.0), abs=0.05),)
    if channel != "road_wheel_angle":
        assert one.advice.entry == {"leave_out": [[pytest.approx(10.0, abs=0.05), pytest.approx(16.0, abs=0.05)]]}


def test_a_channel_may_stand_still_when_nothing_changes(leaf):
    straight = exact_drive(leaf, 40.0, turning=Sines(0.0, ()))
    assert found(frozen(straight, "yaw_rate", 10.0, 16.0)) == {}
    assert found(frozen(straight, "yaw", 10.0, 16.0)) == {}
    even = exact_drive(leaf, 40.0, speed=Sines(SPEED.mean, ()))
    assert found(frozen(even, "velocity_x", 10.0, 16.0)) == {}


def test_stamps_that_go_back_or_are_there_twice(log):
    stamps = log.ins_time_ns.copy()
    stamps[100:200:10] = stamps[99:199:10]
    stamps[1000] = stamps[990]
    findings = found(log, auxiliary=AuxiliaryData(stamps={"INS": stamps}))
    assert findings["time_duplicates"].value == pytest.approx(10 / len(stamps))
    assert findings["time_order"].value == pytest.approx(1 / len(stamps))
    assert {one.severity for one in findings.values()} == {Severity.NOTE}
    assert findings["time_order"].where == (pytest.approx((9.99, 9.99)),)  # the newest stamp before
    assert found(log, auxiliary=AuxiliaryData(stamps={"INS": log.ins_time_ns, "steering": log.steering_time_ns})) == {}


@pytest.mark.parametrize(("seconds", "severity"), [(1.0, Severity.NOTE), (4.0, Severity.WARNING)])
def test_gaps(log, leaf, seconds, severity):
    since = (log.ins_time_ns - log.ins_time_ns[0]) * 1e-9
    findings = found(log.select_ins((since < 15.0) | (since >= 15.0 + seconds)), leaf)
    assert list(findings) == ["time_gaps"]
    gaps = findings["time_gaps"]
    assert gaps.severity is severity and gaps.value == pytest.approx(seconds, abs=0.02)
    assert gaps.where == (pytest.approx((15.0, 15.0 + seconds), abs=0.02),)


@pytest.mark.parametrize(("rows", "severity"), [(3, Severity.NOTE), (400, Severity.WARNING)])
def test_rows_without_a_value(log, rows, severity):
    kept = np.ones(len(log.x), bool)
    kept[np.random.default_rng(1).choice(len(kept), rows, replace=False)] = False
    one = found(log.select_ins(kept), auxiliary=AuxiliaryData(missing={"yaw_rate": rows}))["values_missing"]
    assert one.channels == ("yaw_rate",) and one.severity is severity
    assert one.value == pytest.approx(rows / len(log.x))


def steered(log, kept):
    """A log and its one finding, of rows of which only the kept ones hold a steering angle."""
    less = replace(log, steering_time_ns=log.steering_time_ns[kept], road_wheel_angle=log.road_wheel_angle[kept],
                   steering_wheel_angle=log.steering_wheel_angle[kept])
    missing = len(log.steering_time_ns) - len(less.steering_time_ns)
    auxiliary = AuxiliaryData({"INS": log.steering_time_ns}, missing={"road_wheel_angle": missing})
    return found(less, auxiliary=auxiliary)["values_missing"]


def test_a_slower_sensor_in_the_same_rows_lacks_nothing(log):
    one = steered(log, np.arange(len(log.steering_time_ns)) % 4 == 0)
    assert one.severity is Severity.NOTE and "25 Hz" in one.text
    assert one.value == pytest.approx(0.75, abs=0.01)


@pytest.mark.parametrize("hole", [(0.0, 0.4), (0.0, 0.5), (0.3, 0.7)])
def test_a_hole_is_no_slower_sensor(log, hole):
    place = np.linspace(0.0, 1.0, len(log.steering_time_ns))
    one = steered(log, (place < hole[0]) | (place > hole[1]))
    assert one.severity is Severity.WARNING and "have no usable value" in one.text


@pytest.mark.parametrize(("channel", "share"), [("road_wheel_angle", 0.5), ("yaw_rate", 0.5), ("acceleration_x", 1.0)])
def test_the_share_is_of_the_rows_there_were(log, channel, share):
    count = len(log.steering_time_ns if channel == "road_wheel_angle" else log.x)
    assert found(log, auxiliary=AuxiliaryData(missing={channel: count}))["values_missing"].value == pytest.approx(share)


def test_positions_held_at_a_lower_rate_do_not_jump(log):
    rows = np.arange(len(log.x)) // 10 * 10
    assert list(found(replace(log, x=log.x[rows], y=log.y[rows]))) == ["samples_repeated"]


@pytest.mark.parametrize(("size", "end", "stretches"), [
    (0.3, 20.0, [12.205, 12.485, 19.855, 20.135]), (2.0, 20.0, [12.205, 12.485, 19.855, 20.135]),
    (5.0, 12.40, [12.205, 12.535])])  # to and fro within a moment: what is between is wrong too
def test_positions_that_jump(log, size, end, stretches):
    since = (log.ins_time_ns - log.ins_time_ns[0]) * 1e-9
    away = size * ((since >= 12.345) & (since < end - 0.001))
    wrong = replace(log, x=log.x + 0.6 * away, y=log.y - 0.8 * away)
    one = found(wrong)["position_jumps"]
    assert one.value == 2.0
    assert float(re.search(r"largest ([\d.]+) m", one.text)[1]) == pytest.approx(size, abs=0.02)
    assert one.where == (pytest.approx((12.34, 12.35)), pytest.approx((end - 0.01, end)))
    left_out = one.advice.entry["leave_out"]
    assert np.ravel(left_out) == pytest.approx(stretches, abs=0.011)
    assert "position_jumps" not in found(apply_corrections(wrong, {}, None, left_out))


def test_positions_that_jump_all_the_time(log):
    since = (log.ins_time_ns - log.ins_time_ns[0]) * 1e-9
    one = found(replace(log, x=log.x + 0.5 * (np.floor(2.0 * since) % 2)))["position_jumps"]
    assert one.value > 50 and one.advice.kind == "look"


@pytest.mark.parametrize("share", [0.1, 0.3, 0.5, 0.7])
def test_positions_one_sample_old(log, share):
    old = np.random.default_rng(3).random(len(log.x)) < share
    old[0] = False
    rows = np.arange(len(old)) - old
    one = found(replace(log, x=log.x[rows], y=log.y[rows]))["position_stale"]
    steps_back = np.mean(old[1:] & ~old[:-1])
    assert one.interval[0] <= steps_back <= one.interval[1] and one.severity is Severity.WARNING
    # By one interval of 10 ms, whatever the speed.
    assert one.effect == pytest.approx(0.01 * np.median(log.velocity_x), rel=0.3)


@pytest.mark.parametrize("deviation", [0.003, 0.01])
def test_stamps_that_jitter_against_the_motion(leaf, deviation):
    drive = exact_drive(leaf, 40.0, rate=20.0)
    late_ns = np.round(1e9 * np.clip(deviation * np.random.default_rng(5).standard_normal(len(drive.x)), -0.02, 0.02))
    one = found(replace(drive, ins_time_ns=drive.ins_time_ns + late_ns.astype(np.int64)))["time_jitter"]
    assert one.value == pytest.approx(float(np.std(np.diff(late_ns))) * 1e-9, rel=0.1)
    assert "time_jitter" not in found(drive)


def test_uneven_stamps_of_an_uneven_recording_are_right(leaf):
    """Samples left out here and there: the motion between them is as long as the stamps say."""
    drive = exact_drive(leaf, 40.0)
    kept = np.random.default_rng(7).random(len(drive.x)) < 0.7
    assert found(drive.select_ins(kept), leaf) == {}
