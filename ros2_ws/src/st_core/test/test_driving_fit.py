"""Parameters fitted to predictions of several drives: values, their spread over runs, gates, bounds."""

import numpy as np
import pytest
from driven import Sensors, drive, weave, with_stiffness
from st_core.identification.driving_fit import DrivingFitSettings, fit_driving
from st_core.identification.driving_prediction import STIFFNESSES
from st_core.identification.result import IdentificationError

NAMES = (*STIFFNESSES, "steering_wheel_offset")


@pytest.fixture(scope="module")
def logs(leaf):
    noisy = Sensors(velocity=0.02, yaw_rate=0.01)
    return [drive(leaf, speed, weave(0.6 / speed), 20.0, sensors=noisy, seed=seed, name=f"run {seed}")
            for seed, speed in enumerate((6.5, 7.5, 8.5, 9.5, 10.5, 11.5, 12.5, 13.5, 14.5))]


@pytest.fixture(scope="module")
def fit(logs, leaf):
    return fit_driving(logs, with_stiffness(leaf, 60_000.0, 120_000.0), NAMES, "linear")


def test_fit_finds_the_car_with_its_spread_over_runs(fit, leaf):
    true = np.array([getattr(leaf, name) for name in NAMES])
    assert fit.values == pytest.approx(true, rel=0.03)
    assert (np.abs(fit.values - true) < 4.0 * fit.spread.deviations).all()
    assert not fit.at_bound and fit.spread.basis[0] == "9 runs" and (fit.spread.degrees_of_freedom == 8.0).all()
    assert fit.residuals.shape == (len(fit.run_of), 2)
    assert fit.prediction_count == sum(used for used, _ in fit.windows.values())


@pytest.mark.slow
def test_spread_is_that_of_fits_without_a_run(logs, leaf, fit):
    """The jackknife by complete fits: (k - 1) / k sum (theta_without - mean)^2."""
    car = with_stiffness(leaf, 60_000.0, 120_000.0)
    without = np.array([fit_driving(logs[:k] + logs[k + 1:], car, NAMES, "linear").values for k in range(9)])
    complete = np.sqrt(8.0 / 9.0 * np.square(without - without.mean(axis=0)).sum(axis=0))
    assert fit.spread.deviations == pytest.approx(complete, rel=0.25)


def test_predictions_beyond_the_gates_do_not_count(logs, leaf, fit):
    slow = fit_driving(logs, leaf, NAMES, "linear", DrivingFitSettings(minimum_speed=9.0))
    assert [slow.windows[f"run {k}"][0] > 0 for k in range(9)] == [False] * 3 + [True] * 6
    assert slow.prediction_count < fit.prediction_count
    with pytest.raises(IdentificationError, match=r"too little driving: 0 of \d+ predictions are faster than 40 m/s"):
        fit_driving(logs, leaf, NAMES, "linear", DrivingFitSettings(minimum_speed=40.0))


def test_a_value_beyond_the_bounds_is_named(logs, leaf):
    far = with_stiffness(leaf, 7.0 * leaf.cornering_stiffness_front, leaf.cornering_stiffness_rear)
    assert fit_driving(logs, far, STIFFNESSES[:1], "linear").at_bound == STIFFNESSES[:1]


def test_an_unknown_name_is_refused(logs, leaf):
    with pytest.raises(IdentificationError, match="cg_height: not identifiable from driving"):
        fit_driving(logs, leaf, ("cg_height",))
