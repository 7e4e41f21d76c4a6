"""Draws the figures of one run: predicted paths, errors versus start time and versus horizon, slip and forces."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from st_core.evaluation import Mode
from st_core.log import LogSignals
from st_core.log_evaluation import LogEvaluation, evaluate_blocks
from st_core.models import Model, get_model, slip_angles
from st_core.palette import MEASURED_COLOUR, MODEL_COLOUR, MODEL_LINE
from st_core.readings import predict_readings
from st_core.vehicle import VehicleParameters

from .background import run_in_background
from .drawing import TEXT_COLOUR, WIDTH, FigureOutput, PageFigure, cut_at_gaps, reduce_points, save_figure

POSITIVE_SIDE = {"longitudinal": "ahead", "lateral": "left"}
AXIS_LABEL = {axis: f"{axis} error, m\n(positive: predicted {side})" for axis, side in POSITIVE_SIDE.items()}
NOTICEABLE_ERROR = 0.5  # m, the lateral clearance of a car in the middle of its lane


@dataclass(frozen=True)
class FigureData:
    """Data and output of the figures of a run. starts: times [s] of the predictions drawn in detail."""

    evaluation: LogEvaluation
    models: Sequence[Model]
    vehicle: VehicleParameters
    signals: LogSignals
    starts: Sequence[float]
    output: FigureOutput


def get_line_style(model: str) -> dict[str, Any]:
    """Matplotlib arguments for the line of a model, including its label."""
    return {"color": MODEL_COLOUR.get(model, TEXT_COLOUR), "ls": MODEL_LINE.get(model, "solid"), "label": model}


def find_complete_starts(evaluation: LogEvaluation) -> np.ndarray:
    """Mask of the starts with a complete horizon (hindsight) for every model."""
    return np.all([e.complete for (_, mode), e in evaluation.errors.items() if mode == "hindsight"], axis=0)


def choose_starts(evaluation: LogEvaluation, times: Sequence[float]) -> np.ndarray:
    """Indices of the complete starts nearest to the times [s]; without times, indices of four evenly spaced starts."""
    complete = np.flatnonzero(find_complete_starts(evaluation))
    if not len(complete):
        return complete
    if times:
        indices = [complete[np.abs(evaluation.time[complete] - t).argmin()] for t in times]
    else:
        # The first and the last start are excluded, because they are the least representative.
        indices = complete[np.linspace(0, len(complete) - 1, 6).round().astype(int)[1:-1]]
    return np.unique(indices)


def draw_run(data: FigureData) -> list[PageFigure]:
    """Draw all figures for which this run has data, half of them on a second core."""
    first, second = (draw_segments, draw_horizon_means), (draw_slip_and_forces, draw_error_against_horizon)
    with run_in_background(lambda: [draw(data) for draw in second]) as wait_for_second:
        figures = [draw(data) for draw in first] + wait_for_second()
    return [figure for figure in figures if figure is not None]


def draw_segments(data: FigureData) -> PageFigure | None:
    """Draw measured and predicted paths from a few starts, with the errors over the horizon: figure 1 of the paper."""
    evaluation = data.evaluation
    indices = choose_starts(evaluation, data.starts)
    if not len(indices):
        return None
    starts, duration = evaluation.starts_ns[indices], float(evaluation.horizon[-1])
    _, block = next(evaluate_blocks(data.models, data.vehicle, data.signals, starts, evaluation.settings))
    figure, grid = plt.subplots(3, len(indices), figsize=(WIDTH, 5.9), height_ratios=(1.75, 1, 1), squeeze=False)
    for column, (index, start_ns) in enumerate(zip(indices, starts, strict=True)):
        path, *profiles = grid[:, column]
        _draw_measured_path(path, data, start_ns, duration)
        speed = evaluation.conditions["speed"][index]
        path.set_title(f"$t_0$ = {evaluation.time[index]:.1f} s, {speed:.1f} m/s", fontsize=9)
        path.set(xlabel="east, m", ylabel="" if column else "north, m")
        for axes, first, (axis, side) in zip(profiles, grid[1:, 0], POSITIVE_SIDE.items(), strict=True):
            if column:
                axes.sharey(first)
            axes.axhline(0, color=TEXT_COLOUR, lw=0.6)
            axes.set(xlim=(0, duration), ylabel="" if column else f"{axis}, m\n(positive: {side})")
            axes.tick_params(labelleft=not column)
        profiles[-1].set_xlabel("horizon, s")
        for model in data.models:
            states, errors = (values[model.name, "hindsight"][column].T
                              for values in (block.trajectories, block.errors))
            predicted = predict_readings(model, data.vehicle, tuple(states))
            path.plot(predicted.x, predicted.y, **get_line_style(model.name))
            for axes, error in zip(profiles, errors[:2], strict=True):
                axes.plot(evaluation.horizon, error, **get_line_style(model.name))
    end_errors = {m.name: float(np.linalg.norm(block.errors[m.name, "hindsight"][:, -1, :2], axis=1).max())
                  for m in data.models}
    largest = ", ".join(f"{model} {value:.2f} m" for model, value in end_errors.items())
    starts_text = "these starts" if len(indices) > 1 else "this start"
    title = f"{evaluation.name}: largest position error {duration:g} s after {starts_text}: {largest}"
    caption = ("Predictions with the measured inputs (hindsight) from selected starts, and their errors over the "
               "horizon, along and across the measured heading.")
    return save_figure(figure, data.output, "segments", title, caption)


def _draw_measured_path(axes: plt.Axes, data: FigureData, start_ns: int, duration: float) -> None:
    log, span = data.signals.log, round(duration * 1e9)
    horizon = slice(*np.searchsorted(log.ins_time_ns, (start_ns, start_ns + span)))
    context = slice(*np.searchsorted(log.ins_time_ns, (start_ns - span, start_ns + 2 * span)))
    x, y = log.x[horizon], log.y[horizon]
    half_size = 0.5 * max(np.ptp(x), np.ptp(y)) * 1.15 + 2.0
    middle = 0.5 * (x.min() + x.max()), 0.5 * (y.min() + y.max())
    in_frame = (np.abs(log.x - middle[0]) < half_size) & (np.abs(log.y - middle[1]) < half_size)
    indices = np.flatnonzero(in_frame)[:: max(1, int(in_frame.sum()) // 400)]
    gaps = np.flatnonzero(np.diff(np.cumsum(~in_frame)[indices])) + 1  # the car left the frame and returned
    axes.plot(*(np.insert(v[indices], gaps, np.nan) for v in (log.x, log.y)), color=MEASURED_COLOUR, lw=0.8, alpha=0.5)
    stride = max(1, len(log.x[context]) // 200)
    axes.plot(log.x[context][::stride], log.y[context][::stride], color=MEASURED_COLOUR, lw=1.2)
    stride = max(1, len(x) // 100)
    axes.plot(x[::stride], y[::stride], color=MEASURED_COLOUR, lw=5, alpha=0.45, solid_capstyle="butt",
              label="measured over the horizon")
    axes.plot(x[:1], y[:1], "o", ms=4, color=TEXT_COLOUR, zorder=5)
    axes.set_aspect("equal", adjustable="box")
    axes.set(xlim=(middle[0] - half_size, middle[0] + half_size), ylim=(middle[1] - half_size, middle[1] + half_size))


def draw_horizon_means(data: FigureData) -> PageFigure:
    """Draw the mean errors over the horizon, speed and acceleration versus start time: figure 2 of the paper."""
    evaluation = data.evaluation
    figure, (upper, lower, context) = plt.subplots(
        3, 1, figsize=(WIDTH, 6.0), height_ratios=(1.3, 1.3, 0.9), sharex=True)
    for k, (axes, axis) in enumerate(((upper, "longitudinal"), (lower, "lateral"))):
        axes.axhline(0, color=TEXT_COLOUR, lw=0.6)
        for model in data.models:
            line = evaluation.errors[model.name, "hindsight"].mean[:, k]
            # The linear and nonlinear models often coincide; the wider line of the linear model remains visible.
            width = 2.4 if model.name == "linear" else 1.2
            axes.plot(*_reduce_over_time(evaluation, line), **get_line_style(model.name), lw=width)
        axes.set_ylabel(AXIS_LABEL[axis])
    speed, lateral = evaluation.conditions["speed"], evaluation.conditions["lateral_acceleration"]
    context.plot(*_reduce_over_time(evaluation, speed), color=TEXT_COLOUR, lw=1.0, label="speed, m/s")
    context.plot(*_reduce_over_time(evaluation, lateral), color=MEASURED_COLOUR, lw=1.0,
                 label="lateral acceleration, m/s² (positive to the left)")
    context.set_ylabel("mean over the\nhorizon, m/s, m/s²")
    context.set_xlabel("start of the prediction $t_0$, s after the first INS measurement")
    title = f"{evaluation.name}: {describe_ranking(evaluation)}"
    caption = "Error averaged over each horizon (hindsight: measured inputs), versus its start time."
    return save_figure(figure, data.output, "horizon_means", title, caption)


def _reduce_over_time(evaluation: LogEvaluation, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    # Successive points of a reduced line are at most 1/225 of the run apart.
    gap = max(1.0, float(np.ptp(evaluation.time)) / 200.0)
    return cut_at_gaps(*reduce_points(evaluation.time, values), gap)


def draw_error_against_horizon(data: FigureData) -> PageFigure:
    """Draw the root mean square error of hindsight and forecast at each point of the horizon."""
    evaluation = data.evaluation
    lines: tuple[tuple[Mode, float, float], ...] = ("hindsight", 1.6, 1.0), ("forecast", 0.9, 0.7)
    figure, panels = plt.subplots(1, 2, figsize=(WIDTH, 3.4))
    for k, (axes, axis) in enumerate(zip(panels, POSITIVE_SIDE, strict=True)):
        for model in data.models:
            for mode, width, alpha in lines:
                line = get_line_style(model.name) | ({"ls": ":", "label": None} if mode == "forecast" else {})
                profile = evaluation.errors[model.name, mode].profile_rmse[:, k]
                axes.plot(evaluation.horizon, profile, **line, lw=width, alpha=alpha)
        # Logarithmic, because forecast errors are many times larger than hindsight errors.
        axes.set_yscale("log")
        axes.set_ylim(bottom=0.01)
        axes.set(xlim=(0, evaluation.horizon[-1]), xlabel="horizon, s", ylabel=f"{axis} RMSE, m")
        axes.yaxis.set_major_formatter("{x:g}")
    panels[-1].plot([], [], color=TEXT_COLOUR, lw=0.9, ls=":", label="forecast: inputs held")
    parts = []
    for model in data.models:
        profile = evaluation.errors[model.name, "hindsight"].profile_rmse[:, 1]
        is_large = profile > NOTICEABLE_ERROR
        time = f"after {evaluation.horizon[is_large.argmax()]:.1f} s" if is_large.any() else "never"
        parts.append(f"{model.name} {time}")
    title = f"{evaluation.name}: lateral hindsight RMSE exceeds {NOTICEABLE_ERROR:g} m: {', '.join(parts)}"
    caption = ("RMSE over the complete starts at each point of the horizon. Hindsight uses the measured inputs; the "
               "forecast holds the inputs constant at their values at the start.")
    return save_figure(figure, data.output, "error_against_horizon", title, caption)


def describe_ranking(evaluation: LogEvaluation) -> str:
    """Lateral hindsight RMSE of the models, smallest first, with the ratio of largest to smallest if above 1.15."""
    values = sorted((evaluation.errors[m, "hindsight"].statistics("lateral")[2], m) for m in evaluation.models)
    values = [(v, m) for v, m in values if math.isfinite(v)]
    if not values:
        return "no complete horizon"
    text = "lateral RMSE of the horizon means: " + ", ".join(f"{m} {v:.2f} m" for v, m in values)
    ratio = values[-1][0] / max(values[0][0], 1e-6)
    return text + (f" (largest {ratio:.1f} times the smallest)" if len(values) > 1 and ratio > 1.15 else "")


def draw_slip_and_forces(data: FigureData) -> PageFigure | None:
    """Draw the predicted slip angles and lateral forces of both axles, and slip angles from the measured motion."""
    models = [m for m in data.models if m.axle_forces and not m.extra_states and not m.signals]
    evaluation, signals, vehicle = data.evaluation, data.signals, data.vehicle
    indices = choose_starts(evaluation, data.starts)
    if not models or not len(indices):
        return None
    lateral = np.where(find_complete_starts(evaluation), np.abs(evaluation.conditions["lateral_acceleration"]), -1.0)
    index = int(indices[0] if len(data.starts) == 1 else lateral.argmax())
    start, begin = evaluation.starts_ns[index : index + 1], evaluation.time[index]
    _, block = next(evaluate_blocks(models, vehicle, signals, start, evaluation.settings))
    horizon, times = evaluation.horizon, start[0] + np.round(evaluation.horizon * 1e9).astype(np.int64)
    angle, acceleration = signals.road_wheel_angle_at(times), signals.ins_at(times, "velocity_x_dot")[0]
    figure, grid = plt.subplots(2, 2, figsize=(WIDTH, 4.6), sharex=True, sharey="row")
    measured_slips, _ = _compute_slip_and_forces(get_model("linear"), vehicle, signals.states_at(times, vehicle), angle,
                                                 acceleration)
    largest_slips = {"measured": np.nanmax(np.abs(measured_slips))}
    for axes, slip in zip(grid[0], measured_slips, strict=True):
        axes.plot(horizon, np.degrees(slip), color=MEASURED_COLOUR, lw=1.0, label="from the measured motion")
    for model in models:
        states = block.trajectories[model.name, "hindsight"][0]
        slips, forces = _compute_slip_and_forces(model, vehicle, states, angle, acceleration)
        for (upper, lower), slip, force in zip(grid.T, slips, forces, strict=True):
            upper.plot(horizon, np.degrees(slip), **get_line_style(model.name))
            lower.plot(horizon, force / 1000.0, **get_line_style(model.name))
        largest_slips[model.name] = np.abs(slips).max()
    for (upper, lower), axle in zip(grid.T, ("front", "rear"), strict=True):
        upper.axhline(0, color=TEXT_COLOUR, lw=0.6)
        lower.axhline(0, color=TEXT_COLOUR, lw=0.6)
        upper.set_title(f"{axle} axle", fontsize=9)
        lower.set_xlabel("horizon, s")
    grid[1, 0].set_xlim(0, horizon[-1])
    grid[0, 0].set_ylabel("slip angle, °\n(positive: slides to the left)")
    grid[1, 0].set_ylabel("lateral force of the axle, kN\n(positive to the left)")
    title = (f"{evaluation.name}: largest slip angle from {begin:.1f} to {begin + horizon[-1]:.1f} s: "
             f"{', '.join(f'{source} {np.degrees(slip):.1f}°' for source, slip in largest_slips.items())}")
    start_text = "requested start" if len(data.starts) == 1 else "start with the largest mean lateral acceleration"
    caption = f"Slip angles and forces that the models predict with the measured inputs, from the {start_text}."
    return save_figure(figure, data.output, "slip_and_forces", title, caption)


def _compute_slip_and_forces(model: Model, vehicle: VehicleParameters, states: np.ndarray, angle: np.ndarray,
                             acceleration: np.ndarray) -> tuple[tuple, tuple]:
    """((front, rear) slip angles [rad], (front, rear) axle forces [N]) of a model for states (n, 6)."""
    p = model.parameters(vehicle)
    w = model.inputs(angle, acceleration, p)
    assert model.axle_forces  # the caller draws only models with axle forces
    front, rear = slip_angles(tuple(states.T), w, p)
    return (front, rear), model.axle_forces(front, rear, w, p)
