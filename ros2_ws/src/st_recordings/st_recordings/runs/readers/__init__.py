"""Registry of the kinds of recordings: every module in this folder registers one or more `Reader`s.

A module imports slow libraries only when it reads, because most commands read runs of one kind.
"""

import importlib
import pkgutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from st_core.vehicle import VehicleParameters

from ..ins_log import InsLog
from ..run_types import LoadedRun, ReadSettings, RunSource


@dataclass(frozen=True)
class Reader:
    """One kind of recording."""

    kind: str
    key: str  # key of its files in a run.yaml
    extensions: tuple[str, ...]  # lower case
    # Reads the whole drive of a run; raises RunError. None for a kind without steering angle, which needs CAN logs.
    read: Callable[[RunSource, VehicleParameters | None, ReadSettings], LoadedRun] | None
    read_ins: Callable[[RunSource, ReadSettings], InsLog] | None = None  # reads only the INS, for a run with CAN logs
    is_folder: Callable[[Path], bool] | None = None  # whether a folder is one recording
    has_drive: Callable[[Path], bool] = lambda path: True  # False if a quick test shows that a file has no drive
    # Whether a file is probably meant to contain a drive but lacks channels, which are then reported.
    is_incomplete: Callable[[Path], bool] = lambda path: False
    lacks_steering: Callable[[Path], bool] = lambda path: False  # whether it has no steering angle, only the INS
    # Whether it is a table of one or several files; `read` and `read_ins` then apply the factor of yaw in run.yaml.
    is_table: bool = False

    @property
    def needs_can(self) -> bool:
        """Whether a recording of this kind needs CAN logs for a drive."""
        return self.read is None

    def is_ins_only(self, path: Path) -> bool:
        return self.needs_can or self.lacks_steering(path)

    def may_contain_drive(self, path: Path) -> bool:
        """Whether a file contains a drive or the INS measurements of one, or is probably meant to."""
        return self.has_drive(path) or self.is_ins_only(path) or self.is_incomplete(path)

    def accepts(self, path: Path) -> bool:
        """Whether a file or folder is a recording of this kind."""
        if path.is_dir():
            return self.is_folder is not None and self.is_folder(path)
        return path.suffix.lower() in self.extensions


READERS: dict[str, Reader] = {}


def register(reader: Reader) -> None:
    """Adds a kind of recording. Raises ValueError if its name is already used."""
    if reader.kind in READERS:
        raise ValueError(f"{reader.kind}: two readers have this name")
    READERS[reader.kind] = reader


def find_reader(path: Path, key: str | None = None) -> Reader | None:
    """The reader that accepts a path; None if there is none. key: only readers with this run.yaml key are candidates;
    if none of them accepts the path, the first is returned."""
    candidates = [reader for reader in READERS.values() if key in (None, reader.key)]
    return next((c for c in candidates if c.accepts(path)), candidates[0] if key and candidates else None)


for _module in sorted(info.name for info in pkgutil.iter_modules(__path__)):
    importlib.import_module(f"{__name__}.{_module}")
