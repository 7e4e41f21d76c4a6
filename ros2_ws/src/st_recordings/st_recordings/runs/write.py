"""Writes a run of NCOM packets and CAN frames as a rosbag2 recording on the INS clock (`st import`)."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from oxts_bridge import file_decoder
from st_core.checks import Finding
from st_core.vehicle import VehicleParameters

from ..mcap import BagWriter
from ..results import collect_versions
from .bag import definitions_folder
from .cdr import CAN_FRAMES, NCOM, ODOMETRY, STEERING, WHEEL_FIELDS, WHEEL_SPEEDS, load_typestore
from .errors import RunError
from .load import apply_run_file, check_coverage, hash_files
from .ncom import NcomLog
from .raw import RawRun, build_drive, move_to_ins_clock, read_raw, summarise_alignment
from .run_types import LoadedRun, ReadSettings, RunSource
from .serialiser import Covariances, Messages, Serialiser, merge_in_time_order

TOPICS = {"/ins/odometry": ODOMETRY, "/ins/ncom": NCOM, "/vehicle/steering": STEERING,
          "/vehicle/wheel_speeds": WHEEL_SPEEDS, "/can/frames": CAN_FRAMES}
BLOCK_NS = 20 * 10**9
"""Duration [ns] of the part of a run that is serialised at once, to limit the use of memory."""
TIME_MARGIN_NS = 60 * 10**9
"""A packet that is more than this [ns] before the first or after the last fix has a wrong time."""


@dataclass(frozen=True)
class ImportResult:
    """Result of an import."""

    directory: Path  # of the bag
    counts: dict[str, int]  # messages by topic
    span: float  # time from the first to the last message [s]
    run: RawRun
    warnings: tuple[str, ...]
    findings: tuple[Finding, ...] = ()


def import_run(source: RunSource, vehicle: VehicleParameters, directory: Path, settings: ReadSettings,
               check: Callable[[LoadedRun], Sequence[Finding]], progress: Callable[[float], None] | None = None
               ) -> ImportResult:
    """Reads and checks a run of NCOM packets and CAN frames, and writes it, uncorrected, as a bag.

    check: returns the findings on a drive; raises RunError for a drive that must not be written. progress: called with
    the completed fraction, 0 to 1. Raises RunError if the run cannot be read or aligned, `check` rejects it, or the bag
    cannot be written.
    """
    if source.problem is None and source.kind != "ncom":
        raise RunError(source.where, f"st import converts NCOM packets and CAN frames, but this run is {source.kind}",
                       "use it without conversion: st evaluate, check, identify and discover read it directly")
    run = read_raw(source, settings)
    drive = apply_run_file(source, build_drive(source, vehicle, settings, run), vehicle)
    uncovered_time = check_coverage(source, drive.log)
    findings = tuple(check(drive))
    try:
        writer = BagWriter(directory, _build_metadata_records(source, vehicle, settings, run))
    except OSError as error:
        raise RunError(directory, str(error.strerror or error)) from None
    store = load_typestore(definitions_folder())
    ids = {topic: writer.add_topic(topic, name, definition=store.generate_msgdef(name, ros_version=2)[0],
                                   type_hash=store.hash_rihs01(name)) for topic, name in TOPICS.items()}
    blocks = _MessageBlocks(run, vehicle, settings, Serialiser(store))
    counts = dict.fromkeys(TOPICS, 0)
    try:
        for start in range(blocks.start_ns, blocks.end_ns + 1, BLOCK_NS):
            for time_ns, topic, data in merge_in_time_order(blocks.messages(start, start + BLOCK_NS)):
                writer.write(ids[topic], bytes(data), time_ns)
                counts[topic] += 1
            if progress is not None:
                progress(min((start + BLOCK_NS - blocks.start_ns) / (blocks.end_ns - blocks.start_ns + 1), 1.0))
    finally:
        writer.close()
    if writer.error:
        raise RunError(directory, writer.error, "check the disk and import again")
    warnings = [*drive.warnings, *uncovered_time]
    if drive.auxiliary.corrected:
        warnings.append(f"{directory}: the bag contains uncorrected data; copy the corrections of the run.yaml to a "
                        "run.yaml of the bag (bag: ...)")
    return ImportResult(directory, counts, (blocks.end_ns - blocks.start_ns) * 1e-9, run, tuple(warnings), findings)


class _MessageBlocks:
    """Serialises the messages of a run in blocks of time."""

    def __init__(self, run: RawRun, vehicle: VehicleParameters, settings: ReadSettings, serialiser: Serialiser):
        self._run, self._vehicle, self._settings, self._serialiser = run, vehicle, settings, serialiser
        assert isinstance(run.ins, NcomLog) and run.steering is not None  # import_run reads only such runs
        self._ins, self._steering, columns = run.ins, run.steering, run.ins.columns
        self._covariances = Covariances(columns)
        is_structure_b = columns.navigation_status == 11  # a packet without regular navigation data
        self._packets = np.nonzero(~is_structure_b)[0]
        # A packet with no time near the fixes gets the time of the previous one.
        utc_ns, fix_ns = columns.utc_ns[self._packets], run.ins.time_ns
        near = (utc_ns >= fix_ns[0] - TIME_MARGIN_NS) & (utc_ns <= fix_ns[-1] + TIME_MARGIN_NS)
        near &= utc_ns != file_decoder.UNKNOWN_TIME
        first = int(utc_ns[near].min()) if near.any() else int(fix_ns[0])
        self._packet_ns = np.maximum.accumulate(np.where(near, utc_ns, first))
        to_reference = run.alignment.to_reference_ns
        self._frame_ns = to_reference(run.can.frames.time_ns)
        buses = np.unique(run.can.frames.bus).tolist()
        self._frames = [(bus, np.nonzero(run.can.frames.bus == bus)[0]) for bus in buses]
        self._steering_ns = move_to_ins_clock(run, settings, run.steering.time_ns)
        messages = {message for name, message in run.signals.signals if name in WHEEL_FIELDS}
        self._wheels = [serialiser.serialise_wheel_speeds(m, run.signals, to_reference) for m in sorted(messages)]
        times = [run.ins.time_ns, self._packet_ns, self._frame_ns, self._steering_ns]
        self.start_ns = min(int(t[0]) for t in times if len(t))
        self.end_ns = max(int(t[-1]) for t in times if len(t))

    def messages(self, start_ns: int, end_ns: int) -> list[Messages]:
        run, serialiser = self._run, self._serialiser
        rows = _select_between(run.ins.time_ns, start_ns, end_ns)
        parts = [serialiser.serialise_odometry(self._ins, rows, self._covariances)]
        rows = _select_between(self._packet_ns, start_ns, end_ns)
        parts.append(serialiser.serialise_ncom(self._ins.columns.raw[self._packets[rows]], self._packet_ns[rows]))
        rows = _select_between(self._steering_ns, start_ns, end_ns)
        wheel = self._settings.steering_sign * self._steering.values[rows]
        parts.append(serialiser.serialise_steering(self._steering_ns[rows], wheel, self._steering.valid[rows],
                                                   self._vehicle))
        for wheels in self._wheels:
            rows = _select_between(wheels.time_ns, start_ns, end_ns)
            parts.append(Messages(wheels.topic, wheels.type_name, wheels.time_ns[rows], wheels.data,
                                  wheels.edges[rows.start : rows.stop + 1]))
        for bus, of_bus in self._frames:
            frames = of_bus[_select_between(self._frame_ns[of_bus], start_ns, end_ns)]
            if len(frames):
                parts.append(serialiser.serialise_can_frames(run.can.frames.select(frames), self._frame_ns[frames],
                                                             f"log:can{bus}"))
        return [p for p in parts if len(p)]


def _select_between(time_ns: np.ndarray, start_ns: int, end_ns: int) -> slice:
    return slice(*np.searchsorted(time_ns, (start_ns, end_ns)).tolist())


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
            "labels": json.dumps([[entry.name, entry.start, entry.end] for entry in source.labels]),
        },
        "alignment": alignment,
        "files_sha256": hash_files((*source.files, *source.can)),
        "versions": collect_versions(),
    }
