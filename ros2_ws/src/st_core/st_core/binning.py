"""Bins prediction starts by driving condition: speed, lateral acceleration, steering rate, direction of the turn."""

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from .log_evaluation import LogEvaluation

# Lower edges of the bins, chosen around the scenarios of the paper: 4 and 16 m/s; 1.5, 4 and 6 m/s^2.
SPEED_EDGES = (0.0, 3.0, 6.0, 9.0, 12.0, 15.0, 20.0, 25.0)  # m/s
LATERAL_ACCELERATION_EDGES = (0.0, 0.5, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0)  # m/s^2, magnitude
STEERING_RATE_EDGES = (0.0, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2)  # rad/s at the road wheel, root mean square
MAX_STRAIGHT_TURN = math.radians(5.0)  # largest change of heading within the horizon that counts as straight


@dataclass(frozen=True, eq=False)
class Bin:
    """Starts within a range of one quantity."""

    quantity: str
    label: str  # for tables, with the unit
    low: float | None  # edge in SI, None if open
    high: float | None  # edge in SI, None if open
    mask: np.ndarray  # (n,), True for the starts in the bin


def bin_starts(evaluation: LogEvaluation) -> list[Bin]:
    """All bins that are not empty; a start with unknown conditions (NaN) is in no bin."""
    conditions, turn = evaluation.conditions, evaluation.conditions["heading_change"]
    lateral_acceleration = np.abs(conditions["lateral_acceleration"])
    bins = [
        *_bin_by_edges("speed", "m/s", conditions["speed"], SPEED_EDGES),
        *_bin_by_edges("lateral acceleration", "m/s²", lateral_acceleration, LATERAL_ACCELERATION_EDGES),
        *_bin_by_edges("steering rate", "rad/s", conditions["steering_rate"], STEERING_RATE_EDGES),
        Bin("direction", "left", MAX_STRAIGHT_TURN, None, turn >= MAX_STRAIGHT_TURN),
        Bin("direction", "straight", -MAX_STRAIGHT_TURN, MAX_STRAIGHT_TURN, np.abs(turn) < MAX_STRAIGHT_TURN),
        Bin("direction", "right", None, -MAX_STRAIGHT_TURN, turn <= -MAX_STRAIGHT_TURN),
    ]
    return [bin_ for bin_ in bins if bin_.mask.any()]


def _bin_by_edges(quantity: str, unit: str, values: np.ndarray, edges: tuple[float, ...]) -> list[Bin]:
    """Bins between consecutive edges, and an open bin above the last edge."""
    bounded = [Bin(quantity, f"{low:g} to {high:g} {unit}", low, high, (values >= low) & (values < high))
               for low, high in pairwise(edges)]
    return [*bounded, Bin(quantity, f"above {edges[-1]:g} {unit}", edges[-1], None, values >= edges[-1])]
