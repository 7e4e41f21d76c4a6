"""Everything a discovery depends on: options, files, drives."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from st_core.discovery import DiscoverySettings
from st_core.vehicle import VehicleParameters
from st_recordings.runs import ReadSettings

from .drives import Drive


@dataclass(frozen=True)
class Request:
    """base: name or model file. vehicle_text: of vehicle_file. settings: of the search.

    runs, reference: paths of recordings; drives, healthy: the same as read. read: how. effects: folder of own effects;
    own_effects: sha256 of each file in it. output: folder, None for runs/discover-<time>. jobs: processes. formats: of
    figure files. report: whether one is written. cached: whether earlier results may be used. force: use runs in which
    a check finds an error. propose: search for a relation beyond the library; None: where much is unexplained. given:
    options that name the car and the reading of the recordings, as typed; given_vehicle: those that every verb takes.
    """

    base: str
    vehicle: VehicleParameters
    vehicle_file: str
    vehicle_text: str
    settings: DiscoverySettings
    runs: Sequence[Path] = ()
    reference: Sequence[Path] = ()
    read: ReadSettings = field(default_factory=ReadSettings)
    effects: Path | None = None
    output: Path | None = None
    jobs: int = 1
    formats: tuple[str, ...] = ()
    report: bool = True
    cached: bool = True
    force: bool = False
    propose: bool | None = None
    given: Sequence[str] = ()
    given_vehicle: Sequence[str] = ()
    drives: Sequence[Drive] = ()
    healthy: Sequence[Drive] = ()
    own_effects: Mapping[str, str] = field(default_factory=dict)
