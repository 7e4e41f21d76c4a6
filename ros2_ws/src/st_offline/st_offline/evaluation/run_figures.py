"""The figures of one run: segments, errors over time, slip and forces, error against horizon and acceleration."""

import math

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.lines import Line2D
from st_core.evaluation import Mode
from st_core.log_evaluation import LogEvaluation, evaluate_blocks
from st_core.palette import MEASURED_COLOUR
from st_core.readings import readings

from .beside import beside
from .drawing import TEXT, WIDTH, Drawn, broken, finish, style, thinned
from .run_drawing import Drawing, chosen_starts, legend
from .slip_figure import slip

SIDE = {"longitudinal": "ahead", "lateral": "left"}
AXIS_LABEL = {axis: f"{axis} error, m\n(+ = predicted {side})" for axis, side in SIDE.items()}
NOTICEABLE = 0.5  # m; half of what is left of a lane beside a car


def run_figures(drawing: Drawing) -> list[Drawn]:
    """All figures that this run has data for."""
    if not any(e.n_starts for e in drawing.evaluation.errors.values()):
        return []
    first, others = (segments, horizon_means), (slip, error_against_horizon, error_against_acceleration)
    with style(), beside(lambda: [make(drawing) for make in others]) as rest:
        drawn = [make(drawing) for make in first] + rest()
    return [figure for figure in drawn if figure is not None]


def segments(drawing: Drawing) -> Drawn | None:
    """Measured and predicted paths from a few starts, and the errors over those horizons: the paper's first figure."""
    evaluation = drawing.evaluation
    rows = chosen_starts(evaluation, drawing.starts)
    if not len(rows):
        return None
    starts, length = evaluation.starts_ns[rows], float(evaluation.horizon[-1])
    _, block = next(evaluate_blocks(drawing.models, drawing.vehicle, drawing.signals, starts, evaluation.settings))
    figure = plt.figure(figsize=(WIDTH, 5.9))
    layout = figure.add_gridspec(3, len(rows), height_ratios=(1.75, 1, 1))
    first: list[plt.Axes | None] = [None, None]
    for column, (row, start_ns) in enumerate(zip(rows, starts, strict=True)):
        axes = figure.add_subplot(layout[0, column])
        _measured_path(axes, drawing, start_ns, length)
        for model in drawing.models:
            states = tuple(block.trajectories[model.name, "hindsight"][column].T)
            seen = readings(model, drawing.vehicle, states)
            axes.plot(seen.x, seen.y, **drawing.line(model.name))
        axes.set_title(f"$t_0$ = {evaluation.time[row]:.1f} s, {evaluation.conditions['speed'][row]:.1f} m/s",
                       fontsize=9)
        axes.set(xlabel="east, m", ylabel="" if column else "north, m")
        for k, axis in ((0, "longitudinal"), (1, "lateral")):
            axes = figure.add_subplot(layout[1 + k, column], sharey=first[k])
            first[k] = first[k] or axes
            axes.axhline(0, color=TEXT, lw=0.6)
            for model in drawing.models:
                errors = block.errors[model.name, "hindsight"][column]
                axes.plot(evaluation.horizon, errors[:, k], **drawing.line(model.name))
            axes.set(xlim=(0, length), ylabel="" if column else f"{axis}, m\n(+ = {SIDE[axis]})",
                     xlabel="horizon, s" if k else "")
            axes.tick_params(labelleft=not column)
    legend(figure, drawing, [Line2D([], [], color=MEASURED_COLOUR, lw=5, alpha=0.45, label="measured, the horizon")])
    ends = {m.name: float(np.linalg.norm(block.errors[m.name, "hindsight"][:, -1, :2], axis=1).max())
            for m in drawing.models}
    worst = ", ".join(f"{model} {value:.2f} m" for model, value in ends.items())
    these = "these starts" if len(rows) > 1 else "this start"
    title = f"{drawing.name}: largest distance after {length:g} s from {these}: {worst}"
    caption = ("Predictions with the measured inputs (hindsight) from chosen starts, and their errors over the "
               "horizon, along and across the measured heading.")
    return finish(figure, drawing.place, "segments", title, caption)


