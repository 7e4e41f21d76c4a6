"""Decodes the INS recording and CAN logs of a run, and aligns their clocks."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from st_core.checks import AuxiliaryData, Finding
from st_core.checks.sampling import make_rejected_frames_finding
from st_core.clock_types import Alignment, SharedSignal, Verdict
from st_core.log import INS_SIGNALS, OPTIONAL_INS_SIGNALS
from st_core.vehicle import VehicleParameters

from ..paths import config
from .bag import may_need_can_frames
from .can_formats import is_can_log
from .can_logs import read_can_logs
from .can_signals import CanSignals, Signal, collect_speeds, decode_signals, find_steering, load_signal_table
from .clocks import INS_ON_CAN_DELAY, align_clocks
from .errors import RunError, check_readable, format_count
from .frames import CanLog, empty_frames
from .ins_log import InsLog, is_mostly_known
from .readers import READERS, find_reader
from .run_types import LoadedRun, ReadSettings, RunSource, make_drive_log, summarise_alignment
from .sources import find_runs

MAX_LOG_GAP = 10.0  # longest gap [s] between frames in one part of a log; after a longer one, a new drive may follow
MAX_PARTS = 20  # maximum number of parts of a log for which alignment is tried, the longest first


@dataclass(frozen=True)
class RawRun:
    """An INS recording and the CAN logs of the same drive, decoded and aligned."""

    name: str
    dbc: Path
    ins: InsLog
    can: CanLog
    signals: CanSignals
    steering: Signal | None  # None for `st align`
    alignment: Alignment
    shared_signals: list[SharedSignal]  # signals that both recordings contain, for the alignment and its check
    latency_text: str  # description of the delay of INS frames on CAN
    warnings: tuple[str, ...]


def read_raw(source: RunSource, settings: ReadSettings, keep_frames: bool = True) -> RawRun:
    """Reads and aligns the INS recording and CAN logs of a run; if the whole log cannot be aligned, uses its longest
    alignable part. Raises RunError, but not for a refused alignment, which is part of the result.

    keep_frames: False discards the raw frames after decoding, because they use most of the memory.
    """
    if source.problem is not None:
        raise source.problem
    if not source.path.is_dir():  # a folder is a bag, and its reader checks it
        check_readable(source.path)
    dbc = settings.dbc or source.settings.get("dbc") or config("car/leaf/can.dbc")
    table = load_signal_table(dbc, settings.signals or source.settings.get("signals")
                              or config("car/leaf/signals.yaml"))
    can = read_can_logs(source.can or source.files, {message.frame_id for message in table.database.messages})
    signals = decode_signals(can.frames, table)
    parts = _split_log(can)
    if not keep_frames:
        can = replace(can, frames=empty_frames())
    read_ins = READERS[source.kind].read_ins
    assert read_ins is not None  # set for every kind of recording that can be combined with CAN logs
    ins = read_ins(source, settings)
    options = choose_clock_settings(source, settings)
    if not source.can and options["offset"] is None and options["search"] is None:
        # CAN frames in a bag are stamped by the same clock as its odometry.
        alignment, shared_signals = Alignment(), list[SharedSignal]()
    else:
        alignment, shared_signals = align_clocks(ins, signals, **options)
    warnings = [f"--search is not used: {reason}" for method, reason in (
        ("time frame", "the INS time in the log determines the offset"), ("by hand", "the offset is given")
        ) if settings.search and alignment.method == method]
    if alignment.verdict is Verdict.REFUSED and (part := _find_alignable_part(ins, signals, parts, options)):
        span, alignment, shared_signals = part
        signals = signals.select_interval(*span)
        can = replace(can, frames=can.frames.select(slice(*np.searchsorted(can.frames.time_ns, span).tolist())))
        used, total = 1e-9 * (span[1] - span[0]), 1e-9 * sum(end - start for start, end in parts)
        warnings.append(f"{can.files[0]}: its clock was adjusted or it contains several drives; only the part that "
                        f"matches the INS recording is used ({used:.1f} of {total:.1f} s, {100 * used / total:.0f} %)")
    steering = None if settings.for_alignment else find_steering(signals, can.files[0], table, can.warnings)
    latency_source = "given" if settings.ins_can_latency or source.settings.get("ins_can_latency") else "assumed"
    delay, deviation = (1e3 * value for value in options["latency"])
    latency_text = f"{delay:g} ms (standard deviation {deviation:g} ms), {latency_source}"
    faults = [f"{can.files[0]}: {message}: {fault}" for message, fault in signals.faults.items()]
    return RawRun(source.name, dbc, ins, can, signals, steering, alignment, shared_signals, latency_text,
                  (*source.notes, *ins.warnings, *can.warnings, *faults, *warnings,
                   *_warn_about_unused_logs(can, ins, alignment)))


def _warn_about_unused_logs(can: CanLog, ins: InsLog, alignment: Alignment) -> list[str]:
    """A warning that names the CAN logs that do not overlap the INS recording in time, if other logs do."""
    spans_ns = [alignment.to_reference_ns(np.array(span)) for span in can.spans]
    unused = [file.name for file, (first, last) in zip(can.files, spans_ns, strict=False)
              if last < ins.time_ns[0] or first > ins.time_ns[-1]]
    if not 0 < len(unused) < len(can.files) or alignment.verdict is Verdict.REFUSED:
        return []
    return [f"{ins.file}: CAN logs that do not overlap it in time are not used: {', '.join(unused)}"]


def _split_log(can: CanLog) -> list[tuple[int, int]]:
    """(start, end) [ns] of the parts of a log between clock steps and gaps over MAX_LOG_GAP, the longest first."""
    time_ns = can.frames.time_ns
    starts = np.flatnonzero(np.isin(time_ns, [time for time, _ in can.steps])
                            | (np.diff(time_ns, prepend=time_ns[0]) > MAX_LOG_GAP * 1e9))
    edges = np.unique([0, *starts, len(time_ns)])
    parts = [(int(time_ns[first]), int(time_ns[last - 1]) + 1) for first, last in pairwise(edges.tolist())]
    return sorted(parts, key=lambda part: part[0] - part[1])


def _find_alignable_part(ins: InsLog, signals: CanSignals, parts: Sequence[tuple[int, int]], options: Mapping[str, Any]
                         ) -> tuple[tuple[int, int], Alignment, list[SharedSignal]] | None:
    """((start, end) [ns], alignment, shared signals) of the longest part of a log that can be aligned; None if there is
    only one part, or none of the MAX_PARTS longest can be aligned."""
    for part in parts[:MAX_PARTS] if len(parts) > 1 else ():
        alignment, shared_signals = align_clocks(ins, signals.select_interval(*part), **options)
        if alignment.verdict is not Verdict.REFUSED:
            return part, alignment, shared_signals
    return None


def read_raw_run(source: RunSource, vehicle: VehicleParameters | None, settings: ReadSettings) -> LoadedRun:
    """Reads the drive in an INS recording and CAN logs. Raises RunError, for example without a vehicle."""
    if vehicle is None:
        raise RunError(source.path, "the road wheel angle of a CAN log needs the steering ratio and offset of the car",
                       "specify the vehicle file of the car")
    return build_drive(source, vehicle, settings, read_raw(source, settings, keep_frames=False))


def build_drive(source: RunSource, vehicle: VehicleParameters, settings: ReadSettings, run: RawRun) -> LoadedRun:
    """Builds the drive of a decoded run, on the INS clock. Raises RunError, for example for a refused alignment."""
    warnings, verdict, reasons = list(run.warnings), run.alignment.verdict, "; ".join(run.alignment.reasons)
    if verdict is Verdict.REFUSED or (verdict is Verdict.DOUBTFUL and not settings.accept_doubtful):
        advice = "inspect the alignment with `st align`, and specify the offset if you know it (--offset)"
        if verdict is Verdict.REFUSED:
            raise RunError(source.path, f"its clock cannot be aligned with that of the CAN log: {reasons}", advice)
        raise RunError(source.path, f"the alignment of its clock with that of the CAN log is doubtful: {reasons}",
                       f"{advice}, or omit --strict to use it")
    if reasons:
        warnings.append(f"{source.path}: the alignment of the clocks is {verdict}: {reasons}")
    ins, steering = run.ins, run.steering
    assert steering is not None
    steering_ns = move_to_ins_clock(run, settings, steering.time_ns)
    is_usable = steering.valid & (np.diff(steering_ns, prepend=steering_ns[0] - 1) > 0)
    steering_wheel_angle = settings.steering_sign * steering.values[is_usable]
    missing = {name: int(np.isnan(ins.values[name]).sum()) for name in OPTIONAL_INS_SIGNALS if name in ins.values}
    warnings += [f"{source.path}: {name}: {format_count(count, len(ins.time_ns), 'samples')} have no value; "
                 f"it is {'unknown there' if is_mostly_known(ins.values[name]) else 'not used'}"
                 for name, count in missing.items() if count]
    missing["road_wheel_angle"] = int((~steering.valid).sum())
    log = make_drive_log(
        source.path, source.name, ins_time_ns=ins.time_ns,
        **{name: values for name, values in ins.values.items() if name in INS_SIGNALS or is_mostly_known(values)},
        steering_time_ns=steering_ns[is_usable], steering_wheel_angle=steering_wheel_angle,
        road_wheel_angle=vehicle.road_wheel_angle(steering_wheel_angle))
    implausible: tuple[Finding, ...] = ()
    if steering.message in run.signals.rejected_times_ns and len(ins.time_ns):
        rejected_ns = move_to_ins_clock(run, settings, run.signals.rejected_times_ns[steering.message])
        implausible = (make_rejected_frames_finding(
            (rejected_ns - ins.time_ns[0]) * 1e-9, len(rejected_ns) + len(steering.time_ns),
            run.signals.faults[steering.message]),)
    provenance = {"reader": f"{source.kind} and CAN log", **({"origin": list(ins.origin)} if ins.origin else {}),
                  "alignment": summarise_alignment(run.alignment),
                  "settings": {"steering_sign": settings.steering_sign, "steering_latency": settings.steering_latency,
                               "ins_can_latency": run.latency_text}}
    auxiliary = AuxiliaryData({"INS": ins.stamps_ns, "steering": steering_ns},
                              {name: count for name, count in missing.items() if count},
                              *collect_speeds(run.signals, run.alignment.to_reference_ns), ins.quality,
                              implausible=implausible, geographic=ins.origin is not None)
    return LoadedRun(log, provenance, source.labels, tuple(warnings), run.alignment, auxiliary)


def move_to_ins_clock(run: RawRun, settings: ReadSettings, time_ns: np.ndarray) -> np.ndarray:
    """Converts times of steering angles [ns] from the CAN clock to the INS clock and subtracts the steering latency."""
    return run.alignment.to_reference_ns(time_ns) - round(settings.steering_latency * 1e9)


def choose_clock_settings(source: RunSource, settings: ReadSettings) -> dict[str, Any]:
    """Arguments of `align_clocks`, from the settings or else the run.yaml. Raises RunError for invalid bounds."""
    if settings.search and settings.search[0] >= settings.search[1]:
        raise RunError("--search", "the lower bound {:g} is not below the upper bound {:g}".format(*settings.search))
    offset = settings.offset if settings.offset is not None else source.settings.get("offset")
    latency = settings.ins_can_latency or source.settings.get("ins_can_latency") or INS_ON_CAN_DELAY
    return {"offset": offset, "search": settings.search, "latency": latency, "steering_sign": settings.steering_sign}


def read_pair(files: Sequence[Path], settings: ReadSettings) -> RawRun:
    """Reads and aligns an INS recording and CAN logs, which need not contain the steering angle. Raises RunError.

    files: INS recording (NCOM, VBO, bag, or CSV with speed and yaw rate) and logs, or their folder, or a run.yaml.
    """
    return read_raw(_find_pair(files, settings), replace(settings, for_alignment=True), keep_frames=False)


def _find_pair(files: Sequence[Path], settings: ReadSettings) -> RunSource:
    logs = [f for f in files if is_can_log(f)]
    tables = [(f, reader) for f in files if f not in logs and (reader := find_reader(f)) and reader.is_table]
    if len(tables) == 1 and len(logs) == len(files) - 1 and logs:  # find_runs would read the table as a complete drive
        ((table, reader),) = tables
        return RunSource(table.stem, reader.kind, (table,), tuple(logs))
    runs = find_runs(files)
    for run in runs:
        if run.problem is not None:
            raise run.problem
    if [run.kind for run in runs] == ["bag"] and not runs[0].can:
        if may_need_can_frames(runs[0].path, runs[0].files) and (settings.search or settings.offset is not None):
            return runs[0]
        raise RunError(runs[0].path, "all its messages are on one clock, so there is nothing to align")
    pairs = [run for run in runs if run.can]
    if len(pairs) != 1:
        count = "no pair" if not pairs else f"more than one pair ({', '.join(run.name for run in pairs)})"
        raise RunError(", ".join(map(str, files)), f"these files contain {count} of INS recording and CAN logs",
                       "pass one INS recording (.ncom, .csv, .vbo or a bag) and its CAN logs")
    pair_files = {*pairs[0].files, *pairs[0].can, pairs[0].run_file}
    if unused := [file for file in files if file.is_file() and file not in pair_files]:
        raise RunError(unused[0], f"this is neither the INS recording {pairs[0].path.name} nor one of its CAN logs "
                       f"({', '.join(log.name for log in pairs[0].can)})", "pass a log of CAN frames, or omit it")
    return pairs[0]
