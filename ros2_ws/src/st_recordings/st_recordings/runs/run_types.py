"""A run before and after it is read, and the settings for reading it."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from st_core.checks import AuxiliaryData
from st_core.clock_types import Alignment, alignment_not_needed
from st_core.errors import StCoreError
from st_core.log import DriveLog

from ..paths import config
from .errors import RunError


@dataclass(frozen=True)
class SteeringField:
    """Location, unit and sign of the steering angle in a recording of other software.

    topic: of a bag, "" for a table. field: path in its messages, as "drive.steering_angle"; column of a table.
    quantity: road (mean of the front wheels) or wheel (steering wheel, offset included). unit: None for the unit in the
    header of a table, rad in a bag. sign: 1 if left is positive in the recording, else -1.
    """

    topic: str
    field: str = "data"
    quantity: Literal["road", "wheel"] = "road"
    unit: Literal["rad", "deg"] | None = None
    sign: int = 1

    @property
    def scale(self) -> float:
        """Factor from the recorded number to rad, left positive."""
        return self.sign * (math.pi / 180.0 if self.unit == "deg" else 1.0)


@dataclass(frozen=True)
class Label:
    """A named part of a run, in seconds after its first INS measurement."""

    name: str
    start: float
    end: float


@dataclass(frozen=True)
class RunSource:
    """The files of one run. kind: of its reader ("bag", "ncom", "csv", "vbo"), or "" with a `problem`.

    settings: from run.yaml: offset [s], ins_can_latency (value and deviation [s]), dbc, signals (paths), layout
    (columns.Layout), correct (channel -> Correction), leave_out ((start, end) [s]). run_file: the run.yaml, if any.
    """

    name: str
    kind: str
    files: tuple[Path, ...]
    can: tuple[Path, ...] = ()
    labels: tuple[Label, ...] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)
    problem: RunError | None = None
    run_file: Path | None = None

    @property
    def arguments(self) -> str:
        """Command line arguments that read this run."""
        return str(self.run_file) if self.run_file else " ".join(map(str, (*self.files, *self.can)))

    @property
    def where(self) -> Path:
        """The file or folder for messages."""
        return self.files[0] if self.files else Path(self.name)


@dataclass(frozen=True)
class ReadSettings:
    """How raw files are read.

    dbc, signals: files of the CAN bus, default the Leaf's. steering_sign: +1 where the decoded sensor is left
    positive. steering_latency: from the motion of the wheel to the stamp of its frame [s]. offset: INS minus CAN clock
    [s], None to estimate it within the bounds `search` [s]. ins_can_latency: from the validity of an INS value to
    its CAN frame in the log, and its standard deviation [s]; None: assumed (clocks.py). accept_doubtful: whether a
    doubtful alignment may be used (with a warning); a refused one never is. steering: where the angle is in bags
    without st_msgs/Steering, or in tables. odometry: the topic to read from a bag that has several.
    """

    dbc: Path | None = None
    signals: Path | None = None
    steering_sign: int = 1
    steering_latency: float = 0.0
    offset: float | None = None
    search: tuple[float, float] | None = None
    ins_can_latency: tuple[float, float] | None = None
    accept_doubtful: bool = True
    steering: SteeringField | None = None
    odometry: str | None = None


@dataclass(frozen=True)
class LoadedRun:
    """A run that was read. log: the drive on the INS clock.

    provenance: plain values for reports: files (path -> sha256), reader, settings, alignment, corrected. warnings:
    sentences. auxiliary: what else was recorded, for checks.
    """

    log: DriveLog
    provenance: Mapping[str, Any]
    labels: tuple[Label, ...] = ()
    warnings: tuple[str, ...] = ()
    alignment: Alignment = field(default_factory=alignment_not_needed)
    auxiliary: AuxiliaryData = field(default_factory=AuxiliaryData)


def make_drive_log(where: Path, name: str, **columns: Any) -> DriveLog:
    """The log of a run's columns. Raises RunError if DriveLog rejects them."""
    try:
        return DriveLog(name, **columns)
    except StCoreError as error:
        raise RunError(where, str(error)) from None


def find_signal_files(source: RunSource, settings: ReadSettings) -> tuple[Path, Path]:
    """(DBC, signal table) of a run: from the settings, else its run.yaml, else the Leaf's."""
    return (settings.dbc or source.settings.get("dbc") or config("car/leaf/can.dbc"),
            settings.signals or source.settings.get("signals") or config("car/leaf/signals.yaml"))
