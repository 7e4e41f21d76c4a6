"""Slip angles and axle forces over one horizon: the paper's third figure."""

from collections.abc import Sequence

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.lines import Line2D
from st_core.log_evaluation import evaluate_blocks
from st_core.models import Model, get_model
from st_core.palette import MEASURED_COLOUR
from st_core.vehicle import VehicleParameters

from .drawing import TEXT, WIDTH, Drawn, finish
from .run_drawing import Drawing, chosen_starts, complete_in_all, legend

AXLES = ("front", "rear")


def slip(drawing: Drawing) -> Drawn | None:
    """Predicted slip angles and lateral forces of both axles; grey: slip angles from the measured motion."""
    models = [m for m in drawing.models if m.axles is not None and not m.extra_states and not m.signals]
    row = _start(drawing)
    if not models or row is None:
        return None
    evaluation, signals, vehicle = drawing.evaluation, drawing.signals, drawing.vehicle
    start = evaluation.starts_ns[row : row + 1]
    _, block = next(evaluate_blocks(models, vehicle, signals, start, evaluation.settings))
    times = start[0] + np.round(evaluation.horizon * 1e9).astype(np.int64)
    angle, acceleration = signals.road_wheel_angle_at(times), signals.ins_at(times, "velocity_x_dot")[0]
    measured = signals.states_at(times, vehicle)
    figure, grid = plt.subplots(2, 2, figsize=(WIDTH, 4.6), sharex=True, sharey="row")
    measured_slip = _slip_angles(get_model("linear"), drawing.vehicle, measured, angle, acceleration)[0]
    for column in (0, 1):
        grid[0, column].plot(evaluation.horizon, np.degrees(measured_slip[column]), color=MEASURED_COLOUR, lw=1.0)
    ends = {}
    for model in models:
        states = block.trajectories[model.name, "hindsight"][0]
        slips, forces = _slip_angles(model, drawing.vehicle, states, angle, acceleration)
        for column in (0, 1):
            grid[0, column].plot(evaluation.horizon, np.degrees(slips[column]), **drawing.line(model.name))
            grid[1, column].plot(evaluation.horizon, forces[column] / 1000.0, **drawing.line(model.name))
        ends[model.name] = (np.degrees([s[-1] for s in slips]), np.array([f[-1] for f in forces]))
    for column, axle in enumerate(AXLES):
        for axes in grid[:, column]:
            axes.axhline(0, color=TEXT, lw=0.6)
        grid[0, column].set_title(f"{axle} axle", fontsize=9)
        grid[1, column].set_xlabel("horizon, s")
    grid[1, 0].set_xlim(0, evaluation.horizon[-1])
    grid[0, 0].set_ylabel("slip angle, °\n(+ = slides to the left)")
    grid[1, 0].set_ylabel("lateral force of the axle, kN\n(+ = to the left)")
    measured_line = Line2D([], [], color=MEASURED_COLOUR, lw=1.0, label="from the measured motion")
    legend(figure, drawing, [measured_line], models=models)
    title = f"{drawing.name} from {evaluation.time[row]:.1f} s: {_finding(models, ends)}"
    peak = np.degrees(np.nanmax(np.abs(measured_slip)))
    caption = (f"Slip angles and forces that the models predict with the measured inputs; measured slip angles reach "
               f"{peak:.1f}°. The start: the one asked for, else that of the largest lateral acceleration.")
    return finish(figure, drawing.place, "slip_and_forces", title, caption)


def _slip_angles(model: Model, vehicle: VehicleParameters, states: np.ndarray, angle: np.ndarray,
                 acceleration: np.ndarray) -> tuple[tuple, tuple]:
    """((front, rear) slip angles [rad], (front, rear) axle forces [N]) of a model in states (n, 6)."""
    p = model.parameters(vehicle)
    w = model.inputs(angle, acceleration, p)
    assert model.axles is not None  # those without are not drawn
    front, rear = model.axles.slip_angles(tuple(states.T), w, p)
    return (front, rear), model.axles.forces(front, rear, w, p)


def _start(drawing: Drawing) -> int | None:
    """The start asked for, if it is just one; else where the lateral acceleration over the horizon is largest."""
    rows = chosen_starts(drawing.evaluation, drawing.starts)
    if not len(rows):
        return None
    if len(drawing.starts) == 1:
        return int(rows[0])
    lateral = np.abs(drawing.evaluation.conditions["lateral_acceleration"])
    return int(np.where(complete_in_all(drawing.evaluation), lateral, -1.0).argmax())


def _finding(models: Sequence[Model], ends: dict[str, tuple[np.ndarray, np.ndarray]]) -> str:
    if len(models) < 2:
        slips, forces = ends[models[0].name]
        kilonewton = forces.sum() / 1000.0
        return f"{models[0].name} ends at {slips[0]:.1f}° in front and {slips[1]:.1f}° behind, {kilonewton:.1f} kN"
    (slip_a, force_a), (slip_b, force_b) = (ends[m.name] for m in models[:2])
    degrees, newton = np.abs(slip_b) - np.abs(slip_a), np.abs(force_b) - np.abs(force_a)
    parts = [f"{d:+.2f}° and {n:+.0f} N {where}" for d, n, where in zip(degrees, newton, AXLES, strict=True)]
    return f"{models[1].name} ends {', '.join(parts)} from {models[0].name}"
