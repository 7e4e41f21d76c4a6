"""Bands while driving: the same numbers as offline, and how soon and how often a loss of coverage is told."""

import math
from itertools import count

import numpy as np
import pytest
from st_core.bands import (
    Bands,
    CalibrationDomain,
    CoverageMonitor,
    LiveBands,
    activity_instants,
    calibrate,
    compute_error_samples,
    conditions_at,
    conditions_now,
    steering_activity,
)
from st_core.bands.file import hash_configuration
from st_core.bands.live import ALTERNATIVE_RATIO, HORIZONS, BandCoverage
from st_core.evaluation import make_score
from st_core.log import DriveLog
from st_core.log_evaluation import EvaluationSettings
from st_core.measurement_history import MeasurementHistory
from st_core.models import get_model
from st_core.types import InsSample
from st_core.vehicle import VehicleParameters
from support import ROOT
from winding_road import Truth, winding_road

MODELS = ("kinematic", "linear")
SETTINGS = EvaluationSettings()
SECOND = 1_000_000_000


@pytest.fixture(scope="module")
def leaf():
    return VehicleParameters.from_yaml((ROOT / "config" / "vehicle" / "leaf.yaml").read_text())


@pytest.fixture(scope="module")
def logs(leaf):
    """Ten drives of one car and one more."""
    truth = Truth(0.0, leaf.steering_ratio, 0.95)
    rows = [winding_road(leaf, truth, 25.0, seed) for seed in range(11)]
    return [DriveLog(f"road {k}", *_columns(one, leaf)) for k, one in enumerate(rows)]


def _columns(rows, car):
    time_ns = 1_700_000_000 * SECOND + np.round(rows[:, 0] * 1e9).astype(np.int64)
    return time_ns, *rows[:, 1:7].T, time_ns, car.road_wheel_angle(rows[:, 7]), rows[:, 7]


@pytest.fixture(scope="module")
def bands(leaf, logs):
    models = [get_model(name) for name in MODELS]
    runs = [compute_error_samples(models, leaf, SETTINGS.signals(log), SETTINGS) for log in logs[:10]]
    time = SETTINGS.prediction.step * np.arange(1, SETTINGS.prediction.steps + 1)
    found = {(m, q): calibrate(runs, (m, q), time) for m in MODELS for q in ("hindsight", "forecast")}
    hashes = {m: hash_configuration(leaf, SETTINGS.as_dict(), "") for m in MODELS}
    domain = CalibrationDomain.of([r.conditions for r in runs])
    return Bands(leaf.name, leaf.hash, SETTINGS.as_dict(), {}, 10, domain, found, hashes)


def test_live_states_what_the_file_states_of_the_recorded_drive(bands, logs):
    log, live = logs[10], LiveBands(bands, MODELS)
    history = MeasurementHistory(2.0, SETTINGS.prediction.maximum_gap, SETTINGS.prediction.filter_cutoff)
    signals, compared = SETTINGS.signals(log), 0
    for k, time_ns in enumerate(log.ins_time_ns.tolist()):
        history.add_ins(InsSample(time_ns, *(float(getattr(log, name)[k]) for name in (
            "x", "y", "yaw", "velocity_x", "velocity_y", "yaw_rate"))))
        history.add_steering(time_ns, float(log.road_wheel_angle[k]))
        if k < 120 or k % 50:
            continue
        start_ns = time_ns - 3_000_000  # between two samples
        here, = conditions_at(signals, np.array([start_ns]))
        assert conditions_now(history, start_ns) == pytest.approx(here, rel=1e-6, abs=1e-9)
        found = live(here.tolist())
        assert found == bool(bands.domain(here[None])[0]) == (live.domain.describe_outside(here) == "")
        for model, stated in live.half_widths.items() if found else ():
            for (mode, level), widths in stated.items():
                assert widths == pytest.approx(bands.half_widths(model, mode, here, level)[0], rel=2e-7)  # float32
                compared += 1
    assert compared > 100


