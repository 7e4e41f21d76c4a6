"""Parameters fitted to predictions of several drives: values, spread over runs, speed limit, bounds."""

import numpy as np
import pytest
from driven import Sensors, drive, weave, with_stiffness
from scipy import stats
from st_core.identification.driving_fit import DrivingFitSettings, fit_driving
from st_core.identification.driving_prediction import STIFFNESSES, _make_identification
from st_core.identification.result import IdentificationError
from st_core.regression import Z95

NAMES = (*STIFFNESSES, "steering_wheel_offset")


@pytest.fixture(scope="module")
def logs(leaf):
    noisy = Sensors(velocity=0.02, yaw_rate=0.01)
    return [drive(leaf, speed, weave(0.6 / speed), 20.0, sensors=noisy, seed=seed, name=f"run {seed}")
            for seed, speed in enumerate((6.5, 7.5, 8.5, 9.5, 10.5, 11.5, 12.5, 13.5, 14.5))]


@pytest.fixture(scope="module")
def fit(logs, leaf):
    return fit_driving(logs, with_stiffness(leaf, 60_000.0, 120_000.0), NAMES, "linear")


def test_fit_recovers_parameters_within_their_spread_over_runs(fit, leaf):
    true = np.array([getattr(leaf, name) for name in NAMES])
    assert fit.values == pytest.approx(true, rel=0.03)
    assert (np.abs(fit.values - true) < 4.0 * fit.spread.standard_errors).all()
    assert not fit.at_bound and fit.spread.basis[0] == "9 runs" and (fit.spread.degrees_of_freedom == 8.0).all()
    deviations = {channel: np.std(values) for channel, values in fit.residuals.items()}
    assert deviations.keys() == {"velocity_y", "yaw_rate"}
    assert deviations["velocity_y"] == pytest.approx(0.02, rel=0.3) and deviations["yaw_rate"] < 0.01  # of the noise
    assert all(values.shape == fit.run_index.shape for values in fit.residuals.values())
    assert fit.prediction_count == sum(used for used, _ in fit.window_counts.values())


@pytest.mark.slow
def test_spread_equals_jackknife_of_complete_fits(logs, leaf, fit):
    """The jackknife by complete fits: (k - 1) / k sum (theta_without - mean)^2."""
    car = with_stiffness(leaf, 60_000.0, 120_000.0)
    without = np.array([fit_driving(logs[:k] + logs[k + 1:], car, NAMES, "linear").values for k in range(9)])
    complete = np.sqrt(8.0 / 9.0 * np.square(without - without.mean(axis=0)).sum(axis=0))
    assert fit.spread.standard_errors == pytest.approx(complete, rel=0.25)


def test_students_t_does_not_apply_to_errors_of_the_single_track_model(fit, leaf):
    """These are known; a systematic error estimated from the same drives has the interval of Student's t."""
    systematic = {NAMES[0]: 0.5 * leaf.cornering_stiffness_front}
    found = _make_identification("stiffness", leaf, fit, "", NAMES, systematic, {})
    factors = [(found[n].interval95[1] - found[n].value) / found[n].standard_uncertainty for n in NAMES]
    student = stats.t.ppf(0.975, fit.spread.degrees_of_freedom)
    assert factors[0] == pytest.approx(student[0], rel=1e-3) and Z95 <= factors[2] < 0.999 * student[2]


def test_predictions_below_minimum_speed_are_excluded(logs, leaf, fit):
    fast_only = fit_driving(logs, leaf, NAMES, "linear", DrivingFitSettings(minimum_speed=9.0))
    assert [fast_only.window_counts[f"run {k}"][0] > 0 for k in range(9)] == [False] * 3 + [True] * 6
    assert fast_only.prediction_count < fit.prediction_count
    with pytest.raises(IdentificationError, match=r"driving: 0 of \d+ windows of [0-9.]+ s are faster than 40 m/s"):
        fit_driving(logs, leaf, NAMES, "linear", DrivingFitSettings(minimum_speed=40.0))


def test_value_at_its_bound_is_reported(logs, leaf):
    start = with_stiffness(leaf, 7.0 * leaf.cornering_stiffness_front, leaf.cornering_stiffness_rear)
    assert fit_driving(logs, start, STIFFNESSES[:1], "linear").at_bound == STIFFNESSES[:1]


def test_unknown_parameter_is_rejected(logs, leaf):
    with pytest.raises(IdentificationError, match="cg_height: not identifiable from driving; choose from cornering"):
        fit_driving(logs, leaf, ("cg_height",))
