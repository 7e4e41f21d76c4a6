"""Planned inputs: plans of the true inputs equal hindsight, invalid plans are rejected with a reason."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from drives import T0, wavy_drive
from st_core.augmented import augment
from st_core.errors import StCoreError
from st_core.evaluation import Evaluator
from st_core.log_evaluation import EvaluationSettings, evaluate_log
from st_core.models import get_model
from st_core.planned_inputs import (
    PlannedInputs,
    find_plan_problem,
    interpolate_plan,
    select_inputs,
    steady_state_steering,
)
from st_core.prediction import PredictionSettings, Predictor, Start, predict
from st_core.types import ControlInput, InputSequence, InsSample, VehicleState

MODELS = ("kinematic", "linear", "nonlinear")
SHORT = PredictionSettings(horizon=1.0)
STATE, INPUTS = VehicleState(0.0, 0.0, 10.0, 0.0, 0.0, 0.1), ControlInput(0.02, 0.5)
START = T0 + 10**9


def plan(seconds=6.0, points=61, **changes) -> PlannedInputs:
    time = START + np.round(np.linspace(0.0, seconds, points) * 1e9).astype(np.int64)
    return replace(PlannedInputs(START, time, np.full(points, 0.02), np.full(points, 0.5)), **changes)


def test_negative_number_of_steps_is_rejected():
    assert len(plan().sequence(START, 0, 0.05).road_wheel_angle) == 1
    with pytest.raises(StCoreError, match="-1 steps"):
        plan().sequence(START, -1, 0.05)


def test_plan_of_the_true_inputs_equals_hindsight(leaf):
    settings = EvaluationSettings(SHORT)
    signals = settings.signals(wavy_drive())
    log = signals.log
    times = np.union1d(log.ins_time_ns, log.steering_time_ns)
    inputs = signals.road_wheel_angle_at(times), *signals.ins_at(times, "velocity_x_dot")
    planned = partial(interpolate_plan, times, inputs, SHORT.steps, SHORT.step, 0.1)
    result = evaluate_log(MODELS, leaf, signals, settings, future_inputs={"plan": planned})
    for model in MODELS:
        hindsight, plan_errors, forecast = (result.errors[model, mode] for mode in ("hindsight", "plan", "forecast"))
        both = hindsight.complete & plan_errors.complete
        assert both.sum() > 90
        assert np.abs(hindsight.at_seconds - plan_errors.at_seconds)[both].max() < 1e-3
        assert np.abs(forecast.at_seconds - plan_errors.at_seconds)[both].max() > 0.1


def test_live_plan_is_predicted_and_scored_separately(leaf):
    """A path with constant speed and curvature: trajectory of the predictor and score of mode `plan`."""
    log = wavy_drive()
    predictor, evaluator = Predictor(leaf, MODELS, SHORT), Evaluator(leaf, SHORT)
    for core in (predictor, evaluator):
        ins = [log.ins_time_ns, *(getattr(log, name) for name in InsSample._fields[1:])]
        for row in zip(*(column.tolist() for column in ins), strict=True):
            if row[0] < START or core is evaluator:
                core.add_ins(InsSample(*row))
        for time_ns, angle in zip(log.steering_time_ns.tolist(), log.road_wheel_angle.tolist(), strict=True):
            if time_ns < START or core is evaluator:
                core.add_steering(time_ns, angle)
    start = predictor.find_start(START)
    assert isinstance(start, Start)
    path = PlannedInputs.from_path(START, START - 10**8 + np.arange(0, 20) * 10**8, np.full(20, start.state.velocity_x),
                                   np.full(20, start.state.yaw_rate / start.state.velocity_x), leaf)
    ahead = predictor.plan_inputs(path, start)
    assert isinstance(ahead, InputSequence)
    issued = predictor.run(start, "linear", ahead)
    expected = predict("linear", leaf, start.state, ahead, SHORT.horizon, SHORT.step)
    np.testing.assert_array_equal(issued.states, expected.states)
    evaluator.add_prediction("linear", start.time_ns, issued, "plan")  # scored independently of the forecast
    evaluator.add_prediction("linear", start.time_ns, predictor.run(start, "linear"))
    modes = {score.mode: score for score in evaluator.flush()}
    assert set(modes) == {"forecast", "plan", "hindsight"} and all(score.complete for score in modes.values())
    assert not np.array_equal(modes["plan"].lateral, modes["forecast"].lateral)


def test_steady_turn_follows_the_planned_curvature(leaf):
    speed, curvature = 12.0, 0.02
    angle = float(steady_state_steering(np.array(speed), np.array(curvature), leaf))
    end = predict("linear", leaf, VehicleState(0, 0, speed, 0, 0, 0), ControlInput(angle, 0.0)).states[-1]
    assert end[5] / speed == pytest.approx(curvature, rel=0.02)


@pytest.mark.parametrize(("model", "slip_free"), [
    ("kinematic", True), ("nonlinear", False), (augment("kinematic", ["steering_lag"]), True),
    (augment("nonlinear", ["steering_lag"]), False), (augment("kinematic", {"tyre_slip": {"share": 1.0}}), False)])
def test_slip_free_steering_is_used_only_by_models_without_tyres(leaf, model, slip_free):
    path = PlannedInputs.from_path(START, plan().time_ns, np.full(61, 10.0), np.full(61, 0.02), leaf)
    planned = path.sequence(START, 20, 0.05)
    used = select_inputs(get_model(model), planned).road_wheel_angle
    expected = planned.signals["slip_free_angle"] if slip_free else planned.road_wheel_angle
    np.testing.assert_array_equal(used, expected)


def test_path_with_arrays_of_unequal_length_is_rejected(leaf):
    with pytest.raises(StCoreError, match="plan: road_wheel_angle has 60 values, time has 61"):
        PlannedInputs.from_path(START, plan().time_ns, np.full(61, 10.0), np.full(60, 0.02), leaf)


@pytest.mark.parametrize(("time_ns", "reason"), [
    (np.zeros(0, int), r"plan: 0 point\(s\); at least two are needed"),
    (plan().time_ns[::-1], "plan: the times are not increasing"),
    (np.array([0.0, np.nan, 1e9]), "plan: a time is not finite"),
    (np.array([0.0, 1e9, np.inf]), "plan: a time is not finite"),
    (np.linspace(0.0, 6.0, 61), "plan: the times are not whole nanoseconds: multiply seconds by 1e9 and round"),
])
def test_invalid_times_are_rejected(leaf, time_ns, reason):
    values = np.full(len(time_ns), 10.0), np.full(len(time_ns), 0.02)
    with pytest.raises(StCoreError, match=reason):
        PlannedInputs(START, time_ns, *values)
    with pytest.raises(StCoreError, match=reason):
        PlannedInputs.from_path(START, time_ns, *values, leaf)


@pytest.mark.parametrize(("changes", "reason"), [
    ({}, ""),
    ({"road_wheel_angle": np.where(np.arange(61) == 7, np.nan, 0.02)}, "road_wheel_angle is not finite at point 7"),
    ({"velocity_x_dot": np.full(61, np.inf)}, "velocity_x_dot is not finite at point 0"),
    ({"issued_ns": START - 10**9}, "issued 1.00 s before the start"),
    ({"issued_ns": START + 10**9}, "clocks disagree"),
    ({"time_ns": START - 10**10 + np.arange(61) * 10**8}, "covers -10.00 to -4.00 s after the start, not"),
    ({"time_ns": START + 10**9 + np.arange(61) * 10**8}, "covers 1.00 to 7.00 s after the start, not"),
    ({"time_ns": START + np.arange(61) * 5 * 10**7}, "covers 0.00 to 3.00 s after the start, not"),
    ({"time_ns": START + np.arange(61) * 6 * 10**8}, "up to 0.60 s apart"),
    ({"road_wheel_angle": np.full(61, 0.9)}, "0.90 rad"),
    ({"road_wheel_angle": 0.02 + 0.2 * (np.arange(61) % 2)}, "steering rate"),
    ({"velocity_x_dot": np.linspace(0.5, 20.0, 61)}, "limit 12"),
    ({"road_wheel_angle": np.linspace(0.02, 0.5, 61)}, "limit 12"),
    ({"road_wheel_angle": np.full(61, -0.06)}, "check sign, frame and unit"),
    ({"velocity_x_dot": np.full(61, -4.0)}, "velocity_x_dot is -4 m/s^2 at the start, but 0.5 m/s^2 was measured"),
    ({"speed": np.full(61, 15.0)}, "speed is 15 m/s at the start, but 10 m/s was measured"),
])
def test_invalid_plans_are_rejected_with_a_reason(leaf, changes, reason):
    found = find_plan_problem(plan(**changes), START, STATE, INPUTS, 5.0, leaf)
    assert reason in found and bool(found) == bool(reason)
