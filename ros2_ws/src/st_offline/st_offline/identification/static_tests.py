"""Experiments of `st identify` without driving: scales, turntables, axle lift, flat-plank tyre tests."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from st_core.identification import mass_and_cg
from st_core.identification.magic_formula import FlatPlank, fit_tyre, identify_lambda_ky, identify_magic_formula
from st_core.identification.mass_and_cg import LiftRows, compute_pitch, identify_cg_height
from st_core.identification.result import Identification
from st_core.identification.steering import Turntable, identify_steering_ratio
from st_core.palette import MEASURED_COLOUR, MODEL_COLOUR
from st_core.regression import Z95
from st_core.vehicle import TYRES
from st_recordings.runs.errors import RunError

from ..evaluation.drawing import TEXT_COLOUR, WIDTH, FigureOutput, PageFigure, save_figure
from .experiment import Experiment, IdentificationJob, MeasurementTable, read_tables

LIFT_COLUMNS = {"front_radius": ("m", "mm"), "rear_radius": ("m", "mm"), "pitch": ("deg", "rad"), "lift": ("m", "mm"),
                "car_mass": ("kg",)}  # optional
TYRE_COLUMNS = {"load": ("n", "kn"), "slip_angle": ("deg", "rad"), "lateral_force": ("n", "kn")}
# The first three colours are those of the paper, darkened for a white background.
LOAD_COLOURS = ("#3baa32", "#1792b5", "#d1048b", "#8c6d1f", "#5a5a5a", "#7e2f8e")


def identify_scales(job: IdentificationJob) -> tuple[Identification, ...]:
    """Identify mass and CG position; each row of the files is one weighing."""
    table = read_tables(job.files, dict.fromkeys(mass_and_cg.WHEELS, ("kg",)), {"scale_uncertainty": ("kg",)},
                        ("weighing", "driver", "payload"))
    texts = table.texts
    names = (f"{file.name}:{label or row}" for (file, row), label in zip(table.rows, texts["weighing"], strict=True))
    loads = (", ".join(filter(None, notes)) for notes in zip(texts["driver"], texts["payload"], strict=True))
    uncertainties = set(np.nan_to_num(table.numbers["scale_uncertainty"], nan=mass_and_cg.SCALE_UNCERTAINTY).tolist())
    if len(uncertainties) > 1:
        raise RunError(job.files[0], f"scale_uncertainty_kg has several values: {sorted(uncertainties)}",
                       "give the same value in every row")
    readings = np.stack([table.numbers[wheel] for wheel in mass_and_cg.WHEELS], axis=1)
    weighings = mass_and_cg.Weighings(readings, tuple(names), tuple(loads), uncertainties.pop())
    return (mass_and_cg.identify_mass_and_cg(weighings, job.vehicle),)


def draw_scales(outcome: Identification, output: FigureOutput) -> PageFigure:
    """Draw mass and CG position of each weighing, with the estimates and their 95 % intervals."""
    data = outcome.figure
    rows = np.arange(len(data["names"]))
    figure, panels = plt.subplots(1, 2, figsize=(WIDTH, 1.6 + 0.3 * len(rows)), sharey=True)
    for axes, key, values, label in ((panels[0], "mass", data["masses"], "mass, kg"),
                                     (panels[1], "cg_to_front_axle", data["distances"], "CG behind front axle, m")):
        estimate = outcome[key]
        axes.axvspan(*estimate.interval95, color=MODEL_COLOUR["augmented"], alpha=0.2, lw=0, label="95 % interval")
        axes.axvline(estimate.value, color=MODEL_COLOUR["augmented"], label="estimate")
        used = data["is_used"]
        axes.plot(values[used], rows[used], "o", color=TEXT_COLOUR, ms=5, label="weighing")
        axes.plot(values[~used], rows[~used], "x", color=MEASURED_COLOUR, ms=6, label="" if used.all() else "left out")
        axes.set_xlabel(label)
        axes.ticklabel_format(useOffset=False)
        axes.grid(axis="y", visible=False)
    panels[0].set_yticks(rows, data["names"])
    panels[0].set_ylim(len(rows) - 0.5, -0.5)
    caption = "One point per weighing. The interval includes their scatter and the uncertainty of the scales."
    title = f"{outcome['mass'].verdict} {outcome['cg_to_front_axle'].verdict}"
    return save_figure(figure, output, "scales", title, caption)


SCALES = Experiment("scales", "mass and CG position from four wheel scales",
                    "CSV: front_left_kg, front_right_kg, rear_left_kg, rear_right_kg; one row per weighing",
                    identify_scales, draw_scales)


def identify_ratio(job: IdentificationJob) -> tuple[Identification, ...]:
    """Identify the steering ratio; each file has one or more sweeps, named in the column `series`."""
    table = read_tables(job.files, dict.fromkeys(("steering_wheel", "left_wheel", "right_wheel"), ("deg", "rad")),
                        texts=("series",))
    steering, left, right = table.numbers.values()
    return (identify_steering_ratio(Turntable(steering, left, right, _name_series(table))),)


def _name_series(table: MeasurementTable) -> tuple[str, ...]:
    return tuple(f"{file.name}:{name or 1}" for (file, _), name in zip(table.rows, table.texts["series"], strict=True))


def draw_ratio(outcome: Identification, output: FigureOutput) -> PageFigure:
    """Draw road-wheel angles versus steering-wheel angle, with the fitted line and its residuals."""
    data, estimate = outcome.figure, outcome.estimates[0]
    steering, sweeps = np.degrees(data["steering"]), np.asarray(data["sweeps"])
    figure, (left, right) = plt.subplots(1, 2, figsize=(WIDTH, 3.2))
    for side, marker in (("left", "<"), ("right", ">")):
        left.plot(steering, np.degrees(data[side]), marker, color=MEASURED_COLOUR, ms=4, mfc="none",
                  label=f"{side} wheel")
    left.plot(steering, np.degrees(data["mean"]), "o", color=TEXT_COLOUR, ms=3.5, label="mean")
    ends = np.array([steering.min(), steering.max()])
    intercept = float(np.degrees(np.mean(list(data["intercepts"].values()))))
    left.plot(ends, intercept + data["slope"] * ends, color=MODEL_COLOUR["augmented"],
              label=f"steering wheel / {estimate.value:.2f}")
    left.set(xlabel="steering-wheel angle, deg (positive to the left)", ylabel="wheel angle, deg")
    for k, name in enumerate(dict.fromkeys(data["sweeps"])):
        mask = sweeps == name
        right.plot(steering[mask], np.degrees(data["residuals"][mask]), "os^Dv<>P"[k % 8], color=TEXT_COLOUR, ms=4.5,
                   mfc="none", label=name)
    if data["significant"]:
        first, last = np.radians(ends)
        grid = np.linspace(first, last, 101)
        curve = data["cubic"][0] * grid + data["cubic"][1] * grid**3
        right.plot(np.degrees(grid), np.degrees(curve), color=MODEL_COLOUR["nonlinear"], label="cubic")
    right.axhline(0.0, color=MODEL_COLOUR["augmented"])
    right.set(xlabel="steering-wheel angle, deg (positive to the left)", ylabel="mean minus line, deg")
    low, high = estimate.interval95
    title = f"Steering ratio {estimate.value:.2f}, 95 % interval {low:.2f} to {high:.2f}"
    return save_figure(figure, output, "steering-ratio", title,
                       "Left: both front wheels, their mean, and the line. Right: residuals of the line.")


STEERING_RATIO = Experiment("steering-ratio", "steering ratio from turntables",
                            "CSV: steering_wheel_deg, left_wheel_deg, right_wheel_deg; positive to the left",
                            identify_ratio, draw_ratio)


def identify_height(job: IdentificationJob) -> tuple[Identification, ...]:
    """Identify the CG height; each file has one or more lifts, named in the column `series`."""
    table = read_tables(job.files, {"rear_left": ("kg",), "rear_right": ("kg",)}, LIFT_COLUMNS, ("series",))
    columns, pitch = table.numbers, table.numbers["pitch"].copy()
    for file in dict.fromkeys(job.files):
        mask = np.array([row_file == file for row_file, _ in table.rows])
        lift, front, rear = (columns[name][mask] for name in ("lift", "front_radius", "rear_radius"))
        if np.isnan(pitch[mask]).all():
            if np.isnan([lift, front, rear]).all(axis=1).any():
                raise RunError(file, "has no values of pitch_deg, and lacks values of lift_m, front_radius_m or "
                               "rear_radius_m", "give pitch, or lift and both radii, in every row")
            pitch[mask] = compute_pitch(lift, front, rear, job.vehicle.wheelbase)
        elif np.isnan(pitch[mask]).any():
            raise RunError(file, "a row has no pitch", "fill that cell, or remove the row")
    masses = set(columns["car_mass"][np.isfinite(columns["car_mass"])].tolist())
    if len(masses) > 1:
        raise RunError(job.files[0], f"car_mass_kg has several values: {sorted(masses)}", "give weighings of one car")
    lifts = LiftRows(pitch, columns["rear_left"] + columns["rear_right"], _name_series(table), columns["front_radius"],
                     columns["rear_radius"])
    return (identify_cg_height(lifts, job.vehicle, masses.pop() if masses else None),)


def draw_height(outcome: Identification, output: FigureOutput) -> PageFigure:
    """Draw rear load versus pitch with the fitted curve, and the CG height computed from each row alone."""
    data, estimate = outcome.figure, outcome.estimates[0]
    pitch, lifts = np.degrees(data["pitch"]), np.asarray(data["lifts"])
    figure, (left, right) = plt.subplots(1, 2, figsize=(WIDTH, 3.2))
    grid = np.linspace(0.0, data["pitch"].max(), 60)
    for k, (name, intercept) in enumerate(data["intercepts"].items()):
        mask = lifts == name
        marker = "os^Dv<>P"[k % 8]
        left.plot(pitch[mask], data["rear_load"][mask], marker, color=TEXT_COLOUR, ms=4.5, mfc="none", label=name)
        left.plot(np.degrees(grid), intercept + data["slope"] * np.tan(grid), color=MODEL_COLOUR["augmented"], lw=1.0)
        right.plot(pitch[mask], data["height_per_row"][mask], marker, color=TEXT_COLOUR, ms=4.5, mfc="none")
    left.set(xlabel="pitch, deg", ylabel="load on the rear wheels, kg")
    left.legend(title="lift", fontsize=8)
    right.axhspan(*estimate.interval95, color=MODEL_COLOUR["augmented"], alpha=0.2, lw=0, label="95 % interval")
    right.axhline(estimate.value, color=MODEL_COLOUR["augmented"], label="fit through all rows")
    right.axhline(data["average"], color=MEASURED_COLOUR, ls="--", label="average over pitch angles")
    right.set(xlim=(0.0, None), xlabel="pitch, deg", ylabel="CG height, m")
    right.legend(fontsize=8)
    low, high = estimate.interval95
    title = f"CG {estimate.value:.3f} m above the ground, 95 % interval {low:.3f} to {high:.3f} m"
    caption = ("Left: rear load, and the fit with the slope m (h - r) / l versus tan(pitch). Right: the height "
               "from each row with a lifted axle.")
    return save_figure(figure, output, "cg-height", title, caption)


CG_HEIGHT = Experiment("cg-height", "CG height from the axle-lift test (ISO 10392)",
                       "CSV: pitch_deg, rear_left_kg, rear_right_kg, front_radius_m, rear_radius_m; one row per "
                       "pitch angle", identify_height, draw_height)


def identify_lambda(job: IdentificationJob) -> tuple[Identification, ...]:
    """Identify the stiffness scale factor lambda_ky. Files: flat-plank tables for the tyre uncertainty, or none."""
    uncertainties = {}
    for table in read_tyre_tables(job.files) if job.files else ():
        axle = table.tyre.removeprefix("tyre_")
        fit = fit_tyre(table, getattr(job.vehicle, table.tyre))
        stiffness, uncertainty = fit.compute_stiffness(getattr(job.vehicle, f"static_tyre_load_{axle}"))
        uncertainties[table.tyre] = uncertainty / abs(stiffness), table.name
    return (identify_lambda_ky(job.vehicle, uncertainties),)


def read_tyre_tables(files: Sequence[Path]) -> list[FlatPlank]:
    """One table for each tyre, from the rows of all files; the column `tyre` contains front or rear."""
    table = read_tables(files, TYRE_COLUMNS, texts=("tyre",))
    for (file, row), axle in zip(table.rows, table.texts["tyre"], strict=True):
        if not axle:
            raise RunError(file, f"has no column tyre, or no tyre in row {row}", "write front or rear in each row")
        if f"tyre_{axle.lower().removeprefix('tyre_')}" not in TYRES:
            raise RunError(file, f"tyre is {axle[:40]!r} in row {row}", "write front or rear")
    tyres = np.array([f"tyre_{axle.lower().removeprefix('tyre_')}" for axle in table.texts["tyre"]])
    names, (load, slip, force) = np.array([file.name for file, _ in table.rows]), table.numbers.values()
    return [FlatPlank(tyre, load[mask], slip[mask], force[mask], ", ".join(dict.fromkeys(names[mask].tolist())))
            for tyre in TYRES if (mask := tyres == tyre).any()]


def draw_tyre(outcome: Identification, output: FigureOutput) -> PageFigure:
    """Draw lateral force and its residuals versus slip angle, and cornering stiffness versus load."""
    data = outcome.figure
    slip = np.degrees(data["slip"])
    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(WIDTH, 3.2), width_ratios=(1.4, 1.0, 1.0))
    for k, load in enumerate(data["levels"]):
        mask, colour = data["level"] == k, LOAD_COLOURS[k % len(LOAD_COLOURS)]
        left.plot(slip[mask], data["force"][mask], "o", color=colour, ms=3)
        left.plot(np.degrees(data["grid"]), data["curves"][k], color=colour, label=f"{load:.0f} N")
        middle.plot(slip[mask], data["residuals"][mask], "o", color=colour, ms=3)
        value, uncertainty = np.abs(data["stiffness"][k])
        right.errorbar(load, value / 1e3, Z95 * uncertainty / 1e3, fmt="o", color=colour, ms=4)
    left.set(xlabel="slip angle, deg (positive: slides to the left)", ylabel="lateral force, N")
    left.legend(title="load", fontsize=8)
    middle.axhline(0.0, color=TEXT_COLOUR, lw=0.8)
    middle.set(xlabel="slip angle, deg", ylabel="fit minus measurement, N")
    right.plot(data["levels"], np.abs(data["stiffness"][:, 0]) / 1e3, color=MODEL_COLOUR["nonlinear"], lw=0.8)
    right.set(ylim=(0.0, None), xlabel="load, N", ylabel="cornering stiffness, kN/rad")
    percentage = 100.0 * np.sqrt(np.mean(data["residuals"] ** 2)) / np.abs(data["force"]).max()
    axle = data["tyre"].removeprefix("tyre_")
    title = f"Magic Formula of the {axle} tyre: RMS residual {percentage:.2f} % of the largest force"
    return save_figure(figure, output, data["tyre"].replace("_", "-"), title,
                       "Points: measured. Lines: Magic Formula. Bars: 95 % interval of the stiffness at zero slip.")


TYRE = Experiment("tyre", "Magic Formula parameters from flat-plank tyre tests",
                  "CSV: tyre (front or rear), load_n, slip_angle_deg, lateral_force_n",
                  lambda job: tuple(identify_magic_formula(table, getattr(job.vehicle, table.tyre))
                                    for table in read_tyre_tables(job.files)), draw_tyre)
LAMBDA = Experiment("lambda", "stiffness scale factor of the Magic Formula, from the cornering stiffness of the axle",
                    "optional: flat-plank tables, for the uncertainty of the tyre", identify_lambda,
                    needs_files=False)
