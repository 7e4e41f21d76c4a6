"""Fits of multi-step predictions: drives kept apart, influence of a run, bounds."""

from dataclasses import replace

import numpy as np
import pytest
from driven import Sensors, drive, weave
from st_core.identification.blocks import blocks
from st_core.identification.driving_prediction import STIFFNESSES
from st_core.identification.free_parameters import Applied, with_stiffness
from st_core.identification.prediction_error import PredictionError

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


def test_influence_of_a_run_is_the_change_of_a_complete_fit_without_it(problem, fit):
    group = blocks(fit.run_of, fit.time)
    influence = group.influence(fit.jacobian, fit.residuals) * 9.0 / 8.0
    spread = fit.spread()
    for run in (0, 4, 8):
        weights = np.ones(9)
        weights[run] = 0.0
        moved = problem.fit(fit.values, fit.noise, weights=weights).values - fit.values
        assert (np.abs(moved - influence[run]) < 0.15 * spread.deviations).all()
    assert spread.basis[0] == "9 runs" and (spread.freedom == 8.0).all()


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
