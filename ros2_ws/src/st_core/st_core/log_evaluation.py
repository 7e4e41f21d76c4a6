"""Evaluates models on a recorded drive: predictions from many starts are compared with the measured motion.

This is the offline counterpart of Predictor and Evaluator. Trajectories and errors from the same start are equal, which
`st verify` checks; position jumps are detected only live. Only a few blocks of starts are in memory at a time. For each
start, only the mean, the mean square, the largest error and the errors at whole seconds are stored.
"""

import math
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from typing import Literal

import numpy as np

from . import integrate
from .batch import Inputs, LogBatch
from .errors import ConfigurationError
from .evaluation import Mode
from .log import DriveLog, FilterMode, LogSignals
from .models import Model, get_model
from .prediction import PredictionSettings
from .readings import correct_log, reading_errors
from .timeseries import NANOSECOND, half_step_grid
from .types import STATE_NAMES, InputSequence
from .vehicle import VehicleParameters

MODES: tuple[Mode, ...] = ("hindsight", "forecast")  # in every evaluation
PLANNED_MODES: tuple[Mode, ...] = ("plan", "course")  # only in evaluations with planned inputs
AXES = ("longitudinal", "lateral", "yaw")
BLOCK_SIZE = 1024  # starts predicted together; each model and mode then takes 7 MB
PREFETCHED_BLOCKS = 2  # blocks computed in advance, each in a thread
CONDITIONS = ("speed", "lateral_acceleration", "velocity_x_dot", "steering_rate", "heading_change")
# Lower edges of the bins, chosen around the scenarios of the paper: 4 and 16 m/s; 1.5, 4 and 6 m/s^2.
SPEED_EDGES = (0.0, 3.0, 6.0, 9.0, 12.0, 15.0, 20.0, 25.0)  # m/s
LATERAL_ACCELERATION_EDGES = (0.0, 0.5, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0)  # m/s^2, magnitude
STEERING_RATE_EDGES = (0.0, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2)  # rad/s at the road wheel, root mean square
MAX_STRAIGHT_TURN = math.radians(5.0)  # largest change of heading within the horizon that counts as straight
ALL_ROWS = slice(None)
Progress = Callable[[int, int], None]  # (starts evaluated, all starts)
BlockCallback = Callable[[np.ndarray, "Block"], None]
FutureInputs = Callable[[np.ndarray], tuple[np.ndarray, ...]]
"""Function of all starts of an evaluation (n,) [ns], increasing, called once. It returns road wheel angle [rad],
velocity_x_dot [m/s^2] and, if a path was planned, `SLIP_FREE_ANGLE` [rad] over the horizon, each (n, 2 * steps + 1) on
the half-step grid; NaN where unknown."""


@dataclass(frozen=True)
class EvaluationSettings:
    """Settings of an evaluation. Raises ConfigurationError naming the key and the limit.

    inputs: interpolate = an integration step uses the inputs measured at its start, middle and end; hold = only those
    at its start. The paper does not specify which.
    """

    prediction: PredictionSettings = field(default_factory=PredictionSettings)  # stale_after is not used
    interval: float = 0.1  # time between starts [s]
    acceleration: FilterMode = "causal"  # filter of the forward speed before its derivative
    inputs: Literal["interpolate", "hold"] = "interpolate"

    def __post_init__(self) -> None:
        if not 0.001 <= self.interval <= 3600.0:
            raise ConfigurationError(f"interval: {self.interval:g} s is outside 0.001 to 3600 s")
        for key, choices in (("acceleration", ("causal", "zero_phase")), ("inputs", ("interpolate", "hold"))):
            if getattr(self, key) not in choices:
                raise ConfigurationError(f"{key}: {getattr(self, key)!r} is neither {' nor '.join(choices)}")

    def signals(self, log: DriveLog) -> LogSignals:
        """The signals of a drive, with the maximum gap and the filter of these settings."""
        return LogSignals(log, self.prediction.maximum_gap, self.prediction.filter_cutoff, self.acceleration)

    def as_dict(self) -> dict[str, float | str]:
        """All settings by name, for reports."""
        return {**asdict(self.prediction), "interval": self.interval, "acceleration": self.acceleration,
                "inputs": self.inputs}


