"""`st identify tyre` and `st identify lambda`: Magic Formula from flat-plank tables, and its scale to the axle."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from st_core.identification.lambda_ky import TableStiffness, lambda_ky
from st_core.identification.magic_formula import FlatPlank, fit_tyre, magic_formula
from st_core.identification.result import Identification
from st_core.palette import MODEL_COLOUR
from st_core.vehicle import TYRES
from st_recordings.runs.errors import RunError

from ..evaluation.drawing import TEXT, WIDTH, Drawn, Place, finish, style
from .experiment import Experiment, Setup
from .experiment_table import read_columns

COLUMNS = {"load": ("n", "kn", "kg"), "slip_angle": ("deg", "rad"), "lateral_force": ("n", "kn")}
# The paper's colours of the three loads, darker where they would be faint on white.
LOADS = ("#3baa32", "#1792b5", "#d1048b", "#8c6d1f", "#5a5a5a", "#7e2f8e")


def identify(files: Sequence[Path], setup: Setup) -> tuple[Identification, ...]:
    """One outcome per tyre in the tables."""
    return tuple(magic_formula(table, getattr(setup.vehicle, table.tyre)) for table in read_tables(files))


def identify_lambda(files: Sequence[Path], setup: Setup) -> tuple[Identification, ...]:
    """Files: flat-plank tables, for the uncertainty of the tyres' stiffness; may be none."""
    found = {}
    for table in read_tables(files) if files else ():
        axle = table.tyre.removeprefix("tyre_")
        fit = fit_tyre(table, getattr(setup.vehicle, table.tyre))
        stiffness, spread = fit.stiffness(getattr(setup.vehicle, f"static_tyre_load_{axle}"))
        found[table.tyre] = TableStiffness(spread / abs(stiffness), table.name)
    return (lambda_ky(setup.vehicle, found),)


def read_tables(files: Sequence[Path]) -> list[FlatPlank]:
    """All rows of each tyre, from whichever files they are in. A column `tyre` is front or rear."""
    rows: dict[str, list[tuple[np.ndarray, ...]]] = {}
    names: dict[str, list[str]] = {}
    for file in files:
        table = read_columns(file, COLUMNS, texts=("tyre",))
        if table.units["load"] == "kg":
            raise RunError(file, "column load_kg: a load is a force here", "name it load_n and give newtons")
        if "tyre" not in table.texts:
            raise RunError(file, "has no column tyre", "add one with front or rear in each row")
        axle = np.array([word.lower().removeprefix("tyre_") for word in table.texts["tyre"]])
        for word in dict.fromkeys(axle.tolist()):
            if word not in ("front", "rear"):
                raise RunError(file, f"tyre is {word[:40]!r} in a row", "front or rear")
            columns = (table.numbers[name][axle == word] for name in COLUMNS)
            rows.setdefault(f"tyre_{word}", []).append(tuple(columns))
            names.setdefault(f"tyre_{word}", []).append(file.name)
    tables = []
    for tyre in (tyre for tyre in TYRES if tyre in rows):
        load, slip, force = (np.concatenate(column) for column in zip(*rows[tyre], strict=True))
        tables.append(FlatPlank(tyre, load, slip, force, ", ".join(names[tyre])))
    return tables


def draw(found: Identification, place: Place) -> Drawn:
    """Measured and fitted force, residuals, and the stiffness over the load."""
    data = found.figure
    slip = np.degrees(data["slip"])
    with style():
        figure, (left, middle, right) = plt.subplots(1, 3, figsize=(WIDTH, 3.2), width_ratios=(1.4, 1.0, 1.0))
        for k, load in enumerate(data["levels"]):
            row, colour = data["level"] == k, LOADS[k % len(LOADS)]
            left.plot(slip[row], data["force"][row], "o", color=colour, ms=3)
            left.plot(np.degrees(data["grid"]), data["curves"][k], color=colour, label=f"{load:.0f} N")
            middle.plot(slip[row], data["residuals"][row], "o", color=colour, ms=3)
            value, spread = np.abs(data["stiffness"][k])
            right.errorbar(load, value / 1e3, 1.96 * spread / 1e3, fmt="o", color=colour, ms=4)
        left.set(xlabel="slip angle, deg (sliding to the left +)", ylabel="lateral force, N")
        left.legend(title="load", fontsize=8)
        middle.axhline(0.0, color=TEXT, lw=0.8)
        middle.set(xlabel="slip angle, deg", ylabel="fit minus measured, N")
        right.plot(data["levels"], np.abs(data["stiffness"][:, 0]) / 1e3, color=MODEL_COLOUR["nonlinear"], lw=0.8)
        right.set(ylim=(0.0, None), xlabel="load, N", ylabel="cornering stiffness, kN/rad")
        share = 100.0 * np.sqrt(np.mean(data["residuals"] ** 2)) / np.abs(data["force"]).max()
        axle = data["tyre"].removeprefix("tyre_")
        title = f"Magic Formula of the {axle} tyre: {share:.2f} % of the largest force left over"
        return finish(figure, place, data["tyre"].replace("_", "-"), title,
                      "Points: measured. Lines: Magic Formula. Bars: 95 % interval of the stiffness at zero slip.")


def draw_lambda(found: Identification, place: Place) -> Drawn:
    """Both scales with their intervals."""
    with style():
        figure, axes = plt.subplots(figsize=(0.6 * WIDTH, 1.8))
        for row, estimate in enumerate(found.estimates):
            axes.plot(estimate.interval95, [row, row], color=MODEL_COLOUR["nonlinear"], lw=3, solid_capstyle="butt",
                      alpha=0.4)
            axes.plot(estimate.value, row, "o", ms=4, color=MODEL_COLOUR["nonlinear"])
        axes.axvline(1.0, color=TEXT, lw=0.8, ls="--")
        axes.set_yticks(range(len(found.estimates)), [e.parameter.removesuffix(".lambda_ky") for e in found.estimates])
        axes.set_ylim(len(found.estimates) - 0.5, -0.5)
        axes.grid(axis="y", visible=False)
        axes.set(xlim=(0.0, None), xlabel="stiffness of the axle over that of its two tyres")
        values = ", ".join(f"{e.parameter.removesuffix('.lambda_ky').replace('tyre_', '')} "
                           f"{e.value:.3f}" for e in found.estimates)
        return finish(figure, place, "lambda", f"Stiffness scale: {values}",
                      "Bars: 95 % interval. At 1 the axle is as stiff as its tyres on the flat plank.")


TYRE = Experiment("tyre", "Magic Formula parameters from flat-plank tables",
                  "CSV: tyre (front or rear), load_n, slip_angle_deg, lateral_force_n", identify, draw)
LAMBDA = Experiment("lambda", "stiffness scale of the Magic Formula from the axle's stiffness",
                    "none, or the flat-plank tables for the uncertainty of the tyre", identify_lambda, draw_lambda,
                    files_needed=False)
