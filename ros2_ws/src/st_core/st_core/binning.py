"""Starts of predictions binned by driving conditions: speed, lateral acceleration, steering rate, direction."""

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from .log_evaluation import LogEvaluation

# Lower edges of the bins, chosen around the scenarios of the paper: 4 and 16 m/s; 1.5, 4 and 6 m/s^2.
SPEED = (0.0, 3.0, 6.0, 9.0, 12.0, 15.0, 20.0, 25.0)  # m/s
LATERAL_ACCELERATION = (0.0, 0.5, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0)  # m/s^2, magnitude
STEERING_RATE = (0.0, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2)  # rad/s at the road wheel, root mean square
STRAIGHT = math.radians(5.0)  # largest change of heading within the horizon that counts as straight


@dataclass(frozen=True, eq=False)
class Bin:
    """Starts within a range of one quantity.

    label: for tables, with the unit. low, high: edges in SI, None if open. select: (n,) mask of the starts.
    """

    quantity: str
    label: str
    low: float | None
    high: float | None
    select: np.ndarray


def bins(evaluation: LogEvaluation) -> list[Bin]:
    """All bins that are not empty; a start under unknown conditions (NaN) is in no bin."""
    conditions, turn = evaluation.conditions, evaluation.conditions["heading_change"]
    candidates = [
        *_bins_of("speed", "m/s", conditions["speed"], SPEED),
        *_bins_of("lateral acceleration", "m/s²", np.abs(conditions["lateral_acceleration"]), LATERAL_ACCELERATION),
        *_bins_of("steering rate", "rad/s", conditions["steering_rate"], STEERING_RATE),
        Bin("direction", "left", STRAIGHT, None, turn >= STRAIGHT),
        Bin("direction", "straight", -STRAIGHT, STRAIGHT, np.abs(turn) < STRAIGHT),
        Bin("direction", "right", None, -STRAIGHT, turn <= -STRAIGHT),
    ]
    return [candidate for candidate in candidates if candidate.select.any()]


def _bins_of(quantity: str, unit: str, values: np.ndarray, lower: tuple[float, ...]) -> list[Bin]:
    inner = [Bin(quantity, f"{low:g} to {high:g} {unit}", low, high, (values >= low) & (values < high))
             for low, high in pairwise(lower)]
    return [*inner, Bin(quantity, f"above {lower[-1]:g} {unit}", lower[-1], None, values >= lower[-1])]