@dataclass(frozen=True, eq=False)
class ModelErrors:
    """Errors of one model and mode, predicted minus measured; last axis: AXES [m, m, rad]; NaN if incomplete."""

    complete: np.ndarray  # (n,), whether the whole horizon was scored
    mean: np.ndarray  # (n, 3), over all points of the horizon, the start included
    mean_square: np.ndarray  # (n, 3)
    largest: np.ndarray  # (n, 3), magnitude
    at_seconds: np.ndarray  # (n, s, 3), error at 1, 2, ... s
    profile_squares: np.ndarray  # (points, 3), sum of the squares over the complete starts

    @classmethod
    def empty(cls, count: int, horizon: np.ndarray) -> "ModelErrors":
        """Errors of `count` starts, all incomplete until `add` is called. horizon: (points,) time after a start [s]."""
        mean, square, largest = (np.full((count, 3), np.nan) for _ in range(3))
        at_seconds = np.full((count, int(horizon[-1] + 1e-9), 3), np.nan)
        return cls(np.zeros(count, bool), mean, square, largest, at_seconds, np.zeros((len(horizon), 3)))

    def add(self, rows: slice, errors: np.ndarray, horizon: np.ndarray) -> None:
        """Add the errors (n, points, 3) of the starts `rows`; incomplete starts are ignored."""
        complete = np.isfinite(errors).all(axis=(1, 2))
        scored = np.arange(rows.start, rows.stop)[complete]
        if not len(scored):
            return
        if not complete.all():
            errors = errors[complete]
        self.complete[scored] = True
        square = np.square(errors)
        self.mean[scored], self.mean_square[scored] = errors.mean(axis=1), square.mean(axis=1)
        # The grid points nearest to whole seconds, because one second may not be a multiple of the step.
        points = [int(np.abs(horizon - second).argmin()) for second in range(1, self.at_seconds.shape[1] + 1)]
        self.largest[scored], self.at_seconds[scored] = np.abs(errors).max(axis=1), errors[:, points]
        self.profile_squares[:] += square.sum(axis=0)

    @property
    def profile_rmse(self) -> np.ndarray:
        """Root mean square over the complete starts, (points, 3)."""
        with np.errstate(invalid="ignore"):
            return np.sqrt(self.profile_squares / self.complete.sum())

    @property
    def n_starts(self) -> int:
        """Number of starts with a completely scored horizon."""
        return int(self.complete.sum())

    def statistics(self, axis: str, over: Literal["means", "samples"] = "means") -> tuple[float, float, float]:
        """(mean, largest magnitude, root mean square) of one axis; see `statistics_by_axis`."""
        return self.statistics_by_axis(over)[axis]

    def statistics_by_axis(self, over: Literal["means", "samples"] = "means",
                           select: np.ndarray | slice = ALL_ROWS) -> dict[str, tuple[float, float, float]]:
        """{axis: (mean, largest magnitude, root mean square)} of the selected complete starts [m or rad].

        over: means = statistics of the mean error of each horizon, as in the paper's table; samples = statistics of the
        errors at all points. select: rows of starts. NaN if no selected start is complete.
        """
        complete = self.complete[select]
        if not complete.any():
            return dict.fromkeys(AXES, (np.nan, np.nan, np.nan))
        mean = self.mean[select][complete]
        largest, square = ((np.abs(mean), np.square(mean)) if over == "means" else
                           (self.largest[select][complete], self.mean_square[select][complete]))
        columns = mean.mean(axis=0), largest.max(axis=0), np.sqrt(square.mean(axis=0))
        return dict(zip(AXES, zip(*(c.tolist() for c in columns), strict=True), strict=True))


@dataclass(frozen=True, eq=False)
class LogEvaluation:
    """Evaluation of all models on one drive.

    conditions: (n,) each, measured over the horizon; NaN if a measurement is missing: mean speed [m/s], mean
    lateral_acceleration v_x r [m/s^2], mean velocity_x_dot [m/s^2], RMS steering_rate of the road wheels [rad/s],
    heading_change [rad]; positive to the left.
    """

    name: str
    settings: EvaluationSettings
    log_start_ns: int  # first INS sample of the drive
    starts_ns: np.ndarray  # (n,) starts of the predictions
    skipped: dict[str, int]  # number of starts without a prediction, by reason
    incomplete: dict[str, int]  # number of starts not scored over the whole horizon in the mode hindsight, by reason
    conditions: dict[str, np.ndarray]
    errors: dict[tuple[str, Mode], ModelErrors]  # by (model, mode)
    horizon: np.ndarray  # (points,) [s]

    @property
    def models(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(model for model, _ in self.errors))

    @property
    def modes(self) -> tuple[Mode, ...]:
        return tuple(dict.fromkeys(mode for _, mode in self.errors))

    @property
    def time(self) -> np.ndarray:
        """Start times since the beginning of the drive [s]."""
        return (self.starts_ns - self.log_start_ns) * NANOSECOND


