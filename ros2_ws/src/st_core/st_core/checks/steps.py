"""Comparison of positions with integrated velocity, sample by sample: jumps, stale samples, noise, jitter of stamps.

    d_k = p_k - p_{k-1} - integral of R(yaw) v dt

A jump is one large d. A stale position, one receiver interval h old, is a step back along the track by v h, followed by
an equal step forward at the next new position.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from scipy.stats import binomtest

from ..regression import ROBUST
from .finding import HORIZON, LIMITS, Advice, Finding, Severity
from .motion import MAX_GAP, MOVING, Motion, integral, stretches
from .sampling import resolution

OUTLIER_SIGMAS = 6.0  # robust standard deviations beyond which a step is not noise
MIN_NOISE = 0.05  # m; noise between samples is 2 cm for RTK positions, and far less for those of an INS
MIN_JUMP = 0.2  # m; the distance in 10 ms at 20 m/s
MAX_LISTED_JUMPS = 50
JUMP_MARGIN = 0.5 * MAX_GAP + 0.01  # s to both sides of a jump, so that a gap remains; rounded to 10 ms
MIN_STALE_SAMPLES, WARNING_STALE_SHARE = 5, 0.05  # at this fraction, one start in twenty is wrong
MAX_AGE_SPREAD = 0.35  # spread of the ages of stale samples divided by their median
MIN_STEP_BALANCE = 0.5  # ratio of steps forward to steps back
MAX_CROSS_TRACK_SHARE = 0.3  # fraction of the step of a stale sample


def check_position_steps(motion: Motion) -> tuple[Motion, list[Finding]]:
    """(the motion, with even stamps in place of jittering ones; the findings)."""
    if len(motion.time) < 50:
        return motion, []
    errors, along = _step_errors(motion)
    jitter = _check_jitter(motion, along)
    if jitter:
        edges = np.concatenate(([0], np.flatnonzero(np.diff(motion.time) > MAX_GAP) + 1, [len(motion.time)]))
        even = [np.linspace(motion.time[a], motion.time[b - 1], b - a) for a, b in pairwise(edges)]
        return replace(motion, time=np.concatenate(even)), jitter
    rounding = max(resolution(motion.time, motion.x), resolution(motion.time, motion.y))
    stale, findings = _check_stale(motion, errors, along, rounding)
    findings += _check_jumps(motion, errors, stale, rounding)
    return motion, findings + (_check_noise(motion, errors) if rounding == 0.0 else [])


def _step_errors(motion: Motion) -> tuple[np.ndarray, np.ndarray]:
    """(d_k [m], east + i north; its part along the track divided by the speed [s], NaN at standstill), n - 1 each."""
    east, north = motion.velocity_map
    errors = (np.diff(motion.x) - np.diff(integral(motion.time, east))
              + 1j * (np.diff(motion.y) - np.diff(integral(motion.time, north))))
    speed = np.hypot(east, north)[1:]
    heading = np.exp(-1j * np.arctan2(north, east)[1:])
    return errors, np.where(speed > MOVING, (errors * heading).real / np.maximum(speed, MOVING), np.nan)


def _check_stale(motion: Motion, errors: np.ndarray, along: np.ndarray,
                 rounding: float) -> tuple[np.ndarray, list[Finding]]:
    """(mask of the steps due to stale samples, the finding)."""
    known = np.isfinite(along)
    none = np.zeros(len(along), bool)
    if known.sum() < 50:
        return none, []
    age = along - np.median(along[known])
    spacing = float(np.median(np.diff(motion.time)))
    small = np.abs(age[known]) < 0.15 * spacing
    spread = ROBUST * float(np.median(np.abs(age[known][small]))) if small.any() else np.inf
    speed = motion.speed[1:]
    across = np.sqrt(np.maximum(np.abs(errors) ** 2 - np.where(known, along * speed, 0.0) ** 2, 0.0))
    # Noise is equally large across the track and along it; at low speed the latter is many milliseconds.
    noise = ROBUST * float(np.median(across[known]))
    large = (known & (np.abs(age) > max(OUTLIER_SIGMAS * spread, 0.15 * spacing))
             & (np.abs(age) * speed > OUTLIER_SIGMAS * noise))
    # Stale samples step along the track; steps in any direction are jumps.
    if large.sum() < MIN_STALE_SAMPLES or np.median(across[large]) > MAX_CROSS_TRACK_SHARE * np.median(
            np.abs(errors[large])):
        return none, []
    delay = float(np.median(np.abs(age[large])))
    similar = ROBUST * float(np.median(np.abs(np.abs(age[large]) - delay))) < MAX_AGE_SPREAD * delay
    back, forward = known & (age < -0.5 * delay), known & (age > 0.5 * delay)
    balanced = MIN_STEP_BALANCE < forward.sum() / max(back.sum(), 1) < 1.0 / MIN_STEP_BALANCE
    if not similar or not balanced or delay > 1.2 * spacing or float(np.median(np.abs(errors[large]))) < 3.0 * rounding:
        return none, []
    share = float(back.sum() / known.sum())
    trials = max(round(float(known.sum()) * spacing), 1)  # errors of neighbouring samples are not independent
    ends = binomtest(round(share * trials), trials).proportion_ci(method="wilson")
    interval = min(float(ends.low), share), max(float(ends.high), share)
    text = (f"at {100 * share:.3g} % of the rows the position falls back to one measured {delay * 1e3:.0f} ms earlier, "
            "and returns later: in between it is stale by one sample of the receiver")
    severity = Severity.WARNING if share > WARNING_STALE_SHARE else Severity.NOTE
    stale = (back | forward) & (np.abs(age) < 1.6 * delay) & (across < MAX_CROSS_TRACK_SHARE * np.abs(errors))
    return stale, [Finding(
        "position_stale", severity, ("x", "y"), text, share, "1", interval, stretches(motion.time[1:][back], 5.0)[:20],
        delay * float(np.median(speed[known])),
        Advice("look", "stamp positions with their own time, or leave out the rows with a stale position"))]


def _check_jumps(motion: Motion, errors: np.ndarray, stale: np.ndarray, rounding: float) -> list[Finding]:
    size = np.abs(errors - np.median(errors.real) - 1j * np.median(errors.imag))
    scale = ROBUST * float(np.median(size))
    within = (np.diff(motion.time) <= MAX_GAP) & ~stale
    large = within & (size > max(OUTLIER_SIGMAS * scale, MIN_JUMP, 2.0 * rounding))
    count = int(large.sum())
    if not count:
        return []
    where = tuple((float(motion.time[k]), float(motion.time[k + 1])) for k in np.flatnonzero(large))
    median, largest = float(np.median(size[large])), float(size[large].max())
    text = (f"positions jump {count} time{'s' if count > 1 else ''}, not explained by velocity: median "
            f"{median:.2f} m, largest {largest:.2f} m")
    share = min(count * HORIZON / max(float(motion.time[-1] - motion.time[0]), 1.0), 1.0)
    effect = median * float(np.sqrt(share))
    return [Finding("position_jumps", LIMITS.severity(effect, largest >= LIMITS.warning), ("x", "y"), text,
                    float(count), "1", None, where[:MAX_LISTED_JUMPS], effect, _leave_out_jumps(where))]


def _leave_out_jumps(where: Sequence[tuple[float, float]]) -> Advice:
    """Advice to leave out the jumps: nothing is compared and no prediction scored across the resulting gaps."""
    if len(where) > MAX_LISTED_JUMPS:
        return Advice("look", "too many to leave out: record positions with RTK, or post-process the raw data")
    gaps: list[list[float]] = []
    for first, last in where:
        begin, end = round(first - JUMP_MARGIN, 2), round(last + JUMP_MARGIN, 2)
        if gaps and begin <= gaps[-1][1]:
            gaps[-1][1] = end
        else:
            gaps.append([begin, end])
    return Advice("run.yaml", f"leave_out: {gaps}", {"leave_out": gaps})


def _check_noise(motion: Motion, errors: np.ndarray) -> list[Finding]:
    """White noise of positions: |d_k| has a Rayleigh distribution with scale sqrt(2) sigma, median 1.665 sigma."""
    within = np.diff(motion.time) <= MAX_GAP
    if within.sum() < 50:
        return []
    sigma = float(np.median(np.abs(errors[within]))) / 1.665
    if sigma < MIN_NOISE:
        return []
    text = f"positions are noisy: standard deviation {sigma:.2f} m between samples"
    return [Finding("position_noise", LIMITS.severity(sigma), ("x", "y"), text, sigma, "m", effect=sigma,
                    advice=Advice("look", "record with RTK, or use the positions of the INS, not of the receiver"))]


def _check_jitter(motion: Motion, along: np.ndarray) -> list[Finding]:
    """Finding of uneven stamps of a smooth motion: d / v = -(dt - its mean)."""
    spacing = np.diff(motion.time)
    median = float(np.median(spacing))
    inside = (spacing < MAX_GAP) & np.isfinite(along)
    if inside.sum() < 50:
        return []
    uneven = (spacing - median)[inside]
    power = float(np.sum(uneven**2))
    deviation = float(np.std(uneven))
    if deviation < 0.05 * median or power <= 0.0:
        return []
    slope = float(np.sum(along[inside] * -uneven) / power)
    effect = deviation * float(np.median(motion.speed[1:][inside]))
    if slope < 0.5 or effect < LIMITS.min_reported_effect:
        return []
    text = f"the stamps jitter by {deviation * 1e3:.1f} ms but the motion is smooth: they are times of reception"
    return [Finding("time_jitter", LIMITS.severity(effect), ("time",), text, deviation, "s", effect=effect, advice=
                    Advice("look", "use the time of measurement (GPS time)"))]
