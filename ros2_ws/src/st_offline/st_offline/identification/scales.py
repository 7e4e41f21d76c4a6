"""`st identify scales`: mass and CG position from four wheel scales."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from st_core.identification.mass_and_cg import SCALE_UNCERTAINTY, WHEELS, Weighings, mass_and_cg, swapped_axles
from st_core.identification.result import Identification
from st_core.palette import MEASURED_COLOUR, MODEL_COLOUR
from st_recordings.runs.errors import RunError

from ..evaluation.drawing import TEXT, WIDTH, Drawn, Place, finish, style
from .columns import read_columns
from .experiment import Experiment, Setup

NOTES = ("weighing", "driver", "payload")


def identify(files: Sequence[Path], setup: Setup) -> tuple[Identification, ...]:
    """All files together: each row is one weighing."""
    readings, names, loads, scales = [], [], [], set()
    for file in files:
        table = read_columns(file, {wheel: ("kg",) for wheel in WHEELS}, {"scale_uncertainty": ("kg",)}, NOTES)
        readings.append(np.stack([table.numbers[wheel] for wheel in WHEELS], axis=1))
        labels = table.texts.get("weighing") or [str(row) for row in range(1, len(table) + 1)]
        names += [f"{file.name}:{label}" for label in labels]
        notes = [table.texts.get(key, ("",) * len(table)) for key in ("driver", "payload")]
        loads += [", ".join(note for note in row if note) for row in zip(*notes, strict=True)]
        scales |= set(table.numbers.get("scale_uncertainty", np.array([SCALE_UNCERTAINTY])).tolist())
    if len(scales) > 1:
        raise RunError(files[0], f"scale_uncertainty_kg has several values: {sorted(scales)}", "one set of scales")
    vehicle = setup.vehicle
    weighings = Weighings(np.concatenate(readings), tuple(names), tuple(loads), scales.pop())
    found = mass_and_cg(weighings, vehicle.wheelbase, setup.uncertainty_of("wheelbase"))
    swapped = swapped_axles(found, vehicle.wheelbase, vehicle.cg_to_front_axle)
    return (replace(found, warnings=(*found.warnings, *([swapped] if swapped else []))),)


def draw(found: Identification, place: Place) -> Drawn:
    """Every weighing and the 95 % interval of both values."""
    data = found.figure
    rows = np.arange(len(data["names"]))
    with style():
        figure, panels = plt.subplots(1, 2, figsize=(WIDTH, 1.6 + 0.3 * len(rows)), sharey=True)
        for axes, key, values, label in ((panels[0], "mass", data["masses"], "mass, kg"),
                                         (panels[1], "cg_to_front_axle", data["distances"], "CG behind front axle, m")):
            estimate = found[key]
            axes.axvspan(*estimate.interval95, color=MODEL_COLOUR["augmented"], alpha=0.2, lw=0, label="95 % interval")
            axes.axvline(estimate.value, color=MODEL_COLOUR["augmented"], label="value")
            kept = data["kept"]
            axes.plot(values[kept], rows[kept], "o", color=TEXT, ms=5, label="weighing")
            axes.plot(values[~kept], rows[~kept], "x", color=MEASURED_COLOUR, ms=6, label="left out")
            axes.set_xlabel(label)
            axes.ticklabel_format(useOffset=False)
        panels[0].set_yticks(rows, data["names"])
        panels[0].set_ylim(len(rows) - 0.5, -0.5)
        panels[0].grid(axis="y", visible=False)
        panels[1].grid(axis="y", visible=False)
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower left", ncols=4)
        return finish(figure, place, "scales", f"{found['mass'].verdict} {found['cg_to_front_axle'].verdict}",
                      "One point per weighing. The interval holds their scatter and the scales' own uncertainty.")


SCALES = Experiment("scales", "mass and CG position from four wheel scales",
                    "CSV: front_left_kg, front_right_kg, rear_left_kg, rear_right_kg; a row per weighing", identify,
                    draw)