def evaluate_log(models: str | Model | Sequence[str | Model], vehicle: VehicleParameters, log: DriveLog | LogSignals,
                 settings: EvaluationSettings | None = None, starts_ns: np.ndarray | None = None,
                 progress: Progress | None = None, on_block: BlockCallback | None = None,
                 future_inputs: Mapping[Mode, FutureInputs] | None = None) -> LogEvaluation:
    """Predict with every model from every start, and score the predictions.

    log: a drive, or its precomputed signals. starts_ns: increasing; default: `regular_starts`. Starts without a usable
    state or inputs are skipped and counted. progress(done, total): called after each block of starts.
    on_block(starts_ns, block): called with each block. future_inputs: inputs of the modes plan and course; where they
    are unknown, the inputs are held. Source: paper, comparison. Checked by: test_log_evaluation.py.
    """
    settings = settings or EvaluationSettings()
    model_list = [get_model(model) for model in ([models] if isinstance(models, str | Model) else models)]
    signals = log if isinstance(log, LogSignals) else settings.signals(log)
    log = signals.log
    origin = int(log.ins_time_ns[0]) if len(log.ins_time_ns) else 0
    requested = regular_starts(log, settings.interval) if starts_ns is None else np.asarray(starts_ns, np.int64)
    starts, skipped = usable_starts(signals, vehicle, requested, settings.prediction.minimum_speed)
    horizon = settings.prediction.step * np.arange(settings.prediction.steps + 1)
    modes = (*MODES, *(future_inputs or {}))
    results = {(model.name, mode): ModelErrors.empty(len(starts), horizon) for model in model_list for mode in modes}
    conditions = {name: np.full(len(starts), np.nan) for name in CONDITIONS}
    reasons: Counter[str] = Counter()
    for rows, block in evaluate_blocks(model_list, vehicle, signals, starts, settings, future_inputs):
        for name, values in block.conditions.items():
            conditions[name][rows] = values
        for key, errors in block.errors.items():
            results[key].add(rows, errors, horizon)
        reasons.update(block.incomplete)
        if on_block:
            on_block(starts[rows], block)
        if progress:
            progress(rows.stop, len(starts))
    return LogEvaluation(log.name, settings, origin, starts, skipped, dict(reasons), conditions, results, horizon)


