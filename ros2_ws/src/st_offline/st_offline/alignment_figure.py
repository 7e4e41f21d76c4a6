"""Draws a clock alignment: signals of both recordings, correlation and residual lags."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from scipy.ndimage import minimum_filter1d
from st_core.clock_alignment import correlation_curve, residual_lags
from st_core.clock_types import Alignment, SharedSignal
from st_core.palette import MEASURED_COLOUR, OTHER_COLOUR

from .evaluation.drawing import FigureOutput, save_figure

CLOSE_UP_DURATION = 10.0  # s
MAX_POINTS = 4000  # per line


def draw_alignment(signals: Sequence[SharedSignal], alignment: Alignment, title: str, folder: Path) -> None:
    """Draw alignment.png: speed over the whole run, yaw rate in the section where it varies most (the first signal in
    place of a missing one), correlation, and residual lags."""
    candidates = [s for s in signals if not s.is_angle] or list(signals)
    speed = next((s for s in candidates if "velocity" in s.name or "speed" in s.name), candidates[0])
    rate = next((s for s in candidates if "rate" in s.name), candidates[0])
    figure, axes = plt.subplots(2, 2, figsize=(11, 6.0))
    _draw_signal(axes[0, 0], speed, alignment, whole=True)
    _draw_signal(axes[0, 1], rate, alignment, whole=False)
    _draw_correlation(axes[1, 0], signals, alignment)
    _draw_lags(axes[1, 1], signals, alignment)
    save_figure(figure, FigureOutput(folder, ("png",)), "alignment", title, "")


def _draw_signal(ax: plt.Axes, signal: SharedSignal, alignment: Alignment, whole: bool) -> None:
    start_ns = int(signal.reference_time_ns[0])
    mapped = alignment.to_reference_ns(signal.other_time_ns - round(signal.latency * 1e9))
    reference, other = (signal.reference_time_ns - start_ns) * 1e-9, (mapped - start_ns) * 1e-9
    values = signal.other
    if "curvature" in signal.name:  # `other` is a steering angle: scaled to the curvature by a linear fit
        curvature = np.interp(other, reference, signal.reference, left=np.nan, right=np.nan)
        is_finite = np.isfinite(curvature) & np.isfinite(values)
        if is_finite.any():
            values = np.polyval(np.polyfit(values[is_finite], curvature[is_finite], 1), values)
    start = -np.inf
    if not whole:  # the section, within the overlap of both recordings, where the signal varies most
        low, high = max(reference[0], other[0]), min(reference[-1], other[-1]) - CLOSE_UP_DURATION
        starts = np.arange(low, max(high, low + 1e-3), CLOSE_UP_DURATION / 4)
        edges = np.searchsorted(reference, np.stack([starts, starts + CLOSE_UP_DURATION]))
        sections = (signal.reference[a:b] for a, b in edges.T)
        start = float(starts[np.argmax([np.nanstd(v) if np.isfinite(v).sum() > 5 else 0.0 for v in sections])])
    for time, line, colour, width, alpha, label in (
            (reference, signal.reference, MEASURED_COLOUR, 3.0, 0.55, "INS recording"),
            (other, values, OTHER_COLOUR, 1.0, 1.0, "CAN log")):
        indices = np.flatnonzero((time >= start) & (time <= (np.inf if whole else start + CLOSE_UP_DURATION)))
        indices = indices[::max(-(-len(indices) // MAX_POINTS), 1)]
        ax.plot(time[indices], line[indices], color=colour, lw=width, alpha=alpha, label=label)
    units = {"velocity": "m/s", "speed": "m/s", "rate": "rad/s", "curvature": "1/m\n(steering scaled)"}
    unit = next((unit for word, unit in units.items() if word in signal.name), "rad")
    ax.set(title="Aligned" if whole else f"The {CLOSE_UP_DURATION:.0f} s with the largest variation",
           xlabel="s after the first INS measurement", ylabel=f"{signal.name.split(' (')[0]}, {unit}")


def _draw_correlation(ax: plt.Axes, signals: Sequence[SharedSignal], alignment: Alignment) -> None:
    lags, r = correlation_curve(signals)
    ax.set_title("Correlation at every offset, mean of the shared signals")
    if not len(lags):
        ax.text(0.5, 0.5, "no signal to correlate", transform=ax.transAxes, ha="center")
        return
    offset = alignment.offset_ns * 1e-9
    # The correlation is 0 at lags with too little overlap, and interpolated towards 0 at the lags next to these.
    has_overlap = minimum_filter1d(r != 0, 3, mode="nearest")
    ax.plot(lags - offset, np.where(has_overlap, r, np.nan), color=MEASURED_COLOUR, lw=0.9)
    for peak, style, name in ((alignment.peak, "o", "best"), (alignment.second_peak, "s", "second")):
        if peak is not None and peak[1] > 0:
            ax.plot(peak[0] - offset, peak[1], style, ms=5, color=OTHER_COLOUR, label=f"{name} peak: {peak[1]:.2f}")
    ax.set(ylim=(-1.05, 1.1), xlabel="offset relative to the estimate, s", ylabel="correlation")


def _draw_lags(ax: plt.Axes, signals: Sequence[SharedSignal], alignment: Alignment) -> None:
    ax.set_title("Residual lags of 30 s windows")
    lags = residual_lags(signals, alignment)
    if not lags:
        ax.text(0.5, 0.5, "no 30 s window determines the lag", transform=ax.transAxes, ha="center")
        ax.set(xticks=[], yticks=[])
        return
    ax.axhline(0, color="k", lw=0.6)
    # The times of the lags are relative to at_ns on the CAN clock; the other panels begin at the first INS measurement.
    start = (alignment.at_ns + alignment.offset_ns - int(signals[0].reference_time_ns[0])) * 1e-9
    time = [start + w.time for w in lags]
    if len(lags) == 1:
        ax.set_xlim(time[0] - 15.0, time[0] + 15.0)
    ax.errorbar(time, [w.lag * 1e3 for w in lags], yerr=[w.deviation * 1e3 for w in lags], fmt="o", ms=3, lw=0.8,
                color=OTHER_COLOUR)
    reach = max(1.0, 1.2 * max(abs(w.lag) + w.deviation for w in lags) * 1e3)
    ax.set(ylim=(-reach, reach), xlabel="s after the first INS measurement", ylabel="residual lag, ms")
