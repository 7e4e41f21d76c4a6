"""Checks judge only what a drive excites: standstill, slow changes, lags in a slalom, rate of the logger."""

from dataclasses import replace

import numpy as np
import pytest
from exact_drive import SILENT, SPEED, Noise, Sines, delay, exact_drive
from exact_faults import findings_by_name
from st_core.checks import AuxiliaryData, Severity, check, compare_runs
from st_core.log import DriveLog

STAMPS = 1_700_000_000_000_000_000 + 20_000_000 * np.arange(3000)
SWEEP = Sines(0.0, tuple((0.1, period, period) for period in (8.0, 5.0, 3.0, 2.0, 1.5)))
SLALOM = Sines(0.0, ((0.3, 2.0, 0.0),))


def stationary_drive(kind):
    noise = np.random.default_rng(5).standard_normal((9, len(STAMPS)))
    walk, zero, sine = np.cumsum(noise, axis=1) * 0.14, np.zeros(len(STAMPS)), np.sin(np.arange(len(STAMPS)) / 150.0)
    x, y, yaw, v_x, v_y, rate, steering = {
        "zeros": (zero,) * 7,
        "noise": (*(0.005 * noise[:2]), 0.0005 * noise[2], *(0.01 * noise[3:5]), 0.002 * noise[5], 0.0005 * noise[6]),
        "wandering": (*(0.5 * walk[:2] + 0.2 * noise[:2]), 0.02 * walk[2], *(0.1 * noise[3:5]), 0.01 * noise[5],
                      0.2 * np.round(sine)),
        "turned wheel": (*(0.01 * noise[:2]), 0.001 * noise[2], *(0.02 * noise[3:5]), 0.002 * noise[5], 0.5 * sine),
        "heading from course": (*(0.3 * noise[:2]), np.unwrap(np.angle(noise[0] + 1j * noise[1])),
                                *np.abs(0.3 * noise[3:5]), 0.01 * noise[5], zero),
    }[kind]
    return DriveLog(kind, STAMPS, x, y, yaw, v_x, v_y, rate, STAMPS, steering, None, 0.1 * noise[7], 0.1 * noise[8])


@pytest.fixture(scope="module")
def delayed_runs(leaf):
    return [check(delay(exact_drive(leaf, 60.0, seed=seed), 0.2, "yaw_rate"), leaf) for seed in range(3)]


@pytest.mark.parametrize("kind", ["zeros", "noise", "wandering", "turned wheel", "heading from course"])
def test_run_at_standstill_has_no_findings_and_does_not_change_those_of_other_runs(leaf, delayed_runs, kind):
    stationary = check(stationary_drive(kind), leaf)
    assert not stationary.findings and not stationary.estimates
    compared = compare_runs(delayed_runs)
    assert compare_runs([*delayed_runs, stationary]) == compared and compared[0].consistent


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.0005, 0.004, 0.01])
def test_delayed_sensor_gives_a_single_finding_in_every_kind_of_driving(leaf, noise):
    drives = [exact_drive(leaf, 60.0, speed=speed, turning=turning, noise=Noise(yaw=noise))
              for speed, turning in ((SPEED, SLALOM), (SPEED, SWEEP), (Sines(15.0, ()), SWEEP))]
    runs = [check(delay(log, 0.36, "yaw_rate"), leaf) for log in drives]
    for run in runs:
        assert not run.with_severity(Severity.ERROR)
        lags = [finding for finding in run.findings if finding.name.endswith("_lag")]
        assert [finding.name for finding in lags] == ["yaw_rate_lag"]
        assert lags[0].value == pytest.approx(0.36, abs=0.015)
    assert [finding.name for finding in compare_runs(runs) if finding.consistent] == ["yaw_rate_lag"]


@pytest.mark.parametrize("deviation", [0.03, 1.5])
@pytest.mark.parametrize("heading", [0.0, np.pi / 2])
def test_position_noise_across_a_straight_drive_is_not_an_axis_scale(leaf, heading, deviation):
    log = exact_drive(leaf, 15.0, turning=Sines(0.0, ()))
    position = (log.x + 1j * log.y) * np.exp(1j * heading)
    noise = deviation * np.random.default_rng(1).normal(size=(2, len(log.x)))
    found = check(replace(log, x=position.real + noise[0], y=position.imag + noise[1], yaw=log.yaw + heading), leaf)
    assert {finding.name for finding in found.findings} <= {"position_noise"}


def test_small_drift_across_a_straight_drive_is_not_a_large_axis_scale(leaf):
    log = exact_drive(leaf, 60.0, turning=Sines(0.0, ((2e-6, 20.0, 0.0),)), noise=SILENT)
    assert findings_by_name(replace(log, y=97.0 * log.y)) == {}


@pytest.mark.parametrize("seconds", [18.0, -3.0])
def test_positions_on_a_different_clock_give_a_single_error(leaf, seconds):
    found = findings_by_name(delay(exact_drive(leaf, 60.0), seconds, "x", "y"), leaf)
    assert list(found) == ["position_lag"] and found["position_lag"].severity is Severity.ERROR
    assert found["position_lag"].value == pytest.approx(seconds, abs=0.02)


@pytest.mark.parametrize("seconds", [5.0, 18.0])
def test_velocities_on_a_different_clock_are_not_a_position_error(leaf, seconds):
    found = findings_by_name(delay(exact_drive(leaf, 120.0), seconds, "velocity_x", "velocity_y"), leaf)
    assert found and "position_lag" not in found



