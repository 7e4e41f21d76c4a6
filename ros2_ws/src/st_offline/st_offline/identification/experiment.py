"""One experiment of `st identify`: how its data are read, computed and drawn; and its values as table cells."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from st_core.identification.apply import value_of
from st_core.identification.result import Estimate, Identification, quantity
from st_core.models import MODELS, Model
from st_core.vehicle import VehicleParameters
from st_recordings.runs import ReadSettings

from ..evaluation.drawing import Drawn, Place


@dataclass(frozen=True)
class Setup:
    """What every experiment may use in addition to its files. read: how recordings are read. force: use drives that the
    checks refuse. model: what drives are predicted with.
    """

    vehicle: VehicleParameters
    read: ReadSettings = field(default_factory=ReadSettings)
    force: bool = False
    model: Model = MODELS["nonlinear"]

    def uncertainty_of(self, parameter: str) -> float:
        """Standard uncertainty of a value of the vehicle file, SI; 0 where the file states none."""
        known = self.vehicle.provenance.get(parameter)
        return (known.uncertainty or 0.0) if known else 0.0


@dataclass(frozen=True)
class Experiment:
    """name: as on the command line. what: one line. files: what is to be given.

    identify: reads the files and computes; several outcomes where one call does several experiments.
    draw: the figure of an outcome of this experiment.
    Both raise StCoreError or RunError, one line for the user.
    """

    name: str
    what: str
    files: str
    identify: Callable[[Sequence[Path], Setup], tuple[Identification, ...]]
    draw: Callable[[Identification, Place], Drawn] | None = None
    files_needed: bool = True


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
    """The value to the second digit of its uncertainty; five digits without one."""
    if not math.isfinite(value):
        return "unknown"
    if not math.isfinite(spread) or spread <= 0.0:
        return f"{value:.5g}"
    decimals = max(0, 1 - math.floor(math.log10(spread)))
    return f"{value:.{min(decimals, 12)}f}"
