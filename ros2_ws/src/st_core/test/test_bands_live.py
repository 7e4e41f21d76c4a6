"""Live bands: same numbers as offline; delay and false alarm rate of the warning of lost coverage."""

import math
from itertools import count

import numpy as np
import pytest
from st_core.bands import (
    Bands,
    CalibratedBands,
    CalibrationDomain,
    CoverageMonitor,
    activity_instants,
    calibrate,
    compute_error_samples,
    conditions_at,
    conditions_now,
    steering_activity,
)
from st_core.bands.file import hash_configuration
from st_core.bands.live import ALTERNATIVE_RATIO, FALSE_WARNING_TIME, BandCoverage
from st_core.evaluation import make_score
from st_core.log import DriveLog
from st_core.log_evaluation import EvaluationSettings
from st_core.measurement_history import MeasurementHistory
from st_core.models import get_model
from st_core.types import InsSample
from winding_road import Truth, winding_road

MODELS = ("kinematic", "linear")
SETTINGS = EvaluationSettings()
SECOND = 1_000_000_000


@pytest.fixture(scope="module")
def logs(leaf):
    """Ten drives for calibration and one for the comparison, all with the same car."""
    truth = Truth(0.0, leaf.steering_ratio, 0.95)
    drives = [winding_road(leaf, truth, 25.0, seed) for seed in range(11)]
    return [DriveLog(f"road {k}", *make_columns(drive, leaf)) for k, drive in enumerate(drives)]


def make_columns(rows, car):
    time_ns = 1_700_000_000 * SECOND + np.round(rows[:, 0] * 1e9).astype(np.int64)
    return time_ns, *rows[:, 1:7].T, time_ns, car.road_wheel_angle(rows[:, 7]), rows[:, 7]


@pytest.fixture(scope="module")
def bands(leaf, logs):
    models = [get_model(name) for name in MODELS]
    runs = [compute_error_samples(models, leaf, SETTINGS.signals(log), SETTINGS) for log in logs[:10]]
    time = SETTINGS.prediction.step * np.arange(1, SETTINGS.prediction.steps + 1)
    found = {(m, q): calibrate(runs, (m, q), time) for m in MODELS for q in ("hindsight", "forecast")}
    hashes = {m: hash_configuration(leaf, SETTINGS.as_dict(), "") for m in MODELS}
    domain = CalibrationDomain.from_runs([r.conditions for r in runs])
    return Bands(leaf.name, leaf.hash, SETTINGS.as_dict(), {}, 10, domain, found, hashes)


@pytest.mark.slow
def test_live_bands_equal_those_of_the_file_for_the_recorded_drive(bands, logs):
    log, live = logs[10], CalibratedBands(bands, MODELS)
    history = MeasurementHistory(2.0, SETTINGS.prediction.maximum_gap, SETTINGS.prediction.filter_cutoff)
    signals, compared = SETTINGS.signals(log), 0
    for k, time_ns in enumerate(log.ins_time_ns.tolist()):
        history.add_ins(InsSample(time_ns, *(float(getattr(log, name)[k]) for name in (
            "x", "y", "yaw", "velocity_x", "velocity_y", "yaw_rate"))))
        history.add_steering(time_ns, float(log.road_wheel_angle[k]))
        if k < 120 or k % 50:
            continue
        start_ns = time_ns - 3_000_000  # between two samples
        conditions, = conditions_at(signals, np.array([start_ns]))
        assert conditions_now(history, start_ns) == pytest.approx(conditions, rel=1e-6, abs=1e-9)
        calibrated = live.update(conditions.tolist())
        assert calibrated == bool(bands.domain.contains(conditions[None])[0])
        assert calibrated == (live.domain.describe_outside(conditions) == "")
        for model, half_widths in live.half_widths.items() if calibrated else ():
            for (mode, level), widths in half_widths.items():
                from_file = bands.half_widths(model, mode, conditions, level)[0]
                assert widths == pytest.approx(from_file, rel=2e-7)  # float32
                compared += 1
    assert compared > 100


def test_no_band_with_unknown_steering_or_uncalibrated_conditions(bands):
    live = CalibratedBands(bands, MODELS)
    assert not live.update((10.0, 1.0, 0.5, math.nan)) and not live.update((35.0, 0.1, 0.1, 0.01))
    assert "steering activity is unknown" in live.domain.describe_outside((10.0, 1.0, 0.5, math.nan))
    assert "35.0 m/s" in live.domain.describe_outside((35.0, 0.1, 0.1, 0.01))
    empty = MeasurementHistory(2.0, 0.1, 5.0)
    assert np.isnan(conditions_now(empty, SECOND)).all()


