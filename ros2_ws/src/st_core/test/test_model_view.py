"""Live prediction and scoring with effects: the augmented model predicts a car that has the effect.

The drive is simulated with the augmented model, its sensors and its steering; Predictor and Evaluator receive only
the measurements.
"""

from dataclasses import replace

import numpy as np
import pytest
from batched import predict_log
from st_core import integrate
from st_core.augmented import augment
from st_core.effects import find_applicable_effects
from st_core.errors import ConfigurationError, StCoreError
from st_core.evaluation import Evaluator
from st_core.log import DriveLog
from st_core.measurement_history import MeasurementHistory
from st_core.models import MODELS
from st_core.prediction import PredictionSettings, Predictor, Start, predict
from st_core.readings import ModelView, predict_readings
from st_core.timeseries import NANOSECOND
from st_core.types import ControlInput, InputSequence, InsSample, VehicleState

START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 10_000_000
DURATION = 9.0  # s
BRAKING = -0.6  # m/s^2
SETTINGS = PredictionSettings(horizon=2.0)


def steering_wheel(time):
    """Measured steering, as road wheel angle [rad]; time [s]."""
    return 0.03 + 0.04 * np.sin(2.2 * time)


class Drive:
    """INS samples and steering of a car that `model` describes exactly."""

    def __init__(self, model, vehicle):
        self.time_ns = START_NS + PERIOD_NS * np.arange(round(DURATION / (PERIOD_NS * NANOSECOND)) + 1)
        grid = np.arange(2 * len(self.time_ns) - 1) * 0.5 * PERIOD_NS * NANOSECOND
        # True road wheel angle; effects with memory have settled before the drive begins.
        before = np.arange(-8.0, 0.0, 0.005)
        recorded = np.concatenate((before, grid))
        shifted, wheels = model.steering(recorded, steering_wheel(recorded), np.arange(len(recorded)) == 0)
        angle = np.interp(grid, shifted, wheels)
        p = model.parameters(vehicle)
        w = [model.inputs(float(a), BRAKING, p) for a in angle]
        start = model.start_state((5.0, -3.0, 13.0, 0.0, 0.4, 0.1), w[0], p)
        states = np.array(integrate.rk4(model.rhs, start, w, p, PERIOD_NS * NANOSECOND))
        readings = predict_readings(model, vehicle, tuple(states.T))
        self.samples = [InsSample(int(t), *(float(c[i]) for c in readings[:6])) for i, t in enumerate(self.time_ns)]
        self.angles = steering_wheel((self.time_ns - START_NS) * NANOSECOND)

    def feed(self, *receivers):
        for sample, angle in zip(self.samples, self.angles, strict=True):
            for receiver in receivers:
                receiver.add_ins(sample)
                receiver.add_steering(sample.time_ns, float(angle))
            yield sample.time_ns


EFFECTS_BY_BASE = [(base, name) for base in ("linear", "nonlinear") for name in find_applicable_effects(base)]


@pytest.mark.parametrize(("base", "name"), EFFECTS_BY_BASE)
def test_model_with_the_effect_predicts_the_car_with_the_effect(leaf, base, name):
    model = augment(base, [name])
    predictor = Predictor(leaf, [base, model], SETTINGS)
    evaluator = Evaluator(leaf, SETTINGS, models=[model])
    scores = []
    for time_ns in Drive(model, leaf).feed(predictor, evaluator):
        elapsed = time_ns - START_NS
        if elapsed > 2_500_000_000 and elapsed % 500_000_000 == 0:
            start = predictor.find_start(time_ns)
            assert isinstance(start, Start)
            for model_name in predictor.models:
                path = predictor.run(start, model_name)
                readings = predict_readings(evaluator.view(model_name).model, leaf, tuple(path.states.T))
                measured = predictor.history.ins_at(start.time_ns)
                # The first predicted readings are the measured ones, with any sensor effect.
                for field in ("x", "y", "velocity_x", "velocity_y", "yaw_rate"):
                    assert getattr(readings, field)[0] == pytest.approx(getattr(measured, field), abs=1e-9), field
                evaluator.add_prediction(model_name, start.time_ns, path)
        scores += evaluator.poll()
    hindsight = [s for s in scores if s.mode == "hindsight" and s.complete]
    assert len(hindsight) >= 18
    for score in hindsight:
        if score.model == "augmented":
            assert np.abs(score.lateral).max() < 0.03 and np.abs(score.longitudinal).max() < 0.03
            assert np.abs(score.yaw).max() < 0.005


def test_base_model_misses_the_effect_that_the_augmented_model_predicts(leaf):
    """Lateral error of the base model above 0.3 m, of the augmented model below 0.01 m."""
    model = augment("linear", {"steering_offset": {"angle": 0.01}, "steering_lag": {"time_constant": 0.15}})
    evaluator = Evaluator(leaf, SETTINGS, models=[model])
    predictor = Predictor(leaf, ["linear", model], SETTINGS)
    for time_ns in Drive(model, leaf).feed(predictor, evaluator):
        if time_ns == START_NS + 4_000_000_000:
            start = predictor.find_start(time_ns)
            for model_name in predictor.models:
                path = predictor.run(start, model_name)
                evaluator.add_prediction(model_name, start.time_ns, path)
    largest = {s.model: np.abs(s.lateral).max() for s in evaluator.poll() if s.mode == "hindsight"}
    assert largest["augmented"] < 0.01 and largest["linear"] > 0.3


def history_of(angle, memory=20.0) -> MeasurementHistory:
    history = MeasurementHistory(memory, 0.1, 5.0)
    for k in range(800):
        time_ns = START_NS + k * PERIOD_NS
        history.add_ins(InsSample(time_ns, 0.1 * k, 0.0, 0.0, 10.0, 0.0, 0.0))
        history.add_steering(time_ns, float(angle(k * PERIOD_NS * NANOSECOND)))
    return history


