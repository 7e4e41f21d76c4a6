"""Calibration of the band of one model and mode: first the scale of its errors, then the conformal factors.

Runs are assumed exchangeable. The windows (predictions) of one run are not, because they overlap. One window drawn at
random from each of n runs, and one from a future run, have n + 1 exchangeable scores. For any distribution of the
errors, the score of the future run is at most the k-th smallest of the others with probability k / (n + 1) or more, so
k = level (n + 1), and n runs support levels up to n / (n + 1). To make the factor c independent of the draw, its
coverage F(c) is the mean coverage over all draws, with equal weights of the runs:

    F(c) = E[ F(k-th smallest of one window per run) ],     F(s) = 1/n sum_r 1/n_r #{i : s_ri <= s}

If k is not an integer, E[...] is interpolated between the neighbouring integers. With one window per run and an integer
k, c is exactly the split-conformal quantile. The coverage is proven for one draw, and measured for the average over
draws (docs/manual/bands.md). Source: Dunn, Wasserman and Ramdas, Distribution-free prediction sets for two-layer
hierarchical models, JASA 2023, subsampling once and repeatedly. Checked by: test_bands.py.
"""

import math
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
from .scale import CalibrationDomain, Scale, conditions_at, fit_scale, select_evenly

MAX_STARTS_PER_RUN = 1000  # more predictions overlap more; each needs 1.2 kB per model and mode
LEVELS = (0.5, 0.9)
RELIABILITY_LEVELS = tuple(round(0.05 * k, 2) for k in range(1, 20))  # for `Band.ratios` and the reliability diagram
FOLDS = 5  # largest number of groups of runs for cross-fitting
MIN_CALIBRATION_RUNS = 3  # the calibration domain of a scored run requires two other runs
ROUNDING_TOLERANCE = 1.0e-9  # for levels and coverages
ModelMode = tuple[str, str]  # (model, mode); forecast errors include those of the assumed future inputs


class NotFiniteError(StCoreError):
    """Errors of a model that are not finite although all its inputs were measured."""


@dataclass(frozen=True, eq=False)
class ErrorSamples:
    """Errors of the predictions of one run at all points but the start, where they are 0."""

    name: str
    conditions: np.ndarray  # (n, 4) as `scale.CONDITIONS`
    errors: dict[ModelMode, np.ndarray]  # (n, points, 3), float32, see `to_predicted_frame`


def to_predicted_frame(errors: np.ndarray) -> np.ndarray:
    """Errors along and across the predicted heading, from errors along and across the measured heading.

        (along, across) = R(-e_yaw) (longitudinal, lateral),   yaw unchanged

    errors: (..., 3) longitudinal, lateral (> 0: left) [m] and yaw [rad], predicted minus measured, like the result.
    """
    cosine, sine = np.cos(errors[..., 2]), np.sin(errors[..., 2])
    along = cosine * errors[..., 0] + sine * errors[..., 1]
    across = cosine * errors[..., 1] - sine * errors[..., 0]
    return np.stack([along, across, errors[..., 2]], axis=-1)


def compute_error_samples(models: Sequence[Model], vehicle: VehicleParameters, signals: LogSignals,
                          settings: EvaluationSettings) -> ErrorSamples:
    """Error curves of one drive from at most MAX_STARTS_PER_RUN starts with known conditions and a measured horizon.
    Raises NotFiniteError, or another one-line StCoreError for a drive without such a start."""
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
    start_blocks: list[np.ndarray] = []
    curves_by_pair: dict[ModelMode, list[np.ndarray]] = {}
    for rows, block in evaluate_blocks(models, vehicle, signals, starts, settings):
        complete = np.isfinite(block.conditions["speed"])  # finite only if the whole horizon was measured
        start_blocks.append(starts[rows][complete])
        for pair, errors in block.errors.items():
            curves = errors[complete]
            is_invalid = ~np.isfinite(curves).all(axis=(1, 2))
            if is_invalid.any():
                first = (start_blocks[-1][is_invalid][0] - log.start_ns) * NANOSECOND
                raise NotFiniteError(f"errors of {pair[0]} are not finite, first for the start at {first:.1f} s, "
                                     "though all inputs were measured: correct the model or use a shorter --step")
            curves_by_pair.setdefault(pair, []).append(to_predicted_frame(curves[:, 1:]).astype(np.float32))
    scored_starts = np.concatenate([starts[:0], *start_blocks])
    if not len(scored_starts):
        raise StCoreError(f"no prediction has a completely measured horizon of {horizon:g} s; leave the run out")
    return ErrorSamples(log.name, conditions_at(signals, scored_starts),
                        {pair: np.concatenate(curves) for pair, curves in curves_by_pair.items()})


