"""Bands: conformal factor, scale, rejected inputs, and coverage of held-out runs at the stated level."""

import re

import numpy as np
import pytest
from st_core import bands as package
from st_core.bands import Bands, CalibrationDomain, ErrorSamples, calibrate
from st_core.bands.calibration import (
    compute_conformal_factors,
    compute_error_samples,
    compute_highest_level,
    count_required_runs,
    to_predicted_frame,
)
from st_core.bands.file import hash_configuration, make_times
from st_core.bands.scale import fit_scale
from st_core.errors import ConfigurationError, StCoreError
from st_core.log import DriveLog
from st_core.log_evaluation import EvaluationSettings
from st_core.models import get_model
from st_core.vehicle import VehicleParameters
from support import ROOT

PAIR = ("linear", "hindsight")
SETTINGS = EvaluationSettings()
TIME = make_times(5.0, 0.05)
FILE = ROOT / "config" / "vehicle" / "leaf.yaml"


def true_scale(conditions):
    """(n, times, 3) [m, m, rad]: grows with time, speed and lateral acceleration."""
    size = 0.05 * (conditions[:, 0] / 10.0) * (1.0 + conditions[:, 1])
    return size[:, None, None] * TIME[:, None] ** 1.5 * np.array([0.5, 1.0, 0.1])


def draw_run(number, windows=120, spread=0.3):
    """A run with a common error magnitude; within a window the errors of an axis have a fixed ratio to true_scale."""
    draw = np.random.default_rng([5, number])
    conditions = np.stack([draw.uniform(4, 16, windows), draw.uniform(0, 4, windows), draw.uniform(0, 1, windows),
                           draw.uniform(0.0, 0.1, windows)], axis=1)
    size = np.exp(spread * draw.standard_normal()) * draw.standard_normal((windows, 1, 3))
    return ErrorSamples(f"run {number}", conditions, {PAIR: (size * true_scale(conditions)).astype(np.float32)})


def test_factor_with_one_window_per_run_equals_crepes():
    crepes = pytest.importorskip("crepes", reason="crepes is not installed")
    residuals = np.random.default_rng(1).standard_normal(39)
    regressor = crepes.ConformalRegressor().fit(residuals)
    # Levels that are exact multiples of 1/40: crepes truncates 0.2 * 40 to 7.
    for level in (0.5, 0.75, 0.875, 0.975):
        low, high = regressor.predict_int(np.zeros(1), confidence=level)[0]
        factor, = compute_conformal_factors([np.abs([r]) for r in residuals], [level])
        assert factor == pytest.approx(0.5 * (high - low), rel=1e-12)


def test_new_run_is_covered_at_the_level_despite_correlated_windows():
    draw = np.random.default_rng(2)
    covered = {0.5: [], 0.9: []}
    for _ in range(400):
        runs = [np.abs(np.exp(0.5 * draw.standard_normal()) * draw.standard_normal(30)) for _ in range(13)]
        for shares, c in zip(covered.values(), compute_conformal_factors(runs[1:], list(covered)), strict=True):
            shares.append(np.mean(runs[0] <= c))
    for level, shares in covered.items():
        assert np.mean(shares) == pytest.approx(level, abs=0.03)


def test_level_above_what_the_runs_support_is_rejected():
    assert compute_highest_level(8) == pytest.approx(8 / 9)
    assert count_required_runs(0.9) == 9 and count_required_runs(0.5) == 1
    with pytest.raises(StCoreError, match=r"^8 runs support levels up to 88\.9 %.*give 9 runs") as caught:
        compute_conformal_factors([np.ones(5)] * 8, [0.9])
    assert "\n" not in str(caught.value)
    assert np.isfinite(compute_conformal_factors([np.arange(5.0)] * 9, [0.9])).all()


def test_fitted_scale_matches_the_true_scale():
    runs = [draw_run(k, 300, 0.0) for k in range(20)]
    scale = fit_scale([r.conditions for r in runs], [r.errors[PAIR] for r in runs], TIME)
    probe = np.array([[6.0, 1.0, 0.5, 0.03], [12.0, 3.0, 0.5, 0.03]])
    for second in (1.0, 2.0, 5.0):
        point = int(np.abs(TIME - second).argmin())
        found, true = scale(probe)[:, point], true_scale(probe)[:, point]
        assert np.hypot(true, scale.floors[point]) == pytest.approx(found, rel=0.25)


