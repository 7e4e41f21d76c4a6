"""Samples for calibration: error curves over the whole horizon, with the conditions at the start."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..errors import StCoreError
from ..log import LogSignals
from ..log_evaluation import EvaluationSettings, evaluate_blocks, regular_starts, usable_starts
from ..models import Model
from ..readings import correct_log
from ..timeseries import NANOSECOND, half_step_grid
from ..vehicle import VehicleParameters
from .conditions import conditions_at
from .scale import select_evenly

MAX_STARTS_PER_RUN = 1000  # more predictions overlap more and need 1.2 kB each per model and mode
ModelMode = tuple[str, str]  # (model, mode); errors in hindsight are due to the model, in a forecast also to the driver


class NotFiniteError(StCoreError):
    """Errors of a model are not finite although all its inputs were measured."""


@dataclass(frozen=True, eq=False)
class ErrorSamples:
    """Error curves of the starts of one run, without the point at time 0, where errors are 0."""

    name: str
    conditions: np.ndarray  # (n, 4) as `conditions.CONDITIONS`
    errors: dict[ModelMode, np.ndarray]  # (n, points, 3), float32, see `to_predicted_frame`


def to_predicted_frame(errors: np.ndarray) -> np.ndarray:
    """Errors along and across the predicted heading, from errors along and across the measured heading.

        (along, across) = R(-e_yaw) (longitudinal, lateral),   yaw unchanged

    errors: (..., 3) longitudinal, lateral (left +) [m] and yaw [rad], predicted minus measured, like the result.
    """
    cosine, sine = np.cos(errors[..., 2]), np.sin(errors[..., 2])
    along = cosine * errors[..., 0] + sine * errors[..., 1]
    across = cosine * errors[..., 1] - sine * errors[..., 0]
    return np.stack([along, across, errors[..., 2]], axis=-1)


def compute_error_samples(models: Sequence[Model], vehicle: VehicleParameters, signals: LogSignals,
                          settings: EvaluationSettings) -> ErrorSamples:
    """Error curves of one drive from at most MAX_STARTS_PER_RUN starts with known conditions and a measured horizon.

    Raises NotFiniteError, and another one-line StCoreError for a drive without such a start.
    """
    horizon = settings.prediction.horizon
    log = signals.log
    if log.overlap < horizon:
        raise StCoreError(f"INS and steering overlap for {log.overlap:.1f} s, less than the horizon of {horizon:g} s: "
                          "no prediction can be scored; leave the run out")
    starts, _ = usable_starts(signals, vehicle, regular_starts(log, settings.interval),
                              settings.prediction.minimum_speed)
    conditions = conditions_at(signals, starts)
    starts = starts[np.isfinite(conditions).all(axis=1) & _is_measured(models, signals, starts, settings)]
    starts = starts[select_evenly(len(starts), MAX_STARTS_PER_RUN)]
    scored: list[np.ndarray] = []
    curves_of: dict[ModelMode, list[np.ndarray]] = {}
    for rows, block in evaluate_blocks(models, vehicle, signals, starts, settings):
        complete = np.isfinite(block.conditions["speed"])  # finite only if the whole horizon was measured
        scored.append(starts[rows][complete])
        for pair, errors in block.errors.items():
            curves = errors[complete]
            bad = ~np.isfinite(curves).all(axis=(1, 2))
            if bad.any():
                first = (scored[-1][bad][0] - log.start_ns) * NANOSECOND
                raise NotFiniteError(f"errors of {pair[0]} are not finite, first for the start at {first:.1f} s, "
                                     "though all inputs were measured: correct the model or use a shorter --step")
            curves_of.setdefault(pair, []).append(to_predicted_frame(curves[:, 1:]).astype(np.float32))
    scored_starts = np.concatenate(scored) if scored else starts[:0]
    if not len(scored_starts):
        raise StCoreError(f"no prediction has a completely measured horizon of {horizon:g} s; leave the run out")
    return ErrorSamples(log.name, conditions_at(signals, scored_starts),
                        {pair: np.concatenate(curves) for pair, curves in curves_of.items()})


def join_runs(runs: Sequence[ErrorSamples]) -> ErrorSamples:
    """Join dependent runs, for example of one day or place, into one."""
    errors = {pair: np.concatenate([run.errors[pair] for run in runs]) for pair in runs[0].errors}
    return ErrorSamples(", ".join(run.name for run in runs), np.concatenate([run.conditions for run in runs]), errors)


def _is_measured(models: Sequence[Model], signals: LogSignals, starts_ns: np.ndarray,
                 settings: EvaluationSettings) -> np.ndarray:
    """Mask (n,) of starts with a completely measured horizon, also after the models' own corrections of the drive."""
    measured = np.ones(len(starts_ns), bool)
    times = starts_ns[:, None] + half_step_grid(0, settings.prediction.steps, settings.prediction.step)
    own_logs = [correct_log(model, signals.log, signals.maximum_gap) for model in models]
    for log in {id(log): log for log in (signals.log, *own_logs)}.values():
        own = signals if log is signals.log else signals.for_log(log)
        state, = own.ins_at(starts_ns, "x")
        acceleration, = own.ins_at(times, "velocity_x_dot")
        angle = own.road_wheel_angle_at(times)
        measured &= np.isfinite(state) & np.isfinite(angle).all(axis=1) & np.isfinite(acceleration).all(axis=1)
    return measured
