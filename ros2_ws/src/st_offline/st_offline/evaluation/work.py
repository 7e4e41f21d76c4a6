"""Evaluates one run, from its files to its part of the report, in this process or in a worker."""

import math
import re
import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from oxts_bridge.geometry import compute_origin_offset
from st_core.bands import Bands
from st_core.checks import Finding
from st_core.course import Course, predict_course_inputs
from st_core.effects import load_folder
from st_core.errors import ConfigurationError, StCoreError, add_prefix
from st_core.evaluation import Mode
from st_core.integrate import StepTooLongWarning
from st_core.log import LogSignals
from st_core.log_evaluation import AXES, EvaluationSettings, FutureInputs, LogEvaluation, Progress, evaluate_log
from st_core.model_file import ModelFile
from st_core.models import Model, get_model
from st_core.planned_inputs import SLIP_FREE_ANGLE, interpolate_plan, path_inputs
from st_core.vehicle import VehicleParameters
from st_recordings.runs import LoadedRun, ReadSettings, RunError, RunSource, read
from st_recordings.runs.csv_table import read_header
from st_recordings.runs.errors import log_warnings
from st_recordings.runs.run_types import summarise_alignment

from ..bands.bands_report import Scorer, collect_intervals, pool_sums, sum_contributions
from ..checking.gate import RUN_ERRORS, check_log, describe_problem, raise_for_errors
from . import tables
from .background import run_in_background
from .drawing import FigureOutput, PageFigure
from .drive_parts import segment_drive
from .run_figures import FigureData, describe_ranking, draw_run

PLANNED_INPUTS = ("planned_road_wheel_angle", "planned_velocity_x_dot")
"""Columns of a CSV [rad, positive to the left; m/s^2]: inputs at the time of the row, planned before the prediction."""
PLANNED_PATH = ("planned_speed", "planned_curvature")  # alternative columns, of the CG [m/s; 1/m, positive to the left]


@dataclass(frozen=True)
class Task:
    """Settings of an evaluation."""

    vehicle: VehicleParameters
    models: Mapping[str, ModelFile | None]  # file name -> content, or built-in model -> None
    settings: EvaluationSettings = field(default_factory=EvaluationSettings)
    read_settings: ReadSettings = field(default_factory=ReadSettings)
    vehicle_file: str = ""  # source of `vehicle`
    over: str = "means"  # "means" (of each horizon) or "samples", for the statistics in the table
    starts: tuple[float, ...] = ()  # times of the predictions drawn in detail [s], () for an automatic choice
    folder: Path | None = None  # folder of the results, None for no files
    formats: tuple[str, ...] = ("png", "pdf")  # formats of the figure files
    force: bool = False  # whether to evaluate runs in which the checks find errors
    bands: tuple[str, Bands] | None = None  # (file name, content)
    course: tuple[str, Course] | None = None  # (file name, content)
    adaptive: bool = False  # whether to test adaptive bands
    effects: Path | None = None  # folder of the user-defined effects in the model files

    @property
    def model_files(self) -> list[ModelFile]:
        return [file for file in self.models.values() if file is not None]


@dataclass(frozen=True)
class RunReport:
    """Results of one run, picklable."""

    name: str
    problem: str = ""  # why the run was not evaluated; then only `findings` of the checks are set
    ranking: str = ""  # sentence with the lateral RMSE of each model
    metadata: dict[str, Any] = field(default_factory=dict)  # provenance, counts, alignment, warnings
    models: dict[str, Any] = field(default_factory=dict)
    seconds_ahead: dict[str, Any] = field(default_factory=dict)  # errors by second of the horizon
    bins: list[dict[str, Any]] = field(default_factory=list)
    manoeuvres: list[dict[str, Any]] = field(default_factory=list)
    figures: list[PageFigure] = field(default_factory=list)
    bands: dict[str, Any] = field(default_factory=dict)  # sums of `Scorer` and `sum_contributions`
    findings: tuple[Finding, ...] = ()
    seconds: dict[str, float] = field(default_factory=dict)  # wall time [s] of reading, predicting and drawing


def evaluate_run(source: RunSource, task: Task, progress: Progress | None = None) -> RunReport:
    """Read, evaluate and draw one run. An error in the run becomes the `problem` of the report."""
    try:
        # The checks already report a step that is too long as a finding.
        with warnings.catch_warnings(action="ignore", category=StepTooLongWarning):
            return _evaluate(source, task, progress)
    except RUN_ERRORS as error:
        return RunReport(source.name, describe_problem(error, source), findings=getattr(error, "findings", ()))