def test_bands_cover_held_out_runs_at_their_level():
    # Similar runs, so that one calibration set is representative: 0.1/sqrt(24) changes the coverage by 0.02.
    band = calibrate([draw_run(k, spread=0.1) for k in range(24)], PAIR, TIME)
    scores = [(np.abs(r.errors[PAIR]) / band.scale(r.conditions)).max(axis=(1, 2))
              for r in (draw_run(100 + k, spread=0.1) for k in range(60))]
    shares = {level: np.mean([(of_run <= band.factors[level]).mean() for of_run in scores]) for level in (0.5, 0.9)}
    assert shares[0.9] == pytest.approx(0.9, abs=0.04) and shares[0.5] == pytest.approx(0.5, abs=0.06)
    factors = list(band.factors.values())
    assert factors == sorted(factors) and max(band.factors) <= compute_highest_level(24)


def test_too_few_runs_and_non_finite_errors_are_rejected():
    with pytest.raises(StCoreError, match=r"^2 runs: the errors of each run are scaled by a fit to at least two"):
        calibrate([draw_run(k) for k in range(2)], PAIR, TIME, (0.5,))
    with pytest.raises(StCoreError, match="5 runs support levels up to 83"):
        calibrate([draw_run(k) for k in range(5)], PAIR, TIME)
    with pytest.raises(StCoreError, match=r"not 99\.5 %: give 199 runs"):  # not rounded to 100 %
        calibrate([draw_run(k) for k in range(5)], PAIR, TIME, (0.995,))
    runs = [draw_run(k) for k in range(9)]
    runs[3].errors[PAIR][7, 50, 1] = np.inf
    with pytest.raises(StCoreError, match=r"^run 3: errors of linear are not finite; correct"):
        calibrate(runs, PAIR, TIME)


def test_runs_with_unshared_conditions_are_not_counted():
    runs = [draw_run(k) for k in range(8)]
    fast, hard = draw_run(9), draw_run(8)  # more speed, more lateral acceleration
    fast.conditions[:, 0] += 30.0
    hard.conditions[:, 1] += 8.0
    with pytest.raises(StCoreError, match=r"2 of 10 runs were driven only under conditions.*8 runs support"):
        calibrate([*runs, fast, hard], PAIR, TIME)


def test_errors_are_rotated_into_the_predicted_frame():
    # Measured heading north, predicted heading 0.1 rad further left; predicted position 2 m ahead.
    along, across, yaw = to_predicted_frame(np.array([2.0, 0.0, 0.1]))
    predicted = np.array([0.0, 2.0])
    heading = np.pi / 2 + 0.1
    forward, left = np.array([np.cos(heading), np.sin(heading)]), np.array([-np.sin(heading), np.cos(heading)])
    assert (along, across, yaw) == pytest.approx((predicted @ forward, predicted @ left, 0.1))


def test_run_shorter_than_the_horizon_is_rejected(leaf):
    time = np.arange(0, 4_000_000_000, 20_000_000)
    zero = np.zeros(len(time))
    log = DriveLog("short", time, time * 1e-8, zero, zero, zero + 10.0, zero, zero, time, zero)
    with pytest.raises(StCoreError, match=r"overlap for 4\.0 s, less than the horizon of 5 s"):
        compute_error_samples([get_model("linear")], leaf, SETTINGS.signals(log), SETTINGS)


@pytest.fixture(scope="module")
def bands(leaf):
    runs = [draw_run(k) for k in range(12)]
    settings = SETTINGS.as_dict()
    other = ("linear", "forecast")
    band = calibrate(runs, PAIR, TIME)
    return Bands(leaf.name, leaf.hash, settings, {"a.csv": "0" * 64}, 12,
                 CalibrationDomain.from_runs([r.conditions for r in runs]),
                 {PAIR: band, other: band}, {"linear": hash_configuration(leaf, settings, "")})


def test_example_of_the_page_works(bands, leaf):
    page = (ROOT / "docs" / "manual" / "bands.md").read_text()
    names = {**vars(package), "text": bands.to_yaml(), "vehicle": leaf, "settings": SETTINGS, "start_ns": 10**9,
             "velocity_x": 10.0, "yaw_rate": 0.2, "velocity_x_dot": 0.1, "errors": np.zeros((100, 3)),
             "angles": np.linspace(0.0, 0.02, len(package.activity_instants(10**9)))}
    exec(re.search(r"```python\n(.*?)```", page, re.S)[1], names)
    assert names["z"].shape == (4,)
    assert names["bands"].half_widths("linear", "forecast", names["z"], 0.9).shape == (1, 101, 3)


