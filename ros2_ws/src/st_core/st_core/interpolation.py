"""Signals at wanted instants: linear between samples that are close enough together, known nowhere else."""

import numpy as np


def between(times: np.ndarray, wanted: np.ndarray, gap_ns: int) -> tuple[np.ndarray, ...]:
    """(sample before, after, whether it is just that of `after`, whether it is known, share of the way there).

    times [ns]: rising, at least one. wanted [ns]: of any shape. gap_ns: nothing is known between samples further apart.
    """
    after = np.minimum(np.searchsorted(times, wanted), len(times) - 1)
    before = np.maximum(after - 1, 0)
    spacing = times[after] - times[before]
    exact = times[after] == wanted
    known = exact | ((wanted > times[before]) & (wanted < times[after]) & (spacing <= gap_ns))
    return before, after, exact, known, np.where(exact, 1.0, (wanted - times[before]) / np.maximum(spacing, 1))


def interpolate(time_ns: np.ndarray, values: np.ndarray, wanted_ns: np.ndarray, gap_ns: int) -> np.ndarray:
    """A signal at wanted instants; NaN where not known."""
    if not len(time_ns):
        return np.full(len(wanted_ns), np.nan)
    return at(values, *between(time_ns, wanted_ns, gap_ns))


def at(values: np.ndarray, before: np.ndarray, after: np.ndarray, exact: np.ndarray, known: np.ndarray,
       fraction: np.ndarray) -> np.ndarray:
    """A signal where `between` says."""
    low, high = values[before], values[after]
    return np.where(known, np.where(exact, high, low + fraction * (high - low)), np.nan)