def _evaluate(source: RunSource, task: Task, progress: Progress | None) -> RunReport:
    times = [time.perf_counter()]
    run = read(source, task.vehicle, task.read_settings)
    run = _warn_of_fitted_models(source, run, task)
    times.append(time.perf_counter())
    models, prediction = load_models(task), task.settings.prediction
    name = to_file_name(source.name)
    with (run_in_background(lambda: (check_log(run.log, task.vehicle, run.auxiliary, models, prediction.step).findings,
                                     segment_drive(run.log, run.labels))) as wait_for_checks,
          TemporaryDirectory(dir=task.folder) as figure_folder):
        signals = task.settings.signals(run.log)
        bands = task.bands[1] if task.bands else None
        scorer = Scorer(bands, task.adaptive, signals, run.provenance["files"], prediction)
        try:
            future_inputs = make_future_inputs(run, signals, task)
            evaluation = evaluate_log(models, task.vehicle, signals, task.settings, progress=progress,
                                      on_block=scorer.add, future_inputs=future_inputs)
            _require_scores(source, run, evaluation)
            times.append(time.perf_counter())
            # Drawn before the result of the checks, which take longer than the predictions.
            output = FigureOutput(Path(figure_folder) if task.folder else None, task.formats, f"{name}-")
            figures = draw_run(FigureData(evaluation, models, task.vehicle, signals, task.starts, output))
        finally:  # a finding of the checks explains a fault better than an exception of the evaluation
            findings, parts = wait_for_checks()
            raise_for_errors(source.path, findings, task.force)
        if task.folder:
            folder = task.folder / "runs" / name
            folder.mkdir(parents=True, exist_ok=True)
            for file in Path(figure_folder).iterdir():
                file.replace(folder / file.name)
            write_starts(folder / "starts.csv", evaluation)
    times.append(time.perf_counter())
    sums = pool_sums(scorer.sums)
    if bands:
        sums |= sum_contributions(models, task.vehicle, signals, task.settings, collect_intervals(task.model_files))
    seconds = dict(zip(("read", "predict", "draw"), np.diff(times).tolist(), strict=True))
    return RunReport(source.name, "", describe_ranking(evaluation),
                     _collect_metadata(run, evaluation, list(future_inputs)), tables.summarise_by_model(evaluation),
                     tables.summarise_by_second(evaluation), tables.summarise_by_bin(evaluation),
                     tables.summarise_by_manoeuvre(evaluation, parts), figures, sums, findings, seconds)


def _warn_of_fitted_models(source: RunSource, run: LoadedRun, task: Task) -> LoadedRun:
    digests = set(run.provenance["files"].values())
    fitted = [f"{source.path}: {Path(name).name} was fitted to this recording: its errors here are not held-out errors"
              for name, file in task.models.items() if file and digests <= set(file.provenance.data.values())]
    log_warnings(fitted)
    return replace(run, warnings=(*run.warnings, *fitted))


def _collect_metadata(run: LoadedRun, evaluation: LogEvaluation, inputs_ahead: list[Mode]) -> dict[str, Any]:
    return {
        "duration": run.log.duration, "overlap": run.log.overlap, "n_predictions": len(evaluation.starts_ns),
        "skipped": evaluation.skipped, "incomplete": evaluation.incomplete,
        "labels": "given" if run.labels else "detected", "alignment": summarise_alignment(run.alignment),
        "warnings": list(run.warnings), "provenance": dict(run.provenance), "inputs_ahead": inputs_ahead}


def _require_scores(source: RunSource, run: LoadedRun, evaluation: LogEvaluation) -> None:
    """Raise RunError with the reasons if no prediction was scored."""
    if any(errors.n_starts for errors in evaluation.errors.values()):
        return
    length = float(evaluation.horizon[-1])
    if run.log.overlap < length:
        raise RunError(source.path, f"nothing to score: INS and steering overlap for {run.log.overlap:.1f} s, less "
                       f"than the horizon of {length:g} s")
    skipped = {**evaluation.skipped, **evaluation.incomplete}
    reasons = ", ".join(f"{reason} ({count} start{'s' * (count > 1)})" for reason, count in skipped.items())
    raise RunError(source.path, f"nothing to score: {reasons}", "`st check` reports gaps and invalid samples")


def load_models(task: Task) -> list[Model]:
    """Models of a task. Raises ConfigurationError for an unknown model, a duplicate name, or an unusable model file."""
    models: list[Model] = []
    if task.effects:
        load_folder(str(task.effects.absolute()))
    for name, file in task.models.items():
        if file is not None:
            file.check_vehicle(task.vehicle, "the vehicle file", f"{name}: ")
        models.append(get_model(name) if file is None else file.model())
    names = [model.name for model in models]
    for name in names:
        if names.count(name) > 1:
            raise ConfigurationError(f"two models are named {name}: give each name once, and at most one model file")
    return models