def test_file_round_trip_and_rejection_of_edited_files(bands):
    text = bands.to_yaml()
    reloaded = Bands.from_yaml(text)
    probe = np.array([[8.0, 1.0, 0.2, 0.02], [40.0, 1.0, 0.2, 0.02]])
    widths = reloaded.half_widths("linear", "hindsight", probe, 0.9)
    assert np.array_equal(widths, bands.half_widths("linear", "hindsight", probe, 0.9), equal_nan=True)
    assert widths.shape == (2, 101, 3) and (widths[0, 0] == 0).all() and np.isnan(widths[1]).all()
    assert (widths[0, 1:] > bands.half_widths("linear", "hindsight", probe, 0.5)[0, 1:]).all()
    assert reloaded.to_yaml() == text
    with pytest.raises(ConfigurationError, match="x: hash: the content was edited"):
        Bands.from_yaml(text.replace("runs: 12", "runs: 99"), "x")
    with pytest.raises(ConfigurationError, match="x: schema: 2 is not supported, only 3; run st calibrate again"):
        Bands.from_yaml(text.replace("schema: 3", "schema: 2").replace("calibration_domain", "seen"), "x")
    for broken in ("", "schema: 1", text[:len(text) // 2], "[1, 2]"):
        with pytest.raises(ConfigurationError) as caught:
            Bands.from_yaml(broken, "x")
        assert "\n" not in str(caught.value)


def test_conditions_outside_the_calibration_are_described(bands):
    describe = bands.domain.describe_outside
    assert describe(np.array([8.0, 1.0, 0.2, 0.02])) == ""
    assert describe(np.array([40.0, 1.0, 0.2, 0.02])) == (
        "40.0 m/s with 1.0 m/s^2 lateral acceleration: fewer than 2 calibration runs have 10 predictions in this range")
    activity = describe(np.array([8.0, 1.0, 0.2, 0.5]))
    assert activity.startswith("steering activity 0.5 rad/s exceeds the calibrated limit 0.0")
    assert describe(np.array([8.0, 1.0, 0.2, np.nan])) == "steering activity is unknown"


def test_conditions_of_a_single_run_are_outside_the_calibration():
    slow, fast = (np.tile([speed, 1.5, 0.2, 0.02], (400, 1)) for speed in (8.0, 22.0))
    probe = np.stack([slow[0], fast[0]])
    assert CalibrationDomain.from_runs([slow, np.concatenate([slow, fast])]).contains(probe).tolist() == [True, False]
    # Fewer than 10 windows of a run do not count.
    sparse = CalibrationDomain.from_runs([np.concatenate([slow, fast[:9]]), np.concatenate([slow, fast])])
    assert sparse.contains(probe).tolist() == [True, False]
    enough = CalibrationDomain.from_runs([np.concatenate([slow, fast[:10]]), np.concatenate([slow, fast])])
    assert enough.contains(probe).all()


def test_bands_of_a_different_car_model_or_configuration_are_rejected(bands, leaf):
    bands.check(leaf, {"linear": ""}, SETTINGS)
    other = VehicleParameters.from_yaml(FILE.read_text().replace("steering_ratio: {value: 17.3",
                                                                 "steering_ratio: {value: 16.3"))
    for arguments, message in (((other, {"linear": ""}, SETTINGS), "vehicle: the bands are for"),
                               ((leaf, {"nonlinear": ""}, SETTINGS), "nonlinear: missing"),
                               ((leaf, {"linear": "f" * 64}, SETTINGS), "a different model of this name"),
                               ((leaf, {"linear": ""}, EvaluationSettings(acceleration="zero_phase")), "acceleration")):
        with pytest.raises(ConfigurationError, match=message):
            bands.check(*arguments)


def test_casadi_half_widths_equal_those_of_the_band(bands, leaf):
    casadi = pytest.importorskip("casadi", reason="casadi is not installed")
    from st_offline.model_export import make_half_width_function

    band = bands.bands[PAIR]
    function = casadi.Function.deserialize(make_half_width_function(band, 0.9, leaf).serialize())
    for velocity, rate, acceleration, activity in ((12.0, 0.2, -1.0, 0.03), (0.0,) * 4, (30.0, -0.2, 3.0, 0.2)):
        conditions = np.abs([[velocity, velocity * rate, acceleration, activity]])
        found = function([0.0, 0.0, velocity, 0.1, 0.5, rate], [0.02, acceleration], activity)
        np.testing.assert_allclose(np.asarray(found), band.half_widths(conditions, 0.9)[0], rtol=1e-9)
    with pytest.raises(ConfigurationError, match="bands have"):
        make_half_width_function(band, 0.99, leaf)
