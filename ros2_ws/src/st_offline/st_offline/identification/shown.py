"""Values as a reader wants them: as many digits as the uncertainty bears, angles in degrees."""

import math
from collections.abc import Sequence

from st_core.identification.apply import value_of
from st_core.identification.result import Estimate, Identification, quantity
from st_core.vehicle import VehicleParameters

HEADS = ("parameter", "value", "±", "95 % interval", "unit", "in the file", "status")


def rows(found: Identification, vehicle: VehicleParameters) -> list[Sequence[str]]:
    """One row of HEADS per estimate; "in the file": what `vehicle` had before."""
    return [row(estimate, vehicle) for estimate in found.estimates]


def row(estimate: Estimate, vehicle: VehicleParameters) -> Sequence[str]:
    factor, unit = (180.0 / math.pi, "deg") if estimate.unit == "rad" else (1.0, estimate.unit)
    spread = estimate.standard_uncertainty * factor
    before = ""
    if quantity(estimate.parameter) is not None:
        before = number(value_of(vehicle, estimate.parameter) * factor, spread)
    low, high = (number(end * factor, spread) for end in estimate.interval95)
    return (estimate.parameter, number(estimate.value * factor, spread), number(spread, spread), f"{low} to {high}",
            unit, before, estimate.status)


def number(value: float, spread: float) -> str:
    """The value to the second digit of its uncertainty; five digits where there is none."""
    if not math.isfinite(value):
        return "unknown"
    if not math.isfinite(spread) or spread <= 0.0:
        return f"{value:.5g}"
    decimals = max(0, 1 - math.floor(math.log10(spread)))
    return f"{value:.{min(decimals, 12)}f}"
