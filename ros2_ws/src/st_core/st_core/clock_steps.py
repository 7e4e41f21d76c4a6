"""Detects a clock step: lags of single windows, and the step that explains them better than offset and drift alone."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from .clock_fit import STEP, Pair, Resampled, find_peaks, fit

WINDOW = 30.0  # s, length of a window
MAX_WINDOWS = 150  # largest number of windows, evenly spaced in a long recording
MIN_CORRELATION, MAX_PEAK_RATIO = 0.9, 0.97  # of the highest peak; of the second peak to it, in a window that is used
MAX_DEVIATION = 0.05  # s, largest standard deviation of the lag of a window that is used
MIN_STEP = 0.01  # s, smallest step reported
USUAL_DRIFT = 50e-6  # s/s, standard deviation of the prior of the drift
MIN_STEP_EVIDENCE = 30.0  # required reduction of the normalised sum of squares by a step
OUTLIER_LIMIT = 5.0  # standard deviations: scale of the robust weight of a window, and cap of its normalised residual


@dataclass(frozen=True)
class WindowLag:
    """Offset of a window minus the common offset."""

    time: float  # middle of the window [s, other clock]
    lag: float  # s
    deviation: float  # standard deviation [s]


class ClockStep(NamedTuple):
    time: float  # s, other clock
    size: float  # increase of the lag [s]


def measure_window_lags(pairs: Sequence[Pair], offset: float, search: float) -> list[WindowLag]:
    """Lags of windows of 30 s relative to `offset`, searched within +/- `search` [s].

    Windows with a low or ambiguous correlation or an uncertain lag are left out.
    """
    lags = []
    first = min(p.other.origin for p in pairs)
    last = max(p.other.time[-1] for p in pairs)
    for start in np.arange(first, last - WINDOW / 2, max(WINDOW, (last - first) / MAX_WINDOWS)):
        middle = start + WINDOW / 2
        windows = [Pair(p.name, _cut(p.reference, start + offset - search, start + offset + WINDOW + search),
                        _cut(p.other, start, start + WINDOW)) for p in pairs]
        windows = [p for p in windows if p.other.known.sum() * STEP > WINDOW / 3 and p.reference.known.any()]
        peaks = find_peaks(windows, WINDOW / 3) if windows else None
        if peaks is None:
            continue
        best, second = peaks
        if best.correlation < MIN_CORRELATION or second.correlation > MAX_PEAK_RATIO * best.correlation:
            continue
        try:
            fine = fit(windows, best.offset, middle, free_drift=False)
        except ValueError:
            continue
        if fine.offset_deviation < MAX_DEVIATION and abs(fine.offset - offset) <= search + 1.0:
            lags.append(WindowLag(float(middle), fine.offset - offset, fine.offset_deviation))
    return lags


def _cut(signal: Resampled, start: float, end: float) -> Resampled:
    low = int(np.clip(np.ceil((start - signal.origin) / STEP), 0, len(signal.values)))
    high = int(np.clip(np.ceil((end - signal.origin) / STEP), low, len(signal.values)))
    return Resampled(signal.origin + low * STEP, signal.values[low:high], signal.known[low:high])


def find_clock_step(lags: Sequence[WindowLag]) -> ClockStep | None:
    """The step that explains the window lags far better than a straight line; None if there is no such step.

        lag(t) = a + b t     against     lag(t) = a + b t + size [t > time],     prior of b: 0 +/- 50 ppm

    There must be at least two windows on each side; a step below 10 ms is ignored.
    """
    if len(lags) < 4:
        return None
    time = np.array([w.time for w in lags])
    lag = np.array([w.lag for w in lags])
    deviation = np.array([max(w.deviation, 1e-3) for w in lags])
    time = time - time.mean()
    line = np.stack([np.ones_like(time), time], axis=1)
    cost_without_step, _ = _fit_with_drift_prior(line, lag, deviation)
    fits = []
    for k in range(2, len(lags) - 1):
        after = (np.arange(len(lags)) >= k).astype(float)
        cost, solution = _fit_with_drift_prior(np.column_stack([line, after]), lag, deviation)
        fits.append((cost, ClockStep((lags[k - 1].time + lags[k].time) / 2, float(solution[2]))))
    cost, step = min(fits, key=lambda fit: fit[0])
    return step if cost_without_step - cost >= MIN_STEP_EVIDENCE and abs(step.size) >= MIN_STEP else None


def _fit_with_drift_prior(design: np.ndarray, value: np.ndarray, deviation: np.ndarray) -> tuple[float, np.ndarray]:
    """(sum of capped squares, solution) of a robust fit; the prior of the drift, column 1, is 0 +/- USUAL_DRIFT."""
    prior = np.zeros((1, design.shape[1]))
    prior[0, 1] = 1 / USUAL_DRIFT
    weight = 1 / deviation
    for _ in range(10):
        rows = np.vstack([design * weight[:, None], prior])
        solution = np.linalg.lstsq(rows, np.append(value * weight, 0.0), rcond=None)[0]
        normalised = (value - design @ solution) / deviation
        weight = 1 / deviation / np.sqrt(1 + (normalised / OUTLIER_LIMIT) ** 2)
    drift = solution[1] / USUAL_DRIFT
    return float(np.minimum(normalised**2, OUTLIER_LIMIT**2).sum() + drift**2), solution
