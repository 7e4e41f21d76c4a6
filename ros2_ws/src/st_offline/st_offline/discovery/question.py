"""What a discovery was asked."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from st_core.discovery import DiscoverySettings
from st_core.vehicle import VehicleParameters

from .drives import Drive


@dataclass(frozen=True)
class Question:
    """Runs and healthy drives as read, base model by name or file, settings. vehicle_text: of
    vehicle_file. effects: folder of own effects, and the sha256 of each file in it."""

    runs: Sequence[Drive]
    reference: Sequence[Drive]
    base: str
    vehicle: VehicleParameters
    vehicle_file: str
    vehicle_text: str
    settings: DiscoverySettings
    effects: Mapping[str, str]
