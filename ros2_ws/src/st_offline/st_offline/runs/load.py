"""A run read into a DriveLog: decoded, its clocks aligned, and where every part of it came from."""

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from st_core.clock_types import Alignment, SharedSignal, Verdict, none_needed
from st_core.errors import StCoreError
from st_core.log import DriveLog
from st_core.vehicle import VehicleParameters

from ..paths import config
from . import bag, csv
from .can_logs import CanLog, read_can_logs
from .can_signals import CanSignals, Signal, decode_signals, load_signal_table, steering_of
from .clocks import INS_ON_CAN, align_clocks
from .errors import RunError, check_readable
from .frames import empty
from .ncom import InsLog, read_ncom
from .sources import Label, RunSource


@dataclass(frozen=True)
class ReadSettings:
    """How raw files become a run.

    dbc, signals: of the CAN bus; default config/can/leaf_ze0.*. steering_sign: +1 where the decoded sensor is left
    positive. steering_latency: from the turn of the wheel to the frame in the log [s]. offset: INS minus CAN clock [s],
    given by hand. search: bounds of that offset [s] when it is looked for. ins_can_latency: from the instant an INS
    value is true to its CAN frame in the log, and the standard deviation of that [s]; None: assumed (clocks.py).
    doubtful: whether an alignment that is doubtful may be used (with a warning); a refused one never is.
    """

    dbc: Path | None = None
    signals: Path | None = None
    steering_sign: int = 1
    steering_latency: float = 0.0
    offset: float | None = None
    search: tuple[float, float] | None = None
    ins_can_latency: tuple[float, float] | None = None
    doubtful: bool = True


@dataclass(frozen=True)
class LoadedRun:
    """log: the drive on the INS clock. labels: named parts, in seconds after the first INS measurement.

    provenance: files (path -> sha256), reader, settings, alignment: plain values for reports. warnings: sentences.
    """

    log: DriveLog
    provenance: Mapping[str, Any]
    labels: tuple[Label, ...] = ()
    warnings: tuple[str, ...] = ()
    alignment: Alignment = field(default_factory=none_needed)


@dataclass(frozen=True)
class RawRun:
    """INS and CAN files decoded and aligned, with everything that was in them: what `st import` writes down."""

    ins: InsLog
    can: CanLog
    signals: CanSignals
    steering: Signal
    alignment: Alignment
    shared: list[SharedSignal]
    warnings: tuple[str, ...]


def read(source: RunSource, vehicle: VehicleParameters | None = None,
         settings: ReadSettings | None = None) -> LoadedRun:
    """Read one run.

    vehicle: steering ratio and offset for the road wheel angle; without one, the road wheel angle must be in the
    recording (bag, CSV). Raises RunError, one sentence for the user, for a run that cannot be used.
    """
    settings = settings or ReadSettings()
    if source.problem is not None:
        raise source.problem
    if source.kind == "ncom":
        loaded = _read_raw_run(source, vehicle, settings)
    elif source.kind == "bag":
        drive = bag.read_bag(source.where, source.name)
        recorded = {name: dict(record) for name, record in drive.records.items()}
        about = {"reader": "bag", "topics": dict(drive.topics), "recorded": recorded}
        loaded = LoadedRun(drive.log, about, source.labels or _recorded_labels(drive.records), drive.warnings)
    else:
        log, warnings = csv.read_drive(source.where)
        loaded = LoadedRun(replace(log, name=source.name), {"reader": "csv"}, source.labels, warnings)
    log = loaded.log
    if vehicle is not None and log.steering_wheel_angle is not None:
        log = log.with_steering(vehicle)
    check_common_time(source, log.ins_time_ns, log.steering_time_ns)
    return replace(loaded, log=log, provenance={**loaded.provenance, "files": hashes(source)})


def read_raw(source: RunSource, settings: ReadSettings, keep_frames: bool = True) -> RawRun:
    """INS recording and CAN logs of a run of kind "ncom".

    keep_frames: False leaves the raw frames out as soon as they are decoded; they are most of what is in memory.
    Raises RunError; a refused alignment is returned as such.
    """
    if source.problem is not None:
        raise source.problem
    check_readable(source.where)
    can = read_can_logs(source.can)
    table = load_signal_table(*signal_files(source, settings))
    signals = decode_signals(can.frames, table)
    steering = steering_of(signals, can.files[0], table)
    if not keep_frames:
        can = replace(can, frames=empty())
    ins = read_ncom(source.where)
    alignment, shared = align_clocks(ins.motion, signals, **clock_settings(source, settings))
    faults = [f"{can.files[0]}: {message}: {fault}" for message, fault in signals.faults.items()]
    return RawRun(ins, can, signals, steering, alignment, shared, (*ins.warnings, *can.warnings, *faults))


