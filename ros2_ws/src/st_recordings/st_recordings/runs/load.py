"""Reads a run of any kind, removes implausible samples, and applies the corrections of its run.yaml."""

import hashlib
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
from st_core.checks.plausibility import drop_implausible
from st_core.corrections import Correction, apply_corrections, describe_corrections
from st_core.errors import StCoreError
from st_core.log import DriveLog
from st_core.sideslip import with_steady_sideslip
from st_core.vehicle import VehicleParameters

from .errors import RunError, log_warnings
from .readers import READERS
from .run_types import LoadedRun, ReadSettings, RunSource
from .vbo import YAW_RATE_REVERSED

MAX_STATIONARY_EXTENT = 20.0  # m; positions of a parked car vary by less, even without differential corrections
MIN_UNUSED_TIME, MIN_UNUSED_FRACTION = 1.0, 0.01
"""[s], and fraction of the recording. Time that only INS or only steering covers is reported if it exceeds both."""


def read(source: RunSource, vehicle: VehicleParameters | None = None,
         settings: ReadSettings | None = None) -> LoadedRun:
    """Reads one run. Raises RunError for a run that cannot be used.

    vehicle: used for the steering ratio and offset, and for heading and sideslip if the yaw is the course over ground;
    without a vehicle, the recording (bag, CSV) must contain the road wheel angle. Implausible samples are left out or
    set to NaN (`st_core.checks.plausibility`), see `auxiliary.implausible`; then the run.yaml is applied.
    """
    settings = settings or ReadSettings()
    if source.problem is not None:
        raise source.problem
    # Hashing releases the GIL, so it runs in parallel with reading.
    with ThreadPoolExecutor(1) as pool:
        digests = pool.submit(hash_files, (*source.files, *source.can))
        reader = READERS[source.kind]
        if reader.read is None or (source.can and reader.read_ins and not settings.steering):
            from .raw import read_raw_run  # imports the CAN libraries

            run = read_raw_run(source, vehicle, settings)
        else:
            run = reader.read(source, vehicle, settings)
    notes = () if source.can else source.notes  # those of a run with CAN logs are among its warnings
    run = replace(run, warnings=(*notes, *run.warnings, *_list_unused_options(source, settings)))
    _check_samples(source, run.log, run.warnings)
    start_ns = int(run.log.ins_time_ns[0])
    log, implausible = drop_implausible(run.log, start_ns)
    if vehicle is not None and log.steering_wheel_angle is not None:
        log = log.with_steering(vehicle)
    auxiliary = replace(run.auxiliary, implausible=(*run.auxiliary.implausible, *implausible), start_ns=start_ns)
    run = apply_run_file(source, replace(run, log=log, auxiliary=auxiliary), vehicle)
    if vehicle is not None and not (log := with_steady_sideslip(run.log, vehicle)).sideslip_measured:
        text = (f"{source.path}: yaw is the course over ground; heading and sideslip are computed from it for steady "
                "cornering with the vehicle file")
        run = replace(run, log=log, warnings=(*run.warnings, text))
    run = replace(run, warnings=(*run.warnings, *check_coverage(source, run.log)))
    log_warnings(run.warnings)
    return replace(run, provenance={**run.provenance, "files": digests.result()})


def _list_unused_options(source: RunSource, settings: ReadSettings) -> list[str]:
    """Warnings about options that do not apply to this recording; other recordings of the command may need them."""
    steering, reader = settings.steering, READERS[source.kind]
    unused = [f"{option} {topic}, because it is not a bag" for option, topic in (
        ("--steering-topic", steering.topic if steering else ""), ("--odometry-topic", settings.odometry))
        if topic and source.kind != "bag"]
    if steering and not steering.topic and reader.read is None:
        unused.append(f"--steering-field {steering.field}, because its steering angle is in CAN logs; --signals "
                      "describes their signals")
    if settings.offset is not None and not source.can and source.kind != "bag":
        unused.append(f"--offset {settings.offset:g}, because all its channels are on one clock")
    if steering and source.can and reader.read is not None:
        unused.append("its CAN logs, because an option names the steering angle in this file")
    return [f"{source.path}: this recording does not use {text}" for text in unused]


