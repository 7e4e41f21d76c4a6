"""Conformal factors: the multiple of the scale that covers a new run with a stated probability, calibrated run by run.

Windows of one run repeat each other; runs are exchangeable, windows are not. Take one window at random of each of n
runs and one of a run to come: n + 1 exchangeable scores, so that the k-th smallest of the n,

    k = level (n + 1),

is not exceeded by the last with the probability k/(n + 1) = level, whatever the errors are distributed like. For k > n
no bound exists: n runs support levels up to n/(n + 1). The draw of windows must not matter, so the factor c
covers as much as draws do on average, every run weighing the same:

    F(c) = E[ F(k-th smallest of one window a run) ],     F(s) = 1/n sum_r 1/n_r #{i : s_ri <= s}

For a k that is not whole, E[...] is interpolated between the neighbouring whole ones. With one window a run and a whole
k, c is the split-conformal quantile, exactly. This is proven for one draw; for the average over draws it
is measured, not proven (docs/manual/bands.md).
Source: Dunn, Wasserman and Ramdas, Distribution-free prediction sets for two-layer hierarchical models, JASA 2023,
subsampling once and repeatedly. Checked by: test_bands.py, against crepes and by drawing runs.
"""

import math
from collections.abc import Sequence

import numpy as np

from ..errors import StCoreError

ROUNDING = 1.0e-9


def highest_level(runs: int) -> float:
    """The highest level that so many runs support, n/(n + 1) [1]."""
    return runs / (runs + 1.0)


def runs_needed(level: float) -> int:
    """The fewest runs that support a level in (0, 1): the least n with n/(n + 1) >= level."""
    return max(1, math.ceil(level / (1.0 - level) - ROUNDING))


def check_levels(levels: Sequence[float], runs: int) -> None:
    """Raises StCoreError, one line, for a level outside (0, 1) or above what `runs` runs support."""
    for level in levels:
        if not 0.0 < level < 1.0:
            raise StCoreError(f"level {level:g}: not between 0 and 1")
        if level > highest_level(runs) + ROUNDING:
            raise StCoreError(f"{runs} run{'' if runs == 1 else 's'} can promise {highest_level(runs):.1%} at most, "
                              f"n/(n + 1), not {level:.0%}: give {runs_needed(level)} runs or more, or a lower --level")


def conformal_factors(scores: Sequence[np.ndarray], levels: Sequence[float]) -> np.ndarray:
    """c for every level, (levels,) [1]; see the top of this file.

    scores: one array a run, one score a window [1], at least one each. Raises StCoreError for scores that are not
    finite, a run without any, and as `check_levels`.
    """
    count = len(scores)
    check_levels(levels, count)
    if any(len(one) == 0 for one in scores):
        raise StCoreError("a run has no window; leave it out")
    values = np.sort(np.concatenate([np.asarray(one, float) for one in scores]))
    if not np.isfinite(values).all():
        raise StCoreError("a score is not finite; no band is made of such errors")
    below = np.stack([np.searchsorted(np.sort(one), values, side="right") / len(one) for one in scores])
    covered = below.mean(axis=0)
    # at_least[k]: distribution of the k-th smallest of a draw; what it covers on average. The 0-th covers nothing.
    at_least = _chance_of_at_least(below)
    mean = np.concatenate([[0.0], np.diff(at_least[1:], axis=1, prepend=0.0) @ covered])
    target = np.interp(np.asarray(levels, float) * (count + 1.0), np.arange(count + 1), mean)
    return values[np.minimum(np.searchsorted(covered, target - ROUNDING), len(values) - 1)]


def _chance_of_at_least(below: np.ndarray) -> np.ndarray:
    """(runs + 1, values): probability that at least k of one window a run are <= a value. below: (runs, values)."""
    exactly = np.zeros((len(below) + 1, below.shape[1]))
    exactly[0] = 1.0
    for p in below:
        exactly[1:] = exactly[1:] * (1.0 - p) + exactly[:-1] * p
        exactly[0] *= 1.0 - p
    return np.cumsum(exactly[::-1], axis=0)[::-1]
