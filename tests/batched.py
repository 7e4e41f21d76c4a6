"""Predictions in one pass of the numpy backend, for comparison with single predictions by `predict`."""

from collections.abc import Mapping

import numpy as np
from st_core.backends import numpy_batch
from st_core.batch import LogBatch
from st_core.models import Model, get_model
from st_core.prediction import step_count
from st_core.vehicle import VehicleParameters


def predict_batch(model: str | Model, vehicle: VehicleParameters, states: np.ndarray, road_wheel_angle: np.ndarray,
                  velocity_x_dot: np.ndarray, horizon: float = 5.0,
                  signals: Mapping[str, np.ndarray] | None = None) -> np.ndarray:
    """States (n, steps + 1, 6). states: (n, 6). Inputs, signals: (n,) constant, or (n, 2 * steps + 1) at half steps."""
    model = get_model(model)
    p, count = model.parameters(vehicle), len(states)
    step = 0.05
    steps = step_count(horizon, step)
    inputs = [np.asarray(a, float).T for a in (road_wheel_angle, velocity_x_dot, *((signals or {}).values()))]
    angle, acceleration, *others = np.broadcast_arrays(*map(np.atleast_2d, inputs))
    with np.errstate(all="ignore"):
        fields = model.inputs(angle, acceleration, p, *others)
        w = np.array([np.broadcast_to(f, angle.shape).ravel() for f in fields])
        start = model.start_state(tuple(np.asarray(states, float).T), tuple(w[:, :count]), p)
    offsets = np.arange(2 * steps + 1) * (count if len(angle) > 1 else 0)
    begin = np.array([np.broadcast_to(row, count) for row in start])
    return numpy_batch.advance(model, p, begin, w, offsets, step, np.arange(steps + 1)).transpose(2, 0, 1)


def predict_log(model: str | Model, vehicle: VehicleParameters, log, starts_ns: np.ndarray, *of_batch,
                **options) -> np.ndarray:
    return LogBatch(log, starts_ns, *of_batch, **options).predict(model, vehicle)
