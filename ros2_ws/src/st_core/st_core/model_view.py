"""Measurements as seen by one model: its start state and its inputs.

A model without effects uses the measurements unchanged. Effects may correct the sensors, move the INS point or delay
the steering; start state and inputs then depend on the model.
"""

from collections.abc import Sequence
from functools import partial

import numpy as np

from . import readings
from .augmented import AugmentedModel
from .errors import ConfigurationError, StCoreError
from .log import OPTIONAL_INS_SIGNALS
from .measurement_history import DERIVATIVE, MeasurementHistory
from .models import Model
from .timeseries import NANOSECOND, half_step_grid, interpolate
from .types import ControlInput, InputSequence, VehicleState, ins_to_cg
from .vehicle import VehicleParameters


class ModelView:
    """One model's view of a MeasurementHistory that is shared between models.

    A model that corrects the samples of the INS has a history of corrected samples, filled in parallel with the shared
    one. vehicle: as in its file. Raises ConfigurationError if the model needs a quantity that is not measured live.
    """

    def __init__(self, model: Model, vehicle: VehicleParameters, shared: MeasurementHistory):
        missing = readings.find_missing_reading(model, OPTIONAL_INS_SIGNALS)
        if missing:
            raise ConfigurationError("model {}: effect {} needs {}, which is not measured live".format(
                model.name, *missing))
        self.model = model
        self.car = model.effective_vehicle(vehicle)
        self.is_augmented = isinstance(model, AugmentedModel)
        self.has_steering_dynamics = readings.has_steering_dynamics(model)
        corrects_samples = isinstance(model, AugmentedModel) and model.has_sensor_effects
        self._history = shared.make_corrected(partial(readings.correct_sample, model)) if corrects_samples else shared
        self.ahead_ns = readings.required_lookahead_ns(model)

    @staticmethod
    def extend_span(models: Sequence[Model], span: float) -> float:
        """Length of the history [s] for a time span [s]; it is longer if a model has steering memory."""
        return span + readings.MEMORY_TIME if any(readings.has_steering_dynamics(model) for model in models) else span

    def read_start(self, time_ns: int, steps: int, step: float) -> tuple[VehicleState, ControlInput | InputSequence]:
        """State at the CG of the model, and inputs of a forecast with constant steering wheel angle and acceleration.

        With steering memory the inputs are a sequence. Raises StCoreError if state or inputs are unknown.
        """
        sample, now = self._history.ins_at(time_ns), self._history.inputs_at(time_ns)
        if sample is None or now is None:
            raise StCoreError(f"model {self.model.name}: state or inputs not known at {time_ns} ns")
        state = ins_to_cg(sample, self.car.cg_to_ins_x, self.car.cg_to_ins_y)
        if not self.has_steering_dynamics:
            return state, now
        series, grid = self._history.steering, half_step_grid(time_ns, steps, step)
        held = np.full(len(grid), now.road_wheel_angle)
        angle = readings.predict_wheel_angles(self.model, series.times, series.rows[:, 0], grid, held,
                                              series.maximum_gap_ns * NANOSECOND)
        return state, InputSequence(angle, np.full(len(grid), now.velocity_x_dot))

    def read_inputs(self, times_ns: np.ndarray) -> InputSequence:
        """Measured inputs at increasing times [ns]; NaN where unknown."""
        acceleration = self._history.ins.sample(times_ns)[:, DERIVATIVE]
        if not self.has_steering_dynamics:
            return InputSequence(self._history.steering.sample(times_ns)[:, 0], acceleration)
        series = self._history.steering
        gap_ns = series.maximum_gap_ns
        span = times_ns[0] - readings.MEMORY_NS, times_ns[-1] + gap_ns + self.ahead_ns
        rows = slice(*np.searchsorted(series.times, span).tolist())
        wheels = readings.correct_steering(self.model, series.times[rows], series.rows[rows, 0], gap_ns * NANOSECOND)
        return InputSequence(interpolate(*wheels, times_ns, gap_ns), acceleration)
