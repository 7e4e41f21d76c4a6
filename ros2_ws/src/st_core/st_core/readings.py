"""Corrects logs and samples for the sensor and steering effects of a model, and predicts INS readings from states.

A model without these effects leaves logs and samples unchanged. `ModelView` gives start state and inputs of a live
prediction, which depend on these effects and on the lever arm of the model.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from .augmented import AugmentedModel
from .effects import Measured
from .errors import ConfigurationError, StCoreError
from .log import OPTIONAL_INS_SIGNALS, DriveLog
from .measurement_history import DERIVATIVE, MeasurementHistory
from .models import Model
from .timeseries import NANOSECOND, half_step_grid, interpolate
from .types import ControlInput, InputSequence, InsSample, VehicleState, cg_to_ins_position, ins_to_cg, pose_errors
from .vehicle import VehicleParameters

MEMORY_TIME = 5.0  # s, steering history for delay, play and lag; the response to a lag of 0.5 s has decayed to e^-10
MEMORY_NS = round(MEMORY_TIME / NANOSECOND)


def correct_sample(model: Model, sample: InsSample) -> InsSample:
    """The sample that an ideal INS would measure; NaN where its correction needs an acceleration."""
    if not isinstance(model, AugmentedModel) or not model.has_sensor_effects:
        return sample
    ideal = model.correct(Measured(*sample[1:], acceleration_x=np.nan, acceleration_y=np.nan))
    return InsSample(sample.time_ns, *ideal[:6])


def find_missing_reading(model: Model, missing: Sequence[str]) -> tuple[str, str] | None:
    """(effect, reading) of the first sensor effect that needs a missing acceleration to correct pose, velocity or yaw
    rate; None if there is no such effect."""
    if not isinstance(model, AugmentedModel):
        return None
    missing_readings = [name for name in missing if name in Measured._fields]
    for effect in model.active_effects:
        for reading in missing_readings if effect.correct else ():
            example = Measured(1.0, 2.0, 0.1, 10.0, 0.2, 0.3, 0.4, 3.0)._replace(**{reading: np.nan})
            reduced = model.select_effects(e for e in model.effects if e.converts or e is effect)
            if np.isnan(reduced.correct(example)[:6]).any():
                return effect.name, reading
    return None


def correct_steering(model: Model, time_ns: np.ndarray, angle: np.ndarray,
                     maximum_gap: float) -> tuple[np.ndarray, np.ndarray]:
    """(time [ns], angle of the wheels [rad]): delay, play and lag applied to a recorded road wheel angle [rad].

    maximum_gap [s]: after a longer gap the effects restart.
    """
    if not isinstance(model, AugmentedModel) or not model.has_steering_dynamics or not len(time_ns):
        return time_ns, angle
    seconds = (time_ns - time_ns[0]) * NANOSECOND
    restarts = np.diff(time_ns, prepend=time_ns[0]) > round(maximum_gap / NANOSECOND)
    restarts[0] = True
    wheel_seconds, angle = model.steering(seconds, angle, restarts)
    # Only the shift is rounded, so that the times are exact without a delay.
    return time_ns + np.round((wheel_seconds - seconds) / NANOSECOND).astype(np.int64), angle


def predict_wheel_angles(model: Model, time_ns: np.ndarray, angle: np.ndarray, grid_ns: np.ndarray, planned: np.ndarray,
                         maximum_gap: float) -> np.ndarray:
    """Angle of the wheels [rad] at increasing instants grid_ns (m,) [ns] for a planned road wheel angle (m,) [rad].

    time_ns [ns], angle [rad]: recorded steering, used from MEMORY_TIME before the first instant, because delay, play
    and lag depend on earlier steering. After the last instant the last planned angle is held. maximum_gap [s].
    """
    if not model.has_steering_dynamics:
        return planned
    before = slice(*np.searchsorted(time_ns, (grid_ns[0] - MEMORY_NS, grid_ns[0])).tolist())
    gap_ns, spacing = round(maximum_gap / NANOSECOND), int(grid_ns[1] - grid_ns[0])
    # The planned samples must be at most maximum_gap / 2 apart, because the effects restart after a gap.
    substeps = max(1, -(-2 * spacing // gap_ns))
    fine_grid, coarse_grid = np.arange(substeps * (len(planned) - 1) + 1) / substeps, np.arange(len(planned))
    future_ns = grid_ns[0] + np.round(np.interp(fine_grid, coarse_grid, grid_ns - grid_ns[0])).astype(np.int64)
    extension_ns = future_ns[-1] + (spacing // substeps) * np.arange(
        1, 2 + substeps * required_lookahead_ns(model) // spacing)
    steering_ns = np.concatenate((time_ns[before], future_ns, extension_ns))
    steering = np.concatenate((angle[before], np.interp(fine_grid, coarse_grid, planned),
                               np.full(len(extension_ns), planned[-1])))
    return interpolate(*correct_steering(model, steering_ns, steering, maximum_gap), grid_ns, gap_ns)


def required_lookahead_ns(model: Model) -> int:
    """Time after an instant [ns] up to which the steering must be known to compute the wheel angle at the instant; 0
    unless the delay of the steering is negative."""
    if not isinstance(model, AugmentedModel) or not model.has_steering_dynamics:
        return 0
    time, _ = model.steering(np.zeros(1), np.zeros(1), np.ones(1, bool))
    return max(0, round(-float(time[0]) / NANOSECOND))


def correct_log(model: Model, log: DriveLog, maximum_gap: float = 0.1) -> DriveLog:
    """The drive as ideal sensors would record it, with delay, play and lag of the steering applied; its
    steering_wheel_angle is then None. maximum_gap [s]. Raises StCoreError for a missing acceleration."""
    if not isinstance(model, AugmentedModel):
        return log
    corrected: dict[str, Any] = {}
    if model.has_sensor_effects:
        names = Measured._fields[:-1]
        if missing := find_missing_reading(model, [name for name in names if getattr(log, name) is None]):
            raise StCoreError("{}: effect {} needs {}, which was not recorded".format(log.name, *missing))
        recorded = {name: getattr(log, name) for name in Measured._fields if getattr(log, name) is not None}
        zeros = np.zeros(len(log.ins_time_ns))
        ideal = model.correct(Measured(*(recorded.get(name, zeros) for name in Measured._fields)))
        corrected |= {name: getattr(ideal, name) for name in names if name in recorded}
    if model.has_steering_dynamics:
        time_ns, angle = correct_steering(model, log.steering_time_ns, log.road_wheel_angle, maximum_gap)
        corrected |= {"steering_time_ns": time_ns, "road_wheel_angle": angle, "steering_wheel_angle": None}
    return replace(log, **corrected) if corrected else log


def predict_readings(model: Model, vehicle: VehicleParameters, states: tuple) -> Measured:
    """Readings of the INS in the given states: `predict_ideal_readings` with the sensor effects applied."""
    ideal = predict_ideal_readings(model, vehicle, states)
    return model.observe(ideal) if isinstance(model, AugmentedModel) else ideal


def predict_ideal_readings(model: Model, vehicle: VehicleParameters, states: tuple) -> Measured:
    """Readings of an ideal INS in the given states, at the INS point; the accelerations are NaN.

    states: (x, y, velocity_x, velocity_y, yaw, yaw_rate, extra states ...) at the CG, floats or arrays of equal shape.
    The yaw acceleration is 0, so a delay of the yaw rate has no effect. vehicle: without the effects of the model.
    """
    car = model.effective_vehicle(vehicle)
    x, y, velocity_x, velocity_y, yaw, yaw_rate = states[:6]
    unknown = velocity_x * np.nan
    return Measured(*cg_to_ins_position(x, y, yaw, car.cg_to_ins_x, car.cg_to_ins_y), yaw,
                    velocity_x - yaw_rate * car.cg_to_ins_y, velocity_y + yaw_rate * car.cg_to_ins_x, yaw_rate,
                    unknown, unknown, 0.0 * yaw_rate)


def reading_errors(model: Model, vehicle: VehicleParameters, states: np.ndarray, x: np.ndarray, y: np.ndarray,
                   yaw: np.ndarray) -> np.ndarray:
    """Errors (n, k, 3) of states (n, k, 6): longitudinal, lateral [m], yaw [rad]; predicted minus measured.

    x, y [m], yaw [rad]: measured, (n, k) each. Axes and signs as in `types.pose_errors`.
    """
    with np.errstate(all="ignore"):
        predicted = predict_readings(model, vehicle, tuple(np.moveaxis(states, -1, 0)))
        # The errors are stacked in the memory order of the states, by point; this is twice as fast as by start.
        errors = pose_errors(predicted.x, predicted.y, predicted.yaw, x, y, yaw)
        return np.stack([e.T for e in errors]).transpose(2, 1, 0)


class ModelView:
    """One model's view of a MeasurementHistory that is shared between models.

    A model with sensor effects has its own history of corrected samples, fed by the shared one. vehicle: without
    the effects of the model. Raises ConfigurationError if the model needs a quantity that is not measured live.
    """

    def __init__(self, model: Model, vehicle: VehicleParameters, shared: MeasurementHistory):
        if missing := find_missing_reading(model, OPTIONAL_INS_SIGNALS):
            raise ConfigurationError("model {}: effect {} needs {}, which is not measured live".format(
                model.name, *missing))
        self.model = model
        self.car = model.effective_vehicle(vehicle)
        self.is_augmented = isinstance(model, AugmentedModel)
        self.has_steering_dynamics = model.has_steering_dynamics
        corrects_samples = isinstance(model, AugmentedModel) and model.has_sensor_effects
        self._history = shared.make_corrected(partial(correct_sample, model)) if corrects_samples else shared
        self.lookahead_ns = required_lookahead_ns(model)

    @staticmethod
    def extend_span(models: Sequence[Model], span: float) -> float:
        """Length of the history [s] that covers a time span [s]; longer by MEMORY_TIME for steering dynamics."""
        return span + MEMORY_TIME if any(model.has_steering_dynamics for model in models) else span

    def read_start(self, time_ns: int, steps: int, step: float) -> tuple[VehicleState, ControlInput | InputSequence]:
        """State at the model's CG, and inputs of a forecast with constant steering wheel angle and acceleration. With
        steering dynamics the inputs are a sequence. Raises StCoreError if state or inputs are unknown."""
        sample, inputs = self._history.ins_at(time_ns), self._history.inputs_at(time_ns)
        if sample is None or inputs is None:
            raise StCoreError(f"model {self.model.name}: state or inputs not known at {time_ns} ns")
        state = ins_to_cg(sample, self.car.cg_to_ins_x, self.car.cg_to_ins_y)
        if not self.has_steering_dynamics:
            return state, inputs
        series, grid = self._history.steering, half_step_grid(time_ns, steps, step)
        constant_angle = np.full(len(grid), inputs.road_wheel_angle)
        angle = predict_wheel_angles(self.model, series.times, series.rows[:, 0], grid, constant_angle,
                                     series.maximum_gap_ns * NANOSECOND)
        return state, InputSequence(angle, np.full(len(grid), inputs.velocity_x_dot))

    def read_inputs(self, times_ns: np.ndarray) -> InputSequence:
        """Measured inputs, as corrected by the model, at increasing times [ns]; NaN where unknown."""
        acceleration = self._history.ins.sample(times_ns)[:, DERIVATIVE]
        if not self.has_steering_dynamics:
            return InputSequence(self._history.steering.sample(times_ns)[:, 0], acceleration)
        series = self._history.steering
        gap_ns = series.maximum_gap_ns
        span = times_ns[0] - MEMORY_NS, times_ns[-1] + gap_ns + self.lookahead_ns
        rows = slice(*np.searchsorted(series.times, span).tolist())
        wheels = correct_steering(self.model, series.times[rows], series.rows[rows, 0], gap_ns * NANOSECOND)
        return InputSequence(interpolate(*wheels, times_ns, gap_ns), acceleration)
