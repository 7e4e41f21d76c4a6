"""`st identify steering-ratio`: from turntables under the front wheels."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from st_core.identification.result import Identification
from st_core.identification.steering_ratio import Turntable, steering_ratio
from st_core.palette import MEASURED_COLOUR, MODEL_COLOUR

from ..evaluation.drawing import TEXT, WIDTH, Drawn, Place, finish, style
from .columns import read_columns
from .experiment import Experiment, Setup

ANGLES = {"steering_wheel": ("deg", "rad"), "left_wheel": ("deg", "rad"), "right_wheel": ("deg", "rad")}


def identify(files: Sequence[Path], setup: Setup) -> tuple[Identification, ...]:
    """Each file holds one or several sweeps, named in a column `series`."""
    columns, names = [], []
    for file in files:
        table = read_columns(file, ANGLES, texts=("series",))
        names += [f"{file.name}:{name}" for name in table.texts.get("series") or ("1",) * len(table)]
        columns.append([table.numbers[name] for name in ANGLES])
    hand, left, right = (np.concatenate(parts) for parts in zip(*columns, strict=True))
    return (steering_ratio(Turntable(hand, left, right, tuple(names))),)


def draw(found: Identification, place: Place) -> Drawn:
    """Wheel angles over the hand-wheel angle with the line, and what it leaves over."""
    data, estimate = found.figure, found.estimates[0]
    hand, sweeps = np.degrees(data["hand"]), np.asarray(data["sweeps"])
    with style():
        figure, (left, right) = plt.subplots(1, 2, figsize=(WIDTH, 3.2))
        left.plot(hand, np.degrees(data["left"]), "<", color=MEASURED_COLOUR, ms=4, mfc="none", label="left wheel")
        left.plot(hand, np.degrees(data["right"]), ">", color=MEASURED_COLOUR, ms=4, mfc="none", label="right wheel")
        left.plot(hand, np.degrees(data["mean"]), "o", color=TEXT, ms=3.5, label="mean")
        ends = np.array([hand.min(), hand.max()])
        level = float(np.degrees(np.mean(list(data["levels"].values()))))
        left.plot(ends, level + data["slope"] * ends, color=MODEL_COLOUR["augmented"],
                  label=f"hand wheel / {estimate.value:.2f}")
        left.set(xlabel="hand-wheel angle, deg (left +)", ylabel="wheel angle, deg (left +)")
        for k, name in enumerate(dict.fromkeys(data["sweeps"])):
            row = sweeps == name
            right.plot(hand[row], np.degrees(data["residuals"][row]), "os^Dv<>P"[k % 8], color=TEXT, ms=4.5, mfc="none",
                       label=name)
        if data["significant"]:
            first, last = np.radians(ends)
            grid = np.linspace(first, last, 101)
            curve = data["cubic"][0] * grid + data["cubic"][1] * grid**3
            right.plot(np.degrees(grid), np.degrees(curve), color=MODEL_COLOUR["nonlinear"], label="cubic")
        right.axhline(0.0, color=MODEL_COLOUR["augmented"])
        right.set(xlabel="hand-wheel angle, deg (left +)", ylabel="mean wheel angle minus line, deg")
        handles = [pair for axes in (left, right) for pair in zip(*axes.get_legend_handles_labels(), strict=True)]
        figure.legend(*zip(*handles, strict=True), loc="outside lower left", ncols=4, fontsize=8)
        title = f"Steering ratio {estimate.value:.2f}, 95 % interval {estimate.interval95[0]:.2f} to " \
                f"{estimate.interval95[1]:.2f}"
        return finish(figure, place, "steering-ratio", title,
                      "Left: both front wheels, their mean, and the line. Right: what the line leaves over.")


STEERING_RATIO = Experiment("steering-ratio", "steering ratio from turntables",
                            "CSV: steering_wheel_deg, left_wheel_deg, right_wheel_deg; left positive", identify, draw)
