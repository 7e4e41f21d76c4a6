"""Experiments of `st identify` on recorded drives: steering, INS mounting, cornering stiffness, yaw inertia."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from scipy.stats import chi2
from st_core.errors import ConfigurationError
from st_core.identification.axle_forces import identify_stiffness
from st_core.identification.driving_prediction import fit_stiffness, identify_steering, identify_yaw_inertia
from st_core.identification.ins_mounting import identify_ins_mounting
from st_core.identification.result import Identification, IdentificationError, ParameterEstimate, describe_contradiction
from st_core.identification.steering import identify_steering_offset
from st_core.log import DriveLog
from st_core.models import MODELS, Model
from st_core.palette import MEASURED_COLOUR, MODEL_COLOUR
from st_core.vehicle import VehicleParameters
from st_recordings.runs import find_runs
from st_recordings.runs.errors import join_problems

from ..discovery.drives import read_drives
from ..evaluation.drawing import TEXT_COLOUR, WIDTH, FigureOutput, PageFigure, save_figure
from .experiment import Experiment, IdentificationJob, format_rounded

MAX_POINTS = 4000  # in a scatter plot; more points would only overlap
PAPER_COLOUR, FIT_COLOUR = MODEL_COLOUR["linear"], MODEL_COLOUR["augmented"]
DEG = np.rad2deg(1.0)
DISPLAY_UNITS = {"rad": (DEG, "deg"), "N/rad": (1e-3, "kN/rad")}
MAX_DISAGREEMENT = 0.15  # between two stiffness estimates, relative to that from the regression of the paper
STIFFNESS_ADVICE = "Steering ratio or lever arm may be wrong: run `st identify steering` and `st identify ins` first."


def draw_offset(outcome: Identification, output: FigureOutput) -> PageFigure:
    """Draw the steering offset in each straight window, its two estimates, and the residuals of the yaw rate."""
    data = outcome.figure
    figure, (left, right) = plt.subplots(1, 2, figsize=(WIDTH, 3.4), width_ratios=(2, 1))
    time = _concatenate_times(data["run"], data["time"])
    left.plot(time, data["offset"] * DEG, ".", color=MEASURED_COLOUR, ms=4, label="steady straight window")
    for estimate, colour, label in ((outcome.estimates[0], PAPER_COLOUR, "yaw rate (paper)"),
                                    (outcome.estimates[1], FIT_COLOUR, "mean of windows")):
        left.axhspan(*(np.array(estimate.interval95) * DEG), color=colour, alpha=0.25, lw=0)
        left.axhline(estimate.value * DEG, color=colour, label=label)
    left.set(xlabel="driving time, s (straights of all runs)", ylabel="sensor reading on straights, deg")
    right.hist(data["residual_yaw_rate"] * DEG, 40, color=MEASURED_COLOUR)
    right.set(xlabel="simulated minus measured\nyaw rate, deg/s", ylabel="predictions")
    first, second = (e.value * DEG for e in outcome.estimates[:2])
    return save_figure(figure, output, "steering-offset",
                       f"Steering offset {first:.2f} deg from the yaw rate, {second:.2f} deg from the mean reading",
                       "Bands: 95 % intervals. Right: residuals of the yaw rate.")


def draw_mounting(outcome: Identification, output: FigureOutput) -> PageFigure:
    """Draw v_y / v_x, corrected for slip, versus curvature, and the residuals of the fitted line."""
    data = outcome.figure
    figure, (left, right) = plt.subplots(1, 2, figsize=(WIDTH, 3.6))
    subset = _thin_rows(len(data["curvature"]))
    for index, name in enumerate(names := data["names"]):
        indices = subset[data["run"][subset] == index]
        left.plot(data["curvature"][indices], data["velocity_ratio"][indices], ".", ms=2.5,
                  color=plt.get_cmap("cividis")(index / len(names)), label=name if len(names) <= 8 else None)
    ends = np.array([data["curvature"].min(), data["curvature"].max()])
    left.plot(ends, data["theta"][0] + data["theta"][1] * ends, color=TEXT_COLOUR, lw=1, label="fit")
    left.set(xlabel="yaw rate / forward velocity, 1/m (positive to the left)",
             ylabel="lateral / forward velocity, slip removed")
    left.legend(markerscale=3, fontsize=7)
    right.plot(data["speed"][subset], data["residual"][subset] * 1e3, ".", color=MEASURED_COLOUR, ms=2.5)
    right.axhline(0.0, color=TEXT_COLOUR, lw=0.8)
    right.set(xlabel="forward velocity, m/s", ylabel="residual, mm/s")
    lever, angle = outcome["cg_to_ins_x"], outcome["ins_misalignment"]
    distance, side = replace(lever, value=abs(lever.value)), "behind" if lever.value < 0.0 else "ahead of"
    title = f"INS {_format_value(distance)} {side} the CG, misaligned by {_format_value(angle)}"
    caption = ("The slope of the line is the distance of the INS ahead of the rear axle; its value at zero "
               "curvature is the misalignment with the opposite sign.")
    return save_figure(figure, output, "ins", title, caption)


def draw_stiffness(outcome: Identification, output: FigureOutput) -> PageFigure:
    """Draw axle force versus slip angle, if the regression succeeded, and the joint region of a fit by prediction."""
    paper = outcome.figure.get("paper")
    values = ", ".join(f"{axle} {_format_value(outcome[f'cornering_stiffness_{axle}'])}" for axle in ("front", "rear"))
    if outcome.experiment == "stiffness-paper":
        figure, panels = plt.subplots(1, 2, figsize=(WIDTH, 3.6))
        _draw_force_and_slip(panels, outcome, (outcome,))
        caption = "Dots: force and slip angle of the axle from force and moment balance, up to 2 deg of slip."
        return save_figure(figure, output, outcome.experiment, f"Cornering stiffness {values} by regression", caption)
    if paper:
        figure, (*force_panels, region_panel) = plt.subplots(1, 3, figsize=(WIDTH, 3.6), width_ratios=(1.2, 1.2, 1))
        _draw_force_and_slip(force_panels, paper, (paper, outcome))
        caption = ("Left: force and slip as in the paper, with the fitted slopes. Right: 95 % intervals and joint 95 % "
                   "region of the fit.")
    else:
        figure, region_panel = plt.subplots(figsize=(WIDTH, 3.6))
        caption = "95 % intervals and joint 95 % region of the fit."
    _draw_region(region_panel, outcome, outcome.estimates[:2])
    for source, colour, label in ((outcome, FIT_COLOUR, "prediction"), (paper, PAPER_COLOUR, "regression (paper)")):
        if source and np.isfinite([e.value for e in source.estimates[:2]]).all():
            front, rear = source.estimates[:2]
            region_panel.errorbar(
                front.value * 1e-3, rear.value * 1e-3, fmt="o", color=colour, mec=TEXT_COLOUR, label=label, zorder=3,
                **{f"{axis}err": np.abs(np.array(e.interval95) - e.value)[:, None] * 1e-3
                   for axis, e in (("x", front), ("y", rear))})
    region_panel.set(xlabel="front, kN/rad", ylabel="rear, kN/rad")
    region_panel.legend(loc="lower right", fontsize=8)
    return save_figure(figure, output, "stiffness", f"Cornering stiffness {values} by prediction", caption)


def draw_prediction(outcome: Identification, output: FigureOutput) -> PageFigure:
    """Draw the residuals of a fit by prediction, and the joint 95 % region of its first parameter and the parameter
    most correlated with it."""
    data, first = outcome.figure, outcome.estimates[0]
    axis_labels = (("yaw_rate", "yaw rate error, deg/s", DEG), ("velocity_y", "lateral velocity error, mm/s", 1e3))
    channels = [channel for channel in axis_labels if channel[0] in data["residuals"]]  # those that were measured
    figure, panels = plt.subplot_mosaic([[key, "region"] for key, *_ in channels], figsize=(WIDTH, 4.2),
                                        width_ratios=(1.5, 1))
    time = _concatenate_times(data["residual_run"], data["residual_time"])
    subset = _thin_rows(len(time))
    run_starts = time[np.unique(data["residual_run"], return_index=True)[1]]
    for key, label, factor in channels:
        axes = panels[key]
        for run_start in run_starts[1:]:
            axes.axvline(run_start - 1.0, color=TEXT_COLOUR, lw=0.6, ls=":")
        axes.plot(time[subset], data["residuals"][key][subset] * factor, ".", ms=1.5, color=MEASURED_COLOUR)
        axes.axhline(0.0, color=TEXT_COLOUR, lw=0.8)
        axes.set_ylabel(label)
        axes.tick_params(labelbottom=key == channels[-1][0])
    panels[channels[-1][0]].set_xlabel("driving time, s (all runs)")
    index = 1 if outcome.correlation is None else 1 + int(np.argmax(np.abs(outcome.correlation[0, 1:])))
    second = outcome.estimates[index]
    region_panel = panels["region"]
    _draw_region(region_panel, outcome, (first, second))
    bars: dict[str, Any] = {}
    for axis, e in (("x", first), ("y", second)):
        factor, unit = _get_display_unit(e)
        bars |= {axis: e.value * factor, f"{axis}err": np.abs(np.array(e.interval95) - e.value)[:, None] * factor}
        region_panel.set(**{f"{axis}label": e.parameter.replace("_", " ") + (f", {unit}" if unit != "1" else "")})
    region_panel.errorbar(**bars, fmt="o", ms=4, color=TEXT_COLOUR, label="95 % interval")
    region_panel.legend(fontsize=8)
    title = "; ".join(f"{e.parameter.replace('_', ' ')} {_format_value(e)}" for e in (first, second))
    caption = ("Left: predicted minus measured values, with dotted lines between runs. Right: the first parameter "
               "and the one most correlated with it; the intervals include systematic uncertainty.")
    return save_figure(figure, output, outcome.experiment, title, caption)


def _draw_force_and_slip(panels: Sequence[plt.Axes], points: Identification, lines: Sequence[Identification]) -> None:
    for axes, axle in zip(panels, ("front", "rear"), strict=True):
        slip, force = points.figure[f"slip_{axle}"], points.figure[f"force_{axle}"]
        subset = _thin_rows(len(slip))
        axes.plot(slip[subset] * DEG, force[subset] * 1e-3, ".", color=MEASURED_COLOUR, ms=2)
        # Each line passes through the mean of the samples, which an offset of steering or INS shifts from the origin.
        middle, ends = slip.mean(), np.array([slip.min(), slip.max()])
        styles = ((PAPER_COLOUR, "regression (paper)"), (FIT_COLOUR, "prediction"))
        for line, (colour, label) in zip(lines, styles, strict=False):
            estimate = line[f"cornering_stiffness_{axle}"]
            if not np.isfinite(estimate.value):
                continue
            axes.plot(ends * DEG, (force.mean() - estimate.value * (ends - middle)) * 1e-3, color=colour,
                      label=f"{label}: {estimate.value * 1e-3:.1f} kN/rad")
        axes.set(xlabel=f"{axle} slip angle, deg (positive: slides to the left)",
                 ylabel=f"{axle} axle force, kN (positive to the left)")
        axes.legend(fontsize=8)


def _draw_region(axes: plt.Axes, outcome: Identification, pair: Sequence[ParameterEstimate]) -> None:
    """Draw the joint 95 % region of two estimates from the covariance of the fit."""
    data, names = outcome.figure, [e.parameter for e in pair]
    index = [data["names"].index(name) for name in names]
    values, directions = np.linalg.eigh(data["covariance"][np.ix_(index, index)])
    size = directions * np.sqrt(chi2.ppf(0.95, 2) * np.maximum(values, 0.0))
    angle = np.linspace(0.0, 2.0 * np.pi, 121)
    x, y = size @ np.stack([np.cos(angle), np.sin(angle)])
    x_factor, y_factor = (_get_display_unit(estimate)[0] for estimate in pair)
    axes.plot((pair[0].value + x) * x_factor, (pair[1].value + y) * y_factor, color=FIT_COLOUR, lw=1,
              label="95 % region")


def _thin_rows(count: int) -> np.ndarray:
    return np.arange(0, count, max(1, -(-count // MAX_POINTS)))


def _concatenate_times(run: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Time axis [s] on which the runs follow each other, 2 s apart."""
    result, start = np.zeros(len(time)), 0.0
    for index in np.unique(run):
        mask = run == index
        result[mask] = start + time[mask] - time[mask].min()
        start = float(result[mask].max()) + 2.0
    return result


