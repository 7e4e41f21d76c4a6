"""The figure of a clock alignment: signals of both recordings before and after, correlation and residual lags."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from st_core.clock_alignment import correlation_curve, residual_lags
from st_core.clock_types import Alignment, SharedSignal
from st_core.palette import MEASURED_COLOUR, RC

OTHER_COLOUR = "#d55e00"
CLOSE_UP = 10.0  # s
MOST_POINTS = 4000  # of a line


def alignment_figure(signals: Sequence[SharedSignal], alignment: Alignment, title: str, file: Path) -> None:
    """Rows: one signal over the whole drive; the liveliest 10 s of another; correlation, and residual lags."""
    with plt.rc_context(RC):
        figure, axes = plt.subplots(3, 2, figsize=(11, 8.2), height_ratios=(1, 1, 0.9))
        chosen = _chosen(signals)
        _draw_whole(axes[0], chosen[0], alignment)
        _draw_close_up(axes[1], chosen[-1], alignment)
        _draw_correlation(axes[2, 0], signals, alignment)
        _draw_lags(axes[2, 1], signals, alignment)
        figure.suptitle(title, x=0.01, ha="left", fontweight="bold")
        figure.savefig(file)
        plt.close(figure)


def _chosen(signals: Sequence[SharedSignal]) -> list[SharedSignal]:
    """A speed for the overview, a yaw rate for the close-up, else the first signal."""
    plain = [s for s in signals if not s.angle] or list(signals)
    speeds = [s for s in plain if "velocity" in s.name or "speed" in s.name]
    rates = [s for s in plain if "rate" in s.name]
    return [(speeds or plain)[0], (rates or plain)[0]]


def _label(signal: SharedSignal) -> str:
    units = {"velocity": "m/s", "speed": "m/s", "rate": "rad/s", "curvature": "1/m, steering scaled"}
    unit = next((unit for word, unit in units.items() if word in signal.name), "rad")
    return f"{signal.name.split(' (')[0]}, {unit}"


def _before(signal: SharedSignal) -> tuple[np.ndarray, np.ndarray, str]:
    """Times of both [s] without alignment: as stamped where the clocks are near, else each from its own start."""
    reference, other = signal.reference_time_ns, signal.other_time_ns
    near = other[0] < reference[-1] and reference[0] < other[-1]
    zero = (int(reference[0]),) * 2 if near else (int(reference[0]), int(other[0]))
    what = "as stamped" if near else "each from its own start (the clocks have nothing in common)"
    return (reference - zero[0]) * 1e-9, (other - zero[1]) * 1e-9, what


def _after(signal: SharedSignal, alignment: Alignment) -> tuple[np.ndarray, np.ndarray]:
    zero = int(signal.reference_time_ns[0])
    late = round(signal.latency * 1e9)
    mapped = alignment.to_reference_ns(signal.other_time_ns - late)
    return (signal.reference_time_ns - zero) * 1e-9, (mapped - zero) * 1e-9


def _scaled(signal: SharedSignal, reference: np.ndarray, other: np.ndarray) -> np.ndarray:
    """The other recording's values in the units of the reference, where the two only share a shape (steering)."""
    if "curvature" not in signal.name:
        return signal.other
    known = np.isfinite(signal.reference)
    on_grid = np.interp(reference[known], other, signal.other)
    gain, bias = np.polyfit(on_grid, signal.reference[known], 1)
    return gain * signal.other + bias


def _draw_whole(axes: Sequence[plt.Axes], signal: SharedSignal, alignment: Alignment) -> None:
    reference, other = _after(signal, alignment)
    values = _scaled(signal, reference, other)
    before_reference, before_other, what = _before(signal)
    _lines(axes[0], before_reference, signal.reference, before_other, values)
    axes[0].set_title(f"Before: {what}")
    _lines(axes[1], reference, signal.reference, other, values)
    axes[1].set_title("After")
    axes[0].set_ylabel(_label(signal))
    axes[0].legend(loc="best")
    for ax in axes:
        ax.set_xlabel("s after the first INS measurement")


