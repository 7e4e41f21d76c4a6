"""Clock alignment by frames in which the unit sends its own time."""

from dataclasses import replace
from itertools import pairwise

import numpy as np

from .clock_fit import DRIFT_PRIOR_PPM
from .clock_steps import MOST_WINDOWS, WindowLag, clock_step
from .clock_types import LONGEST_SPAN, STEP_TOO_LARGE, UNUSUAL_DRIFT_PPM, Alignment, Verdict, refused, step_reason


def align_by_time_frame(other_time_ns: np.ndarray, reference_time_ns: np.ndarray, resolution: float = 0.001,
                        latency: float = 0.0, latency_uncertainty: float = 0.0) -> Alignment:
    """Offset and drift from frames in which the unit sends its own time.

    Args:
        other_time_ns: when each frame was logged.
        reference_time_ns: the time it carried, UTC; frames of an unlocked unit (no time) left out.
        resolution: of that time [s].
        latency: a frame is logged this late after the instant it names [s].

    A straight line through one point per frame, medians per second, refitted without what lies off it (soft L1).
    """
    if len(other_time_ns) < 2:
        return refused("the time frames hold no time (the unit had not locked yet?)")
    if abs(int(other_time_ns[-1]) - int(other_time_ns[0])) * 1e-9 > LONGEST_SPAN:
        return refused("the log spans days: its clock was set during the recording")
    o0, r0 = int(other_time_ns[0]), int(reference_time_ns[0])
    time = (other_time_ns - o0) * 1e-9 - latency
    offset = (reference_time_ns - r0) * 1e-9 - time
    time, offset = _medians(time, offset)
    middle = float(time[0] + time[-1]) / 2
    design = np.stack([np.ones_like(time), time - middle], axis=1)
    weight = np.ones_like(time)
    for _ in range(20):
        solution = np.linalg.lstsq(design * weight[:, None], offset * weight, rcond=None)[0]
        residual = offset - design @ solution
        scale = max(1.4826 * float(np.median(np.abs(residual))), 1e-5)
        weight = (1 + (residual / (2 * scale)) ** 2) ** -0.25
    weighted = design * weight[:, None]
    prior = np.diag([0.0, (scale / (DRIFT_PRIOR_PPM * 1e-6)) ** 2])
    covariance = scale**2 * np.linalg.inv(weighted.T @ weighted + prior)
    # Truncation to the resolution does not average out when frames and steps beat slowly.
    rounding = resolution / np.sqrt(12)
    result = Alignment(
        at_ns=o0 + round(middle * 1e9), offset_ns=r0 - o0 + round(float(solution[0]) * 1e9),
        drift_ppm=float(solution[1]) * 1e6,
        offset_deviation=float(np.sqrt(covariance[0, 0] + rounding**2 + latency_uncertainty**2)),
        drift_deviation=float(np.sqrt(covariance[1, 1])) * 1e6,
        method="time frame", verdict=Verdict.GOOD, overlap=float(time[-1] - time[0]),
    )
    # Of the offsets, not of what the line leaves of them: a step has tilted the line.
    step = clock_step([WindowLag(t, v, scale) for t, v in _thinned(time - middle, offset - np.median(offset))])
    if step and abs(step[1]) > STEP_TOO_LARGE:
        return replace(result, verdict=Verdict.REFUSED, reasons=(step_reason(step[1], step[0]),))
    doubts = []
    worst = int(np.argmax(np.abs(residual)))
    if abs(residual[worst]) > 0.02:
        doubts.append(f"the time frames do not lie on one line: {residual[worst] * 1e3:+.0f} ms at "
                      f"{time[worst] - middle:+.0f} s from the middle (a clock was set?)")
    if abs(result.drift_ppm) > UNUSUAL_DRIFT_PPM:
        doubts.append(f"a drift of {result.drift_ppm:.0f} ppm is more than two quartz clocks have")
    return result.doubted(*doubts)


def _medians(time: np.ndarray, value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    second = np.floor(time - time[0]).astype(np.int64)
    edges = np.nonzero(np.diff(second, prepend=second[0] - 1, append=second[-1] + 1))[0]
    if len(edges) - 1 > 0.5 * len(time):
        return time, value
    groups = list(pairwise(edges))
    return np.array([np.median(time[a:b]) for a, b in groups]), np.array([np.median(value[a:b]) for a, b in groups])


def _thinned(time: np.ndarray, value: np.ndarray) -> list[tuple[float, float]]:
    """At most MOST_WINDOWS medians of neighbours."""
    edges = np.linspace(0, len(time), min(len(time), MOST_WINDOWS) + 1).astype(int)
    return [(float(np.median(time[a:b])), float(np.median(value[a:b]))) for a, b in pairwise(edges)]
