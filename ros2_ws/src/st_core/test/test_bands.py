"""Bands: the conformal factor, the scale, what is refused, and that held-out runs are covered as promised."""

import numpy as np
import pytest
from st_core.bands import Bands, CalibrationDomain, ErrorSamples, calibrate, compute_highest_level
from st_core.bands.calibration import compute_conformal_factors, count_runs_needed
from st_core.bands.file import hash_configuration, make_times
from st_core.bands.samples import compute_error_samples, to_predicted_frame
from st_core.bands.scale import compute_floor, fit_scale
from st_core.errors import ConfigurationError, StCoreError
from st_core.log import DriveLog
from st_core.log_evaluation import EvaluationSettings
from st_core.models import get_model
from st_core.vehicle import VehicleParameters
from support import ROOT

QUESTION = ("linear", "hindsight")
SETTINGS = EvaluationSettings()
TIME = make_times(5.0, 0.05)
FILE = ROOT / "config" / "vehicle" / "leaf.yaml"


@pytest.fixture(scope="module")
def leaf():
    return VehicleParameters.from_yaml(FILE.read_text())


def true_scale(conditions):
    """m, m, rad: grows with time, speed and lateral acceleration."""
    size = 0.05 * (conditions[:, 0] / 10.0) * (1.0 + conditions[:, 1])
    return size[:, None, None] * TIME[:, None] ** 1.5 * np.array([0.5, 1.0, 0.1])


def drawn(number, windows=120, spread=0.3):
    """A run: one direction of error for the whole path of a window; a size of its own for the run."""
    draw = np.random.default_rng([5, number])
    conditions = np.stack([draw.uniform(4, 16, windows), draw.uniform(0, 4, windows), draw.uniform(0, 1, windows),
                           draw.uniform(0.0, 0.1, windows)], axis=1)
    size = np.exp(spread * draw.standard_normal()) * draw.standard_normal((windows, 1, 3))
    return ErrorSamples(f"run {number}", conditions, {QUESTION: (size * true_scale(conditions)).astype(np.float32)})


def test_one_window_a_run_is_the_split_conformal_quantile_of_crepes():
    crepes = pytest.importorskip("crepes", reason="crepes is not installed")
    residuals = np.random.default_rng(1).standard_normal(39)
    regressor = crepes.ConformalRegressor().fit(residuals)
    # Levels that leave whole numbers of 40 without rounding: crepes cuts 0.2 * 40 off to 7.
    for level in (0.5, 0.75, 0.875, 0.975):
        low, high = regressor.predict_int(np.zeros(1), confidence=level)[0]
        mine, = compute_conformal_factors([np.abs([r]) for r in residuals], [level])
        assert mine == pytest.approx(0.5 * (high - low), rel=1e-12)


def test_a_run_to_come_is_covered_as_promised_though_windows_repeat_each_other():
    draw = np.random.default_rng(2)
    covered = {0.5: [], 0.9: []}
    for _ in range(400):
        runs = [np.abs(np.exp(0.5 * draw.standard_normal()) * draw.standard_normal(30)) for _ in range(13)]
        for shares, c in zip(covered.values(), compute_conformal_factors(runs[1:], list(covered)), strict=True):
            shares.append(np.mean(runs[0] <= c))
    for level, shares in covered.items():
        assert np.mean(shares) == pytest.approx(level, abs=0.03)


def test_more_than_the_runs_can_promise_is_refused():
    assert compute_highest_level(8) == pytest.approx(8 / 9)
    assert count_runs_needed(0.9) == 9 and count_runs_needed(0.5) == 1
    with pytest.raises(StCoreError, match=r"^8 runs support at most 88\.9%.*give 9 runs") as caught:
        compute_conformal_factors([np.ones(5)] * 8, [0.9])
    assert "\n" not in str(caught.value)
    assert np.isfinite(compute_conformal_factors([np.arange(5.0)] * 9, [0.9])).all()
    with pytest.raises(StCoreError, match="not finite"):
        compute_conformal_factors([np.array([1.0, np.nan])] * 9, [0.5])


