"""Evaluation of a log against the live classes sample by sample, and against the circle of the paper."""

from dataclasses import replace

import numpy as np
import pytest
from drives import T0, wavy_drive
from st_core.errors import ConfigurationError
from st_core.evaluation import ErrorStatistics, Evaluator, Statistic
from st_core.log import DriveLog, LogSignals
from st_core.log_evaluation import AXES, BLOCK_SIZE, MODES, EvaluationSettings, bin_starts, evaluate_log, regular_starts
from st_core.prediction import PredictionSettings, Predictor, Start
from st_core.types import InsSample
from steady_circle import Circle

MODELS = ("kinematic", "linear", "nonlinear")
SHORT = PredictionSettings(horizon=1.0)


def remove_spans(log: DriveLog, ins=(0.0, 0.0), steering=(0.0, 0.0)) -> DriveLog:
    """The drive without the INS and steering samples of two spans (from, to) [s]."""
    ins, steering = (T0 + np.round(np.array(span) * 1e9).astype(np.int64) for span in (ins, steering))
    rows = (log.steering_time_ns < steering[0]) | (log.steering_time_ns >= steering[1])
    log = log.select_ins((log.ins_time_ns < ins[0]) | (log.ins_time_ns >= ins[1]))
    return replace(log, steering_time_ns=log.steering_time_ns[rows], road_wheel_angle=log.road_wheel_angle[rows])


def score_live(log: DriveLog, car, settings):
    """Scores of the live classes, by (model, mode, start), with a prediction requested every 100 ms."""
    predictor, evaluator = Predictor(car, MODELS, settings), Evaluator(car, settings)
    ins = [(t, InsSample(t, *row)) for t, *row in zip(
        log.ins_time_ns.tolist(), *(getattr(log, n).tolist() for n in InsSample._fields[1:]), strict=True)]
    steering = list(zip(log.steering_time_ns.tolist(), log.road_wheel_angle.tolist(), strict=True))
    scores, next_tick = {}, log.start_ns
    for time, value in sorted([*ins, *steering], key=lambda pair: pair[0]):
        for core in (predictor, evaluator):
            core.add_ins(value) if isinstance(value, InsSample) else core.add_steering(time, value)
        if time >= next_tick:
            next_tick += 100_000_000
            start = predictor.find_start(time)
            for model in predictor.models if isinstance(start, Start) else ():
                evaluator.add_prediction(model, start.time_ns, predictor.run(start, model))
        for score in evaluator.poll():
            scores[score.model, score.mode, score.start_ns] = score
    return scores | {(s.model, s.mode, s.start_ns): s for s in evaluator.flush()}


@pytest.fixture(scope="module", params=[{}, {"ins": (5.0, 5.3)}, {"steering": (6.0, 6.4)}],
                ids=["without gaps", "INS gap", "steering gap"])
def live_and_log(leaf, request):
    """(scores of the live classes, evaluation of the log at the same starts)."""
    log = remove_spans(wavy_drive(), **request.param)
    scores = score_live(log, leaf, SHORT)
    starts = np.array(sorted({start for _, _, start in scores}))
    return scores, evaluate_log(MODELS, leaf, log, EvaluationSettings(SHORT), starts)


def test_errors_equal_the_live_classes_start_by_start(live_and_log):
    scores, result = live_and_log
    starts = result.starts_ns
    assert set(starts.tolist()) == {start for _, _, start in scores} and len(starts) > 80 and not result.skipped
    for (model, mode), errors in result.errors.items():
        live = [scores[model, mode, start] for start in starts.tolist()]
        assert errors.complete.tolist() == [score.complete for score in live]
        expected = [[s.longitudinal_mean, s.lateral_mean, s.yaw_mean] for s in live]
        np.testing.assert_allclose(errors.mean, expected, rtol=0.0, atol=1e-9)
        assert errors.complete.any() and not errors.complete.all()
    for model in MODELS:  # completeness depends on the measurements only
        assert np.array_equal(result.errors[model, "hindsight"].complete, result.errors["linear", "hindsight"].complete)


