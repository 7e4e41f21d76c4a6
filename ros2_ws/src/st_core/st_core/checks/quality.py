"""Modes and accuracies reported by the INS."""

import numpy as np

from .finding import Advice, Finding, InsQuality, Severity
from .limits import LIMITS

LOCKED = 4  # NCOM byte 21
RTK = (5, 6)  # NCOM position modes: RTK float, RTK integer


def quality(found: InsQuality | None, start_ns: int) -> list[Finding]:
    if found is None or len(found.time_ns) < 2:
        return []
    time = (found.time_ns - start_ns) * 1e-9
    return [*_mode(found, time), *_accuracy(found, time)]


def _mode(found: InsQuality, time: np.ndarray) -> list[Finding]:
    findings = []
    known = np.isfinite(found.position_mode) & (found.position_mode >= 0)
    lost = known & ~np.isin(found.position_mode, RTK)
    unlocked = np.isfinite(found.navigation_status) & (found.navigation_status != LOCKED)
    for bad, words in ((lost, "without RTK"), (unlocked, "not locked")):
        share = float(bad.mean())
        if share <= 0.0:
            continue
        text = f"the INS is {words} in {100 * share:.0f} % of the time: its positions wander there"
        severity = Severity.WARNING if share > 0.01 else Severity.NOTE
        findings.append(Finding("ins_mode", severity, ("ins",), text, share, where=_stretches(time, bad), advice=Advice(
            "look", "leave these stretches out, or post-process the raw data")))
    return findings


def _accuracy(found: InsQuality, time: np.ndarray) -> list[Finding]:
    known = np.isfinite(found.position_accuracy)
    if not known.any():
        return []
    typical = float(np.median(found.position_accuracy[known]))
    if typical < LIMITS.warning:
        return []
    poor = known & (found.position_accuracy >= LIMITS.warning)
    text = f"the INS's own standard deviation of position is {typical:.2f} m in the median"
    return [Finding("ins_accuracy", LIMITS.severity(typical), ("ins",), text, typical, "m", None,
                    _stretches(time, poor), typical, Advice("look", "record with RTK, or post-process"))]


def _stretches(time: np.ndarray, bad: np.ndarray) -> tuple[tuple[float, float], ...]:
    edges = np.flatnonzero(np.diff(np.concatenate(([0], bad.astype(int), [0]))))
    pairs = zip(edges[::2], edges[1::2] - 1, strict=True)
    return tuple((float(time[a]), float(time[b])) for a, b in pairs)[:20]
