"""Scores: directions, both modes, gaps, ends, jumps, bounds, statistics."""

import math

import numpy as np
import pytest
from st_core.evaluation import ErrorStatistics, Evaluator, Statistic, make_score
from st_core.prediction import PredictionSettings, predict
from st_core.types import ControlInput, InputSequence, VehicleState, cg_to_ins_position, pose_errors
from steady_circle import Circle

MS = 1_000_000
T0 = 1_700_000_000_000_000_000


def test_directions_follow_the_measured_heading():
    # Measured: at (10, 5) heading north. Predicted 2 m further north and 1 m west: ahead and to the left.
    longitudinal, lateral, yaw = pose_errors(9.0, 7.0, 2.0, 10.0, 5.0, math.pi / 2.0)
    assert (longitudinal, lateral, yaw) == pytest.approx((2.0, 1.0, 2.0 - math.pi / 2.0))


def test_errors_are_taken_at_the_ins_point():
    # The predicted CG is where the measured CG is, but turned by 90 degrees: the INS point behind it is not.
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


def issue(evaluator, circle, ms, models=("kinematic", "linear", "nonlinear"), angle=ANGLE):
    start, held = circle.state(0.001 * ms), ControlInput(angle, 0.0)
    for model in models:
        evaluator.add_prediction(model, T0 + ms * MS, predict(model, evaluator.vehicle, start, held))


def test_steady_circle_through_the_evaluator_gives_the_papers_numbers(leaf, circle):
    evaluator = Evaluator(leaf)
    feed(evaluator, circle, ANGLE, 0, 1000)
    issue(evaluator, circle, 900)
    feed(evaluator, circle, ANGLE, 1000, 5900)
    assert evaluator.poll() == [] and evaluator.pending == 3
    feed(evaluator, circle, ANGLE, 5900, 5920)
    scores = evaluator.poll()
    assert evaluator.pending == 0 and len(scores) == 6
    assert all(s.complete and s.incomplete_reason == "" and s.start_ns == T0 + 900 * MS for s in scores)
    for mode in ("forecast", "hindsight"):
        means = [(s.longitudinal_mean, s.lateral_mean) for s in scores if s.mode == mode]
        # S3 of the paper, recomputed: see test_paper.py.
        np.testing.assert_allclose(means, [(0.83, 1.22), (-0.20, -0.31), (-0.23, -0.35)], atol=0.015)
    score = scores[0]
    assert score.horizon[0] == 0.0 and score.horizon[-1] == pytest.approx(5.0) and len(score.horizon) == 101
    assert abs(score.longitudinal[0]) < 1e-6 and abs(score.lateral[0]) < 1e-6
    assert score.longitudinal_mean == pytest.approx(np.mean(score.longitudinal))


def test_hindsight_uses_the_measured_inputs_and_forecast_the_issued_path(leaf):
    # Truth: the linear model itself under a steering step that the held input did not know.
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
    start, held = VehicleState(*truth.states[150]), ControlInput(0.0, 0.0)
    evaluator.add_prediction("linear", T0 + 1500 * MS, predict("linear", leaf, start, held))
    forecast, hindsight = evaluator.poll()
    assert (forecast.mode, hindsight.mode) == ("forecast", "hindsight")
    assert np.abs(hindsight.lateral).max() < 0.01 and np.abs(hindsight.yaw).max() < 0.002
    assert forecast.lateral[-1] < -3.0  # predicted straight on, to the right of where the car went
    assert forecast.yaw[-1] < -0.4


