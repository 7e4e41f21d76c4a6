"""Fits of multi-step predictions: drives kept apart, bootstrap, profile, bounds."""

from dataclasses import replace

import numpy as np
import pytest
from driven import Sensors, drive, weave
from st_core.identification import resampling
from st_core.identification.free_parameters import Applied, with_stiffness
from st_core.identification.prediction_error import PredictionError
from st_core.identification.profile import profile
from st_core.identification.stiffness_prediction import STIFFNESSES

NAMES = (*STIFFNESSES, "steering_wheel_offset")


@pytest.fixture(scope="module")
def logs(leaf):
    noisy = Sensors(velocity=0.02, yaw_rate=0.01)
    return [drive(leaf, speed, weave(0.6 / speed), 20.0, sensors=noisy, seed=seed, name=f"run {seed}")
            for seed, speed in enumerate((6.5, 7.5, 8.5, 9.5, 10.5, 11.5, 12.5, 13.5, 14.5))]


@pytest.fixture(scope="module")
def problem(logs, leaf):
    return PredictionError(logs, with_stiffness(leaf, 60_000.0, 120_000.0), NAMES, "linear")


@pytest.fixture(scope="module")
def fit(problem):
    return problem.fit()


def test_drives_do_not_touch_each_other(logs, problem, leaf):
    """Residuals of all drives in one batch are those of each drive alone."""
    together = problem.residuals(problem.start)
    alone = [PredictionError([log], problem.vehicle, NAMES, "linear", replace(problem.settings, fewest_starts=1))
             .residuals(problem.start) for log in logs]
    assert np.array_equal(together.shape, np.concatenate(alone).shape)
    assert np.allclose(together, np.concatenate(alone), rtol=0, atol=1e-9)


def test_a_gap_costs_only_the_starts_that_reach_into_it(logs, problem):
    log = logs[0]
    seconds = (log.ins_time_ns - log.start_ns) * 1e-9
    keep = (seconds < 8.0) | (seconds > 8.5)
    columns = {name: getattr(log, name)[keep] for name in ("ins_time_ns", "x", "y", "yaw", "velocity_x", "velocity_y",
                                                           "yaw_rate")}
    holed = PredictionError([replace(log, **columns), *logs[1:]], problem.vehicle, NAMES, "linear")
    lost = problem.starts["run 0"] - holed.starts["run 0"]
    assert 3 <= lost <= 5  # 1.5 s of horizon and half a second of gap, at two starts a second
    assert np.isfinite(holed.residuals(holed.start)).all()


def test_fit_finds_the_car(fit, leaf):
    assert fit.values == pytest.approx([leaf.cornering_stiffness_front, leaf.cornering_stiffness_rear,
                                        leaf.steering_wheel_offset], rel=0.03)
    assert not fit.at_bound


def test_one_step_bootstrap_agrees_with_complete_fits(problem, fit):
    drawn = fit.bootstrap(20, seed=7)
    weights = drawn.pieces.draws(20, 7)
    complete = np.array([problem.fit(fit.values, fit.noise, weights=row).values for row in weights[:6]])
    spread = drawn.values.std(axis=0)
    assert (np.abs(drawn.values[:6] - complete) < 0.1 * spread).all()
    assert drawn.words(0) == "9 runs" and (drawn.worth == 9.0).all()


def test_profile_has_its_least_at_the_estimate_and_ends_like_the_bootstrap(problem, fit):
    uncertainty = float(fit.bootstrap(200, seed=0).values[:, 0].std())
    found = profile(problem, fit, STIFFNESSES[0], uncertainty)
    assert found.deviance.argmin() == 3 and found.deviance[3] == 0.0
    low, high = found.interval95
    assert (low, high) == pytest.approx((fit.values[0] - 1.96 * uncertainty, fit.values[0] + 1.96 * uncertainty),
                                        abs=0.3 * uncertainty)


def test_a_value_beyond_the_bounds_is_said(logs, leaf):
    far = with_stiffness(leaf, 7.0 * leaf.cornering_stiffness_front, leaf.cornering_stiffness_rear)
    fit = PredictionError(logs, far, STIFFNESSES[:1], "linear").fit()
    assert fit.at_bound == STIFFNESSES[:1]


def test_applied_values_move_steering_and_car(leaf):
    apply = Applied(leaf, "linear", ("steering_ratio", "steering_wheel_offset", "cornering_stiffness_rear"))
    model, car, misalignment = apply((20.0, 0.1, 90_000.0))
    hand = 0.7
    p = model.parameters(car)
    given = model.inputs(leaf.road_wheel_angle(hand), 0.0, p)
    wanted = model.base.inputs((hand - 0.1) / 20.0, 0.0, model.base.parameters(car))
    assert np.allclose(np.array(given[:len(wanted)]), np.array(wanted), atol=1e-12)
    assert car.cornering_stiffness_rear == 90_000.0 and misalignment == 0.0
    assert car.tyre_rear.lambda_ky / leaf.tyre_rear.lambda_ky == pytest.approx(90_000.0 / leaf.cornering_stiffness_rear)


def test_pieces_are_runs_or_blocks_of_few_runs():
    run_of, time = np.repeat(np.arange(9), 30), np.tile(np.arange(30.0), 9)
    assert resampling.pieces(run_of, time).words == "9 runs"
    pieces = resampling.pieces(run_of[:60], time[:60])
    assert pieces.words == "6 blocks of 10 s from 2 runs" and np.array_equal(np.bincount(pieces.of), [10] * 6)


def test_intervals_hold_a_mean_as_often_as_they_say():
    """95 % intervals of the mean of ten runs of correlated samples, over 400 repetitions."""
    generator = np.random.default_rng(0)
    held = 0
    for number in range(400):
        values = np.repeat(generator.standard_normal(10), 20) + 0.3 * generator.standard_normal(200)
        low, high = _interval_of_mean(values, np.repeat(np.arange(10), 20), np.zeros(200), number)
        held += low < 0.0 < high
    assert 0.92 <= held / 400 <= 0.98


@pytest.mark.parametrize(("wander", "seconds"), [(0.0, 60), (20.0, 30), (20.0, 60)])
def test_an_error_that_outlasts_a_block_makes_intervals_wider(wander, seconds):
    """95 % intervals of the mean of five runs whose error wanders over `wander` seconds, over 400 repetitions."""
    generator = np.random.default_rng(1)
    run_of, time = np.repeat(np.arange(5), seconds), np.tile(np.arange(float(seconds)), 5)
    memory = np.exp(-1.0 / wander) if wander else 0.0
    held = 0
    for number in range(400):
        draws = generator.standard_normal((5, seconds))
        draws[:, 1:] *= np.sqrt(1.0 - memory**2)
        for k in range(1, seconds):
            draws[:, k] += memory * draws[:, k - 1]
        low, high = _interval_of_mean(draws.ravel(), run_of, time, number)
        held += low < 0.0 < high
    assert 0.9 <= held / 400 <= 0.99


def _interval_of_mean(values, run_of, time, seed):
    pieces = resampling.pieces(run_of, time)
    totals = pieces.sums(np.stack([np.ones_like(values), values], axis=1))
    drawn = resampling.bootstrap(lambda weights: (weights @ totals[:, 1:]) / (weights @ totals[:, :1]), pieces, 200,
                                 seed)
    return drawn.interval(0, values.mean(), drawn.covariance[0, 0] ** 0.5)