def test_fault_of_the_yaw_rate_is_found_although_yaw_turns_at_standstill(leaf):
    log = delay(exact_drive(leaf, 60.0), 0.12, "yaw_rate")
    rows, seconds = np.maximum(np.arange(-1000, len(log.x)), 0), 0.01 * np.arange(len(log.x) + 1000)
    moves = np.arange(-1000, len(log.x)) > 0
    stamps = log.ins_time_ns[0] - 10**10 + np.round(1e9 * seconds).astype(np.int64)
    standing = {name: np.where(moves, getattr(log, name)[rows], 0.0)
                for name in ("velocity_x", "velocity_y", "yaw_rate", "acceleration_x", "acceleration_y")}
    standing["yaw_rate"] += 0.001 * np.random.default_rng(1).normal(size=len(rows))
    yaw = log.yaw[rows] + np.where(moves, 0.0, 1.1 * np.exp(-((seconds - 5.0) / 0.3) ** 2))
    waiting = replace(log, ins_time_ns=stamps, x=log.x[rows], y=log.y[rows], yaw=yaw, **standing)
    assert findings_by_name(waiting)["yaw_rate_lag"].value == pytest.approx(0.12, abs=0.01)


def test_spin_has_no_impossible_lateral_acceleration(leaf):
    log = exact_drive(leaf, 40.0, speed=Sines(15.0, ()), turning=Sines(0.0, ()))
    time = (log.ins_time_ns - log.ins_time_ns[0]) * 1e-9
    angle = np.pi * (1.0 + np.tanh((time - 20.0) / 1.5))
    spinning = replace(log, yaw=log.yaw + angle, velocity_x=15.0 * np.cos(angle), velocity_y=-15.0 * np.sin(angle),
                       yaw_rate=log.yaw_rate + np.gradient(angle, time))
    assert "lateral_acceleration_impossible" not in findings_by_name(spinning, leaf)
    without_sideslip = replace(spinning, velocity_x=np.full(len(time), 15.0), velocity_y=np.zeros(len(time)),
                               acceleration_y=None)
    assert "lateral_acceleration_impossible" not in findings_by_name(without_sideslip, leaf)


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.9, 0.97, 1.1, 1.18])
def test_wrong_nominal_sampling_rate_gives_one_finding(leaf, factor):
    log = exact_drive(leaf, 60.0)
    start = log.ins_time_ns[0]
    wrong = replace(log, **{name: start + np.round((getattr(log, name) - start) * factor).astype(np.int64)
                            for name in ("ins_time_ns", "steering_time_ns")})
    (finding,) = [finding for finding in check(wrong).findings if finding.severity is not Severity.NOTE]
    assert finding.name == "time_rate" and finding.interval[0] < factor < finding.interval[1]


def test_no_lag_is_reported_for_slow_changes(leaf):
    for seed in range(4):
        log = exact_drive(leaf, 60.0, speed=Sines(14.0, ((9.0, 17.0, 0.0),)), turning=Sines(0.0, ((0.05, 40.0, 0.0),)),
                          seed=seed)
        assert not [finding for finding in check(log, leaf).findings if finding.name.endswith("_lag")]


@pytest.mark.parametrize(("back", "share"), [(30.0, 0.5), (5.0, 0.083), (59.0, 0.5)])
def test_clock_set_back_gives_a_warning_with_the_number_of_lost_rows(leaf, back, share):
    stamps = STAMPS.copy()
    stamps[1500:] -= round(back * 1e9)
    (finding,) = [finding for finding in check(exact_drive(leaf), leaf, AuxiliaryData({"INS": stamps})).findings
                  if finding.name == "time_order"]
    assert finding.severity is Severity.WARNING and finding.value == pytest.approx(share, abs=0.002)
    assert f"{round(finding.value * (len(stamps) - 1))} of 3000 rows" in finding.text


@pytest.mark.parametrize("slip", [-0.03, -0.1])
def test_finding_on_a_steady_circle_names_the_opposite_sign_of_velocity_y_as_alternative(leaf, slip):
    """A constant velocity_y of the wrong sign looks like a displaced INS point or a yaw offset."""
    rng, radius, speed = np.random.default_rng(0), 50.0, 10.0
    time = (STAMPS - STAMPS[0]) * 1e-9
    course = speed / radius * time + slip
    ones = np.ones(len(time))
    values = {"x": radius * np.sin(course), "y": -radius * np.cos(course), "yaw": course - slip,
              "v_x": speed * np.cos(slip) * ones, "v_y": -speed * np.sin(slip) * ones, "rate": speed / radius * ones}
    scatter = {"x": 0.005, "y": 0.005, "yaw": 0.0005, "v_x": 0.01, "v_y": 0.01, "rate": 0.001}
    x, y, yaw, v_x, v_y, rate = (value + rng.normal(0.0, scatter[name], len(time)) for name, value in values.items())
    log = DriveLog("circle", STAMPS, x, y, yaw, v_x, v_y, rate, STAMPS, 2.7 / radius * ones, None)
    found = [finding for finding in check(log).findings if finding.name in ("position_reference", "yaw_offset")]
    assert found and {finding.advice.kind for finding in found} == {"text"}
    assert all("or velocity_y has the opposite sign" in finding.text for finding in found)