NOW = 7.0  # s after the first sample


def forecast(leaf, effects, angle):
    view = ModelView(augment("linear", effects), leaf, history_of(angle))
    _, inputs = view.read_start(START_NS + round(NOW / NANOSECOND), 100, 0.05)
    return inputs


def test_forecast_input_converges_to_the_constant_angle_with_the_lag(leaf):
    tau, rate = 0.3, 0.01
    inputs = forecast(leaf, {"steering_lag": {"time_constant": tau}}, lambda t: rate * t)
    ahead = 0.025 * np.arange(201)
    expected = rate * NOW - rate * tau * np.exp(-ahead / tau)
    # The lag starts settled five seconds before the start.
    np.testing.assert_allclose(inputs.road_wheel_angle, expected, atol=1e-7)
    assert (inputs.velocity_x_dot == 0.0).all()


def test_forecast_input_reaches_the_constant_angle_after_the_delay(leaf):
    inputs = forecast(leaf, {"steering_delay": {"time": 0.2}}, lambda t: 0.01 * t)
    ahead = 0.025 * np.arange(201)
    np.testing.assert_allclose(inputs.road_wheel_angle, 0.01 * np.minimum(NOW - 0.2 + ahead, NOW), atol=1e-12)


def test_negative_steering_delay_leaves_no_gap_in_a_forecast(leaf):
    inputs = forecast(leaf, {"steering_delay": {"time": -0.15}}, lambda t: 0.01 * t)
    np.testing.assert_allclose(inputs.road_wheel_angle, 0.01 * NOW, atol=1e-12)


def test_only_effects_with_memory_need_an_input_sequence(leaf):
    assert isinstance(forecast(leaf, {"steering_offset": {"angle": 0.01}}, lambda t: 0.02 * t**0), ControlInput)
    assert isinstance(forecast(leaf, {"steering_backlash": {"play": 0.01}}, lambda t: 0.02 * t**0), InputSequence)


def test_long_steps_leave_no_gap_in_constant_inputs(leaf):
    view = ModelView(augment("linear", ["steering_lag"]), leaf, history_of(lambda t: 0.02))
    _, inputs = view.read_start(START_NS + round(NOW / NANOSECOND), 5, 1.0)
    np.testing.assert_allclose(inputs.road_wheel_angle, 0.02, atol=1e-12)


def test_measured_inputs_are_shifted_by_the_delay(leaf):
    view = ModelView(augment("linear", {"steering_delay": {"time": 0.123}}), leaf, history_of(np.sin))
    times = START_NS + np.arange(5_500_000_000, 7_500_000_000, 25_000_000)
    inputs = view.read_inputs(times)
    np.testing.assert_allclose(inputs.road_wheel_angle, np.sin((times - START_NS) * NANOSECOND - 0.123), atol=2e-5)
    beyond = view.read_inputs(times + 5_000_000_000)
    assert np.isnan(beyond.road_wheel_angle[-10:]).all()


def test_unknown_start_is_rejected(leaf):
    view = ModelView(augment("linear", ["mass"]), leaf, history_of(lambda t: 0.0))
    with pytest.raises(StCoreError, match="state or inputs not known"):
        view.read_start(START_NS - 1, 100, 0.05)


def test_model_with_an_unmeasured_signal_is_rejected(leaf):
    mapped = replace(MODELS["linear"], name="mapped", signals=("bank_angle",))
    with pytest.raises(ConfigurationError, match="model mapped: needs bank_angle, which is not measured live"):
        Predictor(leaf, [mapped])


def test_effects_with_memory_extend_the_history():
    assert ModelView.extend_span([MODELS["linear"], augment("linear", ["mass"])], 2.0) == 2.0
    assert ModelView.extend_span([augment("linear", ["steering_lag"])], 2.0) == 7.0


@pytest.mark.parametrize("effects", [
    {"steering_lag": {"time_constant": 0.2}}, {"steering_delay": {"time": 0.11}},
    {"steering_delay": {"time": -0.11}, "steering_backlash": {"play": 0.01}, "heading_misalignment": {"angle": 0.02},
     "cg_position": {"shift": 0.1}}])
@pytest.mark.parametrize("inputs", ["held", "measured"])
def test_batch_over_a_log_equals_the_live_classes(leaf, effects, inputs):
    model = augment("nonlinear", effects)
    drive = Drive(model, leaf)
    columns = {name: np.array([getattr(s, name) for s in drive.samples]) for name in InsSample._fields[1:]}
    log = DriveLog("drive", drive.time_ns, **columns, steering_time_ns=drive.time_ns, road_wheel_angle=drive.angles)
    predictor, evaluator = Predictor(leaf, [model], SETTINGS), Evaluator(leaf, SETTINGS, models=[model])
    starts, paths = [], []
    for time_ns in drive.feed(predictor, evaluator):
        if time_ns - START_NS in (5_200_000_000, 5_700_000_000, 6_133_000_000 - 3_000_000):
            start = predictor.find_start(time_ns)
            starts.append(start.time_ns)
            paths.append(predictor.run(start, "augmented"))
    if inputs == "measured":
        half_steps = 25_000_000 * np.arange(81)
        paths = [predict(model, leaf, VehicleState(*path.states[0].tolist()),
                         evaluator.view("augmented").read_inputs(t + half_steps), 2.0)
                 for t, path in zip(starts, paths, strict=True)]
    for backend in ("numpy", None):
        states = predict_log(model, leaf, log, np.array(starts), 2.0, inputs=inputs, backend=backend)
        np.testing.assert_allclose(states, [path.states for path in paths], rtol=1e-9, atol=1e-9)