def _get_display_unit(estimate: ParameterEstimate) -> tuple[float, str]:
    return DISPLAY_UNITS.get(estimate.unit, (1.0, estimate.unit))


def _format_value(estimate: ParameterEstimate) -> str:
    """Value and half-width of its 95 % interval, angles in degrees, and its status if it is not identified."""
    factor, unit = _get_display_unit(estimate)
    low, high = estimate.interval95
    value, half_width = estimate.value * factor, 0.5 * (high - low) * factor
    text = f"{format_rounded(value, half_width)} ± {format_rounded(half_width, half_width)}"
    status = "" if estimate.status == "identified" else f", {estimate.status}"
    return f"{text if unit == '1' else f'{text} {unit}'} (95 %{status})"


def make_drive_experiment(name: str, description: str, driving: str, compute: Callable[..., Identification],
                          draw: Callable[[Identification, FigureOutput], PageFigure],
                          uses_model: bool = False) -> Experiment:
    """Experiment on recorded drives. driving: required manoeuvres and speeds. compute: called with (logs, vehicle) and,
    if `uses_model`, with the model as keyword argument `base`."""
    def identify(job: IdentificationJob) -> tuple[Identification, ...]:
        if not uses_model and job.model is not MODELS["nonlinear"]:
            raise IdentificationError(f"{name} uses no model: remove --model")
        drives = read_drives(find_runs(job.files), job.vehicle, job.read_settings, 1, lambda: None, job.force)
        problems = {d.name: d.problem for d in drives if d.log is None}
        usable_drives = [d for d in drives if d.log is not None]
        if not usable_drives:
            raise ConfigurationError("no run can be used: " + join_problems(problems.values()))
        outcome = compute([d.log for d in usable_drives], job.vehicle, **({"base": job.model} if uses_model else {}))
        warnings = dict.fromkeys(text for d in usable_drives for text in d.metadata["warnings"])  # each once, in order
        return (replace(outcome, experiment=name, rejected_data=(*problems.items(), *outcome.rejected_data),
                        warnings=(*outcome.warnings, *warnings),
                        findings={d.name: d.findings for d in drives if d.log is not None or d.findings}),)

    return Experiment(name, description, f"recorded drives: {driving}", identify, draw, uses_recordings=True)


