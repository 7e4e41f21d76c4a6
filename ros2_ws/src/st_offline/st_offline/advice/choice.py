"""The cheapest model and step that is good enough, for each speed and second ahead."""

import math
from collections.abc import Mapping

from st_core.binning import SPEED

from .cost import Cost
from .worth import Worth

Key = tuple[str, float]
"""Model, step [s]."""


def paid(cost: Cost) -> float:
    """Processor time that counts in a choice [s]: one prediction, compiled where the model can be."""
    return cost.floats if cost.compiled is None else cost.compiled


def cheapest(costs: Mapping[Key, Cost], worths: Mapping[Key, Worth],
             tolerance: float) -> dict[float, tuple[Key | None, ...]]:
    """By lower edge of speed [m/s]: for each second ahead the cheapest whose error across stays within the tolerance
    [m] in SHARE of the starts; None where no model does.
    """
    order = sorted(worths, key=lambda key: paid(costs[key]))
    speeds = sorted({low for one in worths.values() for low in one.within})
    seconds = max((len(one.second) for one in worths.values()), default=0)
    return {low: tuple(next((key for key in order if low in worths[key].within
                             and worths[key].within[low][k] <= tolerance), None) for k in range(seconds))
            for low in speeds}


def speed_label(low: float) -> str:
    """Of a lower edge [m/s]."""
    high = dict(zip(SPEED, (*SPEED[1:], math.inf), strict=True))[low]
    return f"{low:g} to {high:g} m/s" if math.isfinite(high) else f"above {low:g} m/s"
