"""Writes a run of NCOM packets and CAN frames as a rosbag2 recording on the INS clock (`st import`)."""

import json
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
from oxts_bridge import file_decoder
from oxts_bridge.geometry import Attitude
from rosbags.interfaces import Nodetype
from rosbags.typesys.store import Typestore
from st_core.checks import Finding
from st_core.vehicle import VehicleParameters

from ..mcap import BagWriter
from ..results import collect_versions
from .can_signals import CanSignals
from .cdr import CAN_FRAMES, NCOM, ODOMETRY, STEERING, WHEEL_FIELDS, WHEEL_SPEEDS, CdrLayout, load_typestore
from .errors import RunError
from .frames import ERROR, EXTENDED, FD, FRAME_HEAD_LENGTH, REMOTE, Frames
from .load import apply_run_file, check_coverage, hash_files
from .ncom import ACCURACIES, NcomLog, decode_status_channel, select_latest_values
from .raw import RawRun, build_drive, move_to_ins_clock, read_raw
from .run_types import LoadedRun, ReadSettings, RunSource, summarise_alignment

TOPICS = {"/ins/odometry": ODOMETRY, "/ins/ncom": NCOM, "/vehicle/steering": STEERING,
          "/vehicle/wheel_speeds": WHEEL_SPEEDS, "/can/frames": CAN_FRAMES}
BLOCK_NS = 20 * 10**9  # duration [ns] of the part of a run that is serialised at once, to limit memory use
TIME_MARGIN_NS = 60 * 10**9
"""A packet time more than this [ns] before the first or after the last fix is considered wrong."""
UNKNOWN_VARIANCE = 1e6
"""Variance [SI], as in oxts_bridge.convert: so large that filters ignore the value, but finite, so they do not fail."""
MAP_FRAME, INS_FRAME = "map", "ins_link"
CAN_PERIOD_NS = 20_000_000  # time span of one can/frames message [ns]; 0.1 s in the live bridge

Message = tuple[int, str, bytes]
"""(log time [ns], topic, serialised message)."""
Stream = tuple[np.ndarray, Callable[[slice], list[Message]]]
"""(times [ns] of the entries of a stream, function that serialises a slice of them)."""


@dataclass(frozen=True)
class ImportResult:
    """Summary of a written bag."""

    counts: dict[str, int]  # messages by topic
    span: float  # time from the first to the last message [s]
    run: RawRun
    warnings: tuple[str, ...]
    findings: tuple[Finding, ...] = ()


class Covariances:
    """Covariances of odometry from the accuracies that the INS reports; each is valid until it is sent again."""

    def __init__(self, ins: NcomLog):
        self._ins, self._accuracies = ins, dict[int, tuple[np.ndarray, np.ndarray]]()
        for channel, names in ACCURACIES.items():
            packets, values = decode_status_channel(ins.columns, channel, names)
            self._accuracies[channel] = packets, np.radians(values) if channel == 5 else values

    def compute(self, rows: slice) -> tuple[np.ndarray, np.ndarray]:
        """(pose, twist) covariances, (n, 36) each, for rows of the log.

        The axes of the pose are east, north, up, and rotations are about these fixed axes; the twist is in body axes.
        Variances of angular rates, and variances that the unit does not report, are UNKNOWN_VARIANCE.
        """
        packets, attitude = self._ins.rows[rows], self._ins.select_attitude(rows)
        pose, twist = np.zeros((len(packets), 6, 6)), np.zeros((len(packets), 6, 6))
        pose[:, :3, :3] = self._compute_block(3, packets, Attitude(0.0, 0.0, 0.0).rotate_covariance)
        pose[:, 3:, 3:] = self._compute_block(5, packets, attitude.rotate_orientation_covariance)
        twist[:, :3, :3] = self._compute_block(4, packets, attitude.rotate_covariance)
        twist[:, 3:, 3:] = np.eye(3) * UNKNOWN_VARIANCE
        return pose.reshape(-1, 36), twist.reshape(-1, 36)

    def _compute_block(self, channel: int, packets: np.ndarray, rotate: Callable[[Any], tuple]) -> np.ndarray:
        """Covariances (n, 3, 3) from the accuracies in a status channel. rotate: variances -> elements, row by row."""
        standard_deviations = select_latest_values(*self._accuracies[channel], packets)
        is_known = np.isfinite(standard_deviations).all(axis=1)[:, None, None]
        elements = np.broadcast_arrays(*rotate(np.nan_to_num(standard_deviations).T ** 2))
        return np.where(is_known, np.stack(elements, axis=-1).reshape(-1, 3, 3), np.eye(3) * UNKNOWN_VARIANCE)


