"""Intervals of means over runs and blocks of them."""

import numpy as np
import pytest
from st_core.regression import make_blocks


def test_blocks_are_runs_or_blocks_of_few_runs():
    run_of, time = np.repeat(np.arange(9), 30), np.tile(np.arange(30.0), 9)
    assert make_blocks(run_of, time).name == "9 runs"
    group = make_blocks(run_of[:60], time[:60])
    assert group.name == "6 blocks of 10 s from 2 runs" and np.array_equal(np.bincount(group.block_of), [10] * 6)


def test_intervals_hold_a_mean_as_often_as_they_say():
    """95 % intervals of the mean of ten runs of correlated samples, over 400 repetitions."""
    generator = np.random.default_rng(0)
    held = 0
    for _ in range(400):
        values = np.repeat(generator.standard_normal(10), 20) + 0.3 * generator.standard_normal(200)
        low, high = _interval_of_mean(values, np.repeat(np.arange(10), 20), np.zeros(200))
        held += low < 0.0 < high
    assert 0.92 <= held / 400 <= 0.98


@pytest.mark.parametrize(("wander", "seconds"), [(0.0, 60), (20.0, 30), (20.0, 60)])
def test_an_error_that_outlasts_a_block_makes_intervals_wider(wander, seconds):
    """95 % intervals of the mean of five runs whose error wanders over `wander` seconds, over 400 repetitions."""
    generator = np.random.default_rng(1)
    run_of, time = np.repeat(np.arange(5), seconds), np.tile(np.arange(float(seconds)), 5)
    memory = np.exp(-1.0 / wander) if wander else 0.0
    held = 0
    for _ in range(400):
        draws = generator.standard_normal((5, seconds))
        draws[:, 1:] *= np.sqrt(1.0 - memory**2)
        for k in range(1, seconds):
            draws[:, k] += memory * draws[:, k - 1]
        low, high = _interval_of_mean(draws.ravel(), run_of, time)
        held += low < 0.0 < high
    assert 0.9 <= held / 400 <= 0.99


def _interval_of_mean(values, run_of, time):
    mean, spread, _ = make_blocks(run_of, time).fit_least_squares(np.ones((len(values), 1)), values)
    return spread.interval(0, mean[0])


def test_bootstrap_of_a_mean_agrees_with_its_influence():
    values, run_of = np.random.default_rng(3).standard_normal(120) + np.repeat(np.arange(12.0), 10), np.repeat(
        np.arange(12), 10)
    group = make_blocks(run_of, np.zeros(120))
    totals = group.sum_by_block(np.stack([np.ones(120), values], axis=1))
    drawn = group.bootstrap(lambda w: (w @ totals[:, 1:]) / (w @ totals[:, :1]), 4000, 0)
    _, direct, _ = group.fit_least_squares(np.ones((120, 1)), values)
    assert drawn.deviations == pytest.approx(direct.deviations, rel=0.04)
    assert drawn.degrees_of_freedom == pytest.approx(direct.degrees_of_freedom)
