"""Starts sorted by the conditions of their horizon: speed, lateral acceleration, steering rate, direction."""

import math
from dataclasses import dataclass

import numpy as np

from .log_evaluation import LogEvaluation

# Lower edges. Steps follow the paper's scenarios: 4 and 16 m/s; 1.5, 4 and 6 m/s^2.
SPEED = (0.0, 3.0, 6.0, 9.0, 12.0, 15.0, 20.0, 25.0)  # m/s
LATERAL_ACCELERATION = (0.0, 0.5, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0)  # m/s^2, magnitude
STEERING_RATE = (0.0, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2)  # rad/s at the road wheel, root mean square
STRAIGHT = math.radians(5.0)  # heading changes by less over the horizon


@dataclass(frozen=True, eq=False)
class Bin:
    """label: as shown in tables, with the unit. low, high: edges in SI, None if open. select: (n,)."""

    quantity: str
    label: str
    low: float | None
    high: float | None
    select: np.ndarray


def bins(evaluation: LogEvaluation) -> list[Bin]:
    """All bins with a start; starts with unknown conditions are in none."""
    c = evaluation.conditions
    found = [
        *_edges("speed", "m/s", c["speed"], SPEED),
        *_edges("lateral acceleration", "m/s²", np.abs(c["lateral_acceleration"]), LATERAL_ACCELERATION),
        *_edges("steering rate", "rad/s", c["steering_rate"], STEERING_RATE),
        *_directions(c["heading_change"]),
    ]
    return [b for b in found if b.select.any()]


def _edges(quantity: str, unit: str, values: np.ndarray, lower: tuple[float, ...]) -> list[Bin]:
    upper = (*lower[1:], math.inf)
    return [Bin(quantity, f"{low:g} to {high:g} {unit}" if math.isfinite(high) else f"above {low:g} {unit}", low,
                high if math.isfinite(high) else None, (values >= low) & (values < high))
            for low, high in zip(lower, upper, strict=True)]


def _directions(heading_change: np.ndarray) -> list[Bin]:
    return [Bin("direction", "left", STRAIGHT, None, heading_change >= STRAIGHT),
            Bin("direction", "straight", -STRAIGHT, STRAIGHT, np.abs(heading_change) < STRAIGHT),
            Bin("direction", "right", None, -STRAIGHT, heading_change <= -STRAIGHT)]
