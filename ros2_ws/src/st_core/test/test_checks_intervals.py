"""95 % intervals hold the truth about as often as they say, though neighbouring samples share their errors."""

import numpy as np
import pytest
from scipy.signal import lfilter
from st_core.checks.agreement import compare_series
from st_core.checks.finding import SYSTEMATIC
from st_core.checks.regression import Estimate, Regression, with_systematic

RUNS, FEW_RUNS = 200, 50


def slow_noise(generator, count, step, correlation):
    """First-order autoregressive, standard deviation 1; step, correlation time [s]."""
    kept = np.exp(-step / correlation)
    driven = generator.standard_normal(count) * np.sqrt(1.0 - kept**2)
    driven[0] = generator.standard_normal()
    return lfilter([1.0], [1.0, -kept], driven)


def judge(estimates, truth, least, runs):
    """Covered in at least that share of the runs; on average as wide as the scatter asks for, not absurdly wider."""
    inside = sum(one.interval[0] <= truth <= one.interval[1] for one in estimates)
    half = np.mean([0.5 * (one.interval[1] - one.interval[0]) for one in estimates])
    scatter = float(np.std([one.value for one in estimates]))
    assert inside >= least * runs
    assert 1.5 * scatter < half < 3.0 * 1.96 * scatter
    assert abs(np.mean([one.value for one in estimates]) - truth) < 4.0 * scatter / np.sqrt(runs)


@pytest.mark.parametrize("correlation", [0.3, 2.0])
def test_of_a_regression(correlation):
    time = np.arange(0.0, 90.0)
    columns = {"a": np.stack([np.sin(time / 2.7), np.cos(time / 3.7)], axis=1), "b": np.ones((len(time), 2))}
    found = []
    for seed in range(RUNS):
        draw = np.random.default_rng(seed)
        noise = np.stack([slow_noise(draw, len(time), 1.0, correlation) for _ in range(2)], axis=1)
        found.append(Regression(time, 0.7 * columns["a"] - 0.3 * columns["b"] + noise, columns)
                     .estimates(("a", "b")))
    judge([one["a"] for one in found], 0.7, 0.85, RUNS)
    judge([one["b"] for one in found], -0.3, 0.85, RUNS)


@pytest.mark.parametrize(("late", "correlation"), [(0.2, 0.3), (-0.3, 2.0)])
def test_of_lag_scale_and_bias(late, correlation):
    time = np.arange(0.0, 60.0, 0.02)

    def turning(t):
        return 0.16 * np.sin(t / 3.7) + 0.07 * np.sin(t + 0.7) + 0.05 * np.sin(2.7 * t + 2.0)
    found = []
    for seed in range(FEW_RUNS):
        noise = 0.03 * slow_noise(np.random.default_rng(seed), len(time), 0.02, correlation)
        found.append(compare_series(time, turning(time), time, 1.1 * turning(time - late) + 0.01 + noise, 4.0))
    for kind, truth in (("lag", late), ("scale", 1.1), ("bias", 0.01)):
        judge([getattr(one, kind) for one in found], truth, 0.8, FEW_RUNS)


def test_more_noise_is_a_wider_interval_and_less_driving_too():
    def half(seconds, noise):
        time = np.arange(0.0, seconds)
        column = np.sin(time / 2.7)[:, None]
        draw = np.random.default_rng(1).standard_normal((len(time), 1))
        low, high = Regression(time, column + noise * draw, {"a": column}).estimates(("a",))["a"].interval
        return 0.5 * (high - low)
    assert half(300.0, 0.2) == pytest.approx(2.0 * half(300.0, 0.1), rel=0.1)
    assert half(600.0, 0.1) < 0.85 * half(150.0, 0.1)


def test_what_an_identity_does_not_know_is_added_in_quadrature():
    one = with_systematic("yaw_rate_lag", Estimate(0.3, 0.006, (0.288, 0.312)))
    half = np.hypot(0.012, SYSTEMATIC["lag"])
    assert one.interval == pytest.approx((0.3 - half, 0.3 + half))
    in_degrees = with_systematic("yaw_rate_scale", Estimate(57.3, 0.0, (57.3, 57.3)))
    assert in_degrees.interval[1] - 57.3 == pytest.approx(57.3 * SYSTEMATIC["scale"])
    unknown = Estimate(1.0, 0.1, (0.8, 1.2))
    assert with_systematic("something_else", unknown).interval == pytest.approx(unknown.interval)


def test_sure_is_more_than_an_interval_that_leaves_out_zero():
    assert Estimate(1.0, 0.1, (0.6, 1.4)).significant and Estimate(-1.0, 0.1, (-1.4, -0.6)).significant
    assert not Estimate(1.0, 0.4, (0.2, 1.8)).significant
    assert not Estimate(1.0, 0.6, (-0.2, 2.2)).significant
