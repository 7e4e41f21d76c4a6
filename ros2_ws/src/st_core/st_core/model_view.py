"""What one model makes of the measurements: its start state, its inputs, and what the INS would show on its path.

A plain model takes the measurements as they are. Effects may correct the sensors, move the point that is measured, or
delay the steering; then start and inputs are the model's own.
"""

from collections.abc import Sequence

import numpy as np

from . import frames
from .alignment import DERIVATIVE, MeasurementHistory
from .augmented import AugmentedModel
from .effects import Measured
from .errors import StCoreError
from .filtering import NANOSECOND
from .models import Model
from .readings import corrected_sample, corrected_steering, readings
from .types import ControlInput, InputSequence, InsSample, Trajectory, VehicleState
from .vehicle import VehicleParameters

MEMORY = 5.0
"""s. Steering this far back is kept for effects with memory; a lag of 0.5 s has then forgotten all but e^-10."""
MEMORY_NS = round(MEMORY / NANOSECOND)


class ModelView:
    """One model's view of a MeasurementHistory that it shares with others.

    Where the model corrects the INS it keeps a history of its own, filled by `add_ins` and `add_steering` in step with
    the shared one. vehicle: as in its file.
    """

    def __init__(self, model: Model, vehicle: VehicleParameters, shared: MeasurementHistory):
        self.model = model
        self.car = model.effective_vehicle(vehicle)
        self._vehicle = vehicle
        self.plain = not isinstance(model, AugmentedModel)
        self.has_memory = not self.plain and model.has_memory
        self._has_sensors = not self.plain and model.has_sensors
        self._history = shared.like() if self._has_sensors else shared
        self.ahead_ns = self._ahead() if self.has_memory else 0

    def _ahead(self) -> int:
        """How far ahead the steering must be known [ns]: > 0 where its stamps are late."""
        time, _ = self.model.steering(np.zeros(1), np.zeros(1), np.ones(1, bool))
        return max(0, round(-float(time[0]) / NANOSECOND))

    @staticmethod
    def span(models: Sequence[Model], span: float) -> float:
        """How long a history must be [s] so that effects with memory have theirs also at the beginning of `span`."""
        memory = any(isinstance(m, AugmentedModel) and m.has_memory for m in models)
        return span + MEMORY if memory else span

    def add_ins(self, sample: InsSample) -> None:
        """Tell the view of an INS sample the shared history was offered."""
        if self._has_sensors:
            self._history.add_ins(corrected_sample(self.model, sample))

    def add_steering(self, time_ns: int, road_wheel_angle: float) -> None:
        """Tell the view of a road wheel angle the shared history was offered."""
        if self._has_sensors:
            self._history.add_steering(time_ns, road_wheel_angle)

    def start(self, time_ns: int, steps: int, step: float) -> tuple[VehicleState, ControlInput | InputSequence]:
        """State at the model's CG and the inputs of a forecast: steering wheel and acceleration held from now on.

        With memory the wheels still follow what the steering did before: then it is a sequence on the half-step grid.
        Raises StCoreError where one of them is not known.
        """
        sample, now = self._history.ins_at(time_ns), self._history.inputs_at(time_ns)
        if sample is None or now is None:
            raise StCoreError(f"model {self.model.name}: state or inputs not known at {time_ns} ns")
        state = frames.ins_to_cg(sample, self.car.cg_to_ins_x, self.car.cg_to_ins_y)
        return state, self._held(now, _half_step_grid(time_ns, steps, step)) if self.has_memory else now

    def _held(self, now: ControlInput, grid_ns: np.ndarray) -> InputSequence:
        series = self._history.steering
        before = slice(*np.searchsorted(series.times, (grid_ns[0] - MEMORY_NS, grid_ns[0])).tolist())
        # Held at instants no further apart than what counts as a gap, and on beyond the end.
        spacing = max(1, min(int(grid_ns[1] - grid_ns[0]), series.maximum_gap_ns // 2))
        after = np.arange(grid_ns[0], grid_ns[-1] + self.ahead_ns + spacing, spacing)
        angle = np.concatenate((series.rows[before, 0], np.full(len(after), now.road_wheel_angle)))
        angle = self._wheels(np.concatenate((series.times[before], after)), angle, grid_ns)
        return InputSequence(angle, np.full(len(grid_ns), now.velocity_x_dot))

    def measured(self, times_ns: np.ndarray) -> InputSequence:
        """Measured inputs at rising instants [ns]; NaN where not known."""
        acceleration = self._history.ins.sample(times_ns)[:, DERIVATIVE]
        if not self.has_memory:
            return InputSequence(self._history.steering.sample(times_ns)[:, 0], acceleration)
        series = self._history.steering
        reach = series.maximum_gap_ns + self.ahead_ns
        rows = slice(*np.searchsorted(series.times, (times_ns[0] - MEMORY_NS, times_ns[-1] + reach)).tolist())
        return InputSequence(self._wheels(series.times[rows], series.rows[rows, 0], times_ns), acceleration)

    def shown(self, trajectory: Trajectory) -> Measured:
        """What the INS would show along a trajectory of the model; no accelerations."""
        t = trajectory
        return readings(self.model, self._vehicle, (t.x, t.y, t.velocity_x, t.velocity_y, t.yaw, t.yaw_rate))

    def _wheels(self, time_ns: np.ndarray, angle: np.ndarray, wanted_ns: np.ndarray) -> np.ndarray:
        """Angle of the road wheels [rad] at wanted instants, from a recorded one: the effects with memory applied."""
        gap_ns = self._history.steering.maximum_gap_ns
        time_ns, angle = corrected_steering(self.model, time_ns, angle, gap_ns * NANOSECOND)
        return _interpolated(time_ns, angle, wanted_ns, gap_ns)


def _half_step_grid(time_ns: int, steps: int, step: float) -> np.ndarray:
    return time_ns + np.round(np.arange(2 * steps + 1) * (0.5 * step / NANOSECOND)).astype(np.int64)


def _interpolated(time_ns: np.ndarray, values: np.ndarray, wanted_ns: np.ndarray, gap_ns: int) -> np.ndarray:
    result = np.full(len(wanted_ns), np.nan)
    if not len(time_ns):
        return result
    after = np.minimum(np.searchsorted(time_ns, wanted_ns), len(time_ns) - 1)
    before = np.maximum(after - 1, 0)
    exact = time_ns[after] == wanted_ns
    spacing = time_ns[after] - time_ns[before]
    inside = (wanted_ns > time_ns[before]) & (wanted_ns < time_ns[after]) & (spacing <= gap_ns)
    low, high = before[inside], after[inside]
    fraction = (wanted_ns[inside] - time_ns[low]) / spacing[inside]
    result[inside] = values[low] + fraction * (values[high] - values[low])
    result[exact] = values[after[exact]]
    return result
