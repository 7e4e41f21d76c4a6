"""How driving fills speed and lateral acceleration, and a refusal where it is too thin."""

from collections.abc import Sequence

import numpy as np

from .result import Coverage, IdentificationError

SPEED_EDGES = np.array([0.0, 3.0, 6.0, 9.0, 12.0, 15.0, 20.0, 30.0, 60.0])  # m/s
ACCELERATION_EDGES = np.array([-8.0, -4.0, -3.0, -2.0, -1.0, -0.3, 0.3, 1.0, 2.0, 3.0, 4.0, 8.0])  # m/s^2, left +


def coverage(signal: str, unit: str, edges: np.ndarray, values: Sequence[np.ndarray], interval: float,
             seconds_needed: float, bins_needed: int) -> Coverage:
    """Samples by bin over all drives. values: of each drive, sampled every `interval` [s] on average; a bin counts from
    `seconds_needed` on.
    """
    counts = np.histogram(np.concatenate([np.asarray(v) for v in values]), edges)[0] if len(values) else \
        np.zeros(len(edges) - 1, int)
    return Coverage(signal, unit, edges, counts, needed=max(1, round(seconds_needed / interval)),
                    bins_needed=bins_needed)


def require(coverages: Sequence[Coverage], advice: str) -> None:
    """Raises IdentificationError with the numbers of every signal that is too thin; `advice`: what to drive."""
    thin = [c.words() for c in coverages if not c.enough]
    if thin:
        raise IdentificationError(f"the driving is too thin: {'; '.join(thin)}. {advice}")
