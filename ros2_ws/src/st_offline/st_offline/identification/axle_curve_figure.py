"""Figure of axle force against slip over the driven range, for reports."""

from collections.abc import Mapping, Sequence

import matplotlib.pyplot as plt
import numpy as np
from st_core.identification.axle_curve import AxleCurve
from st_core.identification.cornering_stiffness import AxleSamples
from st_core.palette import MEASURED_COLOUR, MODEL_COLOUR

from ..evaluation.drawing import TEXT, WIDTH, Drawn, Place, finish, style

DEG = np.rad2deg(1.0)


def draw_axle_curves(curves: Sequence[AxleCurve], place: Place, samples: Mapping[str, AxleSamples] | None = None,
                     key: str = "axle-forces") -> Drawn:
    """One panel per axle: force curve with its band, the file's curve, density of the driven slip below.

    samples: by axle, measured forces where the sideslip was measured; drawn as means per bin with their standard error.
    """
    with style():
        figure, grid = plt.subplots(2, len(curves), figsize=(WIDTH, 4.0), sharex="col", squeeze=False,
                                    height_ratios=(4, 1))
        for (axes, below), curve in zip(grid.T, curves, strict=True):
            slip = curve.slip * DEG
            axes.fill_between(slip, curve.low * 1e-3, curve.high * 1e-3, color=MODEL_COLOUR["augmented"], alpha=0.25,
                              lw=0, label=f"{100 * curve.level:.0f} % band")
            axes.plot(slip, curve.force * 1e-3, color=MODEL_COLOUR["augmented"], label="found")
            axes.plot(slip, curve.file * 1e-3, "--", color=TEXT, lw=1.0, label="vehicle file")
            if samples and curve.axle in samples:
                middle, force, error = samples[curve.axle].binned()
                axes.errorbar(middle * DEG, force * 1e-3, error * 1e-3, fmt="o", ms=3, color=MEASURED_COLOUR,
                              label="measured")
            axes.set(ylabel=f"{curve.axle} axle force, kN", ylim=(0.0, None))
            axes.legend(loc="upper left", fontsize=8)
            below.stairs(100.0 * curve.density, slip, fill=True, color=MEASURED_COLOUR)
            below.set(xlabel=f"{curve.axle} slip angle, deg", ylabel="share, %", xlim=(0.0, slip[-1]))
        title = "; ".join(f"{c.axle} {_ratio(c)} to {c.slip[-1] * DEG:.1f} deg" for c in curves)
        return finish(figure, place, key, f"Axle forces over the driven slip: {title}",
                      "Force that opposes the slip, both sides together. Below: how much of the driving is at which "
                      "slip. Beyond the driven slip nothing is stated.")


def _ratio(curve: AxleCurve) -> str:
    """Range of force over the file's along the curve, in words."""
    ratio = curve.force[1:] / curve.file[1:]
    low, high = float(ratio.min()), float(ratio.max())
    return f"{low:.2f} times the file's" if high - low < 0.01 else f"{low:.2f} to {high:.2f} times the file's"