def test_no_band_where_the_steering_before_is_not_known_or_the_conditions_were_never_calibrated(bands):
    live = LiveBands(bands, MODELS)
    assert not live((10.0, 1.0, 0.5, math.nan)) and not live((35.0, 0.1, 0.1, 0.01))
    assert "steering activity is unknown" in live.domain.describe_outside((10.0, 1.0, 0.5, math.nan))
    assert "35.0 m/s" in live.domain.describe_outside((35.0, 0.1, 0.1, 0.01))
    empty = MeasurementHistory(2.0, 0.1, 5.0)
    assert np.isnan(conditions_now(empty, SECOND)).all()


@pytest.mark.parametrize("maximum_gap", [0.02, 0.1, 2.0])
def test_the_angles_before_a_start_are_those_of_the_history_with_gaps_and_without(maximum_gap):
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


def a_score(start_ns, errors, complete=True):
    nothing = [np.full(3, math.nan)] * 3
    return make_score("linear", "forecast", start_ns, 2.5, list(errors.T) if complete else nothing)


def test_a_path_is_inside_when_all_points_and_axes_are_in_the_predicted_frame():
    widths = np.array([[0, 0, 0], [1, 0.1, 0.3], [2, 0.2, 0.3]], float)
    # 1 m ahead along a measured heading 0.2 rad to the right of the predicted one: 0.2 m to the side of that.
    cases = (([0.9, 0.0, 0.0], True), ([0.9, 0.0, 0.2], False), ([1.1, 0.0, 0.0], False), ([0.0, 0.0, 0.4], False))
    coverages = CoverageMonitor()
    for k, (point, _) in enumerate(cases):
        coverages.expect("linear", k * SECOND, {("forecast", 0.9): widths, ("forecast", 0.5): 0.01 * widths})
        coverages.add(a_score(k * SECOND, np.array([[0, 0, 0], point, [0, 0, 0]], float)))
    one = coverages.by_pair["linear", "forecast"]
    assert one.n == 4 and one.inside[0.9] == sum(inside for _, inside in cases) and one.coverage_at(0.5) == 0.0
    coverages.expect("linear", 9 * SECOND, {("forecast", 0.9): widths})
    coverages.add(a_score(9 * SECOND, widths, complete=False))
    coverages.add(a_score(10 * SECOND, widths))  # nothing was stated of it
    assert one.n == 4


def driven(generator, coverage, seconds, one, times):
    """Ten windows a second, alike for a horizon, each kept with a probability; the second of the first warning."""
    for k in range(round(10 * seconds)):
        if k % 50 == 0:
            kept = bool(generator.random() < coverage)
        one.add(next(times), 5.0, {0.5: kept, 0.9: kept})
        if one.warns:
            return 0.1 * k
    return None


def test_a_band_that_holds_is_not_warned_of_and_one_that_does_not_is_within_a_minute():
    generator = np.random.default_rng(4)
    false = 0
    for _ in range(15):
        false += driven(generator, 0.9, 3600.0, BandCoverage(), count(0, SECOND // 10)) is not None
    assert false <= 2  # 15 hours, at most one in ten hours on average
    for _ in range(20):
        one, times = BandCoverage(), count(0, SECOND // 10)
        assert driven(generator, 0.95, 600.0, one, times) is None
        # The score is there a horizon after the start: 55 s leave a minute.
        assert driven(generator, 0.0, 55.0, one, times) < 55.0
        one.add(next(times), 5.0, {0.9: True})
        assert one.warns  # not over at once
        for _ in range(900):
            one.add(next(times), 5.0, {0.9: True})
        assert not one.warns


def test_the_evidence_is_a_likelihood_ratio_that_is_one_on_average():
    p, q = 0.9, 0.9 * ALTERNATIVE_RATIO
    assert p * (q / p) + (1 - p) * ((1 - q) / (1 - p)) == pytest.approx(1.0)
    one = BandCoverage()
    one.add(0, 5.0, {0.9: False})
    assert one.evidence == 0.0  # nothing is known of how much of a horizon it stands for
    one.add(5 * SECOND, 5.0, {0.9: False})
    assert one.evidence == pytest.approx(math.log((1 - q) / (1 - p)))
    one.add(4 * SECOND, 5.0, {0.9: False})  # a replay that starts over
    assert one.evidence == pytest.approx(math.log((1 - q) / (1 - p)))
    assert math.log(HORIZONS) > 5 * one.evidence
