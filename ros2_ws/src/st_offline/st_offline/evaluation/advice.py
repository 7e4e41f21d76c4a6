"""Measures processor time and accuracy of each model at several integration steps, for `st evaluate --advise`."""

import math
import re
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from rich.markup import escape
from st_core.bands import ErrorSamples, NotFiniteError, calibrate
from st_core.bands.calibration import MIN_CALIBRATION_RUNS, compute_error_samples, compute_highest_level
from st_core.bands.file import make_times
from st_core.bands.scale import CONDITIONS
from st_core.batch import LogBatch
from st_core.errors import ConfigurationError, StCoreError
from st_core.integrate import StepTooLongWarning
from st_core.log import LogSignals
from st_core.log_evaluation import AXES, SPEED_EDGES, EvaluationSettings, label_bin, regular_starts, usable_starts
from st_core.models import Model
from st_core.prediction import compile_models, predict
from st_core.types import ControlInput, VehicleState
from st_core.vehicle import VehicleParameters
from st_recordings.runs import RunError, RunSource, read

from ..terminal import console, list_files, make_table, print_line
from .tables import write_csv
from .work import Task, load_models

REPETITIONS = 5  # measurements of the processor time of each function
MIN_MEASUREMENT_TIME = 0.02  # s; a measurement repeats the call until it has used this processor time
MAX_BATCH = 960  # predictions: 20 groups of the 48 that compiled code advances together
LATERAL = AXES.index("lateral")
BAND_LEVELS = (0.9, 0.5)
REQUIRED_FRACTION = 0.9  # fraction of the starts that must be within the tolerance
MIN_STARTS = 100  # in a speed bin; 10 s of driving at 10 starts per second
ModelStep = tuple[str, float]  # (name of the model, step [s])
Cost = dict[str, float]  # processor time per prediction [s], by kind
COST_KINDS = ("interpreted", "compiled", "batch")  # a prediction without numba, one with it, mean of a batch
STEP_MULTIPLES = (1, 2, 4)  # of the integration step of the task


