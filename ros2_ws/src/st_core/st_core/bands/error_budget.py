"""Contributions of parameters, sensors and initial state to the mean squared error of a model, and the residual.

    mean e_a(t)^2 = sum_p mean( (de_a(t)/dp sigma_p)^2 ) + sum_s mean( (de_a(t)/ds sigma_s)^2 ) + residual

p: parameters of vehicle and model file with a known uncertainty, assumed independent. s: the six states at the start
and the measured pose at t, with the white noise of this recording. The derivatives are central differences of whole
predictions with steps of one standard deviation, along and across the predicted heading; the errors are along and
across the measured heading, which is nearly the same. The residual contains errors of the model structure, parameters
without an uncertainty, slow sensor errors, and noise of the inputs; it is negative if the uncertainties exceed the
errors. Only the mode `hindsight` is decomposed. Checked by: test_bands_error_budget.py.
"""

import contextlib
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ..augmented import AugmentedModel
from ..batch import LogBatch
from ..effects import get_effect
from ..errors import ConfigurationError
from ..log import INS_SIGNALS, LogSignals
from ..log_evaluation import EvaluationSettings, regular_starts, usable_starts
from ..models import Model
from ..readings import predict_readings
from ..regression import Z95, white_noise
from ..types import map_to_body, wrap_angle
from ..vehicle import VehicleParameters, value_of
from .scale import select_evenly

PARAMETERS, SENSORS = "parameters", "sensors and start"
MAX_STARTS = 200  # largest number of starts of a run; neighbouring starts are redundant

Intervals = Mapping[tuple[str, str], tuple[float, float]]  # 95 % intervals of a model file, by effect and parameter
Cause = tuple[str, str]  # (PARAMETERS or SENSORS, name)


def sum_squared_contributions(
        model: Model, vehicle: VehicleParameters, signals: LogSignals, settings: EvaluationSettings,
        intervals: Intervals | None) -> tuple[int, np.ndarray, dict[Cause, np.ndarray]]:
    """(number of starts, squared errors, squared contributions by cause) of one run. Squares are summed over all
    starts: (seconds, 3) [m^2, m^2, rad^2], along, across and in yaw at 1, 2, ... s ahead. Causes that change no
    prediction are left out. Raises ConfigurationError if 1 s is not a multiple of the step or exceeds the horizon."""
    seconds = np.arange(1, int(settings.prediction.horizon + 1e-9) + 1, dtype=float)
    starts, _ = usable_starts(signals, vehicle, regular_starts(signals.log, settings.interval),
                              settings.prediction.minimum_speed)
    starts = starts[select_evenly(len(starts), MAX_STARTS)]

    def make_batch(drive: LogSignals) -> LogBatch:
        return LogBatch(drive, starts, settings.prediction.horizon, settings.prediction.step, points=seconds.tolist())

    def predict_path(drive: LogSignals, variant: Model, car: VehicleParameters) -> np.ndarray:
        states = make_batch(drive).predict(variant, car)
        with np.errstate(all="ignore"):
            readings = predict_readings(variant, car, tuple(np.moveaxis(states, -1, 0)))
            return np.stack([readings.x, readings.y, readings.yaw])

    errors, base = make_batch(signals).errors(model, vehicle), predict_path(signals, model, vehicle)
    is_complete = np.isfinite(errors).all(axis=(1, 2))
    # Predictions with each cause one standard deviation lower and higher.
    varied_paths: dict[Cause, list[np.ndarray]] = {}
    for key, variants in _vary_parameters(model, vehicle, intervals or {}).items():
        drives = [signals if car is vehicle or signals.log.steering_wheel_angle is None
                  else settings.signals(signals.log.with_steering(car)) for _, car in variants]
        varied_paths[PARAMETERS, key] = [predict_path(drive, *variant)
                                         for drive, variant in zip(drives, variants, strict=True)]
    noise = {name: white_noise(getattr(signals.log, name)) if len(signals.log.x) > 3 else 0.0 for name in INS_SIGNALS}
    for name, sigma in noise.items():
        logs = [replace(signals.log, **{name: getattr(signals.log, name) + step}) for step in (-sigma, sigma)]
        varied_paths[SENSORS, f"{name} at the start"] = [
            predict_path(settings.signals(log), model, vehicle) for log in logs]
    squares: dict[Cause, np.ndarray] = {}
    for cause, (lower, higher) in varied_paths.items():
        change = np.stack([*map_to_body(0.5 * (higher[0] - lower[0]), 0.5 * (higher[1] - lower[1]), base[2]),
                           wrap_angle(higher[2] - lower[2]) * 0.5], axis=-1)[is_complete]
        if (change != 0.0).any():
            squares[cause] = np.square(change).sum(axis=0)
    position_variance = 0.5 * (noise["x"] ** 2 + noise["y"] ** 2)
    pose_variances = np.array([position_variance, position_variance, noise["yaw"] ** 2])
    squares[SENSORS, "pose at the end"] = np.tile(is_complete.sum() * pose_variances, (len(seconds), 1))
    return int(is_complete.sum()), np.square(errors[is_complete]).sum(axis=0), squares


def _vary_parameters(model: Model, vehicle: VehicleParameters,
                     intervals: Intervals) -> dict[str, list[tuple[Model, VehicleParameters]]]:
    """By parameter, two pairs (model, vehicle): with this parameter one standard deviation lower, and higher.
    Parameters of effects are limited to their bounds."""
    variants: dict[str, list[tuple[Model, VehicleParameters]]] = {}
    for key, provenance in vehicle.provenance.items():
        if sigma := provenance.uncertainty:
            with contextlib.suppress(ConfigurationError):
                variants[key] = [(model, vehicle.with_values({key: value_of(vehicle, key) + step}))
                                 for step in (-sigma, sigma)]
    if not isinstance(model, AugmentedModel):
        return variants
    for (effect, name), (low, high) in intervals.items():
        value, sigma = model.values[effect][name], (high - low) / (2.0 * Z95)
        bounds = next(p.bounds for p in get_effect(effect).parameters if p.name == name)
        pair = [float(np.clip(value + side * sigma, *bounds)) for side in (-1.0, 1.0)]
        if pair[0] < pair[1]:
            variants[f"{effect}.{name}"] = [(model.with_values({effect: {name: end}}), vehicle) for end in pair]
    return variants
