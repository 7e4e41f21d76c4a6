"""Adaptive factors: long-run coverage for any errors, delayed scores, restart, invalid input."""

import math

import numpy as np
import pytest
from st_core.bands import AdaptiveBand, AdaptiveBands, Band
from st_core.bands.live import GAIN, MAX_FACTOR, MIN_FACTOR, START_GAIN, WARM_UP
from st_core.bands.scale import KNOTS, Scale, compute_features
from st_core.evaluation import make_score

TIME = 0.5 * np.arange(1, 11)  # s
STEP_NS = 100_000_000
CONDITION = np.array([10.0, 1.0, 0.2, 0.02])  # m/s, m/s^2, m/s^2, rad/s


def unit_band() -> Band:
    """Scale 1 everywhere; factors 2 at 50 %, 4 at 90 %."""
    coefficients = np.zeros((3, len(KNOTS), compute_features(np.zeros((1, 4))).shape[1]))
    return Band(Scale(coefficients, np.zeros((2, 3)), TIME), {0.5: 2.0, 0.9: 4.0}, np.ones((3, 19)))


def draw_errors(seconds, magnitude, seed=3):
    """Errors of windows every 0.1 s, slowly varying, times magnitude(elapsed fraction of the drive)."""
    rng = np.random.default_rng(seed)
    count = 10 * seconds
    slow = np.convolve(rng.normal(size=count + 50), np.ones(51) / math.sqrt(51.0), mode="valid")
    shape = np.ones((count, len(TIME), 3)) * np.abs(slow)[:, None, None]
    return STEP_NS * np.arange(count), shape * np.array([magnitude(k / count) for k in range(count)])[:, None, None]


@pytest.mark.parametrize("calibrated", [True, False])
@pytest.mark.parametrize("magnitude", [lambda t: 0.2, lambda t: 20.0, lambda t: 1.0 if t < 0.5 else 5.0,
                                       lambda t: 1.0 + math.sin(20.0 * t)], ids=["narrow", "wide", "step", "waves"])
def test_long_run_coverage_equals_the_level_for_any_errors(calibrated, magnitude):
    starts, errors = draw_errors(900, magnitude)
    adaptive = AdaptiveBand(TIME, unit_band() if calibrated else None)
    factors, scales = adaptive.replay(starts, np.tile(CONDITION, (len(starts), 1)), errors)
    scores = (np.abs(errors) / scales).max(axis=(1, 2))
    for level, tolerance in ((0.9, 0.03), (0.5, 0.05)):
        bound = (math.log(MAX_FACTOR / MIN_FACTOR) + START_GAIN * 5.0) / (GAIN * 900.0)
        miss = abs((scores <= factors[level]).mean() - level)
        assert miss < min(tolerance, bound), level
    assert (factors[0.5] <= factors[0.9]).all()


def test_scores_count_only_after_their_horizon():
    starts, errors = draw_errors(60, lambda t: 50.0)
    adaptive, conditions = AdaptiveBand(TIME, unit_band()), np.tile(CONDITION, (len(starts), 1))
    parts = [adaptive.replay(starts[rows], conditions[rows], errors[rows])[0][0.9]
             for rows in (slice(70), slice(70, None))]
    whole = AdaptiveBand(TIME, unit_band()).replay(starts, conditions, errors)[0]
    np.testing.assert_array_equal(np.concatenate(parts), whole[0.9])
    assert (whole[0.9][:50] == 4.0).all() and (np.diff(whole[0.9][49:60]) > 0.0).all()
    # A restart begins with the calibrated factors.
    assert AdaptiveBand(TIME, unit_band()).factors == {0.5: 2.0, 0.9: 4.0}


def test_non_finite_errors_unknown_starts_and_time_jumps_change_nothing():
    adaptive = AdaptiveBand(TIME, unit_band())
    adaptive.issue(1000, np.ones((10, 3)))
    adaptive.issue(2000, np.ones((10, 3)))
    for start, errors in ((500, np.zeros((10, 3))), (1000, np.full((10, 3), np.nan))):
        adaptive.observe(start, errors)
        assert adaptive.factors == {0.5: 2.0, 0.9: 4.0}
    adaptive.observe(2000, np.full((10, 3), 3.0))
    assert adaptive.factors[0.5] > 2.0 and adaptive.factors[0.9] < 4.0  # outside one level, inside the other
    adaptive.issue(1500, np.ones((10, 3)))
    before = adaptive.factors
    adaptive.observe(1500, np.full((10, 3), 99.0))
    assert adaptive.factors == before


def test_uncalibrated_level_starts_in_proportion_to_a_calibrated_one():
    half_only = unit_band()
    half_only.factors.pop(0.9)
    assert AdaptiveBand(TIME, half_only).factors == {0.5: 2.0, 0.9: pytest.approx(2.0 * 3.0 / 1.6)}


def test_bands_without_a_file_are_issued_after_the_warm_up_and_cover():
    starts, errors = draw_errors(600, lambda t: 1.0 + 3.0 * (t > 0.5))
    bands = AdaptiveBands(TIME, ["linear"], ["forecast", "course"])
    has_band, inside = [], []
    waiting = {}
    for start, window_errors in zip(starts.tolist(), errors, strict=True):
        scored_start = start - round(TIME[-1] * 1e9)
        if scored_start in waiting:
            path, widths = waiting.pop(scored_start)
            errors_from_start = np.concatenate([np.zeros((1, 3)), path])
            bands.observe(make_score("linear", "forecast", scored_start, TIME[1] - TIME[0], errors_from_start.T))
            if widths is not None:
                inside.append((np.abs(path) <= widths).all())
        found, reason = bands.issue(start, (10.0, 0.0, 0.0, 0.0), ("forecast", "course"))
        assert found <= {("linear", "forecast")} and not reason  # no course was scored
        has_band.append(bool(found))
        # Small angles: the frame of the prediction is that of the measurement.
        issued = bands.half_widths["linear"]["forecast", 0.9][1:].copy() if found else None
        waiting[start] = window_errors * (1.0, 1.0, 1.0e-3), issued
    seconds = (starts - starts[0]) * 1e-9
    assert not any(np.array(has_band)[seconds < WARM_UP + 4.0]) and all(np.array(has_band)[seconds > WARM_UP + 7.0])
    assert np.mean(inside) == pytest.approx(0.9, abs=0.03)
