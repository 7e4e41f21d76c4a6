"""Do one offset and one drift describe the whole recording? Lags of single windows, and the step that explains them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .clock_fit import STEP, Pair, Resampled, coarse_offset, fit

WINDOW = 30.0  # s
MOST_WINDOWS = 150  # of a long recording, every so many seconds one
SMALLEST_STEP = 0.01  # s
USUAL_DRIFT = 50e-6
SURE = 30.0  # by how much a step must lower the sum of squares (in standard deviations) of the window lags
OUTLIER = 5.0  # standard deviations; a window further off counts no more than this


@dataclass(frozen=True)
class WindowLag:
    """Offset of a stretch of `other` around `time` [s, other clock] minus a common offset, and its deviation [s]."""

    time: float
    lag: float
    deviation: float


def window_lags(pairs: Sequence[Pair], offset: float, search: float) -> list[WindowLag]:
    """The lag of every stretch of 30 s, relative to `offset`, searched within +/- `search` [s].

    Stretches that do not vary enough to be placed within 50 ms, or that fit at two places, are left out.
    """
    lags = []
    first = min(p.other.origin for p in pairs)
    last = max(p.other.time[-1] for p in pairs)
    for start in np.arange(first, last - WINDOW / 2, max(WINDOW, (last - first) / MOST_WINDOWS)):
        middle = start + WINDOW / 2
        cut = [Pair(p.name, _cut(p.reference, start + offset - search, start + offset + WINDOW + search),
                    _cut(p.other, start, start + WINDOW)) for p in pairs]
        cut = [p for p in cut if p.other.known.sum() * STEP > WINDOW / 3 and p.reference.known.any()]
        best = coarse_offset(cut, WINDOW / 3, 2.0) if cut else None
        if best is None or best[1][0] < 0.9 or best[1][1] > 0.97 * best[1][0]:
            continue
        try:
            fine = fit(cut, best[0][0], middle, free_drift=False)
        except ValueError:
            continue
        if fine.offset_deviation < 0.05 and abs(fine.offset - offset) <= search + 1.0:
            lags.append(WindowLag(float(middle), fine.offset - offset, fine.offset_deviation))
    return lags


def _cut(signal: Resampled, start: float, end: float) -> Resampled:
    low = int(np.clip(np.ceil((start - signal.origin) / STEP), 0, len(signal.values)))
    high = int(np.clip(np.ceil((end - signal.origin) / STEP), low, len(signal.values)))
    return Resampled(signal.origin + low * STEP, signal.values[low:high], signal.known[low:high])


def clock_step(lags: Sequence[WindowLag]) -> tuple[float, float] | None:
    """(time, size) [s] of the one step that explains the window lags much better than a straight line; None without.

        lag(t) = a + b t          against          lag(t) = a + b t + size (t > time),        b about 0 +/- 50 ppm

    At least two windows on each side; size above 10 ms.
    """
    if len(lags) < 4:
        return None
    time = np.array([w.time for w in lags])
    lag = np.array([w.lag for w in lags])
    deviation = np.array([max(w.deviation, 1e-3) for w in lags])
    time = time - time.mean()
    plain = np.stack([np.ones_like(time), time], axis=1)
    without, _ = _robust_line(plain, lag, deviation)
    best: tuple[float, float, float] | None = None
    for k in range(2, len(lags) - 1):
        after = (np.arange(len(lags)) >= k).astype(float)
        cost, solution = _robust_line(np.column_stack([plain, after]), lag, deviation)
        if best is None or cost < best[0]:
            best = (cost, (lags[k - 1].time + lags[k].time) / 2, float(solution[2]))
    if best is None or without - best[0] < SURE or abs(best[2]) < SMALLEST_STEP:
        return None
    return best[1], best[2]


def _robust_line(design: np.ndarray, value: np.ndarray, deviation: np.ndarray) -> tuple[float, np.ndarray]:
    """(sum of capped squares, solution) of a line with the usual drift as a prior; outliers weigh less and less."""
    prior = np.zeros((1, design.shape[1]))
    prior[0, 1] = 1 / USUAL_DRIFT
    weight = 1 / deviation
    for _ in range(10):
        rows = np.vstack([design * weight[:, None], prior])
        solution = np.linalg.lstsq(rows, np.append(value * weight, 0.0), rcond=None)[0]
        normalised = (value - design @ solution) / deviation
        weight = 1 / deviation / np.sqrt(1 + (normalised / OUTLIER) ** 2)
    drift = solution[1] / USUAL_DRIFT
    return float(np.minimum(normalised**2, OUTLIER**2).sum() + drift**2), solution
