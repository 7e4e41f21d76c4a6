"""Types of a run before and after reading, and of the settings for reading it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from canedge_bridge.units import UNITS
from st_core.checks import AuxiliaryData
from st_core.clock_types import Alignment
from st_core.errors import StCoreError
from st_core.log import DriveLog

from ..paths import json_ready
from .columns import find_stated_unit
from .errors import RunError


@dataclass(frozen=True)
class SteeringField:
    """Location, unit and sign of the steering angle in a recording that other software wrote."""

    topic: str  # name of a topic in a bag, "" for a table
    field: str = "data"  # path to a number in a message, such as "drive.steering_angle", or name of a column
    quantity: Literal["road", "wheel"] = "road"  # mean road wheel angle, or uncorrected steering wheel angle
    unit: Literal["rad", "deg"] | None = None  # None: as stated in the table or the field name, else rad
    sign: int = 1  # 1 if left is positive in the recording, else -1

    @property
    def scale(self) -> float:
        """Factor that converts the recorded number to rad, positive to the left."""
        return self.sign * UNITS["angle"][self.unit or find_stated_unit(self.field, "angle") or "rad"][0]


@dataclass(frozen=True)
class Label:
    """A named part of a run, in seconds after its first INS measurement."""

    name: str
    start: float
    end: float


@dataclass(frozen=True)
class RunSource:
    """The files of one run, and the settings of its run.yaml.

    settings: offset (INS minus CAN clock [s]), ins_can_latency (value, standard deviation [s]), dbc, signals (paths),
    layout (columns.Layout, of a table), columns (channel -> recorded channel that supplies it, for other files),
    correct (channel -> Correction), leave_out ((start, end) [s]).
    """

    name: str
    kind: str  # kind of the reader ("bag", "ncom", "csv", "vbo"), or "" for a source with a problem
    files: tuple[Path, ...]
    can: tuple[Path, ...] = ()  # CAN logs; empty also for a bag that itself contains the frames
    labels: tuple[Label, ...] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)
    problem: RunError | None = None  # why the source is not a usable run
    run_file: Path | None = None
    notes: tuple[str, ...] = ()  # warnings about the choice of files

    @property
    def arguments(self) -> str:
        """Command line arguments that read this run, or all runs of a run.yaml with the key `each`."""
        return str(self.run_file) if self.run_file else " ".join(map(str, (*self.files, *self.can)))

    @property
    def path(self) -> Path:
        """The file or folder to which messages refer."""
        return self.files[0] if self.files else Path(self.name)


@dataclass(frozen=True)
class ReadSettings:
    """Options for reading runs."""

    dbc: Path | None = None  # None: as in the run.yaml, or else that of the Nissan Leaf
    signals: Path | None = None  # signal table; None as for dbc
    steering_sign: int = 1  # +1 if the decoded angle is positive to the left, else -1
    steering_latency: float = 0.0  # delay from the motion of the steering wheel to the stamp of its CAN frame [s]
    offset: float | None = None  # INS minus CAN clock [s]; None: as in the run.yaml, or else estimated
    search: tuple[float, float] | None = None  # (lower, upper) bounds of the estimated offset [s]; None: unlimited
    # (delay of INS values on CAN, standard deviation) [s]; None: as in the run.yaml, or else clocks.INS_ON_CAN_DELAY.
    ins_can_latency: tuple[float, float] | None = None
    accept_doubtful: bool = True  # whether a doubtful alignment is used, with a warning; a refused one never is
    for_alignment: bool = False  # whether the steering angle and, in a table, positions are optional
    steering: SteeringField | None = None  # for tables, and for bags without st_msgs/Steering
    odometry: str | None = None  # topic to read from a bag with several nav_msgs/Odometry topics


@dataclass(frozen=True)
class LoadedRun:
    """A run that was read.

    provenance: JSON values for reports, such as files (path -> SHA-256), reader, settings, alignment, corrected.
    """

    log: DriveLog  # on the INS clock
    provenance: Mapping[str, Any]
    labels: tuple[Label, ...] = ()
    warnings: tuple[str, ...] = ()
    alignment: Alignment = field(default_factory=Alignment)
    auxiliary: AuxiliaryData = field(default_factory=AuxiliaryData)  # further recorded data, for checks


def make_drive_log(path: Path, name: str, **columns: Any) -> DriveLog:
    """Builds the log of a run. Raises RunError if DriveLog rejects the columns."""
    try:
        return DriveLog(name, **columns)
    except StCoreError as error:
        raise RunError(path, str(error)) from None


def summarise_alignment(alignment: Alignment) -> dict[str, Any]:
    """The alignment as JSON values for reports and metadata; the keys contain the units."""
    return {
        "method": alignment.method, "verdict": str(alignment.verdict), "reasons": list(alignment.reasons),
        "at_ns": alignment.at_ns, "offset_s": alignment.offset_ns * 1e-9, "drift_ppm": alignment.drift_ppm,
        "offset_deviation_s": json_ready(alignment.offset_deviation),
        "drift_deviation_ppm": json_ready(alignment.drift_deviation), "common_time_s": alignment.overlap}