class Serialiser:
    """Serialises the messages of a run. store: message types of ROS and of the suite."""

    def __init__(self, store: Typestore):
        self._store = store
        self._layouts: dict[str, CdrLayout] = {}

    def _make_zeros(self, type_name: str, **texts: str) -> Any:
        """A message of zeros. texts: name of a string field of the message or of its header -> text."""
        values: dict[str, Any] = {}
        fields: Any = self._store.fielddefs[type_name][1]
        for name, (node, detail) in fields:
            if node == Nodetype.NAME:
                values[name] = self._make_zeros(detail, **texts)
            elif node == Nodetype.BASE:
                values[name] = texts.get(name, "") if detail[0] == "string" else np.zeros(1, detail[0])[0].item()
            else:
                (_, base), count = detail
                values[name] = np.zeros(count, base[0]) if node == Nodetype.ARRAY else []
        return self._store.types[type_name](**values)

    def serialise(self, topic: str, columns: Mapping[str, np.ndarray], **texts: str) -> list[Message]:
        """Serialises messages of equal layout. columns: by field. texts: see `_make_zeros`."""
        if topic not in self._layouts:
            self._layouts[topic] = CdrLayout(self._store, TOPICS[topic], self._make_zeros(TOPICS[topic], **texts))
        times = columns["header.stamp"].tolist()
        rows = self._layouts[topic].serialise(len(times), columns)
        return [(time_ns, topic, row.tobytes()) for time_ns, row in zip(times, rows, strict=True)]

    def serialise_odometry(self, ins: NcomLog, rows: slice, covariances: Covariances) -> list[Message]:
        """Serialises odometry of the INS point: pose in the map (ENU), twist in body axes (FLU)."""
        pose_covariance, twist_covariance = covariances.compute(rows)
        columns = {"header.stamp": ins.time_ns[rows], "pose.covariance": pose_covariance,
                   "twist.covariance": twist_covariance}
        for k, axis in enumerate("xyz"):
            columns[f"pose.pose.position.{axis}"] = ins.position[k][rows]
            columns[f"twist.twist.linear.{axis}"] = ins.motion.body_velocity[k][rows]
            columns[f"twist.twist.angular.{axis}"] = ins.motion.angular_velocity[k][rows]
        quaternion = ins.select_attitude(rows).to_quaternion()
        columns |= {f"pose.pose.orientation.{axis}": values for axis, values in zip("xyzw", quaternion, strict=True)}
        return self.serialise("/ins/odometry", columns, frame_id=MAP_FRAME, child_frame_id=INS_FRAME)

    def serialise_wheel_speeds(self, message: str, signals: CanSignals, to_reference: Any) -> list[Message]:
        """Serialises wheel speeds [m/s], one ROS message per frame of a CAN message; NaN for wheels not in the frame.

        to_reference: converts log times to the INS clock [ns].
        """
        wheels = {field: signals.signals[name, message] for name, field in WHEEL_FIELDS.items()
                  if (name, message) in signals.signals}
        log_ns = np.unique(np.concatenate([signal.time_ns for signal in wheels.values()]))
        columns = {field: np.full(len(log_ns), np.nan) for field in WHEEL_FIELDS.values()}
        valid = np.zeros(len(log_ns), bool)
        for field, signal in wheels.items():  # a multiplexed signal is not in every frame
            rows = np.searchsorted(log_ns, signal.time_ns)
            columns[field][rows], valid[rows] = signal.values, signal.valid
        columns |= {"header.stamp": to_reference(log_ns), "valid": valid}
        return self.serialise("/vehicle/wheel_speeds", columns)

    def serialise_can_frames(self, frames: Frames, time_ns: np.ndarray, bus_name: str) -> list[Message]:
        """Serialises the frames of one bus, one message per CAN_PERIOD_NS. time_ns: ascending times of the frames.

        Each frame consists of a head (stamp, id, four flags, length of the data) and its data, padded to 4 bytes.
        """
        n = len(frames)
        width = FRAME_HEAD_LENGTH + frames.payload.shape[1]
        rows = np.zeros((n, width), np.uint8)
        words = rows[:, :12].view("<i4")
        words[:, 0], words[:, 1] = np.divmod(time_ns, 1_000_000_000)
        words[:, 2] = (frames.id & ~np.uint32(EXTENDED)).view(np.int32)
        for byte, flag in ((13, ERROR), (14, REMOTE), (15, FD)):
            rows[:, byte] = (frames.flags & flag) != 0
        rows[:, 12] = (frames.id & np.uint32(EXTENDED)) != 0
        length = np.minimum(frames.length, frames.payload.shape[1]).astype(np.int64)
        rows[:, 16] = length
        rows[:, FRAME_HEAD_LENGTH:] = frames.payload
        rows[:, FRAME_HEAD_LENGTH:][np.arange(width - FRAME_HEAD_LENGTH) >= length[:, None]] = 0
        padded_length = FRAME_HEAD_LENGTH + (length + 3) // 4 * 4
        body = rows[np.arange(width) < padded_length[:, None]]
        starts = np.concatenate(([0], np.cumsum(padded_length)))
        firsts = np.nonzero(np.diff(time_ns // CAN_PERIOD_NS, prepend=-1))[0]
        ends = np.append(firsts[1:], n)
        head = bytearray(self._store.serialize_cdr(self._make_zeros(CAN_FRAMES, frame_id=bus_name), CAN_FRAMES))
        messages = []
        for first, last, start_ns in zip(firsts.tolist(), ends.tolist(), time_ns[firsts].tolist(), strict=True):
            struct.pack_into("<II", head, 4, *divmod(start_ns, 1_000_000_000))
            struct.pack_into("<I", head, len(head) - 4, last - first)
            # CDR does not pad the last frame of a message.
            padding = int(padded_length[last - 1] - FRAME_HEAD_LENGTH - length[last - 1])
            data = bytes(head) + body[starts[first] : starts[last] - padding].tobytes()
            messages.append((start_ns, "/can/frames", data))
        return messages


def import_run(source: RunSource, vehicle: VehicleParameters, directory: Path, settings: ReadSettings,
               check: Callable[[LoadedRun], Sequence[Finding]], progress: Callable[[float], None] | None = None
               ) -> ImportResult:
    """Converts a run of NCOM packets and CAN frames to a bag after checks, without the corrections of its run.yaml.

    check: returns the findings on a drive; raises RunError for a drive that must not be written. progress: called with
    the completed fraction, 0 to 1. Raises RunError if a run cannot be read, aligned or written, or `check` rejects it.
    """
    if source.problem is None and source.kind != "ncom":
        raise RunError(source.path, f"st import converts NCOM packets and CAN frames, but this run is {source.kind}",
                       "use it without conversion: st evaluate, check, identify and discover read it directly")
    run = read_raw(source, settings)
    drive = apply_run_file(source, build_drive(source, vehicle, settings, run), vehicle)
    warnings = [*drive.warnings, *check_coverage(source, drive.log)]
    if drive.auxiliary.corrections:
        warnings.append(f"{directory}: the bag contains uncorrected data; copy the corrections of the run.yaml to a "
                        f"run.yaml next to the bag, with the entry bag: {directory.name}")
    findings = tuple(check(drive))
    del drive  # 100 MB for an hour
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
    return ImportResult(counts, span_ns * 1e-9, run, tuple(warnings), findings)


def _make_streams(run: RawRun, vehicle: VehicleParameters, settings: ReadSettings, serialiser: Serialiser
                  ) -> list[Stream]:
    ins, steering = run.ins, run.steering
    assert isinstance(ins, NcomLog) and steering is not None  # import_run accepts only such runs
    columns, covariances = ins.columns, Covariances(ins)
    packets = np.flatnonzero(columns.navigation_status != 11)  # 11: structure B, a packet without navigation data
    # A packet with an unknown time, or one far from the fixes, gets the time of the previous packet.
    utc_ns = columns.utc_ns[packets]
    is_near_fix = (utc_ns >= ins.time_ns[0] - TIME_MARGIN_NS) & (utc_ns <= ins.time_ns[-1] + TIME_MARGIN_NS)
    is_near_fix &= utc_ns != file_decoder.UNKNOWN_TIME
    first_ns = int(utc_ns[is_near_fix].min()) if is_near_fix.any() else int(ins.time_ns[0])
    packet_ns = np.maximum.accumulate(np.where(is_near_fix, utc_ns, first_ns))
    steering_ns = move_to_ins_clock(run, settings, steering.time_ns)
    angle = settings.steering_sign * steering.values
    to_reference = run.alignment.to_reference_ns
    frame_ns, buses = to_reference(run.can.frames.time_ns), run.can.frames.bus
    wheel_messages = {message for name, message in run.signals.signals if name in WHEEL_FIELDS}
    wheels = [serialiser.serialise_wheel_speeds(m, run.signals, to_reference) for m in sorted(wheel_messages)]
    return [
        (ins.time_ns, lambda rows: serialiser.serialise_odometry(ins, rows, covariances)),
        (packet_ns, lambda rows: serialiser.serialise("/ins/ncom", {
            "header.stamp": packet_ns[rows], "raw_packet": columns.raw[packets[rows]]}, frame_id=INS_FRAME)),
        (steering_ns, lambda rows: serialiser.serialise("/vehicle/steering", {
            "header.stamp": steering_ns[rows], "steering_wheel_angle": angle[rows], "valid": steering.valid[rows],
            "road_wheel_angle": vehicle.road_wheel_angle(angle[rows])})),
        *((np.array([time_ns for time_ns, _, _ in messages]), messages.__getitem__) for messages in wheels),
        *(_make_frame_stream(run.can.frames, frame_ns, np.flatnonzero(buses == bus), serialiser)
          for bus in np.unique(buses).tolist())]


def _make_frame_stream(frames: Frames, frame_ns: np.ndarray, indices: np.ndarray, serialiser: Serialiser) -> Stream:
    """Stream of the frames of one bus. frame_ns: times of all frames [ns]. indices: of the frames of the bus."""
    return frame_ns[indices], lambda rows: serialiser.serialise_can_frames(
        frames.select(indices[rows]), frame_ns[indices[rows]], f"log:can{frames.bus[indices[0]]}")


def _build_metadata_records(source: RunSource, vehicle: VehicleParameters, settings: ReadSettings,
                            run: RawRun) -> dict[str, Any]:
    alignment = {k: v if isinstance(v, str) else json.dumps(v) for k, v in summarise_alignment(run.alignment).items()}
    latitude, longitude, altitude = run.ins.origin or (0.0, 0.0, 0.0)
    return {
        "import": {
            "name": source.name, "ins": str(source.path), "can": json.dumps([str(f) for f in run.can.files]),
            "map_origin": json.dumps({"latitude_deg": np.degrees(latitude), "longitude_deg": np.degrees(longitude),
                                      "altitude_m": altitude}),
            "steering_sign": str(settings.steering_sign), "steering_latency_s": str(settings.steering_latency),
            "ins_can_latency": run.latency_text,
            "vehicle": vehicle.name, "vehicle_hash": vehicle.hash,
            "labels": json.dumps([[entry.name, entry.start, entry.end] for entry in source.labels])},
        "alignment": alignment,
        "files_sha256": hash_files((*source.files, *source.can)),
        "versions": collect_versions()}