def check_bands(task: Task, models: Sequence[Model]) -> None:
    """Raise ConfigurationError for bands of a different car, model or setting."""
    if task.bands is None:
        return
    origin, bands = task.bands
    add_prefix(f"{origin}: ", lambda: bands.check(task.vehicle, collect_model_hashes(task, models), task.settings))


def collect_model_hashes(task: Task, models: Sequence[Model]) -> dict[str, str]:
    """Hash of the model file by model; "" for a built-in model."""
    return {model.name: "" for model in models} | {file.model().name: file.hash for file in task.model_files}


def to_file_name(name: str) -> str:
    """The name with "_" for each group of characters other than ASCII letters, digits, dot, dash and underscore."""
    return re.sub(r"[^\w.-]+", "_", name, flags=re.ASCII).strip(".") or "run"


def write_starts(file: Path, evaluation: LogEvaluation) -> None:
    """Write one row per prediction: time, conditions, mean errors over the horizon (docs/manual/evaluation.md)."""
    def format_numbers(values: np.ndarray, decimals: int) -> list[str]:
        return ["" if math.isnan(v) else f"{v:.{decimals}f}" for v in values.tolist()]

    columns = {"start_ns": evaluation.starts_ns.astype(str), "t0_s": format_numbers(evaluation.time, 3),
               **{name: format_numbers(values, 5) for name, values in evaluation.conditions.items()},
               **{f"{model}_{mode}_{axis}_mean": format_numbers(errors.mean[:, k], 5)
                  for (model, mode), errors in evaluation.errors.items() for k, axis in enumerate(AXES)}}
    tables.write_csv(file, (dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)))


def make_future_inputs(run: LoadedRun, signals: LogSignals, task: Task) -> dict[Mode, FutureInputs]:
    """Inputs over the horizon for `evaluate_log`: "plan" if the recording contains one, "course" if a course is given.

    The passes of this run are removed from the course. If both origins are known, the course is transformed into the
    map of the run; otherwise both must be in the same map. Raises RunError for planned columns that cannot be read and
    a course at a different location, ConfigurationError for planned columns whose times are invalid or do not increase.
    """
    inputs: dict[Mode, FutureInputs] = {}
    prediction, files = task.settings.prediction, run.provenance["files"]
    plan = _read_planned_columns(files, task.vehicle)
    if plan is not None:
        inputs["plan"] = partial(interpolate_plan, *plan, prediction.steps, prediction.step, prediction.maximum_gap)
    if task.course is not None:
        course = task.course[1]
        other_passes = course.exclude(list(files.values()))
        if course.origin is not None and "origin" in run.provenance:
            latitude, longitude = map(math.degrees, run.provenance["origin"][:2])
            try:
                other_passes = other_passes.shift(*compute_origin_offset((latitude, longitude), *course.origin))
            except StCoreError as error:
                raise RunError(Path(run.log.name), f"--course: {error}",
                               "leave the option out, or give a course of this location") from None
        inputs["course"] = partial(predict_course_inputs, other_passes, signals, task.vehicle, prediction.horizon,
                                   prediction.step)
    return inputs


def _read_planned_columns(files: Mapping[str, str],
                          vehicle: VehicleParameters) -> tuple[np.ndarray, tuple[np.ndarray, ...]] | None:
    """Time [ns] and inputs for `interpolate_plan` from the first CSV with t and planned columns; None without one."""
    for file in (Path(name) for name in files if name.lower().endswith(".csv")):
        names = read_header(file)
        kind = next((kind for kind in (PLANNED_INPUTS, PLANNED_PATH) if set(kind) <= set(names)), None)
        if kind is None or "t" not in names:
            continue
        try:
            rows = np.genfromtxt(file, delimiter=",", skip_header=1, usecols=[names.index(n) for n in ("t", *kind)])
        except ValueError as error:
            raise RunError(file, f"planned columns cannot be read: {str(error).splitlines()[0]}",
                           "write numbers with a decimal point, separated by commas") from None
        seconds, first, second = np.atleast_2d(rows).T
        if not np.isfinite(seconds).all() or (np.diff(seconds) <= 0.0).any():
            raise ConfigurationError(f"{file}: with planned columns, t must be finite and increase in each row")
        time_ns = np.round(seconds * 1e6).astype(np.int64) * 1000
        if kind == PLANNED_INPUTS:
            return time_ns, (first, second)
        path = path_inputs(first, second, seconds, vehicle)
        return time_ns, (path.road_wheel_angle, path.velocity_x_dot, path.signals[SLIP_FREE_ANGLE])
    return None
