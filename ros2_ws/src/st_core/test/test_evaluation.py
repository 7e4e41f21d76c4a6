"""Scores of predictions: signs, both modes, gaps, time jumps, bounded memory, statistics."""

import math

import numpy as np
import pytest
from st_core.evaluation import ErrorStatistics, Evaluator, Statistic, make_score
from st_core.prediction import PredictionSettings, predict
from st_core.types import ControlInput, InputSequence, VehicleState, cg_to_ins_position, pose_errors
from steady_circle import Circle

MS = 1_000_000
T0 = 1_700_000_000_000_000_000


def test_error_signs_follow_the_measured_heading():
    # Measured at (10, 5) m heading north; predicted 2 m further north and 1 m west: ahead and to the left.
    longitudinal, lateral, yaw = pose_errors(9.0, 7.0, 2.0, 10.0, 5.0, math.pi / 2.0)
    assert (longitudinal, lateral, yaw) == pytest.approx((2.0, 1.0, 2.0 - math.pi / 2.0))


def test_errors_are_evaluated_at_the_ins_point():
    # Predicted and measured CG coincide, but the yaw differs by 90 deg, so the INS points behind the CG do not.
    predicted = cg_to_ins_position(0.0, 0.0, math.pi / 2.0, -0.4)
    longitudinal, lateral, yaw = pose_errors(*predicted, math.pi / 2.0, -0.4, 0.0, 0.0)
    assert (longitudinal, lateral, yaw) == pytest.approx((0.4, -0.4, math.pi / 2.0))


def test_yaw_error_is_wrapped():
    assert pose_errors(0.0, 0.0, 6.2, 0.0, 0.0, -0.05)[2] == pytest.approx(6.25 - 2.0 * math.pi)


def feed(evaluator, circle, angle, ms_from, ms_to, ins_gap=(0, 0), steering_gap=(0, 0)):
    for ms in range(ms_from, ms_to, 10):
        if not ins_gap[0] <= ms < ins_gap[1]:
            evaluator.add_ins(circle.ins(0.001 * ms, T0 + ms * MS))
        if not steering_gap[0] <= ms < steering_gap[1]:
            evaluator.add_steering(T0 + ms * MS + 2 * MS, angle)


@pytest.fixture
def circle(leaf):
    speed = math.sqrt(3.77 * 11.5)
    return Circle(speed, 0.63, speed / 11.5, leaf.cg_to_ins_x)


ANGLE = math.radians(14.20)


def add_predictions(evaluator, circle, ms, models=("kinematic", "linear", "nonlinear"), angle=ANGLE):
    start, inputs = circle.state(0.001 * ms), ControlInput(angle, 0.0)
    for model in models:
        evaluator.add_prediction(model, T0 + ms * MS, predict(model, evaluator.vehicle, start, inputs))


def test_steady_circle_scores_match_the_paper(leaf, circle):
    evaluator = Evaluator(leaf)
    feed(evaluator, circle, ANGLE, 0, 1000)
    add_predictions(evaluator, circle, 900)
    feed(evaluator, circle, ANGLE, 1000, 5900)
    assert evaluator.poll() == [] and evaluator.pending_count == 3
    feed(evaluator, circle, ANGLE, 5900, 5920)
    scores = evaluator.poll()
    assert evaluator.pending_count == 0 and len(scores) == 6
    assert all(s.complete and s.incomplete_reason == "" and s.start_ns == T0 + 900 * MS for s in scores)
    for mode in ("forecast", "hindsight"):
        means = [(s.longitudinal_mean, s.lateral_mean) for s in scores if s.mode == mode]
        # S3 of the paper, recomputed in test_paper.py.
        np.testing.assert_allclose(means, [(0.83, 1.22), (-0.20, -0.31), (-0.23, -0.35)], atol=0.015)
    score = scores[0]
    assert score.horizon[0] == 0.0 and score.horizon[-1] == pytest.approx(5.0) and len(score.horizon) == 101
    assert abs(score.longitudinal[0]) < 1e-6 and abs(score.lateral[0]) < 1e-6
    assert score.longitudinal_mean == pytest.approx(np.mean(score.longitudinal))


