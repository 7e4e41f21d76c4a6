"""Positions sample by sample against integrated velocity: jumps, stale samples, stamps that jitter.

    d_k = p_k - p_{k-1} - integral of R(yaw) v dt

A jump is one large d. A position that is one sample of the receiver old steps back along the track by v h, and forward
again by as much with the next fresh one.
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from scipy.stats import binomtest

from .finding import LIMITS, Advice, Finding, Severity
from .motion import LONGEST_GAP, MOVING, Motion, integral, stretches
from .sampling import resolution

SIGMAS = 6.0  # robust standard deviations from which on a step is none of the noise
LEAST_NOISE = 0.05  # m; RTK positions have 2 cm, and those of an INS far less from sample to sample
SMALLEST_JUMP = 0.2  # m; what 10 ms are at 20 m/s
MOST_JUMPS = 50  # that are listed one by one
ASIDE = 0.5 * LONGEST_GAP + 0.01  # s to both sides that make a gap, rounded to 10 ms
FEWEST, LEAST_STALE = 5, 0.05  # samples, and their share from which on one start in twenty is wrong by it
ALIKE = 0.35  # spread of the ages of stale samples over their median
BALANCE = 0.5  # steps forward over steps back, at least
CROSSWISE = 0.3  # part of a stale sample's step across the track, at most


def steps(motion: Motion) -> tuple[Motion, list[Finding]]:
    """(motion, with even stamps where they only jitter; what was found)."""
    if len(motion.time) < 50:
        return motion, []
    rest, along = _rests(motion)
    rounding = max(resolution(motion.x), resolution(motion.y))
    jitter = _jitter(motion, along)
    if jitter:
        return motion.with_(time=_even(motion.time)), jitter
    stale, findings = _stale(motion, rest, along, rounding)
    return motion, findings + _jumps(motion, rest, stale, rounding) + (_noise(motion, rest) if rounding == 0.0 else [])


def _even(time: np.ndarray) -> np.ndarray:
    """The same stretches without a gap, evenly stamped."""
    edges = np.concatenate(([0], np.flatnonzero(np.diff(time) > LONGEST_GAP) + 1, [len(time)]))
    return np.concatenate([np.linspace(time[a], time[b - 1], b - a) for a, b in pairwise(edges)])


def _rests(motion: Motion) -> tuple[np.ndarray, np.ndarray]:
    """(d_k [m], east + i north; its part along the track over the speed [s], NaN at standstill): n - 1 each."""
    east, north = motion.velocity_map
    rest = (np.diff(motion.x) - np.diff(integral(motion.time, east))
            + 1j * (np.diff(motion.y) - np.diff(integral(motion.time, north))))
    speed = np.hypot(east, north)[1:]
    heading = np.exp(-1j * np.arctan2(north, east)[1:])
    return rest, np.where(speed > MOVING, (rest * heading).real / np.maximum(speed, MOVING), np.nan)


def _stale(motion: Motion, rest: np.ndarray, along: np.ndarray, rounding: float) -> tuple[np.ndarray, list[Finding]]:
    """(which steps are those of stale samples, the finding)."""
    known = np.isfinite(along)
    none = np.zeros(len(along), bool)
    if known.sum() < 50:
        return none, []
    away = along - np.median(along[known])
    spacing = float(np.median(np.diff(motion.time)))
    small = np.abs(away[known]) < 0.15 * spacing
    spread = 1.4826 * float(np.median(np.abs(away[known][small]))) if small.any() else np.inf
    speed = motion.speed[1:]
    crosswise = np.sqrt(np.maximum(np.abs(rest) ** 2 - np.where(known, along * speed, 0.0) ** 2, 0.0))
    # Noise is as large across the track as along it; at low speed its part along is many milliseconds.
    noise = 1.4826 * float(np.median(crosswise[known]))
    large = known & (np.abs(away) > max(SIGMAS * spread, 0.15 * spacing)) & (np.abs(away) * speed > SIGMAS * noise)
    # Along the track, whatever its direction: else positions jump.
    if large.sum() < FEWEST or np.median(crosswise[large]) > CROSSWISE * np.median(np.abs(rest[large])):
        return none, []
    age = float(np.median(np.abs(away[large])))
    alike = 1.4826 * float(np.median(np.abs(np.abs(away[large]) - age))) < ALIKE * age
    back, forward = known & (away < -0.5 * age), known & (away > 0.5 * age)
    far = float(np.median(np.abs(rest[large])))
    balanced = BALANCE < forward.sum() / max(back.sum(), 1) < 1.0 / BALANCE
    if not alike or not balanced or age > 1.2 * spacing or far < 3.0 * rounding:
        return none, []
    share = float(back.sum() / known.sum())
    trials = max(round(float(known.sum()) * spacing), 1)  # errors of neighbouring samples are not independent
    ends = binomtest(round(share * trials), trials).proportion_ci(method="wilson")
    interval = min(float(ends.low), share), max(float(ends.high), share)
    effect = age * float(np.median(speed[known]))
    text = (f"at {100 * share:.2g} % of the rows the position falls back to one measured {age * 1e3:.0f} ms earlier, "
            "and catches up later: in between it is one sample of the receiver old")
    severity = Severity.WARNING if share > LEAST_STALE else Severity.NOTE
    its = (back | forward) & (np.abs(away) < 1.6 * age) & (crosswise < CROSSWISE * np.abs(rest))
    return its, [Finding(
        "position_stale", severity, ("x", "y"), text, share, "1", interval,
        stretches(motion.time[1:][back], 5.0)[:20], effect,
        Advice("look", "stamp positions with their own time, or leave out rows with an old one"))]


def _jumps(motion: Motion, rest: np.ndarray, stale: np.ndarray, rounding: float) -> list[Finding]:
    size = np.abs(rest - np.median(rest.real) - 1j * np.median(rest.imag))
    scale = 1.4826 * float(np.median(size))
    within = (np.diff(motion.time) <= LONGEST_GAP) & ~stale
    large = within & (size > max(SIGMAS * scale, SMALLEST_JUMP, 2.0 * rounding))
    count = int(large.sum())
    if not count:
        return []
    sizes = size[large]
    where = tuple((float(motion.time[k]), float(motion.time[k + 1])) for k in np.flatnonzero(large))
    median, largest = float(np.median(sizes)), float(sizes.max())
    text = (f"positions jump {count} time{'s' if count > 1 else ''}, by {median:.2f} m in the median, {largest:.2f} m "
            "at most, not explained by velocity")
    share = min(count * 5.0 / max(float(motion.time[-1] - motion.time[0]), 1.0), 1.0)
    effect = median * float(np.sqrt(share))
    return [Finding("position_jumps", LIMITS.severity(effect, largest >= LIMITS.warning), ("x", "y"), text,
                    float(count), "1", None, where[:MOST_JUMPS], effect, _without(where))]


def _without(where: Sequence[tuple[float, float]]) -> Advice:
    """A gap at each jump: nothing is compared, and no prediction scored, across one."""
    if len(where) > MOST_JUMPS:
        return Advice("look", "too many to leave out: use the positions of one receiver, with RTK, or post-process")
    stretches: list[list[float]] = []
    for first, last in where:
        begin, end = round(first - ASIDE, 2), round(last + ASIDE, 2)
        if stretches and begin <= stretches[-1][1]:
            stretches[-1][1] = end
        else:
            stretches.append([begin, end])
    return Advice("run.yaml", f"leave_out: {stretches}", {"leave_out": stretches})


def _noise(motion: Motion, rest: np.ndarray) -> list[Finding]:
    """White noise of positions: the size of d_k is Rayleigh distributed about sigma sqrt(2), its median 1.665 sigma."""
    within = np.diff(motion.time) <= LONGEST_GAP
    if within.sum() < 50:
        return []
    sigma = float(np.median(np.abs(rest[within]))) / 1.665
    if sigma < LEAST_NOISE:
        return []
    text = f"positions are noisy: {sigma:.2f} m of standard deviation from one sample to the next"
    return [Finding("position_noise", LIMITS.severity(sigma), ("x", "y"), text, sigma, "m", effect=sigma,
                    advice=Advice("look", "record with RTK, or use the positions of the INS, not of the receiver"))]


def _jitter(motion: Motion, along: np.ndarray) -> list[Finding]:
    """Uneven stamps of an even motion: d / v = -(dt - its mean)."""
    spacing = np.diff(motion.time)
    usual = float(np.median(spacing))
    inside = (spacing < LONGEST_GAP) & np.isfinite(along)
    if inside.sum() < 50:
        return []
    uneven = (spacing - usual)[inside]
    power = float(np.sum(uneven**2))
    deviation = float(np.std(uneven))
    if deviation < 0.05 * usual or power <= 0.0:
        return []
    slope = float(np.sum(along[inside] * -uneven) / power)
    effect = deviation * float(np.median(motion.speed[1:][inside]))
    if slope < 0.5 or effect < LIMITS.min_reported_effect:
        return []
    text = f"the stamps jitter by {deviation * 1e3:.1f} ms, the motion does not: they were made on arrival"
    return [Finding("time_jitter", LIMITS.severity(effect), ("time",), text, deviation, "s", None, (), effect,
                    Advice("look", "use the time of measurement (GPS time), not that of reception"))]