def test_step_need_not_be_a_whole_number_of_nanoseconds(leaf):
    settings = EvaluationSettings(PredictionSettings(step=1.0 / 30.0))
    starts_ns = T0 + 10**9 * np.arange(1, 4)
    single, several = (evaluate_log(["linear"], leaf, wavy_drive(), settings, starts_ns[:count]) for count in (1, 3))
    for mode in MODES:
        means = [result.errors["linear", mode].mean[:1] for result in (single, several)]
        np.testing.assert_allclose(*means, atol=1e-9)


def test_statistics_equal_those_of_the_live_evaluator(live_and_log):
    scores, result = live_and_log
    for (model, mode), errors in result.errors.items():
        live, samples = ErrorStatistics(), {axis: Statistic() for axis in AXES}
        for (score_model, score_mode, _), score in scores.items():
            if (score_model, score_mode) == (model, mode):
                live.add(score)
                for axis in AXES if score.complete else ():
                    samples[axis].add(getattr(score, axis))
        assert errors.n_starts == live.n_starts > 0
        for axis in AXES:
            for over, expected in (("means", getattr(live, axis)), ("samples", samples[axis])):
                assert errors.statistics(axis, over) == pytest.approx((expected.mean, expected.max, expected.rmse))


@pytest.mark.parametrize("inputs", ["interpolate", "hold"])
@pytest.mark.parametrize("acceleration", ["causal", "zero_phase"])
def test_circle_matches_the_paper_for_every_setting(leaf, inputs, acceleration):
    # S3, see test_paper.py; with constant inputs the settings that the paper leaves open have no influence.
    radius, v_y = 11.5, 0.63
    v_x = np.sqrt(3.77 * radius)
    circle = Circle(v_x, v_y, v_x / radius, leaf.cg_to_ins_x)
    settings = EvaluationSettings(acceleration=acceleration, inputs=inputs)
    result = evaluate_log(MODELS, leaf, circle.log(np.radians(14.20), 8.0), settings)
    published = {"kinematic": (0.83, 1.22), "linear": (-0.20, -0.31), "nonlinear": (-0.23, -0.35)}
    for model, expected in published.items():
        for mode in MODES:
            for axis, value in zip(AXES, expected, strict=False):
                assert result.errors[model, mode].statistics(axis)[0] == pytest.approx(value, abs=0.015)
    np.testing.assert_allclose(result.conditions["lateral_acceleration"][:10], 3.77, atol=0.01)
    np.testing.assert_allclose(result.conditions["heading_change"][:10], 5.0 * v_x / radius, rtol=1e-3)


def test_zero_order_hold_converges_to_interpolated_inputs(leaf):
    log = wavy_drive()
    fine = EvaluationSettings(PredictionSettings(horizon=1.0, step=0.005), inputs="hold")
    coarse = EvaluationSettings(SHORT, inputs="hold")
    reference = EvaluationSettings(SHORT)
    starts = T0 + np.arange(1, 9) * 1_000_000_000
    at_end = [evaluate_log(["linear"], leaf, log, s, starts).errors["linear", "hindsight"].at_seconds[:, 0, 1]
              for s in (reference, coarse, fine)]
    coarse_error, fine_error = (np.abs(other - at_end[0]).max() for other in at_end[1:])
    assert 0.0 < fine_error < 0.2 * coarse_error < 0.2 * 0.1