def join_runs(runs: Sequence[ErrorSamples]) -> ErrorSamples:
    """Join dependent runs, for example of one day or place, into one."""
    errors = {pair: np.concatenate([run.errors[pair] for run in runs]) for pair in runs[0].errors}
    return ErrorSamples(", ".join(run.name for run in runs), np.concatenate([run.conditions for run in runs]), errors)


def _is_measured(models: Sequence[Model], signals: LogSignals, starts_ns: np.ndarray,
                 settings: EvaluationSettings) -> np.ndarray:
    """Mask (n,) of starts with a completely measured horizon, in the recorded drive and as corrected by each model."""
    measured = np.ones(len(starts_ns), bool)
    times = starts_ns[:, None] + half_step_grid(0, settings.prediction.steps, settings.prediction.step)
    corrected_logs = [correct_log(model, signals.log, signals.maximum_gap) for model in models]
    for log in {id(log): log for log in (signals.log, *corrected_logs)}.values():
        log_signals = signals if log is signals.log else signals.for_log(log)
        position, = log_signals.ins_at(starts_ns, "x")
        acceleration, = log_signals.ins_at(times, "velocity_x_dot")
        angle = log_signals.road_wheel_angle_at(times)
        measured &= np.isfinite(position) & np.isfinite(angle).all(axis=1) & np.isfinite(acceleration).all(axis=1)
    return measured


def compute_highest_level(runs: int) -> float:
    """Highest level that n runs support, n/(n + 1) [1]."""
    return runs / (runs + 1.0)


def count_required_runs(level: float) -> int:
    """Smallest number n of runs that supports a level in (0, 1): n/(n + 1) >= level."""
    return max(1, math.ceil(level / (1.0 - level) - ROUNDING_TOLERANCE))


def check_level_range(levels: Sequence[float]) -> None:
    """Raises StCoreError for a level outside (0, 1)."""
    for level in levels:
        if not 0.0 < level < 1.0:
            raise StCoreError(f"level {level:g}: must be between 0 and 1; 90 % is 0.9")


def check_levels(levels: Sequence[float], runs: int) -> None:
    """Raises a one-line StCoreError for 0 runs, or a level outside (0, 1) or above the highest supported level."""
    if not runs:
        raise StCoreError("bands cannot be calibrated without a usable run")
    check_level_range(levels)
    for level in levels:
        if level > compute_highest_level(runs) + ROUNDING_TOLERANCE:
            clause = "run supports" if runs == 1 else "runs support"
            raise StCoreError(f"{runs} {clause} levels up to {100 * compute_highest_level(runs):.1f} %, n/(n + 1), "
                              f"not {100 * level:.6g} %: give {count_required_runs(level)} runs, or a lower --level")


def compute_conformal_factors(scores: Sequence[np.ndarray], levels: Sequence[float]) -> np.ndarray:
    """Factors c of the levels, (levels,) [1]; see the module docstring. Raises StCoreError as `check_levels` does.
    scores: finite scores of the windows of each run [1], at least one."""
    count = len(scores)
    check_levels(levels, count)
    values = np.sort(np.concatenate([np.asarray(run, float) for run in scores]))
    by_run = np.stack([np.searchsorted(np.sort(run), values, side="right") / len(run) for run in scores])
    coverage = by_run.mean(axis=0)
    # count_probability[k]: probability that k windows of a draw, one per run, have a score <= each value.
    # distribution[k]: distribution function of the k-th smallest score of a draw. mean[k]: mean coverage of this score.
    count_probability = np.zeros((count + 1, len(values)))
    count_probability[0] = 1.0
    for p in by_run:
        count_probability[1:] = count_probability[1:] * (1.0 - p) + count_probability[:-1] * p
        count_probability[0] *= 1.0 - p
    distribution = np.cumsum(count_probability[::-1], axis=0)[::-1]
    mean = np.concatenate([[0.0], np.diff(distribution[1:], axis=1, prepend=0.0) @ coverage])
    target = np.interp(np.asarray(levels, float) * (count + 1.0), np.arange(count + 1), mean)
    return values[np.minimum(np.searchsorted(coverage, target - ROUNDING_TOLERANCE), len(values) - 1)]


