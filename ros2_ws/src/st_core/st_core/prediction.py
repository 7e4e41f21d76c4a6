"""Predicts trajectories, from a state and inputs or live from the newest measurements; the caller supplies the time."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Literal

import numpy as np

from .backends import get_backend, has_numba
from .errors import ConfigurationError, StCoreError
from .integrate import rk4, warn_if_step_too_long
from .measurement_history import FrozenSteeringDetector, MeasurementHistory
from .models import Model, get_model
from .planned_inputs import PlannedInputs, apply_steering_dynamics, find_plan_problem, select_inputs
from .readings import ModelView
from .timeseries import NANOSECOND, TimeSeries
from .types import STATE_NAMES, ControlInput, InputSequence, InsSample, Trajectory, VehicleState, ins_to_cg
from .vehicle import VehicleParameters
from .yaml_text import hash_content


def step_count(horizon: float, step: float) -> int:
    """Number of steps [s] in a horizon [s]. Raises ConfigurationError if it is not a whole number from 1 to 1e6."""
    if not (step > 0.0 and 0.0 < horizon < 1.0e6 * step):
        raise ConfigurationError(f"horizon: {horizon:g} s with steps of {step:g} s; both must be above 0, and the "
                                 "horizon below 1e6 steps")
    steps = round(horizon / step)
    if steps < 1 or abs(steps * step - horizon) > 1.0e-9 * horizon:
        raise ConfigurationError(f"horizon: {horizon:g} s is not a whole number of steps of {step:g} s; change one")
    return steps


@dataclass(frozen=True)
class PredictionSettings:
    """Settings of a prediction. Raises ConfigurationError, naming the key and the limit."""

    horizon: float = 5.0  # s
    step: float = 0.05  # s
    minimum_speed: float = 0.5  # m/s; no prediction is made below it
    stale_after: float = 0.2  # s; no prediction is made from older measurements
    maximum_gap: float = 0.1  # s; longest gap that is interpolated
    filter_cutoff: float = 5.0  # Hz; cut-off of the low-pass for the forward acceleration

    def __post_init__(self) -> None:
        limits = {"horizon": (0.01, 60.0, "s"), "step": (0.001, 1.0, "s"), "minimum_speed": (0.0, 50.0, "m/s"),
                  "stale_after": (0.001, 10.0, "s"), "maximum_gap": (0.001, 10.0, "s"),
                  "filter_cutoff": (0.01, 1000.0, "Hz")}
        for key, (low, high, unit) in limits.items():
            value = getattr(self, key)
            if not low <= value <= high:
                raise ConfigurationError(f"{key}: {value:g} {unit} is outside {low:g} to {high:g} {unit}")
        step_count(self.horizon, self.step)

    @property
    def steps(self) -> int:
        return step_count(self.horizon, self.step)


def configuration_hash(vehicle: VehicleParameters, settings: PredictionSettings, model_hash: str = "") -> str:
    """sha256 (hex) of what a prediction depends on in addition to its start and inputs: vehicle, settings and, for a
    model from a file, `model_hash` of that file."""
    values = {key: float(value).hex() for key, value in asdict(settings).items()}
    return hash_content([vehicle.hash, values, *([model_hash] if model_hash else [])])


def predict(model: str | Model, vehicle: VehicleParameters, state: VehicleState, inputs: ControlInput | InputSequence,
            horizon: float = 5.0, step: float = 0.05, substeps: int = 1) -> Trajectory:
    """Trajectory of one model from one state, by RK4 with a fixed step; the first of its steps + 1 states is the start.

    inputs: constant over the horizon (ControlInput), or on the half-step grid (InputSequence of 2 * steps + 1 values).
    horizon, step [s]. substeps: number >= 1 of integration steps per step, with inputs interpolated linearly; see
    `integrate.required_substeps`. NaN in the state or an input makes dependent states NaN. Raises StCoreError for
    inputs of the wrong length, a missing signal, an unknown model, substeps below 1, and a horizon that is not a whole
    number of steps.

    Integration steps above the default step are checked for stability at the initial speed (StepTooLongWarning, once);
    for the limit see `integrate.lowest_stable_speed`.
    """
    if substeps < 1:
        raise ConfigurationError(f"substeps: {substeps} is below 1")
    model = get_model(model)
    if step > PredictionSettings.step * substeps and math.isfinite(state.velocity_x):
        warn_if_step_too_long(model, vehicle, [abs(state.velocity_x)], step / substeps)
    p, steps = model.parameters(vehicle), step_count(horizon, step)
    signals = {} if isinstance(inputs, ControlInput) else inputs.signals
    if missing := [name for name in model.signals if name not in signals]:
        raise StCoreError(f"model {model.name} needs the signal {missing[0]}, which the inputs do not have")
    if isinstance(inputs, ControlInput):
        w = model.inputs(float(inputs.road_wheel_angle), float(inputs.velocity_x_dot), p)
        grid = [w] * (2 * steps * substeps + 1)
    else:
        by_name = {"road_wheel_angle": inputs.road_wheel_angle, "velocity_x_dot": inputs.velocity_x_dot,
                   **{name: signals[name] for name in model.signals}}
        columns = [np.asarray(a, float) for a in by_name.values()]
        for name, values in zip(by_name, columns, strict=True):
            if values.shape != (2 * steps + 1,):
                raise StCoreError(f"{name}: shape {values.shape}, not ({2 * steps + 1},) for the half-step grid")
        if substeps > 1:
            fine_grid = np.arange(2 * steps * substeps + 1) / substeps
            columns = [np.interp(fine_grid, np.arange(2 * steps + 1), values) for values in columns]
        angle, acceleration, *extra = columns
        with np.errstate(all="ignore"):
            fields = [np.broadcast_to(w, angle.shape).tolist() for w in model.inputs(angle, acceleration, p, *extra)]
        grid = list(zip(*fields, strict=True))
    start = model.start_state(state.as_tuple(), grid[0], p)
    states = rk4(model.rhs, start, grid, p, step / substeps)[::substeps]
    # Extra states are internal to the model and not part of the trajectory.
    return Trajectory(step, np.ascontiguousarray(np.array(states)[:, :len(STATE_NAMES)]))


@dataclass(frozen=True, slots=True)
class Start:
    """Start of a prediction: the instant of the measurements [ns], with the state at the CG and the inputs."""

    time_ns: int
    state: VehicleState
    inputs: ControlInput


@dataclass(frozen=True, slots=True)
class Skip:
    """Reason for making no prediction."""

    kind: Literal["stale", "slow"]  # stale: a measurement is missing, old, in the future, in a gap or before a jump
    reason: str


Runner = Callable[[VehicleState, ControlInput | InputSequence], Trajectory]  # for one model, car and horizon


class Predictor:
    """Stores the newest measurements and predicts trajectories from them.

    models: names, or models from model files. runners: compiled replacements of `predict`, by name of the model
    (`compile_model`). history: shared with an `Evaluator` with these settings, so that measurements are stored once;
    None: a new one. Raises ConfigurationError for no model, an unknown model, and one with signals not measured live.
    """

    SPAN = 2.0  # s, minimum length of the history, for late samples and the settling of the filter

    def __init__(self, vehicle: VehicleParameters, models: Sequence[str | Model],
                 settings: PredictionSettings | None = None, runners: Mapping[str, Runner] | None = None,
                 history: MeasurementHistory | None = None):
        self.vehicle = vehicle
        self.settings = settings or PredictionSettings()
        self._runners = dict(runners or {})
        if not models:
            raise ConfigurationError("models: empty; name at least one model")
        resolved = [get_model(model) for model in models]
        for model in resolved:
            if model.signals:
                raise ConfigurationError(f"model {model.name}: needs {model.signals[0]}, which is not measured live")
            warn_if_step_too_long(model, vehicle, [self.settings.minimum_speed], self.settings.step)
        span = max(self.SPAN, 2.0 * self.settings.stale_after + 2.0 * self.settings.maximum_gap)
        span = ModelView.extend_span(resolved, span)
        self.history = history or MeasurementHistory(span, self.settings.maximum_gap, self.settings.filter_cutoff)
        self._views = {model.name: ModelView(model, vehicle, self.history) for model in resolved}
        self.frozen_steering = FrozenSteeringDetector(vehicle)

    @property
    def models(self) -> tuple[str, ...]:
        return tuple(self._views)

    def car(self, model: str) -> VehicleParameters:
        """The vehicle parameters that a model uses, with the effects of the model applied."""
        return self._views[model].car

    def select_inputs(self, model: str, planned: InputSequence) -> InputSequence:
        """Planned inputs for a model (`planned_inputs.select_inputs`)."""
        return select_inputs(self._views[model].model, planned)

    def add_ins(self, sample: InsSample) -> bool:
        """Add an INS sample; False if it was rejected (see MeasurementHistory)."""
        self.frozen_steering.add_ins(sample)
        return self.history.add_ins(sample)

    def add_steering(self, time_ns: int, road_wheel_angle: float) -> bool:
        """Add a road wheel angle [rad], positive to the left; False if it was rejected."""
        self.frozen_steering.add_steering(time_ns, road_wheel_angle)
        return self.history.add_steering(time_ns, road_wheel_angle)

    @property
    def _series(self) -> dict[str, TimeSeries]:
        return {"INS": self.history.ins, "steering": self.history.steering}

    def ages(self, now_ns: int) -> dict[str, float]:
        """Age [s] of the newest sample of each signal; infinite if there is none."""
        return {name: math.inf if series.newest is None else (now_ns - series.newest) * NANOSECOND
                for name, series in self._series.items()}

    def find_start(self, now_ns: int) -> Start | Skip:
        """The newest instant at which both INS and steering are known, or the reason for making no prediction.

        now_ns: current time on the clock of the samples. A sample more than stale_after in the future counts as stale.
        """
        limit = self.settings.stale_after
        for name, age in self.ages(now_ns).items():
            if age == math.inf:
                return Skip("stale", f"{name}: nothing received yet")
            if age > limit:
                return Skip("stale", f"{name}: newest sample is {age:.2f} s old (limit {limit:g} s)")
            if age < -limit:
                return Skip("stale", f"{name}: newest sample is {-age:.2f} s in the future; the clocks disagree")
        newest = min(int(series.times[-1]) for series in self._series.values())
        time_ns: int | None = newest
        previous_ns: int | None = None
        while time_ns is not None and time_ns != previous_ns:  # until both signals are known at this instant
            previous_ns, time_ns = time_ns, self.history.ins.newest_known_time(time_ns)
            time_ns = None if time_ns is None else self.history.steering.newest_known_time(time_ns)
        if time_ns is None or (now_ns - time_ns) * NANOSECOND > limit:
            age_text = "" if time_ns is None else f", last known {(now_ns - time_ns) * NANOSECOND:.2f} s ago"
            reasons = [f"{name}: {reason} at the newest common instant{age_text}"
                       for name, series in self._series.items() if (reason := series.describe_unknown(newest))]
            return Skip("stale", reasons[0] if reasons else "INS and steering: no common instant")
        jump = self.history.last_jump
        if jump and time_ns < jump.time_ns:
            return Skip("stale", f"INS: position jumps by {jump.size:.2f} m after the newest common instant")
        inputs = self.history.inputs_at(time_ns)
        if inputs is None:
            return Skip("stale", "INS: forward acceleration unknown at the first sample or after a gap")
        sample = self.history.ins_at(time_ns)
        assert sample is not None  # known where the inputs are
        state = ins_to_cg(sample, self.vehicle.cg_to_ins_x, self.vehicle.cg_to_ins_y)
        speed = abs(state.velocity_x)
        if speed < self.settings.minimum_speed:
            return Skip("slow", f"speed {speed:.2f} m/s is below {self.settings.minimum_speed:g} m/s")
        return Start(time_ns, state, inputs)

    def plan_inputs(self, plan: PlannedInputs, start: Start) -> InputSequence | str:
        """The inputs of a plan over the horizon, for `run`; or the reason, in one line, why it cannot be used."""
        settings = self.settings
        problem = find_plan_problem(plan, start.time_ns, start.state, start.inputs, settings.horizon, self.vehicle)
        return problem or plan.sequence(start.time_ns, settings.steps, settings.step)

    def run(self, start: Start, model: str, future_inputs: InputSequence | None = None) -> Trajectory:
        """The trajectory of a model from a start, at the CG of the model (`car`).

        future_inputs: on the half-step grid of the horizon, from a plan (`plan_inputs`) or a course; None: constant.
        Raises ConfigurationError if the model is not configured.
        """
        if model not in self._views:
            raise ConfigurationError(f"model {model!r} is not configured; the models are {', '.join(self._views)}")
        view, settings = self._views[model], self.settings
        state, inputs = (view.read_start(start.time_ns, settings.steps, settings.step) if view.is_augmented
                         else (start.state, start.inputs))
        if future_inputs is not None:
            steering = self.history.steering
            inputs = apply_steering_dynamics(view.model, future_inputs, start.time_ns, settings.step, steering.times,
                                             steering.rows[:, 0], settings.maximum_gap)
        if model in self._runners:
            return self._runners[model](state, inputs)
        return predict(view.model, self.vehicle, state, inputs, settings.horizon, settings.step)


TOLERANCE = 1.0e-9  # largest difference from the interpreted model, relative to max(1, |value|)
# States and inputs of the comparison with the interpreted model, (v_x [m/s], v_y [m/s], yaw rate [rad/s],
# road wheel angle [rad], acceleration [m/s^2]): walking pace to motorway speed, left and right, drive and brake.
_SAMPLES = ((1.0, 0.0, 0.05, 0.1, 0.3), (8.0, 0.1, -0.25, -0.08, 0.0), (15.0, -0.2, 0.2, 0.04, -1.0),
            (30.0, 0.0, -0.02, -0.005, 0.5))


def compile_model(model: Model, vehicle: VehicleParameters, settings: PredictionSettings) -> Runner:
    """A compiled replacement of `predict` for one model, car and horizon; six times faster. Its results are compared
    with those of `predict` before it is returned.

    Three models over 5 s take 0.2 ms instead of 1.3 ms; with an additional model of three effects 0.6 ms instead of
    4.1 ms. Inputs are constant, or 2 * steps + 1 values on the half-step grid without further signals; NaN inputs give
    NaN states. Raises ConfigurationError if numba is not installed or cannot compile the model, or if the results
    differ; errors of numba are passed on. Checked by: test_compiled.py.
    """
    if not has_numba():
        raise ConfigurationError("numba is not installed")
    backend, p, points = get_backend("lanes"), model.parameters(vehicle), np.arange(settings.steps + 1)
    constant_rows, sequence_rows = np.zeros(2 * settings.steps + 1, np.int64), np.arange(2 * settings.steps + 1)
    w = model.inputs(0.0, 0.0, p)
    if not backend.can_compile(model, p, len(w), len(model.start_state((0.0,) * len(STATE_NAMES), w, p))):
        raise ConfigurationError("numba cannot compile the model")

    def run(state: VehicleState, inputs: ControlInput | InputSequence) -> Trajectory:
        # The compiled code advances several predictions (lanes) in parallel; only the first is used here.
        angle, acceleration = inputs.road_wheel_angle, inputs.velocity_x_dot
        if isinstance(inputs, ControlInput):
            first = model.inputs(float(angle), float(acceleration), p)
            table, offsets = np.repeat(np.array(first, float)[:, None], backend.LANES, axis=1), constant_rows
        else:
            angle, acceleration = np.asarray(angle, float), np.asarray(acceleration, float)
            with np.errstate(all="ignore"):
                fields = [np.broadcast_to(f, angle.shape) for f in model.inputs(angle, acceleration, p)]
            table, offsets = np.pad(np.array(fields), ((0, 0), (0, backend.LANES - 1)), mode="edge"), sequence_rows
            first = tuple(table[:, 0].tolist())
        start = np.array(model.start_state(state.as_tuple(), first, p), float)
        columns = np.repeat(start[:, None], backend.LANES, axis=1)
        states = backend.advance(model, p, columns, table, offsets, settings.step, points)
        return Trajectory(settings.step, np.ascontiguousarray(states[:, :, 0]))

    ramp = np.linspace(1.0, 0.5, 2 * settings.steps + 1)
    for v_x, v_y, yaw_rate, angle, acceleration in _SAMPLES:
        state = VehicleState(3.0, -2.0, v_x, v_y, 0.7, yaw_rate)
        for inputs in (ControlInput(angle, acceleration), InputSequence(angle * ramp, acceleration * ramp)):
            expected = predict(model, vehicle, state, inputs, settings.horizon, settings.step).states
            compiled, finite = run(state, inputs).states, np.isfinite(expected)
            with np.errstate(all="ignore"):
                difference = np.abs(compiled - expected) / np.maximum(1.0, np.abs(expected))
            # The states may diverge in a spin with a long step: both must then be finite at the same points.
            if not np.array_equal(finite, np.isfinite(compiled)) or (difference[finite] > TOLERANCE).any():
                worst = float(difference[finite & np.isfinite(compiled)].max(initial=0.0))
                raise ConfigurationError(f"the compiled {model.name} model differs from the interpreted one, by "
                                         f"{worst:.1e} where both are finite")
    return run


def compile_models(models: Sequence[Model], vehicle: VehicleParameters,
                   settings: PredictionSettings) -> tuple[dict[str, Runner], str]:
    """(compiled models by name; one line for the log, with their names and the reasons why others are not compiled)."""
    compiled: dict[str, Runner] = {}
    reasons: dict[str, str] = {}
    for model in models:
        try:
            compiled[model.name] = compile_model(model, vehicle, settings)
        except Exception as error:  # numba raises many types of errors; the interpreted model is the fallback
            prefix = "" if isinstance(error, ConfigurationError) else f"{type(error).__name__}: "
            reasons[model.name] = " ".join(f"{prefix}{error}".split())
    parts = [f"compiled and checked: {', '.join(compiled)}"] if compiled else []
    if reasons:
        parts.append(f"not compiled: {', '.join(reasons)} ({'; '.join(dict.fromkeys(reasons.values())):.200})")
    return compiled, "; ".join(parts)
