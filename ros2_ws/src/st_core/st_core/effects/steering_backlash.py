"""Play in the steering: the wheels follow only at the ends of the play."""

from collections.abc import Callable

import numpy as np

from ._base import ANY, Effect, Parameter, register

Maps = tuple[np.ndarray, np.ndarray]


def scan(maps: Maps, compose: Callable[[Maps, Maps], Maps]) -> Maps:
    """Composition of the maps 0 to k for every k, in log2(n) passes (Hillis and Steele, 1986). maps: two numbers per
    map, (n,) each. compose(earlier, later): the two numbers of the map later(earlier(y))."""
    first, second = (np.array(a, float) for a in maps)
    reach = 1
    while reach < len(first):
        earlier, later = (first[:-reach], second[:-reach]), (first[reach:], second[reach:])
        first[reach:], second[reach:] = compose(earlier, later)
        reach *= 2
    return first, second


def compose_affine(earlier: Maps, later: Maps) -> Maps:
    """Composition of maps y -> a y + b, given as (a, b)."""
    return earlier[0] * later[0], later[0] * earlier[1] + later[1]


def compose_clamps(earlier: Maps, later: Maps) -> Maps:
    """Composition of maps y -> min(max(y, low), high), given as (low, high) with low <= high."""
    low, high = (np.minimum(np.maximum(limit, later[0]), later[1]) for limit in earlier)
    return low, high


@register
class SteeringBacklash(Effect):
    physics = "delta is constant until delta_measured leaves delta +- play / 2, then follows it at that distance"
    excited_by = "small steering reversals around straight ahead; not observable at large amplitudes"
    kind, slot = "physics", "steering"
    confounded_with = ("steering_delay", "steering_lag", "steering_ratio")
    applies_to = ANY
    order = 20
    parameter = Parameter("play", "rad", null=0.0, initial=0.003, bounds=(0.0, 0.02),
                          meaning="total play, as an angle of the road wheels",
                          source="0.02 rad is 20 deg at a steering wheel with ratio 17, twice the limit of "
                                 "vehicle inspections")

    @staticmethod
    def steering(time, angle, is_start, theta):
        half = 0.5 * theta.play * ~is_start
        return time, scan((angle - half, angle + half), compose_clamps)[0]