def apply_run_file(source: RunSource, run: LoadedRun, vehicle: VehicleParameters | None) -> LoadedRun:
    """Applies the corrections of the run.yaml. Raises RunError if they are invalid or a time shift leaves no sample.

    Label times are relative to the first INS sample, so they are shifted if the first samples are left out.
    """
    excluded_intervals = source.settings.get("leave_out", ())
    sources: dict[str, str] = source.settings.get("columns", {})  # channel -> recorded channel, {} for tables
    corrections: dict[str, Correction] = dict(source.settings.get("correct", {}))
    notes = list[str]()
    rate = corrections.get("yaw_rate")
    if rate is not None and rate.scale < 0 and f"{source.path}: {YAW_RATE_REVERSED}" in run.warnings:
        corrections["yaw_rate"] = replace(rate, scale=-rate.scale)
        corrections = {name: correction for name, correction in corrections.items() if correction != Correction()}
        notes.append(f"{source.path}: its reader has changed the sign of yaw_rate, so the scale in its run.yaml is "
                     "applied without its sign")
    phrases = (*(f"{name} from {other}" for name, other in sources.items()), *describe_corrections(corrections),
               *(f"INS samples left out from {start:g} to {end:g} s" for start, end in excluded_intervals))
    if not phrases:
        return replace(run, warnings=(*run.warnings, *notes))
    if "yaw" in corrections and READERS[source.kind].is_table:
        corrections["yaw"] = replace(corrections["yaw"], scale=1.0)  # its reader has applied the factor
    try:
        log = replace(run.log, **{name: getattr(run.log, other) for name, other in sources.items()})
        log = apply_corrections(log, corrections, vehicle, excluded_intervals)
    except StCoreError as error:
        raise RunError(source.path, str(error)) from None
    shift = (int(log.ins_time_ns[0]) - int(run.log.ins_time_ns[0])) * 1e-9 if len(log.ins_time_ns) else 0.0
    labels = tuple(replace(label, start=label.start - shift, end=label.end - shift) for label in run.labels)
    return replace(
        run, log=log, labels=labels, provenance={**run.provenance, "corrected": list(phrases)},
        warnings=(*run.warnings, f"{source.path}: corrected by its run.yaml: {'; '.join(phrases)}", *notes),
        auxiliary=replace(run.auxiliary, corrections=phrases))


def check_coverage(source: RunSource, log: DriveLog) -> list[str]:
    """Warnings about time that only INS or only steering covers. Raises RunError without overlap or enough samples."""
    _check_samples(source, log, ())
    spans = {"INS": log.ins_time_ns, "steering": log.steering_time_ns}
    if min(time[-1] for time in spans.values()) <= max(time[0] for time in spans.values()):
        raise RunError(source.path, "INS and steering were not recorded at the same time",
                       "check that the files are from the same drive, and check the offset if you gave one")
    seconds = {name: float(time[-1] - time[0]) * 1e-9 for name, time in spans.items()}
    return [f"{source.path}: {unused:.1f} of {seconds[name]:.1f} s of the {name} "
            f"({100.0 * unused / seconds[name]:.0f} %) are not used: no usable sample of the {other} covers them"
            for name, other in (("INS", "steering"), ("steering", "INS"))
            if (unused := seconds[name] - log.overlap) > max(MIN_UNUSED_TIME, MIN_UNUSED_FRACTION * seconds[name])]


def _check_samples(source: RunSource, log: DriveLog, warnings: Iterable[str]) -> None:
    """Raises RunError if the velocity is 0 although the car moves, or if fewer than two samples of INS or of steering
    remain. warnings: reasons for the latter, for the error message."""
    if min(len(log.ins_time_ns), len(log.steering_time_ns)) < 2:
        problem = "it contains fewer than two measurements of INS or steering"
        reasons = (warning.removeprefix(f"{source.path}: ") for warning in warnings)
        raise RunError(source.path, "; ".join([problem, *reasons]), "remove it from the command")
    # The outermost 1 % on each side may be wrong positions, which have not been left out yet.
    extent = float(np.hypot(*(np.ptp(np.percentile(axis, (1, 99), method="nearest")) for axis in (log.x, log.y))))
    if extent > MAX_STATIONARY_EXTENT and not (log.velocity_x.any() or log.velocity_y.any()):
        raise RunError(source.path, f"its velocity is 0 in all samples, although its positions extend over {extent:.0f}"
                       " m", "record the velocity, or name the topic (--odometry-topic) or column that contains it")


def hash_files(paths: Iterable[Path]) -> dict[str, str]:
    """Path -> SHA-256 of each file; for a folder, of the files directly in it."""
    hashes = {}
    for path in paths:
        for file in sorted(path.iterdir()) if path.is_dir() else [path]:
            if file.is_file():
                with file.open("rb") as stream:
                    hashes[str(file)] = hashlib.file_digest(stream, "sha256").hexdigest()
    return hashes