def test_unusable_starts_are_counted_by_reason(leaf):
    log = remove_spans(wavy_drive(), ins=(5.0, 5.5), steering=(7.0, 7.4))
    result = evaluate_log(["kinematic"], leaf, log, EvaluationSettings(SHORT))
    assert result.skipped["INS data missing"] in (5, 6, 7) and result.skipped["steering angle missing"] in (3, 4, 5)
    assert len(result.starts_ns) + sum(result.skipped.values()) == len(regular_starts(log, 0.1))
    assert sum(result.incomplete.values()) == (~result.errors["kinematic", "hindsight"].complete).sum() > 20
    assert result.incomplete["the recording ends before the horizon"] in (10, 11)
    assert result.incomplete["INS data missing within the horizon"] in (9, 10, 11)
    assert result.incomplete["steering angle missing within the horizon"] in (9, 10, 11)
    slow = EvaluationSettings(PredictionSettings(horizon=1.0, minimum_speed=9.0))
    assert evaluate_log("kinematic", leaf, log, slow).skipped["slower than 9 m/s"] > 20


def test_drive_longer_than_a_block_equals_its_parts(leaf):
    log = wavy_drive()
    starts = T0 + np.linspace(1e9, 10e9, BLOCK_SIZE + 50).astype(np.int64)
    whole = evaluate_log(["linear"], leaf, log, EvaluationSettings(SHORT), starts)
    calls = []
    parts = [evaluate_log(["linear"], leaf, log, EvaluationSettings(SHORT), part, lambda *c: calls.append(c))
             for part in np.array_split(starts, 3)]
    joined = np.concatenate([p.errors["linear", "forecast"].mean for p in parts])
    np.testing.assert_allclose(whole.errors["linear", "forecast"].mean, joined, rtol=0.0, atol=1e-12)
    assert calls == [(len(p), len(p)) for p in np.array_split(starts, 3)]


def test_log_without_complete_starts_gives_an_empty_result(leaf):
    log = wavy_drive(seconds=3.0)
    disjoint = DriveLog("disjoint", *(getattr(log, n) for n in ("ins_time_ns", *InsSample._fields[1:])),
                     log.steering_time_ns + 10**12, log.road_wheel_angle)
    for unusable in (log, disjoint):  # shorter than the horizon; INS and steering do not overlap
        result = evaluate_log(MODELS, leaf, unusable)
        assert not result.errors["linear", "hindsight"].n_starts
        assert np.isnan(result.errors["linear", "hindsight"].statistics("lateral")).all()
        assert np.isnan(result.errors["linear", "hindsight"].profile_rmse).all()
        assert bin_starts(result) == []
    assert not len(regular_starts(disjoint, 0.1))


def test_bins_contain_every_complete_start_once_per_quantity(leaf):
    result = evaluate_log(["kinematic"], leaf, wavy_drive(), EvaluationSettings(SHORT))
    complete = result.errors["kinematic", "hindsight"].complete
    by_quantity: dict[str, np.ndarray] = {}
    for found in bin_starts(result):
        by_quantity[found.quantity] = by_quantity.get(found.quantity, 0) + found.mask.astype(int)
    assert set(by_quantity) == {"speed", "lateral acceleration", "steering rate", "direction"}
    for count in by_quantity.values():
        assert count.tolist() == complete.astype(int).tolist()
    assert {b.label for b in bin_starts(result) if b.quantity == "direction"} == {"left", "straight", "right"}


def test_signals_are_nan_within_a_gap(leaf):
    log = remove_spans(wavy_drive(), ins=(5.0, 5.5))
    signals = LogSignals(log, 0.1, 5.0)
    times_ns = T0 + np.array([[4_900_000_000, 5_250_000_000], [6_000_000_000, 90_000_000_000]])
    x, dot = signals.ins_at(times_ns, "x", "velocity_x_dot")
    assert x.shape == (2, 2) and np.isnan(x).tolist() == np.isnan(dot).tolist() == [[False, True], [False, True]]
    sample = int(log.ins_time_ns[70])
    assert signals.ins_at(np.array([sample]), "x")[0][0] == log.x[70]


@pytest.mark.parametrize(("key", "value"), [("interval", 0.0), ("acceleration", "none"), ("inputs", "none")])
def test_invalid_settings_are_rejected_by_name(key, value):
    with pytest.raises(ConfigurationError, match=key):
        EvaluationSettings(**{key: value})