@pytest.mark.parametrize("maximum_gap", [0.02, 0.1, 2.0])
def test_live_steering_activity_equals_that_of_the_history_with_gaps(maximum_gap):
    draw, found = np.random.default_rng(7), set()
    for _ in range(200):
        history = MeasurementHistory(3.0, maximum_gap, 5.0)
        times = SECOND + np.cumsum(draw.integers(1_000_000, 12_000_000, 400))
        for time_ns in np.delete(times, slice(*np.sort(draw.integers(0, 400, 2)))).tolist():
            history.add_steering(time_ns, draw.uniform(-0.5, 0.5))
        start_ns = int(draw.choice(times)) + int(draw.integers(0, 2)) * 500_000
        exact = steering_activity(history.steering.sample(activity_instants(start_ns))[:, 0])
        assert conditions_now(history, start_ns)[3] == pytest.approx(exact, rel=1e-12, nan_ok=True)
        found.add(bool(np.isnan(exact)))
    assert found == {True, False}


def forecast_score(start_ns, errors, complete=True):
    missing = [np.full(3, math.nan)] * 3
    return make_score("linear", "forecast", start_ns, 2.5, list(errors.T) if complete else missing)


def test_path_is_inside_if_all_points_are_within_the_widths_in_the_predicted_frame():
    widths = np.array([[0, 0, 0], [1, 0.1, 0.3], [2, 0.2, 0.3]], float)
    # 1 m along the measured heading, 0.2 rad right of the predicted one, is 0.2 m lateral in the predicted frame.
    cases = (([0.9, 0.0, 0.0], True), ([0.9, 0.0, 0.2], False), ([1.1, 0.0, 0.0], False), ([0.0, 0.0, 0.4], False))
    monitor = CoverageMonitor()
    for k, (point, _) in enumerate(cases):
        monitor.add_bands("linear", k * SECOND, {("forecast", 0.9): widths, ("forecast", 0.5): 0.01 * widths})
        monitor.add_score(forecast_score(k * SECOND, np.array([[0, 0, 0], point, [0, 0, 0]], float)))
    coverage = monitor.by_pair["linear", "forecast"]
    assert coverage.n == 4 and coverage.inside_counts[0.9] == sum(inside for _, inside in cases)
    assert coverage.coverage_at(0.5) == 0.0
    monitor.add_bands("linear", 9 * SECOND, {("forecast", 0.9): widths})
    monitor.add_score(forecast_score(9 * SECOND, widths, complete=False))
    monitor.add_score(forecast_score(10 * SECOND, widths))  # no band was issued for this start
    assert coverage.n == 4


def seconds_until_warning(generator, probability, seconds, coverage, times):
    """Time of the first warning [s] or None: ten windows per second, equal within a horizon, inside at random."""
    for k in range(round(10 * seconds)):
        if k % 50 == 0:
            inside = bool(generator.random() < probability)
        coverage.add(next(times), 5.0, {0.5: inside, 0.9: inside})
        if coverage.has_warning:
            return 0.1 * k
    return None


def test_loss_of_coverage_is_warned_of_within_a_minute_with_few_false_alarms():
    generator = np.random.default_rng(4)
    false_alarms = 0
    for _ in range(15):
        coverage, times = BandCoverage(), count(0, SECOND // 10)
        false_alarms += seconds_until_warning(generator, 0.9, 3600.0, coverage, times) is not None
    assert false_alarms <= 2  # 15 h, at most one per ten hours on average
    for _ in range(20):
        coverage, times = BandCoverage(), count(0, SECOND // 10)
        assert seconds_until_warning(generator, 0.95, 600.0, coverage, times) is None
        # Scores arrive one horizon (5 s) after the start: 55 s make up a minute.
        assert seconds_until_warning(generator, 0.0, 55.0, coverage, times) < 55.0
        coverage.add(next(times), 5.0, {0.9: True})
        assert coverage.has_warning  # the warning does not end with the first window inside
        for _ in range(900):
            coverage.add(next(times), 5.0, {0.9: True})
        assert not coverage.has_warning


def test_evidence_is_a_log_likelihood_ratio_per_horizon():
    p, q = 0.9, 0.9 * ALTERNATIVE_RATIO
    assert p * (q / p) + (1 - p) * ((1 - q) / (1 - p)) == pytest.approx(1.0)
    coverage = BandCoverage()
    coverage.add(0, 5.0, {0.9: False})
    assert coverage.statistic == 0.0  # the first window has no interval to its predecessor
    coverage.add(5 * SECOND, 5.0, {0.9: False})
    assert coverage.statistic == pytest.approx(math.log((1 - q) / (1 - p)))
    coverage.add(4 * SECOND, 5.0, {0.9: False})  # a replay that restarts
    assert coverage.statistic == pytest.approx(math.log((1 - q) / (1 - p)))
    assert math.log(FALSE_WARNING_TIME) > 5 * coverage.statistic
