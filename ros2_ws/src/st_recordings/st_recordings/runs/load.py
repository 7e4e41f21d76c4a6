"""A run read into a DriveLog: decoded, its clocks aligned, and where every part of it came from."""

import hashlib
import json
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from st_core.checks import Extras
from st_core.clock_types import Alignment, none_needed
from st_core.corrections import Correction, corrected, in_words
from st_core.errors import StCoreError
from st_core.log import DriveLog
from st_core.vehicle import VehicleParameters

from ..paths import config
from . import bag, csv
from .errors import RunError
from .foreign import SteeringField
from .sources import Label, RunSource


@dataclass(frozen=True)
class ReadSettings:
    """How raw files become a run.

    dbc, signals: of the CAN bus; default that of the Leaf. steering_sign: +1 where the decoded sensor is left
    positive. steering_latency: from the turn of the wheel to the frame in the log [s]. offset: INS minus CAN clock [s],
    given by hand. search: bounds of that offset [s] when it is looked for. ins_can_latency: from the instant an INS
    value is true to its CAN frame in the log, and the standard deviation of that [s]; None: assumed (clocks.py).
    doubtful: whether an alignment that is doubtful may be used (with a warning); a refused one never is. steering:
    where the angle is in bags without st_msgs/Steering.
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


@dataclass(frozen=True)
class LoadedRun:
    """log: the drive on the INS clock. labels: named parts, in seconds after the first INS measurement.

    provenance: files (path -> sha256), reader, settings, alignment, corrected: plain values for reports. warnings:
    sentences. extras: what else was recorded, for checks.
    """

    log: DriveLog
    provenance: Mapping[str, Any]
    labels: tuple[Label, ...] = ()
    warnings: tuple[str, ...] = ()
    alignment: Alignment = field(default_factory=none_needed)
    extras: Extras = field(default_factory=Extras)


def read(source: RunSource, vehicle: VehicleParameters | None = None,
         settings: ReadSettings | None = None) -> LoadedRun:
    """Read one run.

    vehicle: steering ratio and offset for the road wheel angle; without one, the road wheel angle must be in the
    recording (bag, CSV). What its run.yaml corrects is corrected, and said. Raises RunError, one sentence for the
    user, for a run that cannot be used.
    """
    settings = settings or ReadSettings()
    if source.problem is not None:
        raise source.problem
    # Hashing does not hold the interpreter; it is done when the rest is.
    with ThreadPoolExecutor(1) as beside:
        digests = beside.submit(hashes, source)
        loaded = _loaded(source, vehicle, settings)
    log = loaded.log
    if vehicle is not None and log.steering_wheel_angle is not None:
        log = log.with_steering(vehicle)
    loaded = treated(source, replace(loaded, log=log), vehicle)
    check_common_time(source, loaded.log.ins_time_ns, loaded.log.steering_time_ns)
    return replace(loaded, provenance={**loaded.provenance, "files": digests.result()})


def _loaded(source: RunSource, vehicle: VehicleParameters | None, settings: ReadSettings) -> LoadedRun:
    if source.kind == "ncom":
        from .raw import read_raw_run  # scipy.signal and the CAN libraries: two seconds that bags need not wait for

        return read_raw_run(source, vehicle, settings)
    if source.kind == "bag":
        drive = bag.read_bag(source.where, source.name, settings.steering)
        recorded = {name: dict(record) for name, record in drive.records.items()}
        about = {"reader": "bag", "topics": dict(drive.topics), "recorded": recorded}
        labels = source.labels or _recorded_labels(drive.records)
        return LoadedRun(drive.log, about, labels, drive.warnings, extras=drive.extras)
    table = csv.read_csv(source.where, vehicle, source.settings.get("layout"), _corrections(source)[1])
    about = {"reader": "csv", "columns": dict(table.columns)}
    return LoadedRun(replace(table.log, name=source.name), about, source.labels, table.warnings, extras=table.extras)


def _corrections(source: RunSource) -> tuple[dict[str, Correction], float]:
    """What is left to correct when a run is read, and the scale of yaw that its reader takes (see `csv.read_csv`)."""
    corrections = dict(source.settings.get("correct", {}))
    yaw = corrections.get("yaw", Correction())
    if source.kind != "csv" or yaw.scale == 1.0:
        return corrections, 1.0
    return {**corrections, "yaw": replace(yaw, scale=1.0)}, yaw.scale


def treated(source: RunSource, run: LoadedRun, vehicle: VehicleParameters | None) -> LoadedRun:
    """The run as its run.yaml corrects it. Labels stay with what they name, though the first samples may go.

    Raises RunError for a correction that leaves nothing.
    """
    left_out = source.settings.get("leave_out", ())
    phrases = (*in_words(source.settings.get("correct", {})),
               *(f"INS left out from {start:g} to {end:g} s" for start, end in left_out))
    if not phrases:
        return run
    try:
        log = corrected(run.log, _corrections(source)[0], vehicle, left_out)
    except StCoreError as error:
        raise RunError(source.where, str(error)) from None
    gone = (int(log.ins_time_ns[0]) - int(run.log.ins_time_ns[0])) * 1e-9 if len(log.ins_time_ns) else 0.0
    labels = tuple(replace(label, start=label.start - gone, end=label.end - gone) for label in run.labels)
    return replace(
        run, log=log, labels=labels, provenance={**run.provenance, "corrected": list(phrases)},
        warnings=(*run.warnings, f"{source.where}: corrected as its run.yaml says: {'; '.join(phrases)}"),
        extras=replace(run.extras, corrected=phrases))


def _recorded_labels(records: Mapping[str, Mapping[str, str]]) -> tuple[Label, ...]:
    """Labels that came with an imported run."""
    return tuple(Label(*entry) for entry in json.loads(records.get("import", {}).get("labels", "[]")))


def check_common_time(source: RunSource, ins_ns: np.ndarray, steering_ns: np.ndarray) -> None:
    """Raises RunError where INS and steering have no time in common."""
    if len(ins_ns) < 2 or len(steering_ns) < 2:
        raise RunError(source.where, "fewer than two measurements of INS or steering are in it", "take it off the list")
    if min(ins_ns[-1], steering_ns[-1]) <= max(ins_ns[0], steering_ns[0]):
        raise RunError(source.where, "INS and steering were not recorded at the same time",
                       "check that the files belong to one drive (and the offset, if it was given by hand)")


def hashes(source: RunSource) -> dict[str, str]:
    """Path -> SHA-256 of every file of a run."""
    return file_hashes((*source.files, *source.can))


def file_hashes(paths: Iterable[Path]) -> dict[str, str]:
    """Path -> SHA-256 of files, and of the files in folders."""
    files = [f for path in paths
             for f in (sorted(path.iterdir()) if path.is_dir() else [path]) if f.is_file()]
    found = {}
    for file in files:
        with file.open("rb") as stream:
            found[str(file)] = hashlib.file_digest(stream, "sha256").hexdigest()
    return found


def signal_files(source: RunSource, settings: ReadSettings) -> tuple[Path, Path]:
    """(DBC, table) of a run: of the settings, else of its run.yaml, else the Leaf's."""
    return (settings.dbc or source.settings.get("dbc") or config("car/leaf/can.dbc"),
            settings.signals or source.settings.get("signals") or config("car/leaf/signals.yaml"))