def test_the_scale_that_errors_were_drawn_with_is_found():
    runs = [drawn(k, 300, 0.0) for k in range(20)]
    scale = fit_scale([r.conditions for r in runs], [r.errors[QUESTION] for r in runs], TIME)
    probe = np.array([[6.0, 1.0, 0.5, 0.03], [12.0, 3.0, 0.5, 0.03]])
    for second in (1.0, 2.0, 5.0):
        point = int(np.abs(TIME - second).argmin())
        found, true = scale(probe)[:, point], true_scale(probe)[:, point]
        assert np.hypot(true, compute_floor(scale.floor, TIME)[point]) == pytest.approx(found, rel=0.25)


def test_bands_cover_runs_they_were_not_learnt_from_and_not_everything():
    # Runs much alike, so that one set of them says what the method does: 0.1/sqrt(24) moves a coverage by 0.02.
    band = calibrate([drawn(k, spread=0.1) for k in range(24)], QUESTION, TIME)
    scores = [(np.abs(r.errors[QUESTION]) / band.scale(r.conditions)).max(axis=(1, 2))
              for r in (drawn(100 + k, spread=0.1) for k in range(60))]
    shares = {level: np.mean([(one <= band.factors[level]).mean() for one in scores]) for level in (0.5, 0.9)}
    assert shares[0.9] == pytest.approx(0.9, abs=0.04) and shares[0.5] == pytest.approx(0.5, abs=0.06)
    factors = list(band.factors.values())
    assert factors == sorted(factors) and max(band.factors) <= compute_highest_level(24)


def test_no_band_of_few_runs_or_errors_that_are_not_finite():
    with pytest.raises(StCoreError, match=r"^2 runs: each run is scored with bands of two others; give 3 or more"):
        calibrate([drawn(k) for k in range(2)], QUESTION, TIME, (0.5,))
    with pytest.raises(StCoreError, match="5 runs support at most 83"):
        calibrate([drawn(k) for k in range(5)], QUESTION, TIME)
    runs = [drawn(k) for k in range(9)]
    runs[3].errors[QUESTION][7, 50, 1] = np.inf
    with pytest.raises(StCoreError, match=r"^run 3: errors of linear are not finite; correct"):
        calibrate(runs, QUESTION, TIME)


def test_runs_whose_conditions_no_other_has_do_not_count():
    runs = [drawn(k) for k in range(9)]
    lonely = drawn(9)
    lonely.conditions[:, 0] += 30.0
    with pytest.raises(StCoreError, match=r"2 of 10 runs were driven under conditions.*8 runs support"):
        calibrate([*runs[:8], lonely, ErrorSamples("far", drawn(8).conditions + np.array([0, 8, 0, 0]),
                                                   drawn(8).errors)],
                  QUESTION, TIME)


def test_errors_are_turned_into_the_predicted_frame():
    # Measured heading north, predicted one 0.1 rad to the left of it; predicted 2 m ahead.
    along, across, yaw = to_predicted_frame(np.array([2.0, 0.0, 0.1]))
    predicted = np.array([0.0, 2.0])
    heading = np.pi / 2 + 0.1
    forward, left = np.array([np.cos(heading), np.sin(heading)]), np.array([-np.sin(heading), np.cos(heading)])
    assert (along, across, yaw) == pytest.approx((predicted @ forward, predicted @ left, 0.1))


def test_a_run_shorter_than_the_horizon_is_refused(leaf):
    time = np.arange(0, 4_000_000_000, 20_000_000)
    zero = np.zeros(len(time))
    log = DriveLog("short", time, time * 1e-8, zero, zero, zero + 10.0, zero, zero, time, zero)
    with pytest.raises(StCoreError, match=r"overlap for 4\.0 s, less than the horizon of 5 s"):
        compute_error_samples([get_model("linear")], leaf, SETTINGS.signals(log), SETTINGS)


@pytest.fixture(scope="module")
def bands(leaf):
    runs = [drawn(k) for k in range(12)]
    settings = SETTINGS.as_dict()
    other = ("linear", "forecast")
    band = calibrate(runs, QUESTION, TIME)
    return Bands(leaf.name, leaf.hash, settings, {"a.csv": "0" * 64}, 12,
                 CalibrationDomain.of([r.conditions for r in runs]),
                 {QUESTION: band, other: band}, {"linear": hash_configuration(leaf, settings, "")})


