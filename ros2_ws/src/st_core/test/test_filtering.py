"""Filtered derivative: equals a Butterworth filter, live equals offline, delay, gaps, zero phase."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import butter, lfilter, lfilter_zi, lsim
from st_core.errors import StCoreError
from st_core.timeseries import filtered_derivative, low_pass_step

CUTOFF, GAP = 5.0, 0.1


def even_times(count: int, rate: float) -> np.ndarray:
    return 1_700_000_000_000_000_000 + np.round(np.arange(count) * 1e9 / rate).astype(np.int64)


def speed_profile(seconds):
    """Forward speed [m/s] with the frequency content of driving, up to 1 Hz."""
    return 10.0 + 2.0 * np.sin(0.7 * seconds) + 0.3 * np.sin(3.0 * seconds) + 0.05 * np.sin(6.0 * seconds)


@pytest.mark.parametrize(("rate", "tolerance"), [(50.0, 0.006), (100.0, 0.002), (250.0, 0.002)])
def test_even_sampling_equals_the_digital_butterworth_filter(rate, tolerance):
    seconds = np.arange(500) / rate
    values = speed_profile(seconds)
    b, a = butter(1, CUTOFF, fs=rate)
    expected, _ = lfilter(b, a, values, zi=lfilter_zi(b, a) * values[0])
    filtered, derivative = filtered_derivative(even_times(500, rate), values, CUTOFF, GAP)
    np.testing.assert_allclose(filtered, expected, atol=0.003)
    np.testing.assert_allclose(derivative[20:], np.diff(expected)[19:] * rate, atol=tolerance)
    assert math.isnan(derivative[0])


def test_uneven_sampling_equals_the_continuous_butterworth_filter():
    seconds = np.cumsum(np.random.default_rng(4).uniform(0.002, 0.09, 80))
    values = speed_profile(seconds)
    b, a = butter(1, 2.0 * math.pi * CUTOFF, analog=True)
    # lsim on a fine grid of the linearly interpolated signal.
    fine = np.linspace(seconds[0], seconds[-1], 400_001)
    _, expected, _ = lsim((b, a), np.interp(fine, seconds, values) - values[0], fine - fine[0])
    filtered, _ = filtered_derivative(np.round(seconds * 1e9), values, CUTOFF, GAP)
    np.testing.assert_allclose(filtered, values[0] + np.interp(seconds, fine, expected), atol=1e-6)


@given(st.lists(st.tuples(st.integers(1, 150_000_000), st.floats(-50.0, 50.0)), min_size=1, max_size=60))
def test_live_and_offline_results_are_identical(steps):
    times = np.cumsum([dt for dt, _ in steps])
    values = np.array([v for _, v in steps])
    pairs = [(values[0], math.nan)]
    for spacing, before, now in zip(np.diff(times) * 1e-9, values, values[1:], strict=False):
        pairs.append(low_pass_step(pairs[-1][0], before, now, spacing, CUTOFF) if spacing <= GAP else (now, math.nan))
    pairs = np.array(pairs)
    filtered, derivative = filtered_derivative(times, values, CUTOFF, GAP)
    np.testing.assert_array_equal(filtered, pairs[:, 0])
    np.testing.assert_array_equal(derivative, pairs[:, 1])
    gaps = np.concatenate([[True], np.diff(times) * 1e-9 > GAP])
    np.testing.assert_array_equal(np.isnan(derivative), gaps)


@pytest.mark.parametrize("rate", [50.0, 100.0, 250.0])
def test_delay_is_filter_lag_plus_half_a_sample(rate):
    # Quadratic speed: the derivative is linear in time, so its error is its delay.
    times = even_times(300, rate)
    seconds = np.arange(300) / rate
    _, derivative = filtered_derivative(times, 0.5 * seconds**2, CUTOFF, GAP)
    delay = seconds[-1] - derivative[-1]
    assert delay == pytest.approx(1.0 / (2.0 * math.pi * CUTOFF) + 0.5 / rate, rel=1e-6)


def test_constant_acceleration_with_uneven_sampling():
    times = np.cumsum(np.random.default_rng(2).integers(4_000_000, 16_000_000, 200))
    _, derivative = filtered_derivative(times, 3.0 * times * 1e-9, CUTOFF, GAP)
    np.testing.assert_allclose(derivative[100:], 3.0, rtol=1e-9)


def test_filter_is_reset_after_a_gap():
    times = np.concatenate([even_times(50, 100.0), even_times(50, 100.0) + 1_000_000_000])
    values = np.concatenate([np.linspace(0.0, 5.0, 50), np.linspace(20.0, 15.0, 50)])
    filtered, derivative = filtered_derivative(times, values, CUTOFF, GAP)
    alone = filtered_derivative(times[50:], values[50:], CUTOFF, GAP)
    np.testing.assert_array_equal(filtered[50:], alone[0])
    np.testing.assert_array_equal(derivative[50:], alone[1])


def test_zero_phase_has_no_delay():
    times, seconds = even_times(600, 100.0), np.arange(600) / 100.0
    _, causal = filtered_derivative(times, np.sin(2.0 * seconds), CUTOFF, GAP)
    _, centred = filtered_derivative(times, np.sin(2.0 * seconds), CUTOFF, GAP, mode="zero_phase")
    inner = slice(100, -100)
    true = 2.0 * np.cos(2.0 * seconds)
    # Only the amplitude changes: 1 / (1 + (w/w_c)^2) at 2 rad/s.
    np.testing.assert_allclose(centred[inner], true[inner] / (1.0 + (2.0 / (2.0 * math.pi * CUTOFF)) ** 2), atol=1e-3)
    assert np.abs(causal[inner] - true[inner]).max() > 10.0 * np.abs(centred[inner] - true[inner]).max()


def test_zero_phase_filter_does_not_cross_a_gap():
    times = np.concatenate([even_times(60, 100.0), even_times(60, 100.0) + 3_000_000_000])
    values = np.random.default_rng(3).normal(size=120)
    whole = filtered_derivative(times, values, CUTOFF, GAP, mode="zero_phase")
    first = filtered_derivative(times[:60], values[:60], CUTOFF, GAP, mode="zero_phase")
    second = filtered_derivative(times[60:], values[60:], CUTOFF, GAP, mode="zero_phase")
    for i in (0, 1):
        np.testing.assert_allclose(whole[i], np.concatenate([first[i], second[i]]), rtol=1e-9)


def test_invalid_arguments_are_rejected():
    with pytest.raises(StCoreError, match="increase"):
        filtered_derivative(np.array([2, 1]), np.zeros(2), CUTOFF, GAP)
    with pytest.raises(StCoreError, match="neither causal nor zero_phase"):
        filtered_derivative(np.array([1, 2]), np.zeros(2), CUTOFF, GAP, mode="both")


def test_empty_log():
    filtered, derivative = filtered_derivative(np.array([], np.int64), np.array([]), CUTOFF, GAP, mode="zero_phase")
    assert len(filtered) == len(derivative) == 0
