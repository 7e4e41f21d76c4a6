"""Faults that begin during a drive, and faults of several channels that have one cause."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from exact_drive import Sines, delay, exact_drive
from exact_faults import biased, corrected_drive, findings_by_name, scaled
from st_core.checks import AuxiliaryData, DriveCheck, Finding, Severity, check, units_and_axes
from st_core.checks.check import MIN_INS_SAMPLES, _report_changes
from st_core.checks.finding import neutral_value
from st_core.checks.motion import Motion
from st_core.checks.vehicle_relations import check_rear_axle
from st_core.handling import rear_slip_coefficient
from st_core.log import DriveLog
from support import read_car, shared

SLOW = {"speed": Sines(6.0, ((1.5, 21.0, 0.4), (0.5, 7.0, 1.1)))}


def seconds_of(log):
    return (log.ins_time_ns - log.ins_time_ns[0]) * 1e-9


def read_real_drive(name):
    rows = np.genfromtxt(shared(f"data/hyundai_genesis_oxts/{name}.csv"), delimiter=",", names=True)
    time = np.round(rows["t"] * 1e9).astype(np.int64)
    return DriveLog(name, time, *(rows[key] for key in ("x", "y", "yaw", "vx", "vy", "yaw_rate")), time, rows["delta"],
                    acceleration_x=rows["ax"], acceleration_y=rows["ay"])


def late_in_second_half(log, seconds, channel):
    """The drive with a channel that is late in its second half only."""
    is_steering = channel.endswith("angle")
    time = (log.steering_time_ns - log.ins_time_ns[0]) * 1e-9 if is_steering else seconds_of(log)
    values = np.interp(time - np.where(time < 0.5 * time[-1], 0.0, seconds), time, getattr(log, channel))
    other = {"steering_wheel_angle": None} if is_steering else {}
    return replace(log, **{channel: values}, **other)


@pytest.mark.slow
@pytest.mark.parametrize("seconds", [0.4, -0.4])
def test_latency_of_the_steering_that_changes_is_not_a_clock_of_another_rate(leaf, seconds):
    log = late_in_second_half(exact_drive(leaf, 200.0, rate=20.0), seconds, "road_wheel_angle")
    checked = check(log, leaf)
    (finding,) = checked.findings
    assert finding.name == "steering_lag" and finding.interval[0] < seconds < finding.interval[1]
    assert finding.text.startswith("in the last 100 s of the drive, ") and finding.advice.kind == "text"
    assert "steering_lag" not in checked.estimates


@pytest.mark.slow
def test_latency_of_the_yaw_rate_that_changes_is_not_one_of_the_steering(leaf):
    log = late_in_second_half(exact_drive(leaf, 200.0, rate=20.0), 0.3, "yaw_rate")
    assert not {"time_rate", "steering_lag"} & findings_by_name(log, leaf).keys()
    late = findings_by_name(delay(log, 0.4, "road_wheel_angle"), leaf)["steering_lag"]
    assert late.interval[0] < 0.4 < late.interval[1]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "rate"), [("cpg_lap_medium", 0.999), ("cpg_lap_fast", 1.003)])
def test_steering_clock_of_another_rate_is_no_step_in_real_drives(name, rate):
    log = read_real_drive(name)
    log = replace(log, steering_time_ns=np.round(rate * log.ins_time_ns).astype(np.int64))
    found = findings_by_name(log, read_car("hyundai_genesis"))
    assert found["time_rate"].channels == ("road_wheel_angle",) and "steering_lag" not in found


@pytest.mark.slow
def test_noise_of_yaw_does_not_hide_a_steering_clock_of_another_rate(leaf):
    log = exact_drive(leaf, 200.0, rate=20.0)
    start = log.steering_time_ns[0]
    wrong = replace(log, steering_time_ns=start + np.round(1.002 * (log.steering_time_ns - start)).astype(np.int64),
                    yaw=log.yaw + 0.02 * np.random.default_rng(0).standard_normal(len(log.yaw)))
    assert "time_rate" in findings_by_name(wrong, leaf)


@pytest.mark.parametrize("seconds", [0.1, -0.1])
def test_clock_that_is_set_is_an_alternative_to_a_jump_of_the_positions(leaf, seconds):
    log = exact_drive(leaf)
    stamps = log.ins_time_ns + np.where(seconds_of(log) > 30.0, round(seconds * 1e9), 0)
    rows = np.append(True, np.diff(np.maximum.accumulate(stamps)) > 0)  # the reader leaves out the others
    found = findings_by_name(replace(log.select_ins(rows), ins_time_ns=stamps[rows]))
    jumps = found.pop("position_jumps")
    assert not found and jumps.text.endswith(f", or the clock jumped by {seconds:+.2f} s: both fit this drive")
    sideways = replace(log, y=log.y + np.where(seconds_of(log) > 30.0, 2.0, 0.0))
    assert findings_by_name(sideways)["position_jumps"].alternatives == ()


def test_change_of_the_map_zone_is_a_jump_only(leaf):
    log = exact_drive(leaf)
    (finding,) = check(replace(log, x=log.x + np.where(seconds_of(log) > 30.0, 3e5, 0.0)), leaf).findings
    assert finding.name == "position_jumps"


def test_speed_without_a_sign_in_reverse_is_not_a_yaw_that_points_backwards(leaf):
    log = exact_drive(leaf, speed=Sines(-6.0, ((1.5, 21.0, 0.4),)))
    found = findings_by_name(scaled(-1.0, "velocity_x")(log), leaf)
    assert found.keys() == {"velocity_x_scale"} and found["velocity_x_scale"].value == pytest.approx(-1.0, abs=0.01)
    backwards = findings_by_name(replace(exact_drive(leaf), yaw=exact_drive(leaf).yaw + np.pi), leaf)
    assert backwards.keys() == {"yaw_offset"}


def test_small_lag_of_yaw_does_not_explain_a_distant_reference_point(leaf):
    log = delay(exact_drive(leaf, **SLOW), 0.03, "yaw_rate")
    found = findings_by_name(replace(log, velocity_y=np.zeros(len(log.x)), acceleration_y=None), leaf)
    assert found["position_reference"].alternatives == ()


def test_motion_at_standstill_has_the_recorded_yaw_rate(leaf):
    """The gyroscope drifts; the mean bias is larger than the yaw rate that it reports at standstill."""
    log = exact_drive(leaf, 60.0, rate=20.0)
    count = np.arange(-300, len(log.x))
    place = {name: getattr(log, name)[np.maximum(count, 0)] for name in ("x", "y", "yaw")}
    motion = {name: np.where(count > 0, getattr(log, name)[np.maximum(count, 0)], 0.0)
              for name in ("velocity_x", "velocity_y", "yaw_rate")}
    motion["yaw_rate"] += 0.02 * np.clip(5.0 * count / len(log.x), 0.0, 1.0)
    found = findings_by_name(replace(log, **place, **motion, ins_time_ns=log.ins_time_ns[0] + 50_000_000 * count,
                                     acceleration_x=None, acceleration_y=None))
    assert "standstill_motion" not in found and found["yaw_rate_bias"].severity is not Severity.ERROR


MIRRORED = {"yaw": (-1.0, 0.5 * np.pi), "yaw_rate": (-1.0, 0.0), "velocity_y": (-1.0, 0.0),
            "acceleration_y": (-1.0, 0.0)}


def with_z_down(log, *unchanged, positions=False):
    """The drive with the axes of an INS whose z axis points down: yaw clockwise from north, right positive."""
    signals = {name: factor * getattr(log, name) + offset for name, (factor, offset) in MIRRORED.items()
               if name not in unchanged}
    return replace(log, **signals, **({"x": log.y, "y": log.x} if positions else {}))


@pytest.mark.parametrize("unchanged", [(), ("acceleration_y",), ("velocity_y",)])
def test_ins_with_z_down_is_one_finding(leaf, unchanged):
    log = exact_drive(leaf, 60.0)
    (finding,) = check(with_z_down(log, *unchanged), leaf).findings
    assert finding.name == "yaw_convention" and set(finding.channels) == MIRRORED.keys() - {*unchanged}
    assert check(corrected_drive(with_z_down(log, *unchanged), finding.advice.entry, leaf), leaf).findings == ()


def test_ins_and_map_with_z_down_are_one_finding(leaf):
    log = exact_drive(leaf, 60.0)
    both = with_z_down(log, positions=True)
    (finding,) = check(both, leaf).findings  # no channel shows which one is mirrored
    assert finding.name == "steering_sign" and "x north, y east, right positive" in finding.text
    assert check(corrected_drive(both, finding.advice.entry, leaf), leaf).findings == ()
    left = with_z_down(log, "acceleration_y", positions=True)
    (finding,) = check(left, leaf).findings
    assert finding.name == "position_axes" and "x is north, y east" in finding.text
    assert check(corrected_drive(left, finding.advice.entry, leaf), leaf).findings == ()
    (finding,) = check(both, leaf, AuxiliaryData(geographic=True)).findings
    assert finding.name == "steering_sign" and not finding.alternatives


def test_velocity_in_a_map_with_z_down_names_the_columns(leaf):
    log = exact_drive(leaf, 60.0)
    ned = with_z_down(log, positions=True)
    velocity = (ned.velocity_x + 1j * ned.velocity_y) * np.exp(1j * ned.yaw)
    found = findings_by_name(replace(ned, velocity_x=velocity.real, velocity_y=velocity.imag), leaf)
    assert set(found) == {"velocity_axes", "steering_sign"} and "along x and y" in found["velocity_axes"].text


def in_second_half(log, values):
    """The values in the second half of the drive, 0 in the first."""
    return np.where(seconds_of(log) > 0.5 * seconds_of(log)[-1], values, 0.0)


CHANGES = {
    "yaw_rate_lag": lambda log: late_in_second_half(log, 0.3, "yaw_rate"),
    "yaw_lag": lambda log: late_in_second_half(log, 0.3, "yaw"),
    "yaw_offset": lambda log: replace(log, yaw=log.yaw + in_second_half(log, 0.03)),
    "yaw_rate_bias": lambda log: replace(log, yaw_rate=log.yaw_rate + in_second_half(log, 0.02)),
    "yaw_rate_scale": lambda log: replace(log, yaw_rate=log.yaw_rate * (1.0 - in_second_half(log, 2.0))),
    "velocity_scale": lambda log: replace(log, velocity_x=log.velocity_x * (1.0 + in_second_half(log, 0.08))),
    "steering_offset": lambda log: replace(log, steering_wheel_angle=None,
                                           road_wheel_angle=log.road_wheel_angle + in_second_half(log, 0.05)),
}


@pytest.mark.parametrize("name", CHANGES)
def test_fault_that_begins_or_grows_is_found_in_the_second_half(leaf, name):
    log = CHANGES[name](exact_drive(leaf, 160.0, rate=20.0))
    finding, *others = [one for one in check(log, leaf).findings if one.severity is not Severity.NOTE]
    assert finding.name == name and not others and finding.advice.kind == "text"
    assert finding.text.startswith("in the last 80 s of the drive, ") and "; in the first 80 s" in finding.text
    assert finding.times == (pytest.approx((80.0, 160.0), abs=0.1),)


@pytest.mark.parametrize("name", sorted(CHANGES.keys() - {"yaw_lag", "yaw_offset"}))
def test_fault_that_begins_is_found_while_yaw_drifts(leaf, name):
    log = CHANGES[name](exact_drive(leaf, 160.0, rate=20.0))
    found = findings_by_name(replace(log, yaw=log.yaw + 4e-4 * seconds_of(log)), leaf)
    assert found.keys() == {name, "yaw_drift"}
    assert found[name].times == (pytest.approx((80.0, 160.0), abs=0.1),) and found[name].advice.kind == "text"
    assert not found["yaw_drift"].times and found["yaw_drift"].value == pytest.approx(4e-4, rel=0.02)


VARIATIONS = {
    "yaw_wander": lambda log, u: replace(log, yaw=log.yaw + np.deg2rad(2.0) * np.sin(2.0 * np.pi * u)),
    "position_lag": lambda log, u: replace(log, **{name: np.interp(
        u - 0.3 / log.duration * np.clip(10.0 - 50.0 * np.abs(u - 0.5), 0.0, 1.0), u, getattr(log, name))
        for name in ("x", "y")}),
    "velocity_scale": lambda log, u: replace(log, velocity_x=log.velocity_x * (1.0 + 0.06 * u)),
    "yaw_wander of iron near a compass": lambda log, _: replace(
        log, yaw=log.yaw + 0.05 * np.sin(log.yaw) + 0.03 * np.cos(2.0 * log.yaw + 0.3)),
    "yaw_wander of soft iron": lambda log, _: replace(log, yaw=log.yaw + 0.03 * np.sin(2.0 * log.yaw)),
}


@pytest.mark.parametrize("drive", ["cpg_lap_fast_controlled", "cpg_low_speed_a"])
@pytest.mark.parametrize("name", VARIATIONS)
def test_fault_that_varies_during_a_real_drive_is_named_alone(name, drive):
    log, car = read_real_drive(drive), read_car("hyundai_genesis")
    wrong = VARIATIONS[name](log, seconds_of(log) / log.duration)
    before, after = ({f.name: f for f in check(each, car).with_severity(Severity.WARNING)} for each in (log, wrong))
    assert after.keys() - before.keys() == {finding := name.split()[0]}
    assert after[finding].advice.kind == "text" and not after[finding].interval
    assert ("heading" in after[finding].text) is ("iron" in name)
    assert not check(wrong, car).with_severity(Severity.ERROR)


def driven_back(log):
    """The path of a drive, of which the car drives back a part in the middle; it stops for 0.5 s before and after."""
    step, ramp = 0.02, 0.5 - 0.5 * np.cos(np.pi * np.arange(100) / 100)
    speed = np.concatenate([sign * np.concatenate([ramp, np.ones(round(share * log.duration / step)), ramp[::-1],
                                                   np.zeros(25)]) for sign, share in ((1, 0.6), (-1, 0.2), (1, 0.3))])
    instants = np.cumsum(speed) * step
    time = log.ins_time_ns[0] + (np.arange(len(speed)) * step * 1e9).astype(np.int64)
    at = {name: np.interp(instants, seconds_of(log), values) for name in log.__dataclass_fields__
          if isinstance(values := getattr(log, name), np.ndarray) and "time" not in name}
    at |= {name: speed * at[name] for name in ("velocity_x", "velocity_y", "yaw_rate")}
    at |= {"acceleration_x": None, "acceleration_y": None}
    return replace(log, **at, ins_time_ns=time, steering_time_ns=time)


@pytest.mark.parametrize("drive", ["cpg_lap_medium", "rfs_turn_b"])
def test_speed_without_a_sign_in_reverse_is_named_alone(drive):
    log, car = driven_back(read_real_drive(drive)), read_car("hyundai_genesis")
    signed = findings_by_name(log, car)
    found = findings_by_name(replace(log, velocity_x=np.abs(log.velocity_x)), car)
    assert found.keys() - signed.keys() == {"velocity_x_scale"}
    ((first, last),) = found["velocity_x_scale"].times
    reverse = seconds_of(log)[log.velocity_x < 0.0]
    assert (first, last) == pytest.approx((reverse[0], reverse[-1]), abs=0.6)
    assert found["velocity_x_scale"].advice.entry["leave_out"] == [[round(first, 1), round(last, 1)]]


def test_positions_that_jump_back_at_a_stop_are_no_speed_with_the_wrong_sign():
    """A bias of the speed of 1 cm/s has the opposite sign of the jump."""
    log, car = driven_back(read_real_drive("rfs_turn_b")), read_car("hyundai_genesis")
    direction, speed = np.sign(log.velocity_x), np.abs(log.velocity_x)
    last = int(np.flatnonzero(direction < 0.0)[0])  # the car waits for 3 s, instead of driving back
    rows = np.concatenate([np.arange(last), np.full(300, last - 1), np.arange(last)[::-1]])
    heading = np.exp(1j * log.yaw[last - 1]) * np.where(np.arange(len(rows)) < last + 150, 0.0, -3.0)
    time = log.ins_time_ns[0] + np.arange(len(rows)) * 20_000_000
    turn = np.where(np.arange(len(rows)) < last + 300, 1.0, -1.0)
    wrong = replace(log, ins_time_ns=time, steering_time_ns=time, x=log.x[rows] + heading.real,
                    y=log.y[rows] + heading.imag, yaw=log.yaw[rows], velocity_x=turn * speed[rows] + 0.01,
                    velocity_y=turn * log.velocity_y[rows], yaw_rate=turn * log.yaw_rate[rows],
                    road_wheel_angle=log.road_wheel_angle[rows])
    assert "velocity_x_scale" not in findings_by_name(wrong, car)


@pytest.mark.parametrize(("change", "name"), [
    (lambda angle: angle, None), (lambda angle: -angle, "steering_sign"), (np.rad2deg, "steering_scale"),
    (lambda angle: angle + 0.05, "steering_offset")])
def test_steering_is_checked_in_reverse(change, name):
    log, car = read_real_drive("cpg_low_speed_a"), read_car("hyundai_genesis")
    reverse = {key: -getattr(log, key)[::-1] for key in ("velocity_x", "velocity_y", "yaw_rate")}
    log = replace(log, **{key: getattr(log, key)[::-1] for key in ("x", "y", "yaw")}, **reverse, acceleration_x=None,
                  acceleration_y=None, road_wheel_angle=change(log.road_wheel_angle[::-1]))
    found = {f.name for f in check(log, car).findings if f.severity is not Severity.NOTE}
    assert {each for each in found if each.startswith("steering")} == ({name} if name else set())


@pytest.mark.parametrize(("name", "other"), [("x", "y"), ("y", "x")])
@pytest.mark.parametrize("offset", [0.5 * np.pi, -0.5 * np.pi, 0.5, 0.03])
def test_wrong_yaw_on_a_straight_along_an_axis_is_no_constant_position(leaf, name, other, offset):
    log = exact_drive(leaf, 60.0, turning=Sines(0.0, ()))
    distance = np.hypot(log.x - log.x[0], log.y - log.y[0])
    heading = {"x": 0.0, "y": 0.5 * np.pi}[name]
    log = replace(log, **{name: distance, other: 0.0 * distance}, yaw=log.yaw - log.yaw[0] + heading + offset)
    (finding,) = check(log, leaf).findings
    assert finding.name == "yaw_offset" and finding.value == pytest.approx(offset, abs=0.001)


def drive_straight(leaf, heading, yaw_rate=0.0):
    log = exact_drive(leaf, 60.0, turning=Sines(0.0, ((yaw_rate, 9.0, 0.3), (yaw_rate, 23.0, 1.0))))
    position = (log.x + 1j * log.y) * np.exp(1j * heading)
    return replace(log, x=position.real, y=position.imag, yaw=log.yaw + heading)


@pytest.mark.parametrize(("heading", "offset", "yaw_rate"), [
    (0.0, 0.3, 0.01), (0.3, 0.03, 0.0), (0.3, 0.3, 0.0), (0.5 * np.pi, 0.03, 0.0003)])
def test_wrong_yaw_on_a_straight_is_no_scale_of_an_axis(leaf, heading, offset, yaw_rate):
    (finding,) = check(biased(offset, "yaw")(drive_straight(leaf, heading, yaw_rate)), leaf).findings
    assert finding.name == "yaw_offset" and finding.value == pytest.approx(offset, abs=0.001)


def test_axes_are_compared_without_the_sign_of_complex_numbers_of_numpy_2(leaf, monkeypatch):
    def sign_of_numpy_1(z):
        return np.sign(np.where(z.real, z.real, z.imag)) if np.iscomplexobj(z) else np.sign(z)

    log = exact_drive(leaf)
    monkeypatch.setattr(units_and_axes, "np", SimpleNamespace(**{**vars(np), "sign": sign_of_numpy_1}))
    assert findings_by_name(log, leaf) == {}
    assert findings_by_name(replace(log, y=-log.y), leaf).keys() == {"position_axes"}


@pytest.mark.filterwarnings("error")
def test_drive_without_a_window_of_one_second_has_no_numerical_warning(leaf):
    log = exact_drive(leaf, 0.9)
    assert len(log.ins_time_ns) >= MIN_INS_SAMPLES and check(log, leaf).findings == ()


@pytest.mark.parametrize(("scale", "yaw_rate"), [(0.75, 0.02), (1.4, 0.01), (1.4, 0.02)])
def test_scale_of_an_axis_with_little_motion_is_found(leaf, scale, yaw_rate):
    found = findings_by_name(scaled(scale, "x")(drive_straight(leaf, 0.5 * np.pi, yaw_rate)), leaf)
    assert found.keys() == {"x_scale"} and found["x_scale"].value == pytest.approx(scale, abs=0.001)


def test_scale_of_an_axis_on_a_straight_is_a_distorted_map(leaf):
    found = findings_by_name(scaled(0.97, "x")(drive_straight(leaf, 0.3)), leaf)
    assert found.keys() == {"velocity_scale", "yaw_offset"} and "distorted" in found["yaw_offset"].text


@pytest.mark.parametrize(("side", "drive"), [(0.6, "cpg_lap_medium"), (-1.0, "cpg_low_speed_a")])
def test_antenna_to_the_side_of_the_ins_is_measured(side, drive):
    log, car = read_real_drive(drive), read_car("hyundai_genesis")
    wrong = replace(log, x=log.x - side * np.sin(log.yaw), y=log.y + side * np.cos(log.yaw))
    before, after = ({f.name: f for f in check(each, car).findings if f.severity is not Severity.NOTE}
                     for each in (log, wrong))
    assert after.keys() - before.keys() == {"position_side"}
    assert after["position_side"].value == pytest.approx(side, abs=0.05)


@pytest.mark.parametrize("first_y", [0.0, 4.5e6])
@pytest.mark.parametrize("with_accelerations", [True, False])
def test_positions_in_web_mercator_are_named_from_the_accelerations_or_from_y(first_y, with_accelerations):
    log, car = read_real_drive("cpg_lap_medium"), read_car("hyundai_genesis")
    known = findings_by_name(log, car).keys()
    scale = np.cosh(4.5e6 / 6378137.0)
    log = replace(log, x=scale * log.x, y=first_y + scale * (log.y - log.y[0]))
    if not with_accelerations:
        log = replace(log, acceleration_x=None, acceleration_y=None)
    found = findings_by_name(log, car)
    name = "position_scale" if first_y or with_accelerations else "velocity_scale"
    assert found.keys() - known == {name}
    value = scale if name == "position_scale" else 1.0 / scale
    assert found[name].value == pytest.approx(value, rel=0.005)
    assert ("web Mercator, at a latitude of 37 deg" in found[name].text) is (name == "position_scale")


@pytest.mark.parametrize("drive", ["cpg_lap_fast_controlled", "cpg_low_speed_a"])
@pytest.mark.parametrize(("channels", "scale"), [(("x", "y"), 0.8), (("velocity_x", "velocity_y"), 1.25)])
def test_small_positions_or_a_large_velocity_are_both_named_unless_the_accelerations_decide(drive, channels, scale):
    """Roll and pitch increase accelerations: they fit either cause of small positions, but no large velocity."""
    log, car = read_real_drive(drive), read_car("hyundai_genesis")
    result = check(scaled(scale, *channels)(log), car)
    finding = {f.name: f for f in result.findings}["velocity_scale"]
    positions = [cause.findings for cause in finding.alternatives]
    assert positions == ([("position_scale",)] if channels[0] == "x" else [])
    assert ("or x and y are" in finding.text) is bool(positions) is (finding.advice.kind == "text")
    assert result.estimates["velocity_scale"][0] == pytest.approx(1.25, abs=0.003)


@pytest.mark.parametrize("drive", ["cpg_lap_fast_controlled", "rfs_turn_a"])
@pytest.mark.parametrize("degrees", [20.0, -30.0])
def test_turned_accelerometer_is_measured_in_real_drives(drive, degrees):
    log, car = read_real_drive(drive), read_car("hyundai_genesis")
    turned = (log.acceleration_x + 1j * log.acceleration_y) * np.exp(-1j * np.deg2rad(degrees))
    turned[100] = 80.0  # one broken sample, which is left out
    before, found = (findings_by_name(each, car) for each in (
        log, replace(log, acceleration_x=turned.real, acceleration_y=turned.imag)))
    assert found.keys() - before.keys() == {"acceleration_axes", "sample_spikes"}
    low, high = np.rad2deg(found["acceleration_axes"].interval)
    assert low <= degrees <= high and high - low < 25.0


def test_samples_at_10_hz_in_bursts_of_a_second_give_no_other_finding():
    log, car = read_real_drive("cpg_lap_medium"), read_car("hyundai_genesis")
    log = log.slice(log.start_ns + 120 * 10**9, log.start_ns + 180 * 10**9)
    log = log.select_ins(np.arange(len(log.x)) % round(0.1 * len(log.x) / log.duration) == 0)
    k = np.arange(len(log.x))
    last = np.minimum(k // 10 * 10 + 9, len(k) - 1)
    wrong = replace(log, ins_time_ns=log.ins_time_ns[last] + (k - last) * 1_000_000)
    before, after = ({f.name for f in check(each, car).findings if f.severity is not Severity.NOTE}
                     for each in (log, wrong))
    assert after - before == {"time_jitter"}


@pytest.mark.parametrize("drive", ["cpg_lap_fast_controlled", "cpg_low_speed_a", "rfs_turn_c"])
def test_positions_displaced_for_a_while_are_found_in_real_drives(drive):
    """By 1.5 m for 4 s, after a ramp of 0.5 s: no step is a jump."""
    log, car = read_real_drive(drive), read_car("hyundai_genesis")
    time = seconds_of(log)
    begin = time[int(0.6 * len(time))]
    wrong = replace(log, y=log.y + 1.5 * np.clip(np.minimum(time - begin, begin + 5.0 - time) / 0.5, 0.0, 1.0))
    before, after = ({f.name: f for f in check(each, car).with_severity(Severity.WARNING)} for each in (log, wrong))
    assert after.keys() - before.keys() == {"position_deviation"}
    deviation = after["position_deviation"]
    ((first, last),) = deviation.times
    assert begin - 6.0 <= first <= begin and begin + 5.0 <= last <= begin + 11.0
    assert deviation.value == pytest.approx(1.5, abs=0.3) and "leave_out" in deviation.advice.entry


@pytest.mark.parametrize("drive", ["cpg_lap_fast_controlled", "cpg_low_speed_a", "rfs_turn_b"])
def test_accelerations_of_a_wrong_axis_or_scale_are_named_in_real_drives(drive):
    log, car = read_real_drive(drive), read_car("hyundai_genesis")
    vertical = 9.8 + 0.3 * np.random.default_rng(0).standard_normal(len(log.x))
    known = findings_by_name(log, car).keys()
    found = findings_by_name(replace(log, acceleration_y=vertical), car)
    assert found.keys() - known == {"acceleration_unrelated"} and "gravity" in found["acceleration_unrelated"].text
    # 0.3 is nearly the length of a foot, but the steering confirms that positions and velocities are in metres.
    found = findings_by_name(scaled(0.3, "acceleration_x", "acceleration_y")(log), car)
    assert found.keys() - known == {"acceleration_x_scale", "acceleration_y_scale"}
    found = findings_by_name(scaled(3.28084, "x", "y", "velocity_x", "velocity_y")(log), car)
    assert found["position_scale"].value == pytest.approx(3.281, abs=0.01) and "steering_scale" not in found


@pytest.mark.parametrize(("degrees", "is_reported"), [(0.1, False), (2.0, True)])
def test_steering_in_coarse_steps_is_reported_in_a_real_drive(degrees, is_reported):
    log, car, step = read_real_drive("cpg_lap_medium"), read_car("hyundai_genesis"), np.deg2rad(degrees)
    found = findings_by_name(replace(log, road_wheel_angle=np.round(log.road_wheel_angle / step) * step), car)
    assert ("resolution_coarse" in found) is is_reported
    assert not is_reported or found["resolution_coarse"].value == pytest.approx(step)


def test_parts_of_a_long_drive_are_limited(leaf):
    log = CHANGES["yaw_rate_bias"](exact_drive(leaf, 900.0, rate=10.0))
    (finding,) = check(log, leaf).findings
    assert finding.times == (pytest.approx((600.0, 900.0), abs=0.2),)
    assert finding.text.startswith("in the last 300 s of the drive, ")


def test_constant_fault_is_one_of_the_whole_drive(leaf):
    constant = biased(0.02, "yaw_rate")(exact_drive(leaf, 160.0, rate=20.0))
    (finding,) = check(constant, leaf).findings
    assert finding.name == "yaw_rate_bias" and not finding.times and finding.advice.kind == "run.yaml"


@pytest.mark.parametrize(("unit", "factor"), [("feet", 3.28084), ("kilometres", 0.001), ("millimetres", 1000.0)])
def test_unit_of_length_of_positions_and_velocities_is_named(leaf, unit, factor):
    log = exact_drive(leaf, 60.0)
    wrong = scaled(factor, "x", "y", "velocity_x", "velocity_y")(log)
    (finding,) = check(wrong, leaf).findings
    assert (finding.name, finding.severity) == ("position_scale", Severity.ERROR) and unit in finding.text
    assert finding.value == pytest.approx(factor, rel=0.002)
    assert check(corrected_drive(wrong, finding.advice.entry, leaf), leaf).findings == ()


@pytest.mark.parametrize("factor", [1000.0, 0.001])
def test_unit_of_the_accelerations_is_no_unit_of_length(leaf, factor):
    accelerations = ("acceleration_x", "acceleration_y")
    found = findings_by_name(scaled(factor, *accelerations)(exact_drive(leaf)), leaf)
    assert found.keys() == {f"{name}_scale" for name in accelerations}


@pytest.mark.parametrize(("name", "is_reported"), [("steering_unrelated", False), ("position_noise", True)])
def test_steering_that_is_unrelated_in_a_half_with_little_steering_is_no_change(name, is_reported):
    finding = Finding(name, Severity.WARNING, ("road_wheel_angle",), "differs", 0.3)
    whole, half = DriveCheck((), {}, ()), DriveCheck((finding,), {}, ())
    assert bool(_report_changes(whole, [half, whole], [(0.0, 60.0), (60.0, 120.0)]).findings) is is_reported


@pytest.mark.parametrize(("other", "is_reported"), [("velocity_scale", False), ("yaw_rate_bias", True)])
def test_bias_of_velocity_that_is_a_scale_in_a_half_at_constant_speed_is_no_change(other, is_reported):
    bias, found = (Finding(name, Severity.WARNING, (), "differs", value, "1", (value - 0.02, value + 0.02))
                   for name, value in (("velocity_x_bias", 0.4), (other, 1.07)))
    halves = [DriveCheck((one,), {}, (), {name: (neutral_value(name), -0.02, 0.02)})
              for one, name in ((bias, other), (found, "velocity_x_bias"))]
    checked = _report_changes(DriveCheck((bias,), {}, ()), halves, [(0.0, 60.0), (60.0, 120.0)])
    assert any(finding.times for finding in checked.findings) is is_reported


@pytest.mark.parametrize(("turns", "lag", "verb"), [(True, 0.3, "lag"), (False, 0.3, "lag"), (True, -0.3, "lead")])
def test_positions_on_another_clock_than_velocities_and_accelerations_are_one_finding(leaf, turns, lag, verb):
    channels = ("x", "y", "yaw") if turns else ("x", "y")
    log = delay(exact_drive(leaf) if turns else drive_straight(leaf, 0.0), lag, *channels)
    (finding,) = check(log, leaf).findings
    assert (finding.name, finding.channels) == ("position_lag", channels)
    assert finding.value == pytest.approx(lag, abs=0.01)
    assert f"{verb} velocities" in finding.statement and "by -" not in finding.statement
    assert check(corrected_drive(log, finding.advice.entry, leaf), leaf).findings == ()


@pytest.mark.parametrize("lag", [0.2, 0.3])
def test_positions_on_another_clock_in_a_fast_drive_are_no_slip_of_a_wheel(leaf, lag):
    """The lag was taken for wheel slip, so that accelerations, yaw rate and steering were named instead of it."""
    fast = exact_drive(leaf, 100.0, speed=Sines(22.0, ((6.0, 20.0, 0.4), (1.5, 13.0, 1.1))))
    (finding,) = check(delay(fast, lag, "x", "y", "yaw"), leaf).findings
    assert finding.name == "position_lag" and finding.value == pytest.approx(lag, abs=0.01)


def test_velocities_and_yaw_rate_on_another_clock_are_named(leaf):
    found = findings_by_name(delay(exact_drive(leaf), 0.3, "velocity_x", "velocity_y", "yaw_rate"), leaf)
    assert {"velocity_lag", "yaw_rate_lag"} <= found.keys() and "position_lag" not in found


def test_transients_do_not_move_the_ins_point(leaf):
    """Rear slip in proportion to speed times yaw rate, without the change of velocity_y, moved it by 0.19 m."""
    log = exact_drive(leaf, 100.0, speed=Sines(20.0, ((6.0, 20.0, 0.4),)),
                      turning=Sines(0.02, ((0.1, 23.0, 0.0), (0.15, 2.3, 0.7))))
    slip, speed, rate = rear_slip_coefficient(leaf), log.velocity_x, log.yaw_rate
    lateral = np.zeros(len(speed))  # of the CG
    for k in range(len(speed) - 1):
        acceleration = (leaf.cg_to_rear_axle * rate[k] - lateral[k]) / (slip * speed[k])
        lateral[k + 1] = lateral[k] + 0.01 * (acceleration - speed[k] * rate[k])
    motion = Motion.from_log(replace(log, velocity_y=lateral + leaf.cg_to_ins_x * rate), log.start_ns, AuxiliaryData())
    assert check_rear_axle(motion, leaf).estimates["measuring_point"].value == pytest.approx(0.0, abs=0.03)


def test_map_rotated_in_mid_drive_is_no_sign_of_velocity_y():
    log = read_real_drive("rfs_turn_a")
    position, middle = log.x + 1j * log.y, len(log.x) // 2
    position[middle:] = position[middle] + (position[middle:] - position[middle]) * np.exp(0.17j)
    found = findings_by_name(replace(log, x=position.real, y=position.imag), read_car("hyundai_genesis"))
    assert "velocity_y_scale" not in found and "measuring_point" not in found


def test_unsigned_steering_in_right_turns_is_an_alternative_to_its_opposite_sign():
    log, car = read_real_drive("rfs_turn_a"), read_car("hyundai_genesis")
    found = findings_by_name(replace(log, road_wheel_angle=np.abs(log.road_wheel_angle)), car)
    assert "without a sign" in found["steering_sign"].text
    assert "without a sign" not in findings_by_name(scaled(-1.0, "road_wheel_angle")(log), car)["steering_sign"].text


def test_lateral_velocity_in_another_unit_is_one_finding_at_low_speed():
    log, car = read_real_drive("cpg_low_speed_b"), read_car("hyundai_genesis")
    known, found = (findings_by_name(each, car) for each in (log, scaled(3.6, "velocity_y")(log)))
    assert found.keys() - known.keys() == {"velocity_y_scale"}
    assert not found["velocity_y_scale"].times and found["velocity_y_scale"].value == pytest.approx(3.6, abs=0.25)


def test_positions_integrated_from_velocity_x_and_yaw_rate_are_without_velocity_y():
    log, car = read_real_drive("cpg_low_speed_b"), read_car("hyundai_genesis")
    step = np.diff(seconds_of(log), prepend=0.0)
    yaw = log.yaw[0] + np.cumsum(step * log.yaw_rate)
    position = np.cumsum(step * log.velocity_x * np.exp(1j * yaw))
    found = findings_by_name(replace(log, x=position.real, y=position.imag, yaw=yaw), car)
    assert "computed without it" in found["velocity_y_scale"].text and "position_lag" not in found
    assert found["velocity_y_scale"].advice.kind == "text"


def test_times_at_half_the_rate_are_one_finding(leaf):
    log = exact_drive(leaf)
    fast = {name: getattr(log, name)[0] + 2 * (getattr(log, name) - getattr(log, name)[0])
            for name in ("ins_time_ns", "steering_time_ns")}
    (finding,) = check(replace(log, **fast), leaf).findings
    assert finding.name == "time_unit" and finding.value == pytest.approx(2.0, rel=0.005)


@pytest.mark.parametrize("factor", [0.5, 1.5])
def test_positions_are_not_attributed_to_velocities_in_knots_if_accelerations_decide(factor):
    log, car = read_real_drive("cpg_lap_slow"), read_car("hyundai_genesis")
    found = findings_by_name(scaled(factor, "x", "y")(log), car)
    assert {*found} & {"velocity_scale", "position_scale"} == {"position_scale"}


def test_ins_with_z_down_is_an_alternative_to_a_map_with_z_down(leaf):
    log = exact_drive(leaf, 60.0)
    wrong = scaled(-1.0, "yaw_rate", "velocity_y", "acceleration_y", "road_wheel_angle")(log)
    (finding,) = check(replace(wrong, steering_wheel_angle=None), leaf).findings
    assert finding.name == "position_axes" and "positive to the right" in finding.text
