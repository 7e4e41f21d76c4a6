"""What `st identify` needs to know of one experiment: how its data are read, computed and drawn."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from st_core.identification.result import Identification
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
    draw: the figure of an outcome whose `what` is this experiment's name.
    Both raise StCoreError or RunError, one line for the user.
    """

    name: str
    what: str
    files: str
    identify: Callable[[Sequence[Path], Setup], tuple[Identification, ...]]
    draw: Callable[[Identification, Place], Drawn] | None = None
    files_needed: bool = True
