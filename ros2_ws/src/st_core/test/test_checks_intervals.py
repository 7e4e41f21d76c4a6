"""Coverage of 95 % confidence intervals when the errors of neighbouring samples are correlated."""

import numpy as np
import pytest
from scipy.signal import lfilter
from st_core.checks import pool_estimates
from st_core.checks.finding import SYSTEMATIC_UNCERTAINTY
from st_core.checks.inertial import compare_series
from st_core.checks.regression import Estimate, Regression, add_systematic_uncertainty

RUNS, FEW_RUNS = 200, 50


def correlated_noise(generator, count, step, correlation):
    """First-order autoregressive noise of standard deviation 1; step, correlation time [s]."""
    factor = np.exp(-step / correlation)
    innovations = generator.standard_normal(count) * np.sqrt(1.0 - factor**2)
    innovations[0] = generator.standard_normal()
    return lfilter([1.0], [1.0, -factor], innovations)


def assert_coverage(estimates, truth, min_coverage, runs):
    """Minimum fraction of intervals that contain the truth; mean half width between 1.5 and 5.9 times the scatter."""
    covered = sum(estimate.interval[0] <= truth <= estimate.interval[1] for estimate in estimates)
    half_width = np.mean([0.5 * (estimate.interval[1] - estimate.interval[0]) for estimate in estimates])
    scatter = float(np.std([estimate.value for estimate in estimates]))
    assert covered >= min_coverage * runs
    assert 1.5 * scatter < half_width < 3.0 * 1.96 * scatter
    assert abs(np.mean([estimate.value for estimate in estimates]) - truth) < 4.0 * scatter / np.sqrt(runs)


@pytest.mark.parametrize("correlation", [0.3, 2.0])
def test_coverage_of_regression_coefficients(correlation):
    time = np.arange(0.0, 90.0)
    columns = {"a": np.stack([np.sin(time / 2.7), np.cos(time / 3.7)], axis=1), "b": np.ones((len(time), 2))}
    found = []
    for seed in range(RUNS):
        draw = np.random.default_rng(seed)
        noise = np.stack([correlated_noise(draw, len(time), 1.0, correlation) for _ in range(2)], axis=1)
        found.append(Regression(time, 0.7 * columns["a"] - 0.3 * columns["b"] + noise, columns)
                     .estimate(("a", "b")))
    assert_coverage([estimate["a"] for estimate in found], 0.7, 0.85, RUNS)
    assert_coverage([estimate["b"] for estimate in found], -0.3, 0.85, RUNS)


@pytest.mark.slow
@pytest.mark.parametrize(("lag", "correlation"), [(0.2, 0.3), (-0.3, 2.0)])
def test_coverage_of_lag_scale_and_bias(lag, correlation):
    time = np.arange(0.0, 60.0, 0.02)

    def turning(t):
        return 0.16 * np.sin(t / 3.7) + 0.07 * np.sin(t + 0.7) + 0.05 * np.sin(2.7 * t + 2.0)
    found = []
    for seed in range(FEW_RUNS):
        noise = 0.03 * correlated_noise(np.random.default_rng(seed), len(time), 0.02, correlation)
        found.append(compare_series(time, turning(time), time, 1.1 * turning(time - lag) + 0.01 + noise, 4.0))
    for quantity, truth in (("lag", lag), ("scale", 1.1), ("bias", 0.01)):
        assert_coverage([getattr(estimate, quantity) for estimate in found], truth, 0.8, FEW_RUNS)


