"""A run before and after it is read, and how it is to be read."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from st_core.checks import AuxiliaryData
from st_core.clock_types import Alignment, none_needed
from st_core.log import DriveLog

from ..paths import config
from .errors import RunError


@dataclass(frozen=True)
class SteeringField:
    """Where the steering angle is, in which unit and with which sign.

    topic: of a bag, "" for a table. field: path in its messages, as "drive.steering_angle"; column of a table.
    quantity: road (mean of the front wheels) or wheel (the hand wheel, offset not removed). unit: rad or deg; None for
    that in the heading of the column of a table, rad in a bag.
    sign: 1 where the number is positive to the left, -1 where to the right.
    """

    topic: str
    field: str = "data"
    quantity: Literal["road", "wheel"] = "road"
    unit: Literal["rad", "deg"] | None = None
    sign: int = 1

    @property
    def scale(self) -> float:
        """What the number is multiplied with to be in rad, left +."""
        return self.sign * (math.pi / 180.0 if self.unit == "deg" else 1.0)


@dataclass(frozen=True)
class Label:
    """A named part of a run, in seconds after its first INS measurement."""

    name: str
    start: float
    end: float


@dataclass(frozen=True)
class RunSource:
    """The files of one run. kind: that of its reader ("bag", "ncom", "csv", "vbo"), or "" with a `problem`.

    settings: from run.yaml: offset [s], ins_can_latency (value and deviation [s]), dbc, signals (paths), layout
    (columns.Layout), correct (channel -> Correction), leave_out ((start, end) [s]). where: the file or folder to name
    to the user.
    """

    name: str
    kind: str
    files: tuple[Path, ...]
    can: tuple[Path, ...] = ()
    labels: tuple[Label, ...] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)
    problem: RunError | None = None

    @property
    def where(self) -> Path:
        return self.files[0] if self.files else Path(self.name)


@dataclass(frozen=True)
class ReadSettings:
    """How raw files become a run.

    dbc, signals: of the CAN bus; default that of the Leaf. steering_sign: +1 where the decoded sensor is left
    positive. steering_latency: from the turn of the wheel to the frame in the log [s]. offset: INS minus CAN clock [s],
    given by hand. search: bounds of that offset [s] when it is looked for. ins_can_latency: from the instant an INS
    value is true to its CAN frame in the log, and the standard deviation of that [s]; None: assumed (clocks.py).
    doubtful: whether an alignment that is doubtful may be used (with a warning); a refused one never is. steering:
    where the angle is in bags without st_msgs/Steering, or in tables. odometry: topic of a bag that has several.
    """

    dbc: Path | None = None
    signals: Path | None = None
    steering_sign: int = 1
    steering_latency: float = 0.0
    offset: float | None = None
    search: tuple[float, float] | None = None
    ins_can_latency: tuple[float, float] | None = None
    doubtful: bool = True
    steering: SteeringField | None = None
    odometry: str | None = None


@dataclass(frozen=True)
class LoadedRun:
    """log: the drive on the INS clock. labels: named parts, in seconds after the first INS measurement.

    provenance: files (path -> sha256), reader, settings, alignment, corrected: plain values for reports. warnings:
    sentences. auxiliary: what else was recorded, for checks.
    """

    log: DriveLog
    provenance: Mapping[str, Any]
    labels: tuple[Label, ...] = ()
    warnings: tuple[str, ...] = ()
    alignment: Alignment = field(default_factory=none_needed)
    auxiliary: AuxiliaryData = field(default_factory=AuxiliaryData)


def signal_files(source: RunSource, settings: ReadSettings) -> tuple[Path, Path]:
    """(DBC, table) of a run: of the settings, else of its run.yaml, else the Leaf's."""
    return (settings.dbc or source.settings.get("dbc") or config("car/leaf/can.dbc"),
            settings.signals or source.settings.get("signals") or config("car/leaf/signals.yaml"))
