"""Positions sample by sample against integrated velocity: jumps, stale samples, stamps that jitter.

    d_k = p_k - p_{k-1} - integral of R(yaw) v dt

A jump is one large d; a stale sample is a step back along the track by v h and the same forward again.
"""

import numpy as np

from .finding import Cure, Finding, Severity
from .limits import LIMITS
from .motion import LONGEST_GAP, MOVING, Motion, integral

NEAR = 0.5  # s around a sample that tell where it should be
SIGMAS = 8.0  # robust standard deviations from which on a step is none of the noise
SMALLEST_JUMP = 0.1  # m; RTK positions wander by 2 cm
LEAST_STALE = 0.02  # share of samples
ALIKE = 0.35  # spread of the ages of stale samples over their median


def steps(motion: Motion) -> list[Finding]:
    if len(motion.time) < 50:
        return []
    along, across, rest = _rests(motion)
    stale = _stale(motion, along)
    return stale or _jumps(motion, rest) or _jitter(motion, rest)


def _rests(motion: Motion) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(distance of each position from its neighbourhood, along and across the track [m]; complex d_k [m], n - 1)."""
    east, north = motion.velocity_map
    drift = (motion.x - integral(motion.time, east)) + 1j * (motion.y - integral(motion.time, north))
    count = max(int(round(2 * NEAR / float(np.median(np.diff(motion.time))))) | 1, 5)
    away = drift - (_running_median(drift.real, count) + 1j * _running_median(drift.imag, count))
    heading = np.exp(-1j * np.arctan2(north, east))
    turned = away * heading
    return turned.real, turned.imag, np.diff(drift)


def _running_median(values: np.ndarray, count: int) -> np.ndarray:
    from scipy.ndimage import median_filter

    return median_filter(values, size=count, mode="nearest")


def _stale(motion: Motion, along: np.ndarray) -> list[Finding]:
    """Samples late by one and the same time."""
    speed = motion.speed
    moving = speed > MOVING
    age = -along[moving] / speed[moving]
    spread = 1.4826 * float(np.median(np.abs(age)))
    spacing = float(np.median(np.diff(motion.time)))
    old = age > max(4.0 * spread, 0.15 * spacing)
    share = float(old.mean()) if len(age) else 0.0
    if share < LEAST_STALE:
        return []
    typical = float(np.median(age[old]))
    alike = 1.4826 * float(np.median(np.abs(age[old] - typical))) < ALIKE * typical
    if not alike or typical > 2.5 * spacing:
        return []
    half = 1.96 * np.sqrt(share * (1.0 - share) / max(moving.sum() / 10.0, 1.0))
    effect = typical * float(np.median(speed[moving]))
    text = (f"{100 * share:.0f} % of the positions are {typical * 1e3:.0f} ms old: they repeat what was measured one "
            "sample before")
    severity = max(LIMITS.severity(effect), Severity.WARNING, key=lambda s: s is Severity.ERROR)
    where = _stretches(motion.time[moving][old])
    return [Finding("position_stale", severity, ("x", "y"), text, share, "1",
                    (max(share - half, 0.0), min(share + half, 1.0)), where, effect,
                    Cure("look", "stamp positions with their own time, or drop rows whose position is the old one"))]


def _jumps(motion: Motion, rest: np.ndarray) -> list[Finding]:
    size = np.abs(rest - np.median(rest.real) - 1j * np.median(rest.imag))
    scale = 1.4826 * float(np.median(size))
    within = np.diff(motion.time) <= LONGEST_GAP
    large = within & (size > max(SIGMAS * scale, SMALLEST_JUMP))
    count = int(large.sum())
    if not count:
        return []
    sizes = size[large]
    where = tuple((float(motion.time[k]), float(motion.time[k + 1])) for k in np.flatnonzero(large)[:50])
    median, largest = float(np.median(sizes)), float(sizes.max())
    text = (f"positions jump {count} time{'s' if count > 1 else ''}, by {median:.2f} m in the median, {largest:.2f} m at "
            "most, which velocity knows nothing of")
    share = min(count * 5.0 / max(float(motion.time[-1] - motion.time[0]), 1.0), 1.0)
    effect = median * np.sqrt(share)
    severity = Severity.ERROR if effect >= LIMITS.error else Severity.WARNING
    stretches = [[round(a - 0.01, 2), round(b + 0.01, 2)] for a, b in where]
    return [Finding("position_jumps", severity, ("x", "y"), text, float(count), "1", None, where, effect,
                    Cure("run.yaml", f"leave_out: {stretches[:3]}" + (" …" if count > 3 else ""),
                         {"leave_out": stretches}))]


def _jitter(motion: Motion, rest: np.ndarray) -> list[Finding]:
    """Uneven stamps of an even motion: d = -v (dt - its mean)."""
    spacing = np.diff(motion.time)
    usual = float(np.median(spacing))
    inside = (spacing < 3.0 * usual) & (motion.speed[1:] > MOVING)
    if inside.sum() < 50:
        return []
    uneven = (spacing - usual)[inside]
    speed = motion.speed[1:][inside]
    east, north = (v[1:][inside] for v in motion.velocity_map)
    along = (rest[inside] * np.exp(-1j * np.arctan2(north, east))).real
    power = float(np.sum((speed * uneven) ** 2))
    deviation = float(np.std(uneven))
    if deviation < 0.05 * usual or power <= 0.0:
        return []
    slope = float(np.sum(along * -speed * uneven) / power)
    effect = deviation * float(np.median(speed))
    if slope < 0.5 or effect < LIMITS.worth_a_word:
        return []
    text = f"the stamps jitter by {deviation * 1e3:.1f} ms, the motion does not: they were made on arrival"
    return [Finding("time_jitter", LIMITS.severity(effect), ("time",), text, deviation, "s", None, (), effect,
                    Cure("look", "use the time of measurement (GPS time), not that of reception"))]


def _stretches(times: np.ndarray) -> tuple[tuple[float, float], ...]:
    """Runs of instants that are less than 5 s apart."""
    if not len(times):
        return ()
    edges = np.flatnonzero(np.diff(times) > 5.0)
    first, last = np.concatenate(([0], edges + 1)), np.concatenate((edges, [len(times) - 1]))
    return tuple((float(times[a]), float(times[b])) for a, b in zip(first, last, strict=True))[:20]
