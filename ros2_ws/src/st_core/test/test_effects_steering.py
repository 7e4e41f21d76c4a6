"""Steering effects with memory: exact responses to ramps and sines, resets at gaps, and correction of a log."""

import numpy as np
import pytest
from st_core.augmented import augment
from st_core.effects.steering_backlash import compose_affine, compose_clamps, scan
from st_core.log import DriveLog
from st_core.readings import correct_log, correct_steering
from st_core.timeseries import NANOSECOND

RANDOM = np.random.default_rng(5)
TIME = np.cumsum(RANDOM.uniform(0.004, 0.016, 2000))  # s, uneven as on a bus
SEGMENT_STARTS = np.arange(len(TIME)) == 0


def apply_effect(effect: str, values: dict[str, float], angle: np.ndarray, segment_starts: np.ndarray = SEGMENT_STARTS):
    return augment("linear", {effect: values}).steering(TIME, angle, segment_starts)


@pytest.mark.parametrize("tau", [0.02, 0.1, 0.5])
def test_lagged_ramp_is_exact(tau):
    t = TIME - TIME[0]
    time, angle = apply_effect("steering_lag", {"time_constant": tau}, 0.2 * t)
    np.testing.assert_array_equal(time, TIME)
    np.testing.assert_allclose(angle, 0.2 * (t - tau * (1.0 - np.exp(-t / tau))), atol=1e-14)


def test_lagged_sine_has_first_order_gain_and_phase():
    tau, omega = 0.08, 6.0
    _, angle = apply_effect("steering_lag", {"time_constant": tau}, np.sin(omega * TIME))
    settled = TIME[0] + 12 * tau < TIME
    gain, phase = 1.0 / np.hypot(1.0, omega * tau), np.arctan(omega * tau)
    # Error of linear interpolation between samples: omega^2 dt^2 / 12.
    np.testing.assert_allclose(angle[settled], gain * np.sin(omega * TIME - phase)[settled], atol=8e-4)


def test_delay_shifts_time_only():
    time, angle = apply_effect("steering_delay", {"time": 0.07}, np.sin(TIME))
    np.testing.assert_array_equal(time, TIME + 0.07)
    np.testing.assert_array_equal(angle, np.sin(TIME))


def test_backlash_is_the_play_operator():
    angle, play = 0.02 * np.sin(3.0 * TIME) + 0.005 * np.sin(17.0 * TIME), 0.006
    _, loose = apply_effect("steering_backlash", {"play": play}, angle)
    expected, at = np.empty_like(angle), angle[0]
    for i, a in enumerate(angle):
        at = min(max(at, a - play / 2), a + play / 2)
        expected[i] = at
    np.testing.assert_array_equal(loose, expected)
    within_play = 0.4 * play * np.sin(9.0 * TIME - 9.0 * TIME[0])
    # An angle within the play has no effect.
    np.testing.assert_array_equal(apply_effect("steering_backlash", {"play": play}, within_play)[1], 0.0)


@pytest.mark.parametrize(("effect", "values"), [
    ("steering_lag", {"time_constant": 0.1}), ("steering_backlash", {"play": 0.01}), ("steering_delay", {"time": 0.1})])
def test_state_is_reset_after_a_gap(effect, values):
    angle = 0.05 * np.sin(2.0 * TIME)
    gap = 800
    segment_starts = SEGMENT_STARTS | (np.arange(len(TIME)) == gap)
    _, whole = apply_effect(effect, values, angle, segment_starts)
    model = augment("linear", {effect: values})
    _, second = model.steering(TIME[gap:], angle[gap:], SEGMENT_STARTS[: len(TIME) - gap])
    np.testing.assert_allclose(whole[gap:], second, atol=1e-15)
    assert whole[gap] == angle[gap]


@pytest.mark.parametrize("count", [0, 1, 2, 3, 17, 100])
def test_scan_equals_a_loop(count):
    a, b = RANDOM.uniform(0.0, 1.0, count), RANDOM.uniform(-1.0, 1.0, count)
    a[:1] = 0.0
    y, expected = 0.0, []
    for gain, add in zip(a, b, strict=True):
        y = gain * y + add
        expected.append(y)
    np.testing.assert_allclose(scan((a, b), compose_affine)[1], expected, atol=1e-14)
    low = np.minimum(a, b)
    high = np.maximum(a, b)
    low[:1] = high[:1]
    y, expected = 0.0, []
    for least, most in zip(low, high, strict=True):
        y = min(max(y, least), most)
        expected.append(y)
    np.testing.assert_array_equal(scan((low, high), compose_clamps)[0], expected)


def test_steering_chain_is_delay_then_backlash_then_lag():
    values = {"steering_lag": {"time_constant": 0.1}, "steering_backlash": {"play": 0.01},
              "steering_delay": {"time": 0.05}}
    angle = 0.05 * np.sin(4.0 * TIME)
    time, chained = augment("linear", values).steering(TIME, angle, SEGMENT_STARTS)
    _, step = apply_effect("steering_backlash", values["steering_backlash"], angle)
    _, step = apply_effect("steering_lag", values["steering_lag"], step)
    np.testing.assert_array_equal(time, TIME + 0.05)
    np.testing.assert_allclose(chained, step, atol=1e-15)


def drive(time_ns: np.ndarray) -> DriveLog:
    t = (time_ns - time_ns[0]) * NANOSECOND
    zero = np.zeros_like(t)
    return DriveLog("drive", time_ns, 10.0 * t, zero, zero, zero + 10.0, zero, zero, time_ns, 0.1 * np.sin(t),
                    1.7 * np.sin(t))


def test_correct_log_changes_only_what_the_effect_needs():
    start = 1_700_000_000_123_456_789  # not representable as float
    log = drive(start + np.arange(0, 10_000_000_000, 10_000_000))
    delayed = correct_log(augment("linear", {"steering_delay": {"time": 0.0375}}), log)
    np.testing.assert_array_equal(delayed.steering_time_ns - log.steering_time_ns, 37_500_000)
    np.testing.assert_array_equal(delayed.ins_time_ns, log.ins_time_ns)
    assert delayed.steering_wheel_angle is None  # it no longer corresponds to the road wheel angle
    unchanged = correct_log(augment("linear", {"mass": {"factor": 1.2}}), log)
    assert unchanged is log and correct_log(augment("linear", []), log) is log
    lag = correct_log(augment("linear", {"steering_lag": {"time_constant": 0.1}}), log)
    np.testing.assert_array_equal(lag.steering_time_ns, log.steering_time_ns)
    assert lag.road_wheel_angle[300] == pytest.approx(0.1 * np.sin(3.0 - 0.1), abs=1e-3)


def test_gap_in_the_recording_is_detected_by_its_length():
    time_ns = np.concatenate((np.arange(100), np.arange(100) + 130)) * 10_000_000
    angle = np.concatenate((np.zeros(100), np.full(100, 0.1)))
    model = augment("linear", {"steering_lag": {"time_constant": 0.2}})
    _, restarted = correct_steering(model, time_ns, angle, 0.1)
    np.testing.assert_allclose(restarted[100:], 0.1, rtol=1e-14)
    _, carried = correct_steering(model, time_ns, angle, 0.5)
    assert 0.0 < carried[100] < 0.1


def test_empty_recording_is_corrected_to_empty():
    model = augment("linear", ["steering_lag", "steering_delay", "steering_backlash"])
    time_ns, angle = correct_steering(model, np.empty(0, np.int64), np.empty(0), 0.1)
    assert not len(time_ns) and not len(angle)
