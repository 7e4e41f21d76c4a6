"""Single predictions by compiled code, with the results of `prediction.predict`, but six times faster.

Three models over 5 s take 0.2 ms instead of 1.3 ms; with an additional model of three effects 0.6 ms instead of 4.1 ms.
The compiled code advances several predictions (lanes) in parallel; only the first is used here.
Checked by: test_compiled.py, and `compile_model` at every start of a node.
"""

from collections.abc import Sequence
from types import ModuleType

import numpy as np

from .backends import get_backend, has_numba
from .errors import ConfigurationError
from .models import Model
from .prediction import PredictionSettings, predict
from .types import STATE_NAMES, ControlInput, InputSequence, Trajectory, VehicleState
from .vehicle import VehicleParameters

TOLERANCE = 1.0e-9  # largest difference from the interpreted model, relative to max(1, |value|)
# States and inputs of the comparison with the interpreted model, (v_x [m/s], v_y [m/s], yaw rate [rad/s],
# road wheel angle [rad], acceleration [m/s^2]): walking pace to motorway speed, left and right, driven and braked.
_SAMPLES = ((1.0, 0.0, 0.05, 0.1, 0.3), (8.0, 0.1, -0.25, -0.08, 0.0), (15.0, -0.2, 0.2, 0.04, -1.0),
            (30.0, 0.0, -0.02, -0.005, 0.5))


class CompiledModel:
    """Compiled prediction of one model, car and horizon, created and verified by `compile_model`."""

    def __init__(self, model: Model, vehicle: VehicleParameters, settings: PredictionSettings):
        """Raises ConfigurationError if numba cannot compile the model."""
        self._lanes: ModuleType = get_backend("lanes")
        self._model, self._parameters = model, model.parameters(vehicle)
        self._step = settings.step
        self._points = np.arange(settings.steps + 1)
        self._constant_rows = np.zeros(2 * settings.steps + 1, np.int64)
        self._sequence_rows = np.arange(2 * settings.steps + 1)
        w = model.inputs(0.0, 0.0, self._parameters)
        start = model.start_state((0.0,) * len(STATE_NAMES), w, self._parameters)
        if not self._lanes.can_compile(model, self._parameters, len(w), len(start)):
            raise ConfigurationError("numba cannot compile the model")

    def __call__(self, state: VehicleState, inputs: ControlInput | InputSequence) -> Trajectory:
        """The trajectory from a state, as `prediction.predict` with substeps = 1.

        inputs: constant, or 2 * steps + 1 values on the half-step grid; no further signals. NaN inputs give NaN states.
        """
        model, p, lanes = self._model, self._parameters, self._lanes.LANES
        angle, acceleration = inputs.road_wheel_angle, inputs.velocity_x_dot
        # Only the first column is used; the others only have to be finite.
        if isinstance(inputs, ControlInput):
            first = model.inputs(float(angle), float(acceleration), p)
            table, offsets = np.repeat(np.array(first, float)[:, None], lanes, axis=1), self._constant_rows
        else:
            angle, acceleration = np.asarray(angle, float), np.asarray(acceleration, float)
            with np.errstate(all="ignore"):
                fields = [np.broadcast_to(f, angle.shape) for f in model.inputs(angle, acceleration, p)]
            table, offsets = np.pad(np.array(fields), ((0, 0), (0, lanes - 1)), mode="edge"), self._sequence_rows
            first = tuple(table[:, 0].tolist())
        start = np.array(model.start_state(state.as_tuple(), first, p), float)
        columns = np.repeat(start[:, None], lanes, axis=1)
        states = self._lanes.advance(model, p, columns, table, offsets, self._step, self._points)
        return Trajectory(self._step, np.ascontiguousarray(states[:, :, 0]))


def compile_model(model: Model, vehicle: VehicleParameters, settings: PredictionSettings) -> CompiledModel:
    """The compiled form of a model, from the compiler or its cache, verified against the interpreted model.

    Raises ConfigurationError if numba is not installed or cannot compile the model, or if the results differ.
    """
    if not has_numba():
        raise ConfigurationError("numba is not installed")
    try:
        result = CompiledModel(model, vehicle, settings)
    except ConfigurationError:
        raise
    except Exception as error:  # numba raises many types of errors; the interpreted model is the fallback
        raise ConfigurationError(f"{type(error).__name__}: {error}") from None
    ramp = np.linspace(1.0, 0.5, 2 * settings.steps + 1)
    for v_x, v_y, yaw_rate, angle, acceleration in _SAMPLES:
        state = VehicleState(3.0, -2.0, v_x, v_y, 0.7, yaw_rate)
        for inputs in (ControlInput(angle, acceleration), InputSequence(angle * ramp, acceleration * ramp)):
            expected = predict(model, vehicle, state, inputs, settings.horizon, settings.step).states
            compiled, finite = result(state, inputs).states, np.isfinite(expected)
            with np.errstate(all="ignore"):
                difference = np.abs(compiled - expected) / np.maximum(1.0, np.abs(expected))
            # Both must be finite at the same points (a spin with a long step diverges), and agree there.
            if not np.array_equal(finite, np.isfinite(compiled)) or (difference[finite] > TOLERANCE).any():
                worst = float(np.nanmax(np.where(finite, difference, 0.0)))
                raise ConfigurationError(f"the compiled {model.name} differs from the interpreted model by {worst:.1e}")
    return result


def compile_models(models: Sequence[Model], vehicle: VehicleParameters,
                   settings: PredictionSettings) -> tuple[dict[str, CompiledModel], str]:
    """(compiled models by name, one line for the log: their names, and why the others are not compiled)."""
    compiled: dict[str, CompiledModel] = {}
    reasons: dict[str, str] = {}
    for model in models:
        try:
            compiled[model.name] = compile_model(model, vehicle, settings)
        except ConfigurationError as error:
            reasons[model.name] = " ".join(str(error).split())
    parts = [f"compiled and checked: {', '.join(compiled)}"] if compiled else []
    if reasons:
        parts.append(f"not compiled: {', '.join(reasons)} ({'; '.join(dict.fromkeys(reasons.values())):.200})")
    return compiled, "; ".join(parts)