def regular_starts(log: DriveLog, interval: float) -> np.ndarray:
    """Instants [ns] every `interval` [s] from the first INS sample on at which both INS and steering are recorded."""
    if not log.overlap:
        return np.empty(0, np.int64)
    first = int(log.ins_time_ns[0])
    begin, end = log.common_span_ns
    step = round(interval / NANOSECOND)
    return first + step * np.arange(-((first - begin) // step), (end - first) // step + 1, dtype=np.int64)


def usable_starts(signals: LogSignals, vehicle: VehicleParameters, requested: np.ndarray,
                  minimum_speed: float) -> tuple[np.ndarray, dict[str, int]]:
    """(starts [ns] with known inputs and |v_x| >= minimum_speed [m/s] at the CG, count of others by reason)."""
    speed, yaw_rate, acceleration = signals.ins_at(requested, "velocity_x", "yaw_rate", "velocity_x_dot")
    no_ins, no_steering = np.isnan(speed) | np.isnan(acceleration), np.isnan(signals.road_wheel_angle_at(requested))
    slow = np.abs(speed + yaw_rate * vehicle.cg_to_ins_y) < minimum_speed
    unusable = {"INS data missing": no_ins, "steering angle missing": no_steering & ~no_ins,
                f"slower than {minimum_speed:g} m/s": slow & ~no_ins & ~no_steering}
    return requested[~(no_ins | no_steering | slow)], _count_reasons(unusable)


def _count_reasons(masks: Mapping[str, np.ndarray]) -> dict[str, int]:
    return {reason: int(mask.sum()) for reason, mask in masks.items() if mask.any()}


@dataclass(frozen=True, eq=False)
class Block:
    """Evaluation of at most BLOCK_SIZE starts."""

    errors: dict[tuple[str, Mode], np.ndarray]  # (n, points, 3), NaN where not scored, axes as AXES
    trajectories: dict[tuple[str, Mode], np.ndarray]  # states (n, points, 6)
    conditions: dict[str, np.ndarray]  # as in LogEvaluation
    incomplete: dict[str, int]  # as in LogEvaluation


def evaluate_blocks(models: Sequence[Model], vehicle: VehicleParameters, signals: LogSignals, starts_ns: np.ndarray,
                    settings: EvaluationSettings,
                    future_inputs: Mapping[Mode, FutureInputs] | None = None) -> Iterator[tuple[slice, Block]]:
    """Yields (rows of `starts_ns`, block) for BLOCK_SIZE starts at a time. The next blocks are computed in threads:
    compiled kernels and array operations release the interpreter lock."""
    blocks = [slice(first, min(first + BLOCK_SIZE, len(starts_ns))) for first in range(0, len(starts_ns), BLOCK_SIZE)]
    # Called for all starts at once, in order of time, because a course tracker depends on the previous starts.
    inputs = {mode: function(starts_ns) for mode, function in (future_inputs or {}).items()} if len(starts_ns) else {}

    def evaluate(rows: slice) -> Block:
        planned = {mode: tuple(v[rows] for v in values) for mode, values in inputs.items()}
        return _evaluate_block(models, vehicle, signals, starts_ns[rows], settings, planned)

    with ThreadPoolExecutor(PREFETCHED_BLOCKS) as pool:
        pending: deque[tuple[slice, Future[Block]]] = deque()
        for rows in blocks:
            pending.append((rows, pool.submit(evaluate, rows)))
            if len(pending) > PREFETCHED_BLOCKS:
                ready_rows, block = pending.popleft()
                yield ready_rows, block.result()
        for rows, block in pending:
            yield rows, block.result()


def _evaluate_block(models: Sequence[Model], vehicle: VehicleParameters, signals: LogSignals, starts_ns: np.ndarray,
                    settings: EvaluationSettings, planned: Mapping[Mode, tuple[np.ndarray, ...]]) -> Block:
    step, steps = settings.prediction.step, settings.prediction.steps
    instants, index = _merge_instants(starts_ns, half_step_grid(0, steps, step))
    times = instants[index].T
    x, y, yaw, *others = signals.ins_at(instants, "x", "y", "yaw", "velocity_x", "yaw_rate", "velocity_x_dot")
    measured_pose = [values[index[::2]].T for values in (x, y, yaw)]
    speed, yaw_rate, acceleration, angle = (v[index].T for v in (*others, signals.road_wheel_angle_at(instants)))
    inputs: dict[Mode, Inputs] = {"hindsight": "measured", "forecast": "held"}
    for mode, columns in planned.items():
        is_planned = np.isfinite(np.stack(columns)).all(axis=(0, 2))[:, None]  # at other starts, inputs are held
        inputs[mode] = tuple(np.where(is_planned, values, initial[:, :1])
                             for values, initial in zip(columns, (angle, acceleration, angle), strict=False))
    trajectories: dict[tuple[str, Mode], np.ndarray] = {}
    for mode, source in inputs.items():
        batch = LogBatch(signals, starts_ns, step * steps, step, inputs=source)
        for model in models:
            trajectories[model.name, mode] = (
                batch.predict(model, vehicle) if mode != "hindsight" or settings.inputs == "interpolate"
                else predict_held_per_step(model, vehicle, signals, starts_ns, times[:, ::2], step))
    errors = {(model.name, mode): reading_errors(model, vehicle, trajectories[model.name, mode], *measured_pose)
              for model in models for mode in inputs}
    inputs_known = InputSequence(angle, acceleration).is_known_so_far
    for model in models:
        errors[model.name, "hindsight"][~inputs_known[:, ::2]] = np.nan
    complete, has_ended = inputs_known[:, -1], times[:, -1] > signals.log.common_span_ns[1]
    known_ins = np.isfinite(acceleration).all(axis=1)
    incomplete = {"the recording ends before the horizon": has_ended,
                  "INS data missing within the horizon": ~known_ins & ~has_ended,
                  "steering angle missing within the horizon": known_ins & ~complete & ~has_ended}
    conditions = {
        "speed": speed[:, ::2].mean(axis=1), "lateral_acceleration": (speed * yaw_rate)[:, ::2].mean(axis=1),
        "velocity_x_dot": acceleration[:, ::2].mean(axis=1),
        "steering_rate": np.sqrt(np.square(np.diff(angle, axis=1) / (0.5 * step)).mean(axis=1)),
        "heading_change": yaw[index[-1]] - yaw[index[0]],
    }
    conditions = {name: np.where(complete, values, np.nan) for name, values in conditions.items()}
    return Block(errors, trajectories, conditions, _count_reasons(incomplete))


def _merge_instants(starts_ns: np.ndarray, after_ns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(instants [ns], index): instants[index[k, i]] is start i + after_ns[k]; overlapping horizons share instants."""
    half, span = int(after_ns[1]), int(starts_ns[-1] - starts_ns[0] + after_ns[-1])
    from_first = starts_ns - starts_ns[0]
    is_regular = np.array_equal(after_ns, half * np.arange(len(after_ns))) and not np.any(from_first % half)
    if not is_regular or span > half * len(starts_ns) * len(after_ns):
        separate = starts_ns + after_ns[:, None]
        return separate.ravel(), np.arange(separate.size).reshape(separate.shape)
    return starts_ns[0] + half * np.arange(span // half + 1), np.arange(len(after_ns))[:, None] + from_first // half


def predict_held_per_step(model: Model, vehicle: VehicleParameters, signals: LogSignals, starts_ns: np.ndarray,
                          times_ns: np.ndarray, step: float) -> np.ndarray:
    """States (n, points, 6), as `LogBatch.predict` but with inputs held over each step [s]. times_ns: (n, points)."""
    corrected = signals.for_log(correct_log(model, signals.log, signals.maximum_gap))
    angle, acceleration = corrected.road_wheel_angle_at(times_ns), corrected.ins_at(times_ns, "velocity_x_dot")[0]
    states = corrected.states_at(starts_ns, model.effective_vehicle(vehicle))
    p = model.parameters(vehicle)
    with np.errstate(all="ignore"):
        inputs = [model.inputs(a, b, p) for a, b in zip(angle.T, acceleration.T, strict=True)]
        state = model.start_state(tuple(np.ascontiguousarray(states.T)), inputs[0], p)
        columns = [state]
        for w in inputs[:-1]:
            state = integrate.rk4_step(model.rhs, state, w, w, w, p, step)
            columns.append(state)
    return np.array([c[:len(STATE_NAMES)] for c in columns]).transpose(2, 0, 1)


@dataclass(frozen=True, eq=False)
class Bin:
    """Starts within a range of one quantity."""

    quantity: str
    label: str  # for tables, with the unit
    low: float | None  # edge in SI, None if open
    high: float | None  # edge in SI, None if open
    mask: np.ndarray  # (n,), True for the starts in the bin


def bin_starts(evaluation: LogEvaluation) -> list[Bin]:
    """The non-empty bins. Starts with unknown conditions are in no bin, and those in reverse are in no speed bin."""
    conditions, turn = evaluation.conditions, evaluation.conditions["heading_change"]
    lateral_acceleration = np.abs(conditions["lateral_acceleration"])
    bins = [
        *bin_by_edges("speed", "m/s", conditions["speed"], SPEED_EDGES),
        *bin_by_edges("lateral acceleration", "m/s²", lateral_acceleration, LATERAL_ACCELERATION_EDGES),
        *bin_by_edges("steering rate", "rad/s", conditions["steering_rate"], STEERING_RATE_EDGES),
        Bin("direction", "left", MAX_STRAIGHT_TURN, None, turn >= MAX_STRAIGHT_TURN),
        Bin("direction", "straight", -MAX_STRAIGHT_TURN, MAX_STRAIGHT_TURN, np.abs(turn) < MAX_STRAIGHT_TURN),
        Bin("direction", "right", None, -MAX_STRAIGHT_TURN, turn <= -MAX_STRAIGHT_TURN),
    ]
    return [bin_ for bin_ in bins if bin_.mask.any()]


def bin_by_edges(quantity: str, unit: str, values: np.ndarray, edges: tuple[float, ...]) -> list[Bin]:
    """Bins between consecutive edges, and an open bin above the last edge."""
    bounded = [Bin(quantity, label_bin(edges, unit, k), low, high, (values >= low) & (values < high))
               for k, (low, high) in enumerate(pairwise(edges))]
    return [*bounded, Bin(quantity, label_bin(edges, unit, len(bounded)), edges[-1], None, values >= edges[-1])]


def label_bin(edges: Sequence[float], unit: str, k: int) -> str:
    """Label of the bin above edge k, such as "3 to 6 m/s"."""
    return f"{edges[k]:g} to {edges[k + 1]:g} {unit}" if k + 1 < len(edges) else f"above {edges[-1]:g} {unit}"