def compare_stiffness(logs: Sequence[DriveLog], vehicle: VehicleParameters, base: Model) -> Identification:
    """Fit the stiffnesses by prediction; a value that differs from the paper's regression significantly and by more
    than MAX_DISAGREEMENT has the status "doubtful"."""
    outcome = fit_stiffness(logs, vehicle, base)
    try:
        paper = identify_stiffness(logs, vehicle)
    except IdentificationError as error:
        return replace(outcome, warnings=(*outcome.warnings, f"The paper's regression failed: {error}"))
    estimates, comparisons = [], []
    for predicted in outcome.estimates:
        estimate, name, regression = predicted, predicted.parameter, paper[predicted.parameter]
        if regression.status == "unidentifiable":
            text = f"The paper's regression did not identify {name}: {regression.verdict}"
        elif text := describe_contradiction(estimate, regression.value, regression.standard_uncertainty,
                                            "the paper's regression"):
            # The regression averages over the nonlinear force curve, so a difference of a few per cent is expected.
            if abs(estimate.value - regression.value) > MAX_DISAGREEMENT * regression.value:
                text += f" {STIFFNESS_ADVICE}"
                verdict = f"{estimate.verdict} Doubtful: {STIFFNESS_ADVICE}"
                estimate = replace(estimate, status="doubtful", verdict=verdict)
        else:
            text = (f"The paper's regression agrees: {name} {regression.value:.0f} N/rad (standard uncertainty "
                    f"{regression.standard_uncertainty:.0f}).")
        estimates.append(estimate)
        comparisons.append(text)
    return replace(outcome, estimates=tuple(estimates), warnings=(*outcome.warnings, *comparisons),
                   figure={**outcome.figure, "paper": paper})


DRIVE_EXPERIMENTS = (
    make_drive_experiment("steering-offset", "offset of the steering wheel sensor, by two methods",
                          "straight driving above 5 m/s", identify_steering_offset, draw_offset),
    make_drive_experiment("steering", "steering ratio and offset, without turntables",
                          "bends and straights at several speeds", identify_steering, draw_prediction, uses_model=True),
    make_drive_experiment("ins", "lever arm and misalignment of the INS",
                          "1.5 to 9 m/s, straights and bends to both sides", identify_ins_mounting, draw_mounting),
    make_drive_experiment("stiffness", "cornering stiffnesses, by prediction", "bends to both sides, up to 4 m/s^2",
                          compare_stiffness, draw_stiffness, uses_model=True),
    make_drive_experiment("stiffness-paper", "cornering stiffnesses, by the regression of the paper",
                          "bends to both sides", identify_stiffness, draw_stiffness),
    make_drive_experiment("yaw-inertia", "yaw inertia", "steering steps, lane changes, steering sweeps",
                          identify_yaw_inertia, draw_prediction, uses_model=True),
)