def test_lag_and_scale_relative_to_a_noisy_angle():
    """The noise of the differentiated angle contains no information about the lag, and biases a regression on it."""
    time = np.arange(0.0, 60.0, 0.01)
    yaw = 0.2 * np.sin(time / 3.7) + 0.075 * np.sin(time + 0.7) + 0.01 * np.sin(2.7 * time + 2.0)
    rate = np.gradient(np.interp(time - 0.08, time, yaw), time)
    found = [compare_series(time, yaw + np.radians(0.3) * np.random.default_rng(seed).standard_normal(len(time)),
                            time, rate, 4.0, derived_is_angle=True) for seed in range(FEW_RUNS)]
    assert sum(agreement.lag.covers(0.08) for agreement in found) >= 0.8 * FEW_RUNS
    assert max(agreement.lag.half_width for agreement in found) < 0.05
    assert np.mean([agreement.scale.value for agreement in found]) == pytest.approx(1.0, abs=0.02)


def test_interval_is_wider_for_more_noise_and_for_less_driving():
    def half_width(seconds, noise):
        time = np.arange(0.0, seconds)
        column = np.sin(time / 2.7)[:, None]
        draw = np.random.default_rng(1).standard_normal((len(time), 1))
        low, high = Regression(time, column + noise * draw, {"a": column}).estimate(("a",))["a"].interval
        return 0.5 * (high - low)
    assert half_width(300.0, 0.2) == pytest.approx(2.0 * half_width(300.0, 0.1), rel=0.1)
    assert half_width(600.0, 0.1) < 0.85 * half_width(150.0, 0.1)


def test_systematic_uncertainty_is_added_in_quadrature():
    estimate = add_systematic_uncertainty("yaw_rate_lag", Estimate(0.3, 0.006, 0.012))
    half_width = np.hypot(0.012, SYSTEMATIC_UNCERTAINTY["lag"])
    assert estimate.interval == pytest.approx((0.3 - half_width, 0.3 + half_width))
    in_degrees = add_systematic_uncertainty("yaw_rate_scale", Estimate(57.3, 0.0, 0.0))
    assert in_degrees.interval[1] - 57.3 == pytest.approx(57.3 * SYSTEMATIC_UNCERTAINTY["scale"])
    unknown = Estimate(1.0, 0.1, 0.2)
    assert add_systematic_uncertainty("something_else", unknown).interval == pytest.approx(unknown.interval)


def test_significance_requires_more_than_an_interval_without_zero():
    assert Estimate(1.0, 0.1, 0.4).is_significant and Estimate(-1.0, 0.1, 0.4).is_significant
    assert not Estimate(1.0, 0.4, 0.8).is_significant
    assert not Estimate(1.0, 0.6, 1.2).is_significant


def test_quantity_that_one_of_several_runs_determines_is_not_pooled():
    lag, bias = (0.028, 0.023, 0.034), (0.003, 0.002, 0.004)
    assert pool_estimates([{"yaw_rate_lag": lag}]) == {"yaw_rate_lag": lag}
    unknown = (0.02, -np.inf, np.inf)
    pooled = pool_estimates([{"yaw_rate_lag": lag, "yaw_rate_bias": bias}, {"yaw_rate_bias": bias},
                             {"yaw_rate_lag": unknown, "yaw_rate_bias": bias}])
    assert pooled.keys() == {"yaw_rate_bias"} and pooled["yaw_rate_bias"][0] == pytest.approx(0.003)


@pytest.mark.parametrize("rate", [20.0, 50.0, 100.0])
def test_scale_of_a_noisy_yaw_rate_is_unbiased_by_the_noise_of_yaw(rate):
    time, random = np.arange(0.0, 120.0, 1.0 / rate), np.random.default_rng(1)
    yaw = 1.5 * np.sin(0.4 * time) + 0.5 * np.sin(0.9 * time + 1.0)
    yaw_rate = 0.6 * np.cos(0.4 * time) + 0.45 * np.cos(0.9 * time + 1.0) + 0.6 * random.normal(size=len(time))
    agreement = compare_series(time, yaw + 0.03 * random.normal(size=len(time)), time, yaw_rate, 4.0,
                               derived_is_angle=True)
    assert agreement.correlation < 0.95 and agreement.scale.value == pytest.approx(1.0, abs=0.05)
