"""First-order recursions over a whole recording without a loop over its samples."""

from collections.abc import Callable

import numpy as np

Maps = tuple[np.ndarray, np.ndarray]


def scan(maps: Maps, compose: Callable[[Maps, Maps], Maps]) -> Maps:
    """Compositions of maps 0..k for every k, in log2(n) passes (Hillis and Steele, 1986).

    maps: two numbers for each map. compose(earlier, later) -> the two numbers of "first earlier, then later".
    """
    first, second = (np.array(a, float) for a in maps)
    reach = 1
    while reach < len(first):
        earlier, later = (first[:-reach], second[:-reach]), (first[reach:], second[reach:])
        first[reach:], second[reach:] = compose(earlier, later)
        reach *= 2
    return first, second


def affine(earlier: Maps, later: Maps) -> Maps:
    """Of maps y -> a y + b, given as (a, b)."""
    return earlier[0] * later[0], later[0] * earlier[1] + later[1]


def clamp(earlier: Maps, later: Maps) -> Maps:
    """Of maps y -> min(max(y, low), high), given as (low, high) with low <= high."""
    low, high = (np.minimum(np.maximum(limit, later[0]), later[1]) for limit in earlier)
    return low, high
