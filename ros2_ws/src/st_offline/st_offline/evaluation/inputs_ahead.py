"""Inputs over the horizon of an offline evaluation: planned, in columns of a recording, or of a course."""

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from st_core.course import Course
from st_core.course_tracker import course_inputs
from st_core.errors import ConfigurationError, StCoreError
from st_core.evaluation import Mode
from st_core.log_evaluation import Ahead
from st_core.log_signals import LogSignals
from st_core.planned_inputs import SLIP_FREE, path_inputs, recorded_plan
from st_core.prediction import PredictionSettings
from st_core.vehicle import VehicleParameters
from st_recordings.runs import LoadedRun, RunError
from st_recordings.runs.csv_table import header_of
from st_recordings.runs.ncom import origin_offset

INPUTS = ("planned_road_wheel_angle", "planned_velocity_x_dot")
"""Columns of a CSV, rad left + and m/s^2: what had been planned for the time of the row, before its horizon began."""
PATH = ("planned_speed", "planned_curvature")
"""Instead: m/s and 1/m, left +, of the CG."""


def inputs_ahead(run: LoadedRun, signals: LogSignals, vehicle: VehicleParameters, prediction: PredictionSettings,
                 course: Course | None) -> dict[Mode, Ahead]:
    """By mode, plan where the recording has one and course where one is given; see `evaluate_log`.

    Passes of the run itself are left out of the course. A course and a run with known origins are brought to one map;
    else both must have been recorded in the same one. Raises RunError for planned columns that are not numbers, and for
    a course of another place.
    """
    found: dict[Mode, Ahead] = {}
    plan = _planned_columns(run.provenance["files"], vehicle)
    if plan is not None:
        found["plan"] = recorded_plan(*plan, prediction.steps, prediction.step, prediction.maximum_gap)
    if course is not None:
        others = course.without(list(run.provenance["files"].values()))
        if course.origin is not None and "origin" in run.provenance:
            latitude, longitude = map(math.degrees, run.provenance["origin"][:2])
            try:
                others = others.moved(*origin_offset((latitude, longitude), *course.origin))
            except StCoreError as error:
                raise RunError(Path(run.log.name), f"--course: {error}",
                               "leave the option out, or evaluate the run with a course of its place") from None
        found["course"] = course_inputs(others, signals, vehicle, prediction.horizon, prediction.step)
    return found


def load_course(file: tuple[str, str] | None) -> Course | None:
    """The course of (file name, content). Raises ConfigurationError, one line."""
    return None if file is None else Course.from_yaml(file[1], file[0])


def _planned_columns(files: Mapping[str, str],
                     vehicle: VehicleParameters) -> tuple[np.ndarray, tuple[np.ndarray, ...]] | None:
    """Time [ns] and columns as in `recorded_plan`, of the first CSV with planned columns; None without one."""
    for file in (Path(name) for name in files if name.lower().endswith(".csv")):
        names = header_of(file)
        kind = next((kind for kind in (INPUTS, PATH) if set(kind) <= set(names)), None)
        if kind is None or "t" not in names:
            continue
        try:
            rows = np.genfromtxt(file, delimiter=",", skip_header=1, usecols=[names.index(n) for n in ("t", *kind)])
        except ValueError as error:
            raise RunError(file, f"planned columns cannot be read: {str(error).splitlines()[0]}",
                           "write numbers with a decimal point, separated by commas") from None
        seconds, one, other = np.atleast_2d(rows).T
        if not np.isfinite(seconds).all() or (np.diff(seconds) <= 0.0).any():
            raise ConfigurationError(f"{file}: t does not rise in rows with planned columns; sort or repair the rows")
        time_ns = np.round(seconds * 1e6).astype(np.int64) * 1000
        if kind == INPUTS:
            return time_ns, (one, other)
        path = path_inputs(one, other, seconds, vehicle)
        return time_ns, (path.road_wheel_angle, path.velocity_x_dot, path.signals[SLIP_FREE])
    return None