@pytest.mark.parametrize(("gaps", "forecast", "hindsight"), [
    ({"ins_gap": (3000, 3200)}, "INS: gap of 0.210 s at 2.100 s of the horizon",
     "INS: gap of 0.210 s at 2.100 s of the horizon"),
    ({"steering_gap": (3000, 3200)}, "", "steering: gap of 0.210 s at 2.100 s of the horizon"),
    ({"ins_gap": (3000, 3080), "steering_gap": (3000, 3080)}, "", ""),
])
def test_gaps_make_a_score_incomplete_and_are_named(leaf, circle, gaps, forecast, hindsight):
    evaluator = Evaluator(leaf)
    feed(evaluator, circle, ANGLE, 0, 1000)
    issue(evaluator, circle, 900, ["nonlinear"])
    feed(evaluator, circle, ANGLE, 1000, 6500, **gaps)
    scores = evaluator.poll()
    assert [s.incomplete_reason for s in scores] == [forecast, hindsight]
    for score in scores:
        assert score.complete == (not score.incomplete_reason)
        assert math.isnan(score.longitudinal_mean) == (not score.complete)
        assert np.isfinite(score.lateral[:42]).all()  # before the gap it is scored
        if not score.complete:
            assert np.isnan(score.lateral[43:46]).all()
    if forecast:
        assert np.isfinite(scores[0].lateral[50:]).all()  # and a forecast after it, too
    if hindsight:
        assert np.isnan(scores[1].lateral[46:]).all()  # hindsight cannot know what happened in between


@pytest.mark.parametrize("unknown_from", [5875, 5900], ids=["last half step", "last instant"])
def test_an_input_unknown_at_the_very_end_makes_every_models_hindsight_incomplete(leaf, circle, unknown_from):
    evaluator = Evaluator(leaf)
    feed(evaluator, circle, ANGLE, 0, 1000)
    issue(evaluator, circle, 900)
    # The last steering sample before the gap comes just before the grid point at which it is not known any more.
    feed(evaluator, circle, ANGLE, 1000, 7000, steering_gap=(unknown_from - 5, 6400))
    scores = evaluator.poll()
    assert len(scores) == 6
    assert [s.complete for s in scores] == [s.mode == "forecast" for s in scores]
    for score in scores:
        assert np.isfinite(score.longitudinal).tolist() == [True] * 100 + [score.mode == "forecast"]


def test_a_gap_longer_than_the_setting_allows_is_the_limit(leaf, circle):
    evaluator = Evaluator(leaf, PredictionSettings(maximum_gap=0.3))
    feed(evaluator, circle, ANGLE, 0, 1000)
    issue(evaluator, circle, 900)
    feed(evaluator, circle, ANGLE, 1000, 6500, ins_gap=(3000, 3200), steering_gap=(4000, 4200))
    assert all(s.complete for s in evaluator.poll())


def test_a_signal_that_stops_is_waited_for_and_then_named(leaf, circle):
    evaluator = Evaluator(leaf)
    feed(evaluator, circle, ANGLE, 0, 1000)
    issue(evaluator, circle, 900, ["linear"])
    feed(evaluator, circle, ANGLE, 1000, 6850, steering_gap=(4000, 9000))
    assert evaluator.poll() == []
    feed(evaluator, circle, ANGLE, 6850, 7000, steering_gap=(4000, 9000))
    forecast, hindsight = evaluator.poll()
    assert forecast.complete
    assert hindsight.incomplete_reason == "steering: ends 0.008 s before at 3.100 s of the horizon"


def test_the_callers_clock_ends_the_waiting_when_everything_stops(leaf, circle):
    evaluator = Evaluator(leaf)
    feed(evaluator, circle, ANGLE, 0, 3000)
    issue(evaluator, circle, 900, ["linear"])
    assert evaluator.poll(T0 + 6800 * MS) == []
    assert [s.complete for s in evaluator.poll(T0 + 6900 * MS)] == [False, False]
    assert evaluator.pending == 0


def test_flush_scores_the_rest_as_incomplete(leaf, circle):
    evaluator = Evaluator(leaf)
    feed(evaluator, circle, ANGLE, 0, 3000)
    issue(evaluator, circle, 900)
    scores = evaluator.flush()
    assert len(scores) == 6 and evaluator.pending == 0 and evaluator.flush() == []
    assert {s.incomplete_reason for s in scores if s.mode == "forecast"} == {
        "INS: ends 0.010 s before at 2.100 s of the horizon"}
    assert np.isfinite(scores[0].longitudinal[:42]).all() and np.isnan(scores[0].longitudinal[42:]).all()


