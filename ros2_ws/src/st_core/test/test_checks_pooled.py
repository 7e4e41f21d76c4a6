"""Estimates of several runs as one: the mean by their weights, an interval that knows how much runs differ."""

import numpy as np
import pytest
from st_core.checks import pooled


def estimate(value: float, deviation: float) -> tuple[float, float, float]:
    return value, value - 1.96 * deviation, value + 1.96 * deviation


def test_one_run_is_taken_as_it_is():
    assert pooled([{"yaw_rate_bias": (0.1, 0.0, 0.3)}]) == {"yaw_rate_bias": (0.1, 0.0, 0.3)}
    assert pooled([]) == {}


def test_alike_runs_are_weighed_by_their_precision():
    value, low, high = pooled([{"a": estimate(1.0, 0.1)}, {"a": estimate(1.3, 0.3)}, {"b": estimate(5.0, 1.0)}])["a"]
    assert value == pytest.approx((1.0 / 0.01 + 1.3 / 0.09) / (1 / 0.01 + 1 / 0.09))
    assert low < value < high


def test_the_interval_covers_the_mean_of_runs_that_differ():
    """Runs whose true values are drawn with a spread far beyond their own intervals."""
    rng = np.random.default_rng(3)
    hits = 0
    for _ in range(200):
        values = rng.normal(2.0, 0.5, 8) + rng.normal(0.0, 0.05, 8)
        _, low, high = pooled([{"a": estimate(value, 0.05)} for value in values])["a"]
        hits += low <= 2.0 <= high
    assert 180 <= hits <= 199
