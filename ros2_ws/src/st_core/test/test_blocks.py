"""Confidence intervals of means from runs and blocks of runs."""

import numpy as np
import pytest
from st_core.regression import count_decimals, make_blocks


@pytest.mark.parametrize(("half_width", "decimals"), [(0.0, 3), (0.0123, 3), (12.0, 0), (np.inf, 3), (np.nan, 3)])
def test_number_of_decimals_is_defined_for_every_half_width(half_width, decimals):
    assert count_decimals(half_width) == decimals


def test_blocks_are_runs_or_parts_of_few_runs():
    run_index, time = np.repeat(np.arange(9), 30), np.tile(np.arange(30.0), 9)
    assert make_blocks(run_index, time).name == "9 runs"
    group = make_blocks(run_index[:60], time[:60])
    assert group.name == "6 blocks of 10 s from 2 runs" and np.array_equal(np.bincount(group.block_index), [10] * 6)


def test_intervals_contain_the_mean_at_their_level():
    """95 % intervals of the mean of ten runs of correlated samples, over 400 repetitions."""
    generator = np.random.default_rng(0)
    covered = 0
    for _ in range(400):
        values = np.repeat(generator.standard_normal(10), 20) + 0.3 * generator.standard_normal(200)
        low, high = _interval_of_mean(values, np.repeat(np.arange(10), 20), np.zeros(200))
        covered += low < 0.0 < high
    assert 0.92 <= covered / 400 <= 0.98


@pytest.mark.parametrize(("correlation_time", "seconds"), [(0.0, 60), (20.0, 30), (20.0, 60)])
def test_intervals_contain_the_mean_of_errors_correlated_beyond_a_block(correlation_time, seconds):
    """95 % intervals of the mean of five runs of errors with a correlation time [s], over 400 repetitions."""
    generator = np.random.default_rng(1)
    run_index, time = np.repeat(np.arange(5), seconds), np.tile(np.arange(float(seconds)), 5)
    memory = np.exp(-1.0 / correlation_time) if correlation_time else 0.0
    covered = 0
    for _ in range(400):
        draws = generator.standard_normal((5, seconds))
        draws[:, 1:] *= np.sqrt(1.0 - memory**2)
        for k in range(1, seconds):
            draws[:, k] += memory * draws[:, k - 1]
        low, high = _interval_of_mean(draws.ravel(), run_index, time)
        covered += low < 0.0 < high
    assert 0.9 <= covered / 400 <= 0.99


def _interval_of_mean(values, run_index, time):
    mean, spread, _ = make_blocks(run_index, time).fit_least_squares(np.ones((len(values), 1)), values)
    return spread.interval(0, mean[0])


def test_bootstrap_deviations_agree_with_least_squares():
    run_index = np.repeat(np.arange(12), 10)
    values = np.random.default_rng(3).standard_normal(120) + run_index
    group = make_blocks(run_index, np.zeros(120))
    totals = group.sum_by_block(np.stack([np.ones(120), values], axis=1))
    bootstrap = group.bootstrap(lambda w: (w @ totals[:, 1:]) / (w @ totals[:, :1]), 4000, 0)
    _, analytic, _ = group.fit_least_squares(np.ones((120, 1)), values)
    assert bootstrap.standard_errors == pytest.approx(analytic.standard_errors, rel=0.04)
    assert bootstrap.degrees_of_freedom == pytest.approx(analytic.degrees_of_freedom)
