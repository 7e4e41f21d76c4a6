"""`st identify cg-height`: CG height from lifting the front axle."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from st_core.identification.cg_height import Lift, LiftedCar, cg_height, pitch_from_lift
from st_core.identification.result import Identification
from st_core.palette import MEASURED_COLOUR, MODEL_COLOUR
from st_recordings.runs.errors import RunError

from ..evaluation.drawing import TEXT, WIDTH, Drawn, Place, finish, style
from .columns import Table, read_columns
from .experiment import Experiment, Setup

LOADS = {"rear_left": ("kg",), "rear_right": ("kg",)}
RADII = {"front_radius": ("m", "mm"), "rear_radius": ("m", "mm")}
OTHERS = {"pitch": ("deg", "rad"), "lift": ("m", "mm"), "car_mass": ("kg",)}


def identify(files: Sequence[Path], setup: Setup) -> tuple[Identification, ...]:
    """Each file holds one or several lifts, named in a column `series`."""
    vehicle = setup.vehicle
    parts, names, masses = [], [], set()
    for file in files:
        table = read_columns(file, LOADS, {**RADII, **OTHERS}, ("series",))
        series = table.texts.get("series") or ("1",) * len(table)
        names += [f"{file.name}:{name}" for name in series]
        masses |= set(table.numbers.get("car_mass", np.array([])).tolist()) - {np.nan}
        empty = np.full(len(table), np.nan)
        columns = table.numbers
        parts.append((_pitch(table, vehicle.wheelbase), columns["rear_left"] + columns["rear_right"],
                      *(columns.get(name, empty) for name in RADII)))
    masses = {mass for mass in masses if np.isfinite(mass)}
    if len(masses) > 1:
        raise RunError(files[0], f"car_mass_kg has several values: {sorted(masses)}", "lift one car")
    pitch, load, front, rear = (np.concatenate(column) for column in zip(*parts, strict=True))
    given = masses.pop() if masses else None
    car = LiftedCar(given or vehicle.mass, vehicle.wheelbase, vehicle.cg_to_front_axle,
                    0.0 if given else setup.uncertainty_of("mass"), setup.uncertainty_of("wheelbase"))
    return (cg_height(Lift(pitch, load, tuple(names), front, rear), car),)


def _pitch(table: Table, wheelbase: float) -> np.ndarray:
    columns = table.numbers
    if "pitch" in columns:
        if not np.isfinite(columns["pitch"]).all():
            raise RunError(table.file, "a row has no pitch", "fill that cell, or leave the row out")
        return columns["pitch"]
    if "lift" not in columns or not set(RADII) <= set(columns):
        raise RunError(table.file, "has no column pitch_deg, nor lift_m with front_radius_m and rear_radius_m",
                       "measure one of the two in every row")
    return pitch_from_lift(columns["lift"], columns["front_radius"], columns["rear_radius"], wheelbase)


def draw(found: Identification, place: Place) -> Drawn:
    """Rear load over tan(pitch) with the line, and the height each row gives by itself."""
    data, estimate = found.figure, found.estimates[0]
    pitch, lifts = np.degrees(data["pitch"]), np.asarray(data["lifts"])
    with style():
        figure, (left, right) = plt.subplots(1, 2, figsize=(WIDTH, 3.2))
        grid = np.linspace(0.0, data["pitch"].max(), 60)
        for k, (name, level) in enumerate(data["levels"].items()):
            row = lifts == name
            marker = "os^Dv<>P"[k % 8]
            left.plot(pitch[row], data["rear_load"][row], marker, color=TEXT, ms=4.5, mfc="none", label=name)
            left.plot(np.degrees(grid), level + data["slope"] * np.tan(grid), color=MODEL_COLOUR["augmented"], lw=1.0)
            use = row & data["usable"]
            right.plot(pitch[use], data["single"][use], marker, color=TEXT, ms=4.5, mfc="none")
        left.set(xlabel="pitch, deg", ylabel="load on the rear wheels, kg")
        left.legend(title="lift", fontsize=8)
        right.axhspan(*estimate.interval95, color=MODEL_COLOUR["augmented"], alpha=0.2, lw=0, label="95 % interval")
        right.axhline(estimate.value, color=MODEL_COLOUR["augmented"], label="fit through all rows")
        right.axhline(data["average"], color=MEASURED_COLOUR, ls="--", label="average over pitch angles")
        right.set(xlim=(0.0, None), xlabel="pitch, deg", ylabel="CG height, m")
        right.legend(fontsize=8)
        title = f"CG {estimate.value:.3f} m above the ground, 95 % interval {estimate.interval95[0]:.3f} to " \
                f"{estimate.interval95[1]:.3f} m"
        return finish(figure, place, "cg-height", title, "Left: rear load and the line whose slope is m (h - r) / l "
                                                         "over "
                      "tan(pitch). Right: the height each lifted row gives by itself.")


CG_HEIGHT = Experiment("cg-height", "CG height from the axle-lift test (ISO 10392)",
                       "CSV: pitch_deg, rear_left_kg, rear_right_kg, front_radius_m, rear_radius_m; a row per pitch",
                       identify, draw)
