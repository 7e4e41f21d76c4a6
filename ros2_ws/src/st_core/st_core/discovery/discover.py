"""From drives to the name of what the model lacks."""

from collections.abc import Callable, Sequence

from ..log import DriveLog
from ..models import Model
from ..vehicle import VehicleParameters
from .result import Discovery
from .settings import DiscoverySettings

Progress = Callable[[str, int, int], None]


def discover(runs: Sequence[DriveLog], vehicle: VehicleParameters, base: str | Model = "nonlinear",
             reference: Sequence[DriveLog] = (), settings: DiscoverySettings | None = None,
             progress: Progress | None = None) -> Discovery:
    """The effects the base model lacks to explain the runs. reference: drives of the healthy car.

    progress(stage, done, total): called as the work goes on.
    """
    raise NotImplementedError("discover")