def measure_costs(models: Sequence[Model], vehicle: VehicleParameters, signals: LogSignals,
                  settings: Mapping[float, EvaluationSettings]) -> dict[ModelStep, Cost]:
    """Cost of each model and step [s], measured with the inputs of one drive. settings: by step."""
    calls: dict[tuple[ModelStep, str], tuple[Callable[[], object], int]] = {}  # (function, number of predictions)
    for step, variant in settings.items():
        starts, _ = usable_starts(signals, vehicle, regular_starts(signals.log, variant.interval),
                                  variant.prediction.minimum_speed)
        starts = starts[:MAX_BATCH]
        batch = LogBatch(signals, starts, variant.prediction.horizon, step, inputs="held")
        middle = starts[len(starts) // 2:][:1]
        state = VehicleState(*signals.states_at(middle, vehicle)[0])
        acceleration, = signals.ins_at(middle, "velocity_x_dot")
        held_inputs = ControlInput(float(signals.road_wheel_angle_at(middle)[0]), float(acceleration[0]))
        compiled, _ = compile_models(models, vehicle, variant.prediction)
        for model in models:
            key = model.name, step
            calls[key, "interpreted"] = partial(
                predict, model, vehicle, state, held_inputs, variant.prediction.horizon, step), 1
            if model.name in compiled:
                calls[key, "compiled"] = partial(compiled[model.name], state, held_inputs), 1
            calls[key, "batch"] = partial(batch.predict, model, vehicle), len(starts)
    for call, _ in calls.values():
        call()  # warm-up
    durations = np.zeros((REPETITIONS, len(calls)))
    for row in durations:  # each row measures all calls, so that a busy period does not affect only one of them
        for column, (call, predictions) in enumerate(calls.values()):
            count, begin = 0, time.process_time()
            while not count or time.process_time() - begin < MIN_MEASUREMENT_TIME:
                call()
                count += 1
            row[column] = (time.process_time() - begin) / (count * predictions)
    costs: dict[ModelStep, Cost] = {}
    for (key, kind), median in zip(calls, np.median(durations, axis=0).tolist(), strict=True):
        costs.setdefault(key, {})[kind] = median
    return {(model.name, step): costs[model.name, step] for model in models for step in settings}


@dataclass(frozen=True)
class Accuracy:
    """Accuracy of one model and step with measured inputs, for each of the `seconds` ahead."""

    seconds: tuple[int, ...]
    rms: tuple[float, ...]  # lateral error [m]
    level: float | None  # of the calibrated band; None for too few runs
    half_widths: tuple[float, ...] | None  # mean lateral half-width of this band [m]; None for too few runs
    # Lateral error [m] that REQUIRED_FRACTION of the starts do not exceed up to each second, by lower edge of the speed
    # bin [m/s]; all runs have the same weight.
    error_quantiles: dict[float, tuple[float, ...]]


def measure_accuracy(runs: Sequence[ErrorSamples], model: str, settings: EvaluationSettings) -> Accuracy:
    """Accuracy of a model over one or more runs. Raises StCoreError if no band can be fitted."""
    pair = model, "hindsight"
    times = make_times(settings.prediction.horizon, settings.prediction.step)
    seconds = range(1, math.floor(times[-1] + 1e-9) + 1)
    indices = [int(np.abs(times - second).argmin()) for second in seconds]
    lateral = [np.abs(run.errors[pair][:, :, LATERAL].astype(float)) for run in runs]
    rms = np.sqrt(np.mean([np.square(errors[:, indices]).mean(axis=0) for errors in lateral], axis=0))
    highest_level = compute_highest_level(len(runs)) + 1e-9 if len(runs) >= MIN_CALIBRATION_RUNS else 0.0
    level = next((level for level in BAND_LEVELS if level <= highest_level), None)
    half_widths = None
    if level is not None:
        # The mean includes starts outside the calibration domain.
        band = calibrate(runs, pair, times, (level,))
        half_widths = tuple(np.mean([band.half_widths(run.conditions, level)[:, indices, LATERAL].mean(axis=0)
                                     for run in runs], axis=0).tolist())
    largest_errors = [np.maximum.accumulate(errors, axis=1)[:, indices] for errors in lateral]  # up to each second
    error_quantiles = {}
    for low, high in zip(SPEED_EDGES, (*SPEED_EDGES[1:], math.inf), strict=True):
        speeds = [run.conditions[:, CONDITIONS.index("speed")] for run in runs]
        parts = [errors[(v >= low) & (v < high)] for errors, v in zip(largest_errors, speeds, strict=True)]
        if sum(map(len, parts)) >= MIN_STARTS:
            # Each run is represented by the same number of quantiles, whatever its length.
            quantiles = [np.quantile(part, np.linspace(0.0, 1.0, 201), axis=0) for part in parts if len(part)]
            error_quantiles[low] = tuple(np.quantile(np.concatenate(quantiles), REQUIRED_FRACTION, axis=0).tolist())
    return Accuracy(tuple(seconds), tuple(rms.tolist()), level, half_widths, error_quantiles)


def make_choice_rows(costs: Mapping[ModelStep, Cost], accuracies: Mapping[ModelStep, Accuracy],
                     tolerance: float) -> list[dict[str, str]]:
    """Table row of each speed bin: by second ahead, the model and step with the least processor time among those with a
    lateral error within the tolerance [m] in REQUIRED_FRACTION of the starts; "none" if there are none."""
    order = sorted(accuracies, key=lambda key: costs[key].get("compiled", costs[key]["interpreted"]))
    seconds = max((accuracy.seconds for accuracy in accuracies.values()), default=())
    rows = []
    for low in sorted({low for accuracy in accuracies.values() for low in accuracy.error_quantiles}):
        row = {"speed": label_bin(SPEED_EDGES, "m/s", SPEED_EDGES.index(low))}
        errors = {key: accuracies[key].error_quantiles[low] for key in order if low in accuracies[key].error_quantiles}
        for k, second in enumerate(seconds):
            row[f"{second} s"] = next((f"{model}, {step:g} s" for (model, step), values in errors.items()
                                       if values[k] <= tolerance), "none")
        rows.append(row)
    return rows


def print_advice(sources: Sequence[RunSource], task: Task, tolerance: float) -> None:
    """Print the tables of the advice, and write advice.csv; unusable runs are skipped. tolerance: lateral error [m]."""
    with console.status("measuring cost and accuracy of each model and step"):
        costs, accuracies, problems = measure_runs(sources, task)
    rows = make_advice_rows(costs, accuracies)
    for title, part in split_rows(rows, accuracies).items():
        console.print(make_table(part, title))
    title = (f"Cheapest model and step with a lateral error within {tolerance:g} m up to each second, in "
             f"{100 * REQUIRED_FRACTION:.0f} % of the starts, with measured inputs")
    console.print(make_table(make_choice_rows(costs, accuracies, tolerance), title))
    for (model, step), reason in problems.items():
        print_line(f"[yellow]{escape(model)}, {step:g} s: {escape(reason)}[/yellow]")
    assert task.folder is not None  # set by the command
    file = task.folder / "advice.csv"
    # Cells of a file hold a number or nothing; the ratios in parentheses follow from the numbers.
    write_csv(file, ({name.removesuffix(" (x)"): "" if cell == "-" else cell.partition(" (")[0]
                      for name, cell in row.items()} for row in rows))
    list_files({file: "cost, error and band of each model and step"})


def measure_runs(sources: Sequence[RunSource],
                 task: Task) -> tuple[dict[ModelStep, Cost], dict[ModelStep, Accuracy], dict[ModelStep, str]]:
    """(costs on the longest usable run, accuracies on all, reasons for missing accuracies), each by model and step.
    Raises ConfigurationError if no run is usable."""
    settings, models = vary_step(task.settings), load_models(task)
    samples: dict[ModelStep, list[ErrorSamples]] = {}
    problems: dict[ModelStep, str] = {}
    longest: LogSignals | None = None
    # A step that is too long for a model leads to large or non-finite errors, which are reported.
    with warnings.catch_warnings(action="ignore", category=StepTooLongWarning):
        for source in sources:
            try:
                log = read(source, task.vehicle, task.read_settings).log
            except (RunError, StCoreError):
                continue
            signals = task.settings.signals(log)
            if log.overlap < task.settings.prediction.horizon:
                continue
            if longest is None or log.overlap > longest.log.overlap:
                longest = signals
            for step, variant in settings.items():
                for model in models:
                    try:
                        errors = compute_error_samples([model], task.vehicle, signals, variant)
                        samples.setdefault((model.name, step), []).append(errors)
                    except NotFiniteError as error:
                        problems[model.name, step] = f"{log.name}: {error}"
                    except StCoreError:  # no start with a complete horizon, for any model and step
                        continue
        if longest is None:
            raise ConfigurationError("--advise: no readable run is as long as the horizon; give longer runs")
        costs = measure_costs(models, task.vehicle, longest, settings)
    accuracies = {}
    for (name, step), runs in samples.items():
        if (name, step) in problems:
            continue
        try:
            accuracies[name, step] = measure_accuracy(runs, name, settings[step])
        except StCoreError as error:
            problems[name, step] = str(error)
    return costs, accuracies, problems


def vary_step(settings: EvaluationSettings) -> dict[float, EvaluationSettings]:
    """Settings by step [s], for STEP_MULTIPLES of the step; a longer step must divide one second and the horizon."""
    first, *longer = (round(multiple * settings.prediction.step, 9) for multiple in STEP_MULTIPLES)
    spans = 1.0, settings.prediction.horizon
    steps = [first, *(step for step in longer if all(
        math.isclose(span / step, round(span / step), abs_tol=1e-9) for span in spans))]
    return {step: replace(settings, prediction=replace(settings.prediction, step=step)) for step in steps}


def make_advice_rows(costs: Mapping[ModelStep, Cost], accuracies: Mapping[ModelStep, Accuracy]) -> list[dict[str, str]]:
    """One row for each model and step. Each cost is followed by its ratio to the lowest cost of the column."""
    lowest = {kind: min(cost[kind] for cost in costs.values() if kind in cost) for kind in COST_KINDS
              if any(kind in cost for cost in costs.values())}
    seconds = max((accuracy.seconds for accuracy in accuracies.values()), default=())
    rows = []
    for (model, step), cost in costs.items():
        row = {"model": model, "step, s": f"{step:g}"}
        row |= {f"{kind}, µs (x)": "-" if (time := cost.get(kind)) is None else
                f"{np.format_float_positional(1e6 * time, 3, fractional=False, trim='-')} ({time / best:.1f})"
                for kind, best in lowest.items()}
        accuracy = accuracies.get((model, step))
        for name, values in (("error", accuracy and accuracy.rms), ("band", accuracy and accuracy.half_widths)):
            row |= {f"{name} {second} s, m": "-" if not values else f"{values[k]:.2f}"
                    for k, second in enumerate(seconds)}
        rows.append(row)
    return rows


def split_rows(rows: Sequence[Mapping[str, str]],
               accuracies: Mapping[ModelStep, Accuracy]) -> dict[str, list[dict[str, str]]]:
    """Rows by title of the tables for the terminal, which is too narrow for all columns of `make_advice_rows`."""
    level = next((accuracy.level for accuracy in accuracies.values()), None)
    missing = f"no bands: fewer than {MIN_CALIBRATION_RUNS} runs" if accuracies else "none could be measured"
    note = "" if level else f" ({missing})"
    patterns = {"Processor time per prediction, µs (multiple of the lowest)": r"(.*), µs \(x\)",
                f"Lateral RMS error with measured inputs, m{note}": r"error (.*), m"}
    if level is not None:
        patterns[f"Mean lateral half-width of the simultaneous {100 * level:.0f} % band, m; calibrated on these "
                 "runs"] = r"band (.*), m"
    return {title: [{name: row[name] for name in ("model", "step, s")} | {
        match[1]: cell for name, cell in row.items() if (match := re.fullmatch(pattern, name))} for row in rows]
        for title, pattern in patterns.items()}
