"""Comparison of predictions with later measurements: longitudinal, lateral and yaw errors, and their statistics."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from .measurement_history import DERIVATIVE, YAW, MeasurementHistory
from .models import MODELS, Model, get_model
from .prediction import PredictionSettings, Runner, predict
from .readings import ModelView, predict_readings
from .timeseries import NANOSECOND, TimeSeries, half_step_grid
from .types import InputSequence, InsSample, Trajectory, VehicleState, pose_errors
from .vehicle import VehicleParameters

EARLIEST = -(2**62)  # ns, before any measurement
Mode = Literal["forecast", "hindsight", "plan", "course"]
"""Inputs over the horizon: forecast = held at their values at the start; hindsight = measured over the horizon; plan =
from a motion planner; course = from earlier drives at the same place."""


@dataclass(frozen=True)
class Score:
    """Error of one prediction, predicted minus measured, at the INS point, along and across the measured heading.

    NaN where no position was measured, after a position jump, and, in hindsight, after an unknown input.
    *_mean: mean over all points of the horizon, including the start; NaN unless complete.
    """

    model: str
    mode: Mode
    start_ns: int
    complete: bool
    incomplete_reason: str
    horizon: np.ndarray  # time after the start, 0 first [s]
    longitudinal: np.ndarray  # m, positive if predicted ahead
    lateral: np.ndarray  # m, positive if predicted to the left
    yaw: np.ndarray  # rad in [-pi, pi), positive if predicted further to the left
    longitudinal_mean: float
    lateral_mean: float
    yaw_mean: float


def make_score(model: str, mode: Mode, start_ns: int, step: float, errors: Sequence[np.ndarray],
               reason: str = "") -> Score:
    """The score of a prediction. errors: (longitudinal, lateral, yaw), (points,) each; complete if all are finite."""
    longitudinal, lateral, yaw = errors
    finite = all(bool(np.isfinite(e).all()) for e in errors)
    means = [float(np.mean(e)) if finite else math.nan for e in errors]
    return Score(model, mode, start_ns, finite, "" if finite else reason or "the prediction is not finite",
                 step * np.arange(len(longitudinal)), longitudinal, lateral, yaw, *means)


_PendingPrediction = tuple[str, Mode, Trajectory]  # (model, mode, trajectory)


class Evaluator:
    """Scores each prediction as soon as the measurements cover its horizon.

    span [s]: minimum duration of the stored measurements. models: models from files, in addition to MODELS. runners:
    compiled replacements of `predict` with these settings (`prediction.compile_model`), by name of the model.
    """

    SIGNAL_TIMEOUT = 1.0  # s after the end of a horizon, within which the signals must arrive
    MAXIMUM_PENDING = 3000  # predictions that are not scored yet; if there are more, the oldest become incomplete

    def __init__(self, vehicle: VehicleParameters, settings: PredictionSettings | None = None, span: float = 30.0,
                 models: Sequence[Model] = (), runners: Mapping[str, Runner] | None = None):
        self.vehicle, self._runners = vehicle, runners or {}
        self.settings = settings or PredictionSettings()
        span = ModelView.extend_span(models, max(span, 2.0 * self.settings.horizon + self.SIGNAL_TIMEOUT))
        self.history = MeasurementHistory(span, self.settings.maximum_gap, self.settings.filter_cutoff)
        self._views = {m.name: ModelView(m, vehicle, self.history) for m in (*MODELS.values(), *models)}
        self._lookahead_ns = max(view.lookahead_ns for view in self._views.values())
        self._pending: dict[tuple[int, int, float], list[_PendingPrediction]] = {}
        self._incomplete_scores: list[Score] = []
        self._generation = self.history.generation

    @property
    def pending_count(self) -> int:
        """Number of predictions that are not scored yet."""
        return sum(len(group) for group in self._pending.values())

    def add_ins(self, sample: InsSample) -> bool:
        """Add an INS sample; False if it was rejected. If time jumps back, pending predictions become incomplete."""
        return self.history.add_ins(sample)

    def add_steering(self, time_ns: int, road_wheel_angle: float) -> bool:
        """Add a road wheel angle [rad], positive to the left; False if it was rejected."""
        return self.history.add_steering(time_ns, road_wheel_angle)

    def view(self, model: str) -> ModelView:
        """The measurements as corrected by a model. Raises ConfigurationError for an unknown model."""
        if model not in self._views:
            get_model(model)  # raises with the list of known models
        return self._views[model]

    def add_prediction(self, model: str, start_ns: int, trajectory: Trajectory, mode: Mode = "forecast") -> None:
        """Add a prediction (at the CG) to be scored. A forecast is also scored in hindsight."""
        self._abandon_after_restart()
        key = (start_ns, len(trajectory.states) - 1, trajectory.step)
        self._pending.setdefault(key, []).append((model, mode, trajectory))
        if self.pending_count > self.MAXIMUM_PENDING:
            self._abandon([min(self._pending)], f"more than {self.MAXIMUM_PENDING} predictions were waiting")

    def poll(self, newest_ns: int | None = None) -> list[Score]:
        """Scores of the predictions whose horizon both signals cover, or which ended SIGNAL_TIMEOUT before newest_ns,
        and of those that became incomplete.

        newest_ns: current time on the clock of the samples; None: time of the newest INS sample.
        """
        self._abandon_after_restart()
        scores, self._incomplete_scores = self._incomplete_scores, []
        ins, steering = (EARLIEST if s.newest is None else s.newest for s in (self.history.ins, self.history.steering))
        timeout_ns = (ins if newest_ns is None else newest_ns) - round(self.SIGNAL_TIMEOUT / NANOSECOND)
        for key in sorted(self._pending):
            start_ns, steps, step = key
            end_ns = start_ns + round(steps * step / NANOSECOND)
            if end_ns <= min(ins, steering - self._lookahead_ns) or end_ns <= timeout_ns:
                scores += self._score(key, self._pending.pop(key))
        return scores

    def flush(self) -> list[Score]:
        """Scores of all pending predictions, at the end of the data; incomplete if their horizon ends later."""
        return self.poll(-EARLIEST)

    def _abandon_after_restart(self) -> None:
        if self.history.generation != self._generation:
            self._generation = self.history.generation
            self._abandon(list(self._pending), "the time of the measurements jumped back")

    def _abandon(self, keys: Sequence[tuple[int, int, float]], reason: str) -> None:
        for key in keys:
            start_ns, steps, step = key
            errors = [np.full(steps + 1, math.nan)] * 3
            for model, given_mode, _ in self._pending.pop(key):
                modes: tuple[Mode, ...] = (given_mode, "hindsight") if given_mode == "forecast" else (given_mode,)
                self._incomplete_scores += [make_score(model, mode, start_ns, step, errors, reason) for mode in modes]
        # Limited like the pending predictions, because `poll` may never be called.
        del self._incomplete_scores[:-2 * self.MAXIMUM_PENDING]

    def _score(self, key: tuple[int, int, float], group: Sequence[_PendingPrediction]) -> list[Score]:
        start_ns, steps, step = key
        times = half_step_grid(start_ns, steps, step)
        ins = self.history.ins.sample(times)
        angle = self.history.steering.sample(times)[:, 0]
        measured = ins[::2, 0], ins[::2, 1], ins[::2, YAW]
        inputs = InputSequence(angle, ins[:, DERIVATIVE])
        no_position = self._describe_unknown("INS", self.history.ins, times[::2], measured[0], start_ns)
        no_inputs = (self._describe_unknown("INS", self.history.ins, times, ins[:, DERIVATIVE], start_ns)
                     or self._describe_unknown("steering", self.history.steering, times, angle, start_ns))
        # All models are scored at the same points, although some do not use the input at the last one.
        is_scorable = inputs.is_known_so_far[::2]
        breaks = self.history.ins.breaks
        jump_ns = min((time_ns for time_ns in breaks if start_ns < time_ns <= times[-1]), default=int(times[-1]) + 1)
        jump = (f"INS: {breaks[jump_ns]} at {(jump_ns - start_ns) * NANOSECOND:.3f} s of the horizon"
                if jump_ns <= times[-1] else "")
        before_jump = times[::2] < jump_ns
        scores = []
        for model, given_mode, original in group:
            view = self.view(model)
            variants: list[tuple[Mode, Trajectory, np.ndarray, str]] = [
                (given_mode, original, before_jump, jump or no_position)]
            if given_mode == "forecast":
                start = VehicleState(*original.states[0].tolist())
                model_inputs = view.read_inputs(times) if view.is_augmented else inputs
                has_runner_settings = (steps, step) == (self.settings.steps, self.settings.step)
                runner = self._runners.get(model) if has_runner_settings else None
                hindsight_trajectory = (runner(start, model_inputs) if runner
                                        else predict(view.model, self.vehicle, start, model_inputs, steps * step, step))
                variants.append(("hindsight", hindsight_trajectory, before_jump & is_scorable, jump or no_inputs))
            for mode, trajectory, is_scored, reason in variants:
                r = predict_readings(view.model, self.vehicle, tuple(trajectory.states.T))
                errors = [np.where(is_scored, e, math.nan) for e in pose_errors(r.x, r.y, r.yaw, *measured)]
                scores.append(make_score(model, mode, start_ns, step, errors, reason))
        return scores

    @staticmethod
    def _describe_unknown(name: str, series: TimeSeries, times: np.ndarray, values: np.ndarray, start_ns: int) -> str:
        unknown_indices = np.flatnonzero(~np.isfinite(values))
        if not len(unknown_indices):
            return ""
        time_ns = int(times[unknown_indices[0]])
        reason = series.describe_unknown(time_ns) or "acceleration unknown at the first sample or after a gap"
        return f"{name}: {reason} at {(time_ns - start_ns) * NANOSECOND:.3f} s of the horizon"


@dataclass
class Statistic:
    """Running mean, largest magnitude and root mean square of added values; NaN before the first value."""

    count: int = 0
    max: float = math.nan  # largest magnitude
    _sum: float = 0.0
    _squares: float = 0.0

    def add(self, values: float | np.ndarray) -> None:
        values = np.atleast_1d(values)
        self.count += values.size
        self._sum += float(values.sum())
        self._squares += float(np.square(values).sum())
        self.max = float(np.fmax.reduce(np.abs(values), initial=self.max))

    @property
    def mean(self) -> float:
        return self._sum / self.count if self.count else math.nan

    @property
    def rmse(self) -> float:
        return math.sqrt(self._squares / self.count) if self.count else math.nan


@dataclass
class ErrorStatistics:
    """Statistics of the mean errors over each horizon, for one model and mode; incomplete scores are only counted."""

    n_starts: int = 0
    n_incomplete: int = 0
    longitudinal: Statistic = field(default_factory=Statistic)  # m
    lateral: Statistic = field(default_factory=Statistic)  # m
    yaw: Statistic = field(default_factory=Statistic)  # rad

    def add(self, score: Score) -> None:
        if not score.complete:
            self.n_incomplete += 1
            return
        self.n_starts += 1
        for name in ("longitudinal", "lateral", "yaw"):
            getattr(self, name).add(getattr(score, f"{name}_mean"))