def _measured_path(axes: plt.Axes, drawing: Drawing, start_ns: int, length: float) -> None:
    log, span = drawing.signals.log, round(length * 1e9)
    inside = slice(*np.searchsorted(log.ins_time_ns, (start_ns, start_ns + span)))
    around = slice(*np.searchsorted(log.ins_time_ns, (start_ns - span, start_ns + 2 * span)))
    x, y = log.x[inside], log.y[inside]
    half = 0.5 * max(np.ptp(x), np.ptp(y)) * 1.15 + 2.0
    middle = 0.5 * (x.min() + x.max()), 0.5 * (y.min() + y.max())
    near = (np.abs(log.x - middle[0]) < half) & (np.abs(log.y - middle[1]) < half)
    shown = np.flatnonzero(near)[:: max(1, int(near.sum()) // 400)]
    passes = np.flatnonzero(np.diff(np.cumsum(~near)[shown])) + 1  # it was elsewhere in between
    axes.plot(*(np.insert(v[shown], passes, np.nan) for v in (log.x, log.y)), color=MEASURED_COLOUR, lw=0.8, alpha=0.5)
    every = max(1, len(log.x[around]) // 200)
    axes.plot(log.x[around][::every], log.y[around][::every], color=MEASURED_COLOUR, lw=1.2)
    every = max(1, len(x) // 100)
    axes.plot(x[::every], y[::every], color=MEASURED_COLOUR, lw=5, alpha=0.45, solid_capstyle="butt")
    axes.plot(x[:1], y[:1], "o", ms=4, color=TEXT, zorder=5)
    axes.set_aspect("equal", adjustable="box")
    axes.set(xlim=(middle[0] - half, middle[0] + half), ylim=(middle[1] - half, middle[1] + half))


def horizon_means(drawing: Drawing) -> Drawn:
    """Horizon-mean errors of all models over the start time, and the speed then: the paper's second figure."""
    evaluation = drawing.evaluation
    figure, (upper, lower, context) = plt.subplots(
        3, 1, figsize=(WIDTH, 5.2), height_ratios=(1.3, 1.3, 0.9), sharex=True)
    for axes, k, axis in ((upper, 0, "longitudinal"), (lower, 1, "lateral")):
        axes.axhline(0, color=TEXT, lw=0.6)
        for model in drawing.models:
            line = evaluation.errors[model.name, "hindsight"].mean[:, k]
            # Linear and nonlinear often lie on each other: the wider one shows on both sides.
            width = 2.4 if model.name == "linear" else 1.0
            axes.plot(*_over_time(evaluation, line), color=drawing.colour(model.name), lw=width)
        axes.set_ylabel(AXIS_LABEL[axis])
    speed, lateral = evaluation.conditions["speed"], evaluation.conditions["lateral_acceleration"]
    context.plot(*_over_time(evaluation, speed), color=TEXT, lw=1.0)
    context.plot(*_over_time(evaluation, lateral), color=MEASURED_COLOUR, lw=1.0)
    context.set_ylabel("mean over the\nhorizon, m/s, m/s²")
    context.set_xlabel("start of the prediction $t_0$, s after the first INS measurement")
    extra = [Line2D([], [], color=TEXT, lw=1.0, label="speed, m/s"),
             Line2D([], [], color=MEASURED_COLOUR, lw=1.0, label="lateral acceleration, m/s² (+ = left)")]
    legend(figure, drawing, extra, solid=True)
    length = evaluation.horizon[-1]
    title = f"{drawing.name}: {ranking(evaluation, 'lateral')}"
    caption = f"Error averaged over each {length:g} s horizon (hindsight: measured inputs), over the time it starts."
    return finish(figure, drawing.place, "horizon_means", title, caption)


def _over_time(evaluation: LogEvaluation, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return broken(*thinned(evaluation.time, values), gap=max(1.0, 3.0 * float(np.ptp(evaluation.time)) / 600.0))


def error_against_horizon(drawing: Drawing) -> Drawn:
    """Root mean square error at each point of the horizon, hindsight and forecast."""
    evaluation = drawing.evaluation
    lines: tuple[tuple[Mode, float, float], ...] = ("hindsight", 1.6, 1.0), ("forecast", 0.9, 0.7)
    figure, panels = plt.subplots(1, 2, figsize=(WIDTH, 3.4))
    for axes, k, axis in zip(panels, (0, 1), ("longitudinal", "lateral"), strict=True):
        for model in drawing.models:
            for mode, width, alpha in lines:
                line = drawing.line(model.name) | ({"ls": ":"} if mode == "forecast" else {})
                profile = evaluation.errors[model.name, mode].profile_rmse[:, k]
                axes.plot(evaluation.horizon, profile, **line, lw=width, alpha=alpha)
        # The forecast's guess at the driver is many times the model's own error: a logarithm keeps both in sight.
        axes.set_yscale("log")
        axes.set_ylim(bottom=0.01)
        axes.set(xlim=(0, evaluation.horizon[-1]), xlabel="horizon, s", ylabel=f"{axis} RMSE, m")
        axes.yaxis.set_major_formatter("{x:g}")
    legend(figure, drawing, [Line2D([], [], color=TEXT, lw=0.9, ls=":", label="forecast: inputs held")])
    parts = []
    for model in drawing.models:
        profile = evaluation.errors[model.name, "hindsight"].profile_rmse[:, 1]
        beyond = np.flatnonzero(profile > NOTICEABLE)
        parts.append(f"{model.name} " + (f"after {evaluation.horizon[beyond[0]]:.1f} s" if len(beyond) else "never"))
    title = f"{drawing.name}: lateral RMSE exceeds {NOTICEABLE:g} m in hindsight: {', '.join(parts)}"
    caption = ("RMSE over all starts at each point of the horizon. Hindsight: measured inputs, what the model is to "
               "blame for. Forecast: inputs held, what a planner has.")
    return finish(figure, drawing.place, "error_against_horizon", title, caption)


def error_against_acceleration(drawing: Drawing) -> Drawn:
    """Horizon means against the mean lateral acceleration of the horizon: points, and their median in steps."""
    evaluation = drawing.evaluation
    lateral = evaluation.conditions["lateral_acceleration"]
    figure, panels = plt.subplots(1, 2, figsize=(WIDTH, 3.6))
    largest: dict[str, tuple[float, float]] = {}
    for axes, k, axis in zip(panels, (0, 1), ("longitudinal", "lateral"), strict=True):
        axes.axhline(0, color=TEXT, lw=0.6)
        for model in drawing.models:
            errors = evaluation.errors[model.name, "hindsight"]
            value = errors.mean[:, k]
            known = np.flatnonzero(errors.complete)
            shown = known[:: max(1, len(known) // 1000)]
            # As pixels: a thousand points as shapes would be most of the page.
            axes.plot(lateral[shown], value[shown], ".", ms=3, alpha=0.3, color=drawing.colour(model.name), mew=0,
                      rasterized=True)
            middles, medians = _medians(lateral[known], value[known])
            axes.plot(middles, medians, **drawing.line(model.name), lw=1.6)
            if axis == "lateral" and len(medians):
                at = int(np.abs(medians).argmax())
                largest[model.name] = (float(medians[at]), float(middles[at]))
        axes.set(xlabel="mean lateral acceleration, m/s² (+ = left)", ylabel=AXIS_LABEL[axis])
    legend(figure, drawing, [Line2D([], [], color=TEXT, marker=".", ls="", ms=4, label="one start")])
    parts = [f"{model} {value:+.2f} m at {at:+.1f} m/s²" for model, (value, at) in largest.items()]
    title = f"{drawing.name}: largest median lateral error: {', '.join(parts)}"
    caption = "Horizon means in hindsight; the lines are medians of steps of 0.5 m/s² that hold at least five starts."
    return finish(figure, drawing.place, "error_against_acceleration", title, caption)


def _medians(x: np.ndarray, y: np.ndarray, width: float = 0.5, least: int = 5) -> tuple[np.ndarray, np.ndarray]:
    steps = np.round(x / width).astype(int)
    found = [(s * width, np.median(y[steps == s])) for s in np.unique(steps) if (steps == s).sum() >= least]
    return np.array([f[0] for f in found]), np.array([f[1] for f in found])


def ranking(evaluation: LogEvaluation, axis: str) -> str:
    """One sentence: RMSE of every model in hindsight, the best first, and how much worse the worst is."""
    values = sorted((evaluation.errors[m, "hindsight"].statistics(axis)[2], m) for m in evaluation.models)
    values = [(v, m) for v, m in values if math.isfinite(v)]
    if not values:
        return "no complete horizon"
    text = f"{axis} RMSE of the horizon means: " + ", ".join(f"{m} {v:.2f} m" for v, m in values)
    ratio = values[-1][0] / max(values[0][0], 1e-6)
    return text + (f" ({ratio:.1f} times)" if len(values) > 1 and ratio > 1.15 else "")
