"""Compiled single predictions equal Python floats for every model; models that cannot be compiled run on floats."""

import math
from dataclasses import replace

import numpy as np
import pytest
from st_core import backends, prediction
from st_core.augmented import augment
from st_core.errors import ConfigurationError
from st_core.models import MODELS
from st_core.prediction import PredictionSettings, Predictor, Start, compile_model, compile_models, predict
from st_core.types import ControlInput, InputSequence, VehicleState

needs_numba = pytest.mark.skipif(not backends.has_numba(), reason="numba is not installed")
SETTINGS = PredictionSettings()
STATE = VehicleState(120.0, -40.0, 12.0, 0.1, 2.9, 0.15)
INPUTS = ControlInput(0.03, -0.4)


def wavy(steps):
    time = np.linspace(0.0, 5.0, 2 * steps + 1)
    return InputSequence(0.05 * np.sin(time), np.cos(time))


@needs_numba
@pytest.mark.parametrize("inputs", [INPUTS, wavy(SETTINGS.steps)], ids=["constant", "sequence"])
@pytest.mark.parametrize("model", [*MODELS.values(), augment("linear", ["tyre_relaxation"]),
                                   augment("nonlinear", ["road_bank"])], ids=lambda m: m.name)
def test_compiled_prediction_equals_floats(leaf, model, inputs):
    compiled_path = compile_model(model, leaf, SETTINGS)(STATE, inputs)
    exact = predict(model, leaf, STATE, inputs)
    assert compiled_path.step == exact.step
    np.testing.assert_allclose(compiled_path.states, exact.states, rtol=1e-12, atol=1e-12)


@needs_numba
def test_nan_propagates_as_on_floats(leaf):
    model = MODELS["linear"]
    sequence = wavy(SETTINGS.steps)
    angle = sequence.road_wheel_angle.copy()
    angle[100:] = math.nan
    compiled_path = compile_model(model, leaf, SETTINGS)(STATE, replace(sequence, road_wheel_angle=angle)).states
    exact = predict(model, leaf, STATE, replace(sequence, road_wheel_angle=angle)).states
    np.testing.assert_array_equal(np.isnan(compiled_path), np.isnan(exact))
    assert np.isnan(compiled_path).any() and np.isfinite(compiled_path[49]).all()


@needs_numba
def test_predictor_uses_compiled_models(leaf):
    runners, message = compile_models(list(MODELS.values()), leaf, SETTINGS)
    assert message == f"compiled and checked: {', '.join(MODELS)}"
    start = Start(0, STATE, INPUTS)
    fast, plain = Predictor(leaf, tuple(MODELS), SETTINGS, runners), Predictor(leaf, tuple(MODELS), SETTINGS)
    for name in MODELS:
        np.testing.assert_allclose(fast.run(start, name).states, plain.run(start, name).states, rtol=1e-12, atol=1e-12)


@needs_numba
def test_compiled_model_that_differs_from_floats_is_not_used(leaf, monkeypatch):
    """With an inexact compiled result the model runs on floats, and the message gives the reason."""
    numba_lanes = backends.get_backend("lanes")
    exact = numba_lanes.advance
    monkeypatch.setattr(numba_lanes, "advance", lambda model, *arguments: (
        exact(model, *arguments) + 1e-6 * (model.name == "linear")))
    runners, message = compile_models(list(MODELS.values()), leaf, SETTINGS)
    assert set(runners) == MODELS.keys() - {"linear"}
    assert message.startswith(f"compiled and checked: {', '.join(runners)}; not compiled: linear (the compiled ")


def test_without_numba_all_models_run_on_floats(leaf, monkeypatch):
    monkeypatch.setattr(prediction, "has_numba", lambda: False)
    assert compile_models(list(MODELS.values()), leaf, SETTINGS) == (
        {}, f"not compiled: {', '.join(MODELS)} (numba is not installed)")
    with pytest.raises(ConfigurationError, match="numba is not installed"):
        compile_model(MODELS["linear"], leaf, SETTINGS)