def _read_raw_run(source: RunSource, vehicle: VehicleParameters | None, settings: ReadSettings) -> LoadedRun:
    if vehicle is None:
        raise RunError(source.where, "the steering of a CAN log needs the steering ratio and offset of the car",
                       "give its vehicle file")
    run = read_raw(source, settings, keep_frames=False)
    warnings = [*run.warnings, *alignment_warnings(source, run.alignment, settings)]
    steering_ns = steering_times(run, settings)
    good = run.steering.valid & (np.diff(steering_ns, prepend=steering_ns[0] - 1) > 0)
    wheel = settings.steering_sign * run.steering.values[good]
    ins = run.ins
    try:
        log = DriveLog(
            source.name, ins_time_ns=ins.time_ns, x=ins.position[0], y=ins.position[1], yaw=ins.yaw,
            velocity_x=ins.velocity[0], velocity_y=ins.velocity[1], yaw_rate=ins.rate[2],
            acceleration_x=_known(ins.acceleration[0]), acceleration_y=_known(ins.acceleration[1]),
            steering_time_ns=steering_ns[good], steering_wheel_angle=wheel,
            road_wheel_angle=(wheel - vehicle.steering_wheel_offset) / vehicle.steering_ratio,
        )
    except StCoreError as error:
        raise RunError(source.where, str(error)) from None
    about = {"reader": "ncom and CAN log", "origin": list(ins.origin), "alignment": about_alignment(run.alignment),
             "settings": {"steering_sign": settings.steering_sign, "steering_latency": settings.steering_latency,
                          "ins_can_latency": latency_in_words(source, settings)}}
    return LoadedRun(log, about, source.labels, tuple(warnings), run.alignment)


def _recorded_labels(records: Mapping[str, Mapping[str, str]]) -> tuple[Label, ...]:
    """Labels that came with an imported run."""
    return tuple(Label(*entry) for entry in json.loads(records.get("import", {}).get("labels", "[]")))


def alignment_warnings(source: RunSource, alignment: Alignment, settings: ReadSettings) -> list[str]:
    """Raises RunError for an alignment that must not be used; else what is to be said about it."""
    reasons = "; ".join(alignment.reasons)
    if alignment.verdict is Verdict.REFUSED or (alignment.verdict is Verdict.DOUBTFUL and not settings.doubtful):
        raise RunError(source.where, f"its clock cannot be aligned with that of the CAN log: {reasons}",
                       "look at it with `st align`, and give the offset by hand if you know it (--offset)")
    return [f"{source.where}: alignment of the clocks is {alignment.verdict}: {reasons}"] if reasons else []


def steering_times(run: RawRun, settings: ReadSettings) -> np.ndarray:
    """When the wheel stood as the frames say, on the INS clock [ns]."""
    return run.alignment.to_reference_ns(run.steering.time_ns) - round(settings.steering_latency * 1e9)


def check_common_time(source: RunSource, ins_ns: np.ndarray, steering_ns: np.ndarray) -> None:
    """Raises RunError where INS and steering have no time in common."""
    if len(ins_ns) < 2 or len(steering_ns) < 2:
        raise RunError(source.where, "fewer than two measurements of INS or steering are in it", "take it off the list")
    if min(ins_ns[-1], steering_ns[-1]) <= max(ins_ns[0], steering_ns[0]):
        raise RunError(source.where, "INS and steering were not recorded at the same time",
                       "check that the files belong to one drive (and the offset, if it was given by hand)")


def about_alignment(alignment: Alignment) -> dict[str, Any]:
    """Plain values for reports and metadata."""
    return {
        "method": alignment.method, "verdict": str(alignment.verdict), "reasons": list(alignment.reasons),
        "at_ns": alignment.at_ns, "offset_s": alignment.offset_ns * 1e-9, "drift_ppm": alignment.drift_ppm,
        "offset_deviation_s": _finite(alignment.offset_deviation),
        "drift_deviation_ppm": _finite(alignment.drift_deviation), "common_time_s": alignment.overlap,
    }


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
    return (settings.dbc or source.settings.get("dbc") or config("can/leaf_ze0.dbc"),
            settings.signals or source.settings.get("signals") or config("can/leaf_ze0.yaml"))


def clock_settings(source: RunSource, settings: ReadSettings) -> dict[str, Any]:
    """What `align_clocks` is told: by the settings, else by the run's run.yaml, else nothing."""
    offset = settings.offset if settings.offset is not None else source.settings.get("offset")
    latency = settings.ins_can_latency or source.settings.get("ins_can_latency") or INS_ON_CAN
    return {"offset": offset, "search": settings.search, "latency": latency}


def latency_in_words(source: RunSource, settings: ReadSettings) -> str:
    """The latency of INS frames on the bus that the alignment rests on, and where it comes from."""
    latency, deviation = clock_settings(source, settings)["latency"]
    given = settings.ins_can_latency or source.settings.get("ins_can_latency")
    return f"{latency * 1e3:g} ± {deviation * 1e3:g} ms, {'given' if given else 'assumed'}"


def _known(values: np.ndarray) -> np.ndarray | None:
    return values if np.isfinite(values).all() else None


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None