def test_before_any_measurement_nothing_is_scored(leaf, circle):
    evaluator = Evaluator(leaf)
    issue(evaluator, circle, 900, ["linear"])
    assert evaluator.poll() == [] and evaluator.pending == 1
    assert [s.incomplete_reason for s in evaluator.flush()] == ["INS: no samples at 0.000 s of the horizon"] * 2


def test_time_that_jumps_back_ends_what_was_waiting_and_starts_anew(leaf, circle):
    evaluator = Evaluator(leaf)
    feed(evaluator, circle, ANGLE, 100_000, 103_000)
    issue(evaluator, circle, 102_000, ["linear"])
    feed(evaluator, circle, ANGLE, 0, 1000)
    issue(evaluator, circle, 900, ["linear"])
    feed(evaluator, circle, ANGLE, 1000, 6500)
    scores = evaluator.poll()
    assert [(s.start_ns - T0) // MS for s in scores] == [102_000, 102_000, 900, 900]
    assert scores[0].incomplete_reason == scores[1].incomplete_reason == "the time of the measurements jumped back"
    assert scores[2].complete and scores[3].complete


def test_a_prediction_that_is_not_finite_is_not_scored(leaf, circle):
    evaluator = Evaluator(leaf)
    feed(evaluator, circle, ANGLE, 0, 7000)
    spoilt = predict("linear", leaf, circle.state(0.9), ControlInput(ANGLE, 0.0))
    spoilt.states[1:] = math.nan
    evaluator.add_prediction("linear", T0 + 900 * MS, spoilt)
    forecast, hindsight = evaluator.poll()
    assert forecast.incomplete_reason == "the prediction is not finite"
    assert hindsight.complete


def test_memory_stays_bounded_when_nothing_is_ever_measured(leaf, circle):
    evaluator = Evaluator(leaf)
    evaluator.MAXIMUM_PENDING = 30
    path = predict("linear", leaf, circle.state(0.0), ControlInput(0.0, 0.0))
    for i in range(200):
        evaluator.add_prediction("linear", T0 + i * 100 * MS, path)
    assert evaluator.pending == 30
    scores = evaluator.poll()
    assert len(scores) == 60 and {s.incomplete_reason for s in scores} == {"more than 30 predictions were waiting"}


def test_history_keeps_at_least_two_horizons(leaf):
    evaluator = Evaluator(leaf, PredictionSettings(horizon=20.0), span=5.0)
    for ms in range(0, 60_000, 10):
        evaluator.add_steering(T0 + ms * MS, 0.0)
    assert evaluator.history.steering.newest - evaluator.history.steering.times[0] == 41_000 * MS


def test_statistics_are_over_the_horizon_means():
    statistics = ErrorStatistics()
    errors = [np.array([0.0, 1.0, 2.0]), np.array([0.0, -3.0, -3.0])]
    for lateral in errors:
        statistics.add(make_score("linear", "forecast", 0, 0.05, (np.zeros(3), lateral, np.full(3, 0.1))))
    statistics.add(make_score("linear", "forecast", 0, 0.05, [np.full(3, np.nan)] * 3, "gap"))
    assert (statistics.n_starts, statistics.n_incomplete) == (2, 1)
    lateral = statistics.lateral
    assert (lateral.mean, lateral.max, lateral.rmse) == pytest.approx((-0.5, 2.0, math.sqrt((1.0 + 4.0) / 2.0)))
    assert statistics.yaw.mean == pytest.approx(0.1) and statistics.longitudinal.max == 0.0


def test_statistics_of_nothing_are_nan():
    empty = Statistic()
    assert math.isnan(empty.mean) and math.isnan(empty.max) and math.isnan(empty.rmse)