def test_hindsight_uses_measured_inputs_and_forecast_the_issued_path(leaf):
    # The car is the linear model under a steering ramp that begins after the start of the prediction.
    evaluator = Evaluator(leaf)
    times = np.arange(0, 7000, 10)
    angles = np.where(times < 2000, 0.0, np.minimum((times - 2000) * 1e-4, 0.05))
    truth = predict("linear", leaf, VehicleState(0.0, 0.0, 10.0, 0.0, 0.0, 0.0),
                    InputSequence(np.interp(np.arange(0, 6990.1, 5), times, angles), np.zeros(1399)), 6.99, 0.01)
    for k, (ms, angle) in enumerate(zip(times, angles, strict=True)):
        state = VehicleState(*truth.states[k])
        evaluator.add_ins(Circle(10.0, 0.0, 1.0, leaf.cg_to_ins_x).ins(0.0)._replace(
            time_ns=T0 + int(ms) * MS, x=state.x - 0.398 * math.cos(state.yaw), y=state.y - 0.398 * math.sin(state.yaw),
            yaw=state.yaw, velocity_x=state.velocity_x))
        evaluator.add_steering(T0 + int(ms) * MS, float(angle))
    start, inputs = VehicleState(*truth.states[150]), ControlInput(0.0, 0.0)
    evaluator.add_prediction("linear", T0 + 1500 * MS, predict("linear", leaf, start, inputs))
    forecast, hindsight = evaluator.poll()
    assert (forecast.mode, hindsight.mode) == ("forecast", "hindsight")
    assert np.abs(hindsight.lateral).max() < 0.01 and np.abs(hindsight.yaw).max() < 0.002
    assert forecast.lateral[-1] < -3.0  # predicted straight ahead while the car turns left
    assert forecast.yaw[-1] < -0.4


@pytest.mark.parametrize(("gaps", "forecast", "hindsight"), [
    ({"ins_gap": (3000, 3200)}, "INS: gap of 0.210 s at 2.100 s of the horizon",
     "INS: gap of 0.210 s at 2.100 s of the horizon"),
    ({"steering_gap": (3000, 3200)}, "", "steering: gap of 0.210 s at 2.100 s of the horizon"),
    ({"ins_gap": (3000, 3080), "steering_gap": (3000, 3080)}, "", ""),
])
def test_gap_makes_a_score_incomplete_with_a_reason(leaf, circle, gaps, forecast, hindsight):
    evaluator = Evaluator(leaf)
    feed(evaluator, circle, ANGLE, 0, 1000)
    add_predictions(evaluator, circle, 900, ["nonlinear"])
    feed(evaluator, circle, ANGLE, 1000, 6500, **gaps)
    scores = evaluator.poll()
    assert [s.incomplete_reason for s in scores] == [forecast, hindsight]
    for score in scores:
        assert score.complete == (not score.incomplete_reason)
        assert math.isnan(score.longitudinal_mean) == (not score.complete)
        assert np.isfinite(score.lateral[:42]).all()  # scored before the gap
        if not score.complete:
            assert np.isnan(score.lateral[43:46]).all()
    if forecast:
        assert np.isfinite(scores[0].lateral[50:]).all()  # a forecast is scored after the gap, too
    if hindsight:
        assert np.isnan(scores[1].lateral[46:]).all()  # hindsight lacks the inputs within the gap


@pytest.mark.parametrize("unknown_from", [5875, 5900], ids=["last half step", "last instant"])
def test_unknown_input_at_the_end_makes_hindsight_incomplete_for_every_model(leaf, circle, unknown_from):
    evaluator = Evaluator(leaf)
    feed(evaluator, circle, ANGLE, 0, 1000)
    add_predictions(evaluator, circle, 900)
    # The last steering sample lies just before the first grid point at which steering is unknown.
    feed(evaluator, circle, ANGLE, 1000, 7000, steering_gap=(unknown_from - 5, 6400))
    scores = evaluator.poll()
    assert len(scores) == 6
    assert [s.complete for s in scores] == [s.mode == "forecast" for s in scores]
    for score in scores:
        assert np.isfinite(score.longitudinal).tolist() == [True] * 100 + [score.mode == "forecast"]


def test_gap_within_maximum_gap_is_interpolated(leaf, circle):
    evaluator = Evaluator(leaf, PredictionSettings(maximum_gap=0.3))
    feed(evaluator, circle, ANGLE, 0, 1000)
    add_predictions(evaluator, circle, 900)
    feed(evaluator, circle, ANGLE, 1000, 6500, ins_gap=(3000, 3200), steering_gap=(4000, 4200))
    assert all(s.complete for s in evaluator.poll())


def test_missing_signal_is_named_after_the_waiting_time(leaf, circle):
    evaluator = Evaluator(leaf)
    feed(evaluator, circle, ANGLE, 0, 1000)
    add_predictions(evaluator, circle, 900, ["linear"])
    feed(evaluator, circle, ANGLE, 1000, 6850, steering_gap=(4000, 9000))
    assert evaluator.poll() == []
    feed(evaluator, circle, ANGLE, 6850, 7000, steering_gap=(4000, 9000))
    forecast, hindsight = evaluator.poll()
    assert forecast.complete
    assert hindsight.incomplete_reason == "steering: ends 0.008 s earlier at 3.100 s of the horizon"


