"""Forward acceleration from forward speed: first-order Butterworth low-pass, then the derivative.

The filter is the continuous one, tau y_dot = u - y with tau = 1 / (2 pi f_c), solved exactly for a speed u that runs
straight between its samples, with the actual spacing dt of each pair:

    x = dt / tau,  e = exp(-x),  g = (1 - e) / x,   y_k = e y_{k-1} + (g - e) u_{k-1} + (1 - g) u_k
    y_dot_k = (y_k - y_{k-1}) / dt

So uneven spacing adds no noise of its own, which a bilinear transform does (1 % of a constant acceleration at
10 +- 6 ms, measured); at an even 100 Hz its answers are those of scipy.signal.butter(1, 5, fs=100) to a thousandth.
The derivative is the backward difference, so it belongs to the middle of the last interval: for slow changes the
result is late by tau + dt / 2, at 5 Hz and 100 Hz sampling 31.8 + 5 = 37 ms. The filter starts at rest on the first
sample and after every gap; the derivative there is not known (NaN).
Source: paper, section on the models' inputs. Checked by: test_filtering.py.
"""

import math
from typing import Literal

import numpy as np

from .errors import StCoreError

NANOSECOND = 1.0e-9


def advance(filtered: float, before: float, now: float, spacing: float, cutoff: float) -> tuple[float, float]:
    """(filtered, derivative) at a sample `now`, `spacing` [s] after `before` with the filtered value `filtered`."""
    x = 2.0 * math.pi * cutoff * spacing
    drop = -math.expm1(-x)  # 1 - e
    g = drop / x
    result = filtered + drop * (before - filtered) + (1.0 - g) * (now - before)
    return result, (result - filtered) / spacing


def filtered_derivative(times_ns: np.ndarray, values: np.ndarray, cutoff: float, maximum_gap: float,
                        mode: Literal["causal", "zero_phase"] = "causal") -> tuple[np.ndarray, np.ndarray]:
    """(filtered, derivative) of a whole log, arrays as `values`.

    causal: the very numbers `advance` gives live. zero_phase: the filter forward and backward over each stretch without
    a gap, then central differences: no delay, twice the attenuation; for logs only.
    times_ns: increasing [ns]. cutoff [Hz]. maximum_gap [s].
    """
    times_ns, values = np.asarray(times_ns, np.int64), np.asarray(values, float)
    if np.any(np.diff(times_ns) <= 0):
        raise StCoreError("times must increase")
    filtered, derivative = _causal(times_ns, values, cutoff, maximum_gap)
    if mode == "causal":
        return filtered, derivative
    if mode != "zero_phase":
        raise StCoreError(f"mode {mode!r} is neither causal nor zero_phase")
    backward, _ = _causal(-times_ns[::-1], filtered[::-1], cutoff, maximum_gap)
    filtered = backward[::-1].copy()
    derivative = np.full_like(filtered, np.nan)
    seconds = (times_ns - times_ns[:1]) * NANOSECOND
    for stretch in np.split(np.arange(len(values)), np.flatnonzero(np.diff(seconds) > maximum_gap) + 1):
        if len(stretch) > 1:
            derivative[stretch] = np.gradient(filtered[stretch], seconds[stretch])
    return filtered, derivative


def _causal(times_ns: np.ndarray, values: np.ndarray, cutoff: float,
            maximum_gap: float) -> tuple[np.ndarray, np.ndarray]:
    # `advance` sample by sample, to the last bit; what does not depend on the sample before is worked out beforehand.
    spacings_ns = np.diff(times_ns)
    different, which = np.unique(spacings_ns, return_inverse=True)
    x = 2.0 * math.pi * cutoff * (different * NANOSECOND)
    drops = np.array([-math.expm1(-value) for value in x.tolist()])
    pull = (1.0 - drops / x)[which] * (values[1:] - values[:-1])
    begins = spacings_ns * NANOSECOND > maximum_gap
    course = values[:1].tolist()
    last = course[0] if course else math.nan
    for drop, before, more, now, fresh in zip(drops[which].tolist(), values[:-1].tolist(), pull.tolist(),
                                              values[1:].tolist(), begins.tolist(), strict=True):
        last = now if fresh else last + drop * (before - last) + more
        course.append(last)
    filtered = np.array(course, float)
    derivative = np.full(len(values), np.nan)
    derivative[1:] = np.where(begins, np.nan, (filtered[1:] - filtered[:-1]) / (spacings_ns * NANOSECOND))
    return filtered, derivative
