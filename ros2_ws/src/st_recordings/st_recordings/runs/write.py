"""Writes a run of NCOM packets and CAN frames as a rosbag2 recording on the INS clock (`st import`)."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
from oxts_bridge import file_decoder
from st_core.checks import Finding
from st_core.vehicle import VehicleParameters

from ..mcap import BagWriter
from ..results import collect_versions
from .cdr import CAN_FRAMES, NCOM, ODOMETRY, STEERING, WHEEL_FIELDS, WHEEL_SPEEDS, load_typestore
from .errors import RunError
from .frames import Frames
from .load import apply_run_file, check_coverage, hash_files
from .ncom import NcomLog
from .raw import RawRun, build_drive, move_to_ins_clock, read_raw, summarise_alignment
from .run_types import LoadedRun, ReadSettings, RunSource
from .serialiser import Covariances, Message, Serialiser

TOPICS = {"/ins/odometry": ODOMETRY, "/ins/ncom": NCOM, "/vehicle/steering": STEERING,
          "/vehicle/wheel_speeds": WHEEL_SPEEDS, "/can/frames": CAN_FRAMES}
BLOCK_NS = 20 * 10**9
"""Duration [ns] of the part of a run that is serialised at once, to limit the use of memory."""
TIME_MARGIN_NS = 60 * 10**9
"""A packet that is more than this [ns] before the first or after the last fix has a wrong time."""
Stream = tuple[np.ndarray, Callable[[slice], list[Message]]]
"""(times [ns] of the entries of a stream, function that serialises some of the entries)."""


@dataclass(frozen=True)
class ImportResult:
    counts: dict[str, int]  # messages by topic
    span: float  # time from the first to the last message [s]
    run: RawRun
    warnings: tuple[str, ...]
    findings: tuple[Finding, ...] = ()


def import_run(source: RunSource, vehicle: VehicleParameters, directory: Path, settings: ReadSettings,
               check: Callable[[LoadedRun], Sequence[Finding]], progress: Callable[[float], None] | None = None
               ) -> ImportResult:
    """Reads and checks a run of NCOM packets and CAN frames, and writes it as a bag, without corrections of a run.yaml.

    check: returns the findings on a drive; raises RunError for a drive that must not be written. progress: called with
    the completed fraction, 0 to 1. Raises RunError if the run cannot be read or aligned, `check` rejects it, or the bag
    cannot be written.
    """
    if source.problem is None and source.kind != "ncom":
        raise RunError(source.where, f"st import converts NCOM packets and CAN frames, but this run is {source.kind}",
                       "use it without conversion: st evaluate, check, identify and discover read it directly")
    run = read_raw(source, settings)
    drive = apply_run_file(source, build_drive(source, vehicle, settings, run), vehicle)
    coverage_warnings = check_coverage(source, drive.log)
    findings = tuple(check(drive))
    try:
        writer = BagWriter(directory, _build_metadata_records(source, vehicle, settings, run))
    except OSError as error:
        raise RunError(directory, str(error.strerror or error)) from None
    store = load_typestore()
    ids = {topic: writer.add_topic(topic, name, definition=store.generate_msgdef(name, ros_version=2)[0],
                                   type_hash=store.hash_rihs01(name)) for topic, name in TOPICS.items()}
    streams = _make_streams(run, vehicle, settings, Serialiser(store))
    start_ns = min(int(times[0]) for times, _ in streams if len(times))
    span_ns = max(int(times[-1]) for times, _ in streams if len(times)) - start_ns
    counts = dict.fromkeys(TOPICS, 0)
    try:
        for block_ns in range(start_ns, start_ns + span_ns + 1, BLOCK_NS):
            edges = block_ns, block_ns + BLOCK_NS
            messages = [message for times, serialise in streams
                        if (rows := slice(*np.searchsorted(times, edges).tolist())).start < rows.stop
                        for message in serialise(rows)]
            for time_ns, topic, data in sorted(messages, key=itemgetter(0)):
                writer.write(ids[topic], data, time_ns)
                counts[topic] += 1
            if progress is not None:
                progress(min((block_ns + BLOCK_NS - start_ns) / (span_ns + 1), 1.0))
    finally:
        writer.close()
    if writer.error:
        raise RunError(directory, writer.error, "check the disk and import again")
    warnings = [*drive.warnings, *coverage_warnings]
    if drive.auxiliary.corrected:
        warnings.append(f"{directory}: the bag contains uncorrected data; copy the corrections of the run.yaml to a "
                        "run.yaml of the bag (bag: ...)")
    return ImportResult(counts, span_ns * 1e-9, run, tuple(warnings), findings)


def _make_streams(run: RawRun, vehicle: VehicleParameters, settings: ReadSettings, serialiser: Serialiser
                  ) -> list[Stream]:
    ins, steering = run.ins, run.steering
    assert isinstance(ins, NcomLog) and steering is not None  # import_run reads only such runs
    columns, covariances = ins.columns, Covariances(ins.columns)
    packets = np.flatnonzero(columns.navigation_status != 11)  # 11: structure B, a packet without navigation data
    # A packet with no time near the fixes gets the time of the previous one.
    utc_ns = columns.utc_ns[packets]
    near = (utc_ns >= ins.time_ns[0] - TIME_MARGIN_NS) & (utc_ns <= ins.time_ns[-1] + TIME_MARGIN_NS)
    near &= utc_ns != file_decoder.UNKNOWN_TIME
    first_ns = int(utc_ns[near].min()) if near.any() else int(ins.time_ns[0])
    packet_ns = np.maximum.accumulate(np.where(near, utc_ns, first_ns))
    steering_ns = move_to_ins_clock(run, settings, steering.time_ns)
    angle = settings.steering_sign * steering.values
    to_reference = run.alignment.to_reference_ns
    frame_ns, buses = to_reference(run.can.frames.time_ns), run.can.frames.bus
    wheel_messages = {message for name, message in run.signals.signals if name in WHEEL_FIELDS}
    wheels = [serialiser.serialise_wheel_speeds(m, run.signals, to_reference) for m in sorted(wheel_messages)]
    return [
        (ins.time_ns, lambda rows: serialiser.serialise_odometry(ins, rows, covariances)),
        (packet_ns, lambda rows: serialiser.serialise_ncom(columns.raw[packets[rows]], packet_ns[rows])),
        (steering_ns, lambda rows: serialiser.serialise_steering(steering_ns[rows], angle[rows], steering.valid[rows],
                                                                 vehicle)),
        *((np.array([time_ns for time_ns, _, _ in messages]), messages.__getitem__) for messages in wheels),
        *(_make_frame_stream(run.can.frames, frame_ns, np.flatnonzero(buses == bus), serialiser)
          for bus in np.unique(buses).tolist())]


def _make_frame_stream(frames: Frames, frame_ns: np.ndarray, of_bus: np.ndarray, serialiser: Serialiser) -> Stream:
    """Stream of the frames with the indices `of_bus`. frame_ns: times of all frames [ns]."""
    name = f"log:can{frames.bus[of_bus[0]]}"
    return frame_ns[of_bus], lambda rows: serialiser.serialise_can_frames(
        frames.select(of_bus[rows]), frame_ns[of_bus[rows]], name)


def _build_metadata_records(source: RunSource, vehicle: VehicleParameters, settings: ReadSettings,
                            run: RawRun) -> dict[str, Any]:
    alignment = {k: v if isinstance(v, str) else json.dumps(v) for k, v in summarise_alignment(run.alignment).items()}
    latitude, longitude, altitude = run.ins.origin or (0.0, 0.0, 0.0)
    return {
        "import": {
            "name": source.name, "ins": str(source.where), "can": json.dumps([str(f) for f in run.can.files]),
            "map_origin": json.dumps({"latitude_deg": np.degrees(latitude), "longitude_deg": np.degrees(longitude),
                                      "altitude_m": altitude}),
            "steering_sign": str(settings.steering_sign), "steering_latency_s": str(settings.steering_latency),
            "ins_can_latency": run.latency,
            "vehicle": vehicle.name, "vehicle_hash": vehicle.hash,
            "labels": json.dumps([[entry.name, entry.start, entry.end] for entry in source.labels])},
        "alignment": alignment,
        "files_sha256": hash_files((*source.files, *source.can)),
        "versions": collect_versions()}