def test_caller_clock_ends_the_waiting_when_all_signals_stop(leaf, circle):
    evaluator = Evaluator(leaf)
    feed(evaluator, circle, ANGLE, 0, 3000)
    add_predictions(evaluator, circle, 900, ["linear"])
    assert evaluator.poll(T0 + 6800 * MS) == []
    assert [s.complete for s in evaluator.poll(T0 + 6900 * MS)] == [False, False]
    assert evaluator.pending_count == 0


def test_flush_scores_pending_predictions_as_incomplete(leaf, circle):
    evaluator = Evaluator(leaf)
    feed(evaluator, circle, ANGLE, 0, 3000)
    add_predictions(evaluator, circle, 900)
    scores = evaluator.flush()
    assert len(scores) == 6 and evaluator.pending_count == 0 and evaluator.flush() == []
    assert {s.incomplete_reason for s in scores if s.mode == "forecast"} == {
        "INS: ends 0.010 s earlier at 2.100 s of the horizon"}
    assert np.isfinite(scores[0].longitudinal[:42]).all() and np.isnan(scores[0].longitudinal[42:]).all()


def test_nothing_is_scored_before_the_first_measurement(leaf, circle):
    evaluator = Evaluator(leaf)
    add_predictions(evaluator, circle, 900, ["linear"])
    assert evaluator.poll() == [] and evaluator.pending_count == 1
    assert [s.incomplete_reason for s in evaluator.flush()] == ["INS: no samples at 0.000 s of the horizon"] * 2


def test_backward_time_jump_ends_pending_scores_and_scoring_resumes(leaf, circle):
    evaluator = Evaluator(leaf)
    feed(evaluator, circle, ANGLE, 100_000, 103_000)
    add_predictions(evaluator, circle, 102_000, ["linear"])
    feed(evaluator, circle, ANGLE, 0, 1000)
    add_predictions(evaluator, circle, 900, ["linear"])
    feed(evaluator, circle, ANGLE, 1000, 6500)
    scores = evaluator.poll()
    assert [(s.start_ns - T0) // MS for s in scores] == [102_000, 102_000, 900, 900]
    assert scores[0].incomplete_reason == scores[1].incomplete_reason == "the time of the measurements jumped back"
    assert scores[2].complete and scores[3].complete


def test_non_finite_prediction_is_not_scored(leaf, circle):
    evaluator = Evaluator(leaf)
    feed(evaluator, circle, ANGLE, 0, 7000)
    not_finite = predict("linear", leaf, circle.state(0.9), ControlInput(ANGLE, 0.0))
    not_finite.states[1:] = math.nan
    evaluator.add_prediction("linear", T0 + 900 * MS, not_finite)
    forecast, hindsight = evaluator.poll()
    assert forecast.incomplete_reason == "the prediction is not finite"
    assert hindsight.complete


def test_pending_predictions_are_bounded_without_measurements(leaf, circle):
    evaluator = Evaluator(leaf)
    evaluator.MAXIMUM_PENDING = 30
    path = predict("linear", leaf, circle.state(0.0), ControlInput(0.0, 0.0))
    for i in range(200):
        evaluator.add_prediction("linear", T0 + i * 100 * MS, path)
    assert evaluator.pending_count == 30
    scores = evaluator.poll()
    assert len(scores) == 60 and {s.incomplete_reason for s in scores} == {"more than 30 predictions were waiting"}


def test_history_spans_at_least_two_horizons(leaf):
    evaluator = Evaluator(leaf, PredictionSettings(horizon=20.0), span=5.0)
    for ms in range(0, 60_000, 10):
        evaluator.add_steering(T0 + ms * MS, 0.0)
    assert evaluator.history.steering.newest - evaluator.history.steering.times[0] == 41_000 * MS


def test_statistics_are_those_of_the_horizon_means():
    statistics = ErrorStatistics()
    errors = [np.array([0.0, 1.0, 2.0]), np.array([0.0, -3.0, -3.0])]
    for lateral in errors:
        statistics.add(make_score("linear", "forecast", 0, 0.05, (np.zeros(3), lateral, np.full(3, 0.1))))
    statistics.add(make_score("linear", "forecast", 0, 0.05, [np.full(3, np.nan)] * 3, "gap"))
    assert (statistics.n_starts, statistics.n_incomplete) == (2, 1)
    lateral = statistics.lateral
    assert (lateral.mean, lateral.max, lateral.rmse) == pytest.approx((-0.5, 2.0, math.sqrt((1.0 + 4.0) / 2.0)))
    assert statistics.yaw.mean == pytest.approx(0.1) and statistics.longitudinal.max == 0.0


def test_statistics_without_values_are_nan():
    empty = Statistic()
    assert math.isnan(empty.mean) and math.isnan(empty.max) and math.isnan(empty.rmse)