def test_a_file_is_read_back_and_an_edited_one_refused(bands):
    text = bands.to_yaml()
    again = Bands.from_yaml(text)
    probe = np.array([[8.0, 1.0, 0.2, 0.02], [40.0, 1.0, 0.2, 0.02]])
    widths = again.half_widths("linear", "hindsight", probe, 0.9)
    assert np.array_equal(widths, bands.half_widths("linear", "hindsight", probe, 0.9), equal_nan=True)
    assert widths.shape == (2, 101, 3) and (widths[0, 0] == 0).all() and np.isnan(widths[1]).all()
    assert (widths[0, 1:] > bands.half_widths("linear", "hindsight", probe, 0.5)[0, 1:]).all()
    assert again.to_yaml() == text
    with pytest.raises(ConfigurationError, match="x: hash: the content was edited"):
        Bands.from_yaml(text.replace("runs: 12", "runs: 99"), "x")
    for broken in ("", "schema: 1", text[:len(text) // 2], "[1, 2]"):
        with pytest.raises(ConfigurationError) as caught:
            Bands.from_yaml(broken, "x")
        assert "\n" not in str(caught.value)


def test_conditions_never_seen_are_named(bands):
    why = bands.domain.describe_outside
    assert why(np.array([8.0, 1.0, 0.2, 0.02])) == ""
    assert why(np.array([40.0, 1.0, 0.2, 0.02])) == (
        "40.0 m/s with 1.0 m/s^2 lateral acceleration was driven in fewer than 2 calibration runs")
    assert why(np.array([8.0, 1.0, 0.2, 0.5])).startswith("steering activity 0.5 rad/s exceeds the calibrated 0.0")
    assert why(np.array([8.0, 1.0, 0.2, np.nan])) == "steering activity is unknown"


def test_what_one_run_alone_did_is_not_calibrated():
    slow, fast = (np.tile([speed, 1.5, 0.2, 0.02], (400, 1)) for speed in (8.0, 22.0))
    few = fast[:9]
    probe = np.stack([slow[0], fast[0]])
    assert CalibrationDomain.of([slow, np.concatenate([slow, fast])])(probe).tolist() == [True, False]
    thin = CalibrationDomain.of([np.concatenate([slow, few]), np.concatenate([slow, fast])])
    assert thin(probe).tolist() == [True, False]
    assert CalibrationDomain.of([np.concatenate([slow, fast[:10]]), np.concatenate([slow, fast])])(probe).all()


def test_bands_of_another_car_model_or_configuration_are_refused(bands, leaf):
    bands.check(leaf, {"linear": ""}, SETTINGS)
    other = VehicleParameters.from_yaml(FILE.read_text().replace("steering_ratio: {value: 17.3",
                                                                 "steering_ratio: {value: 16.3"))
    for refused, words in (((other, {"linear": ""}, SETTINGS), "vehicle: the bands are for"),
                           ((leaf, {"nonlinear": ""}, SETTINGS), "nonlinear: missing"),
                           ((leaf, {"linear": "f" * 64}, SETTINGS), "another model file"),
                           ((leaf, {"linear": ""}, EvaluationSettings(acceleration="zero_phase")), "acceleration")):
        with pytest.raises(ConfigurationError, match=words):
            bands.check(*refused)


def test_half_widths_as_a_casadi_function_are_those_of_the_band(bands, leaf):
    casadi = pytest.importorskip("casadi", reason="casadi is not installed")
    from st_offline.model_export import make_half_width_function

    band = bands.bands[QUESTION]
    function = casadi.Function.deserialize(make_half_width_function(band, 0.9, leaf).serialize())
    for velocity, rate, acceleration, activity in ((12.0, 0.2, -1.0, 0.03), (0.0,) * 4, (30.0, -0.2, 3.0, 0.2)):
        here = np.abs([[velocity, velocity * rate, acceleration, activity]])
        found = function([0.0, 0.0, velocity, 0.1, 0.5, rate], [0.02, acceleration], activity)
        np.testing.assert_allclose(np.asarray(found), band.half_widths(here, 0.9)[0], rtol=1e-9)
    with pytest.raises(ConfigurationError, match="bands have"):
        make_half_width_function(band, 0.99, leaf)