@dataclass(frozen=True, eq=False)
class Band:
    """The band of one model and mode: half-widths are factor times scale."""

    scale: Scale
    factors: dict[float, float]  # by level, not decreasing [1]
    ratios: np.ndarray  # (3, len(RELIABILITY_LEVELS)) quantiles of |error| / scale at a single point, for the CRPS

    def half_widths(self, conditions: np.ndarray, level: float) -> np.ndarray:
        """Half-widths (n, points, 3) along, across [m] and in yaw [rad] after time 0, under conditions (n, 4)."""
        return self.factors[level] * self.scale(conditions)


def calibrate(runs: Sequence[ErrorSamples], pair: ModelMode, time: np.ndarray,
              levels: Sequence[float] = LEVELS) -> Band:
    """The band of one model and mode.

        band = { |e_a(t)| <= c s_a(t | z)  for all t and a },       score of a window = max over t, a of |e_a(t)| / s_a

    A run is scored with a scale fitted to other runs (cross-fitting), because scores of runs used in the fit would be
    too small. Windows with conditions z outside the domain of the other runs are ignored. time: (points,) [s ahead].
    Raises a one-line StCoreError for too few runs with common conditions, an invalid level (`check_levels`), errors
    that are not finite, and a scale that cannot be fitted.
    """
    check_levels(levels, len(runs))
    if len(runs) < MIN_CALIBRATION_RUNS:
        raise StCoreError(f"{len(runs)} run{'' if len(runs) == 1 else 's'}: the errors of each run are scaled by a fit "
                          f"to at least two others; give {MIN_CALIBRATION_RUNS} runs or more")
    for run in runs:
        if not np.isfinite(run.errors[pair]).all():
            raise StCoreError(f"{run.name}: errors of {pair[0]} are not finite; correct the model or leave the run out")
    scores, ratios = [], []
    for group in np.array_split(np.arange(len(runs)), min(FOLDS, len(runs))):
        others = [run for number, run in enumerate(runs) if number not in group]
        scale = fit_scale([run.conditions for run in others], [run.errors[pair] for run in others], time)
        domain = CalibrationDomain.from_runs([run.conditions for run in others])
        for number in group:
            run = runs[number]
            rows = domain.contains(run.conditions)
            if rows.any():
                ratio = np.abs(run.errors[pair][rows]) / scale(run.conditions[rows])
                scores.append(ratio.max(axis=(1, 2)))
                # Every fifth point suffices, because errors at neighbouring points are similar.
                ratios.append(ratio[:, ::5].reshape(-1, ratio.shape[2]))
    if len(scores) < len(runs):
        try:
            check_levels(levels, len(scores))
        except StCoreError as error:
            raise StCoreError(f"{len(runs) - len(scores)} of {len(runs)} runs were driven only under conditions that "
                              f"the other runs do not cover; {error}") from None
    levels = sorted({*levels, *(level for level in RELIABILITY_LEVELS if level <= compute_highest_level(len(scores)))})
    factors = dict(zip(levels, compute_conformal_factors(scores, levels).tolist(), strict=True))
    # Quantiles of the mean distribution function of the runs.
    pooled = np.concatenate([np.quantile(ratio, np.linspace(0.0, 1.0, 201), axis=0) for ratio in ratios])
    scale = fit_scale([run.conditions for run in runs], [run.errors[pair] for run in runs], time)
    return Band(scale, factors, np.quantile(pooled, RELIABILITY_LEVELS, axis=0).T)