def _draw_close_up(axes: Sequence[plt.Axes], signal: SharedSignal, alignment: Alignment) -> None:
    reference, other = _after(signal, alignment)
    start = _liveliest(reference, signal.reference, other)
    values = _scaled(signal, reference, other)
    before_reference, before_other, _ = _before(signal)
    for ax, (t_reference, t_other) in zip(axes, ((before_reference, before_other), (reference, other)), strict=True):
        mine = (t_reference >= start) & (t_reference <= start + CLOSE_UP)
        theirs = (t_other >= start) & (t_other <= start + CLOSE_UP)
        _lines(ax, t_reference[mine], signal.reference[mine], t_other[theirs], values[theirs])
        ax.set(xlim=(start, start + CLOSE_UP), xlabel="s after the first INS measurement",
               title=f"The liveliest {CLOSE_UP:.0f} s")
    axes[0].set_ylabel(_label(signal))


def _lines(ax: plt.Axes, t_reference: np.ndarray, reference: np.ndarray, t_other: np.ndarray,
           other: np.ndarray) -> None:
    keep = slice(None, None, max(len(t_reference) // MOST_POINTS, 1))
    ax.plot(t_reference[keep], reference[keep], color=MEASURED_COLOUR, lw=3, alpha=0.55, label="INS recording")
    keep = slice(None, None, max(len(t_other) // MOST_POINTS, 1))
    ax.plot(t_other[keep], other[keep], color=OTHER_COLOUR, lw=1.0, label="CAN log")


def _liveliest(time: np.ndarray, values: np.ndarray, other: np.ndarray) -> float:
    """Start of the stretch, inside the time common to both, in which the signal varies most."""
    low, high = max(time[0], other[0]), min(time[-1], other[-1]) - CLOSE_UP
    starts = np.arange(low, max(high, low + 1e-3), CLOSE_UP / 4)
    edges = np.searchsorted(time, np.stack([starts, starts + CLOSE_UP]))
    spread = [np.nanstd(values[a:b]) if np.isfinite(values[a:b]).sum() > 5 else 0.0 for a, b in edges.T]
    return float(starts[int(np.argmax(spread))])


def _draw_correlation(ax: plt.Axes, signals: Sequence[SharedSignal], alignment: Alignment) -> None:
    lags, r = correlation_curve(signals)
    ax.set_title("Correlation at every offset, mean of the shared signals")
    if not len(lags):
        ax.text(0.5, 0.5, "no signal to correlate", transform=ax.transAxes, ha="center")
        return
    zero = alignment.offset_ns * 1e-9
    ax.plot(lags - zero, np.where(r == 0, np.nan, r), color=MEASURED_COLOUR, lw=0.9)
    for peak, style, name in ((alignment.peak, "o", "best"), (alignment.second_peak, "s", "second")):
        if peak is not None and peak[1] > 0:
            ax.plot(peak[0] - zero, peak[1], style, ms=5, color=OTHER_COLOUR, label=f"{name}: {peak[1]:.2f}")
    ax.set(ylim=(-1.05, 1.1), xlabel="offset minus the result, s", ylabel="correlation")
    if alignment.peak is not None:
        ax.legend(loc="lower right")


def _draw_lags(ax: plt.Axes, signals: Sequence[SharedSignal], alignment: Alignment) -> None:
    ax.set_title("Residual lag of each stretch of 30 s")
    lags = residual_lags(signals, alignment)
    if not lags:
        ax.text(0.5, 0.5, "no stretch of 30 s with enough motion", transform=ax.transAxes, ha="center")
        return
    ax.axhline(0, color="k", lw=0.6)
    time = [w.time for w in lags]
    ax.errorbar(time, [w.lag * 1e3 for w in lags], yerr=[w.deviation * 1e3 for w in lags], fmt="o", ms=3, lw=0.8,
                color=OTHER_COLOUR)
    reach = max(1.0, 1.2 * max(abs(w.lag) + w.deviation for w in lags) * 1e3)
    ax.set(ylim=(-reach, reach), xlabel="s from the middle of the common time", ylabel="residual lag, ms")
