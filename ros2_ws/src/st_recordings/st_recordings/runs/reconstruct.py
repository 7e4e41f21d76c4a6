"""Reconstructs odometry and steering of a bag from raw packets and frames, as the bridges would have published them.

This module also reads steering from topics of any type, and auxiliary data for the checks.
"""

import math
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from oxts_bridge import file_decoder
from oxts_bridge.motion import FIRST_FIX, GIVEN, Motion, Origin, reconstruct_odometry
from oxts_bridge.ncom import NEW, NcomError
from st_core.checks import AuxiliaryData, InsQuality, Series
from st_core.errors import StCoreError
from st_core.timeseries import find_ascending
from st_core.vehicle import VehicleParameters

from .bag_storage import Storage, Topic, find_file_text, parse_parameters
from .cdr import CAN_FRAMES, INS_ON_CAN, INS_STATUS, NCOM, WHEEL_FIELDS, WHEEL_SPEEDS
from .errors import RunError, convert_errors
from .ins_log import compute_car_speed, make_series
from .ncom import collect_quality
from .run_types import SteeringField

ORIGIN_TOPIC, ORIGIN_TYPE = "ins/origin", "sensor_msgs/msg/NavSatFix"
RECONSTRUCTED_SUFFIX = " (reconstructed)"  # appended to the topic name of the raw data from which values are computed
_AUXILIARY_FIELDS = {WHEEL_SPEEDS: ("header.stamp", *WHEEL_FIELDS.values(), "valid"),
                     INS_ON_CAN: ("header.stamp", "velocity_x"), NCOM: ("raw_packet",)}
_STATUS_FIELDS = ("header.stamp", "navigation_status", "position_mode", "position_accuracy_north",
                  "position_accuracy_east")


class Reconstruction:
    """Odometry, steering and speeds of one recording, computed from raw packets and frames."""

    def __init__(self, storage: Storage, records: Mapping[str, Mapping[str, str]]):
        """records: metadata records with node parameters, DBC, signal table and vehicle file."""
        self._storage, self._path, self._by_type = storage, storage.path, storage.by_type
        self._records, self._nodes = records, parse_parameters(records)

    @property
    def has_decodable_frames(self) -> bool:
        """Whether the recording includes CAN frames with their DBC and signal table."""
        return CAN_FRAMES in self._by_type and None not in self._read_can_files()

    def map_frame(self) -> str:
        return str(self._nodes.get("oxts_bridge", {}).get("map_frame", "map"))

    def reconstruct_odometry(self, fields: tuple[str, ...]) -> dict[str, np.ndarray]:
        """Columns of nav_msgs/Odometry, reconstructed from raw packets. Raises RunError for packets of different
        lengths or publishers, or if no packet has a fix and a time.

        fields: names of stamp, position x, y, quaternion x, y, z, w, velocity x, y and yaw rate, in this order.
        """
        bridge = self._nodes.get("oxts_bridge", {})
        topic = self._by_type[NCOM]
        raw = self._storage.columns({topic: ("header.stamp", "raw_packet")}).get(topic.name)
        if raw is None:
            raise RunError(self._path, "its raw packets differ in length, or several nodes have published them",
                           "record the packets of one INS")
        packets = zip(raw["header.stamp"].tolist(), map(bytes, raw["raw_packet"]), strict=True)
        source, position = bridge.get("origin_source", FIRST_FIX), self.read_origin()
        if position is not None:
            source = GIVEN
        elif source == GIVEN:
            latitude, longitude, altitude = (float(bridge.get(f"origin_{name}", math.nan))
                                             for name in ("latitude", "longitude", "altitude"))
            position = latitude, longitude, altitude
        odometry = reconstruct_odometry(packets, Origin(source, position), not bridge.get("replay_file"),
                                        bridge.get("stamp_source") == "receive")
        rows = [(stamp_ns, *position[:2], *motion.attitude.to_quaternion(), *motion.body_velocity[:2],
                 motion.angular_velocity[2]) for stamp_ns, position, motion in odometry]
        if not rows:
            raise RunError(self._path, "none of its raw packets has a fix and a time",
                           "record again after the unit has locked")
        stamps, *values = zip(*rows, strict=True)
        return {fields[0]: np.array(stamps, np.int64), **dict(zip(fields[1:], map(np.array, values), strict=True))}

    def read_origin(self) -> tuple[float, float, float] | None:
        """Recorded origin of the map frame: latitude, longitude [deg], altitude [m]; None if it was not recorded."""
        topic = next((t for t in self._storage.topics if t.name.endswith(ORIGIN_TOPIC) and t.type_name == ORIGIN_TYPE),
                     None)
        if topic is None:
            return None
        fix: Any = self._storage.store.deserialize_cdr(next(self._storage.messages(topic.name)), topic.type_name)
        return fix.latitude, fix.longitude, fix.altitude

    def reconstruct_steering(self) -> dict[str, np.ndarray]:
        """Columns of st_msgs/Steering, reconstructed from raw CAN frames. Raises RunError if they cannot be decoded."""
        from canedge_bridge.decode import SteeringCalibration  # imports CAN libraries, which takes half a second

        from .can_signals import find_steering

        bridge = self._nodes.get("canedge_bridge", {})
        signal = find_steering(self._signals, self._path, self._table)
        ratio = self._read_steering_parameter(bridge, "steering_ratio")
        offset = self._read_steering_parameter(bridge, "steering_wheel_offset")
        calibration = SteeringCalibration(bridge.get("steering_sign", 1), offset, ratio)
        latency_ns = round(float(bridge.get("steering_latency", 0.0)) * 1e9)
        steering_wheel_angle, road_wheel_angle = calibration.convert(signal.values)
        return {"header.stamp": signal.time_ns - latency_ns, "steering_wheel_angle": steering_wheel_angle,
                "road_wheel_angle": road_wheel_angle, "valid": signal.valid}

    def _read_steering_parameter(self, bridge: Mapping[str, Any], key: str) -> float:
        value = float(bridge.get(key, math.nan))
        if math.isfinite(value):
            return value
        text = find_file_text(self._records, str(bridge.get("vehicle_file", "")))
        try:
            return getattr(VehicleParameters.from_yaml(text or "", "the vehicle in the recording"), key)
        except StCoreError as error:
            raise RunError(self._path, "the road wheel angle cannot be computed from its raw frames without the "
                           f"steering ratio and offset of a vehicle: {error}", "also record vehicle/steering") from None

    def choose_auxiliary_fields(self) -> dict[Topic, tuple[str, ...]]:
        """Auxiliary topics, one per type, and their fields; raw packets only if no other topics contain their data."""
        fields = {self._by_type[name]: fields for name, fields in _AUXILIARY_FIELDS.items() if name in self._by_type}
        if self._by_type.keys() >= {NCOM, INS_ON_CAN, INS_STATUS}:
            fields.pop(self._by_type[NCOM])
        return fields

    def collect_auxiliary_data(self, columns: Mapping[str, Mapping[str, np.ndarray]], stamps: Mapping[str, np.ndarray],
                               missing: Mapping[str, int]) -> AuxiliaryData:
        """Collects the auxiliary data of a bag for the checks; missing data are reconstructed if possible.

        columns: fields from `choose_auxiliary_fields`, except unreadable ones, by type. stamps: times [ns] of "INS" and
        "steering". missing: channel -> number of messages without a usable value.
        """
        quality = self._read_reported_quality()
        car_speed = None
        if wheel_speeds := columns.get(WHEEL_SPEEDS):
            valid = wheel_speeds["valid"].astype(bool)
            speeds = {name: make_series(wheel_speeds["header.stamp"][valid], wheel_speeds[field][valid])
                      for name, field in WHEEL_FIELDS.items()}
            car_speed = compute_car_speed(
                {name: (speed.time_ns, speed.values) for name, speed in speeds.items() if speed})
        ins_on_can = columns.get(INS_ON_CAN)
        ins_speed = make_series(ins_on_can["header.stamp"], ins_on_can["velocity_x"]) if ins_on_can else None
        if WHEEL_SPEEDS not in columns and self.has_decodable_frames:
            from .can_signals import collect_speeds

            with suppress(RunError):  # the data for checks are optional
                car_speed, decoded_speed = collect_speeds(self._signals)
                ins_speed = ins_speed or decoded_speed
        if NCOM in columns and (quality is None or ins_speed is None):
            packet_quality, packet_speed = _decode_packets(columns[NCOM]["raw_packet"])
            quality, ins_speed = quality or packet_quality, ins_speed or packet_speed
        return AuxiliaryData(stamps, {name: count for name, count in missing.items() if count}, car_speed, ins_speed,
                             quality)

    def _read_reported_quality(self) -> InsQuality | None:
        """INS quality from st_msgs/InsStatus, read one by one because its texts vary in length; None if unavailable."""
        if INS_STATUS not in self._by_type:
            return None
        try:
            columns = self._storage.read_one_by_one(self._by_type[INS_STATUS], _STATUS_FIELDS)
        except RunError:  # the data for checks are optional
            return None
        time_ns, *values = columns.values()
        rows = find_ascending(time_ns)
        status, mode, north, east = (column[rows].astype(float) for column in values)
        return InsQuality(time_ns[rows], status, mode, np.hypot(north, east))

    def _read_can_files(self) -> tuple[str | None, ...]:
        bridge = self._nodes.get("canedge_bridge", {})
        return tuple(find_file_text(self._records, str(bridge.get(name, ""))) for name in ("dbc_file", "signals_file"))

    @cached_property
    def _table(self) -> Any:
        from .can_signals import load_signal_table

        if not self.has_decodable_frames:
            raise RunError(self._path, "it contains raw CAN frames, but no DBC and signal table to decode them",
                           "also record vehicle/steering")
        with tempfile.TemporaryDirectory() as folder:
            files = Path(folder, "can.dbc"), Path(folder, "signals.yaml")
            for file, text in zip(files, self._read_can_files(), strict=True):
                file.write_text(text or "", encoding="utf-8")
            try:
                return load_signal_table(*files)
            except RunError as error:
                raise RunError(self._path, f"its recorded {Path(error.path).name}: {error.problem}") from None

    @cached_property
    def _signals(self) -> Any:
        from .can_signals import decode_signals  # imports the CAN libraries
        from .frames import read_frames

        table = self._table
        with convert_errors(self._path, "its raw CAN frames are damaged", "also record vehicle/steering", ValueError):
            frames = read_frames(self._storage.messages(self._by_type[CAN_FRAMES].name))
        return decode_signals(frames, table)


def _decode_packets(raw: np.ndarray) -> tuple[InsQuality | None, Series | None]:
    """(INS quality, forward speed [m/s]) from raw packets; None for a quantity without a usable packet."""
    try:
        columns = file_decoder.decode_file(np.ascontiguousarray(raw, np.uint8).tobytes())
    except NcomError:
        return None, None
    timed_packets = np.flatnonzero((columns.kind == file_decoder.REGULAR) & (columns.order == NEW)
                                   & (columns.utc_ns != file_decoder.UNKNOWN_TIME))
    rows = timed_packets[find_ascending(columns.utc_ns[timed_packets])]
    if not len(rows):
        return None, None
    forward = Motion.from_packet(columns.take(rows)).body_velocity[0]
    has_fix = ~columns.is_approximate[rows]
    return collect_quality(columns, rows), make_series(columns.utc_ns[rows][has_fix], forward[has_fix])


def find_steering_topic(storage: Storage, steering: SteeringField) -> Topic:
    """Finds the topic of --steering-topic. Raises RunError if it has no messages or an unknown type."""
    topic = next((t for t in storage.topics if t.is_in(steering.topic)), None)
    if topic is None:
        names = ", ".join(sorted(t.name for t in storage.topics))[:300] or "none"
        raise RunError(storage.path, f"--steering-topic: topic {steering.topic} has no messages in this bag",
                       f"name one of the recorded topics: {names}")
    if topic.type_name not in storage.store.fielddefs:
        raise RunError(storage.path, f"--steering-topic: the type {topic.type_name} of topic {topic.name} is unknown, "
                       "and the bag does not contain its definition", "record it as MCAP, which includes definitions")
    return topic


def extract_steering_angle(path: Path, message: Any, steering: SteeringField) -> float:
    """Steering angle [rad], positive to the left, in a message. Raises RunError if the field is not a number."""
    value = message
    for part in steering.field.split("."):
        fields = [name for name in getattr(value, "__dataclass_fields__", {}) if not name.startswith("__")]
        if part.isdigit() and _is_list(value) and int(part) < len(value):
            value = value[int(part)]
            continue
        if part not in fields:
            names = ", ".join(fields) or "none"
            raise RunError(path, f"--steering-field: {steering.field!r} is not in {steering.topic}: {part!r} is not "
                           f"one of the fields ({names})", "give the path to a number, such as drive.steering_angle")
        value = getattr(value, part)
    if _is_list(value):
        raise RunError(path, f"--steering-field: {steering.field!r} of {steering.topic} is a list of {len(value)} "
                       "elements", f"add an index, such as {steering.field}.0")
    if isinstance(value, bool | str) or not isinstance(value, int | float | np.number):
        raise RunError(path, f"--steering-field: {steering.field!r} of {steering.topic} is not a number",
                       "give the path to a number, such as drive.steering_angle")
    return steering.scale * float(value)


def _is_list(value: Any) -> bool:
    return hasattr(value, "__getitem__") and hasattr(value, "__len__") and not isinstance(value, str | bytes)


def get_stamp(message: Any, log_ns: int) -> int:
    """header.stamp or stamp [ns], or the log time if the message has neither or its stamp is zero."""
    stamp: Any = getattr(getattr(message, "header", message), "stamp", None)
    return (stamp.sec * 1_000_000_000 + stamp.nanosec if hasattr(stamp, "nanosec") else 0) or log_ns


def read_steering_columns(storage: Storage, topic: Topic, steering: SteeringField) -> dict[str, np.ndarray]:
    """Columns of st_msgs/Steering, read from a topic of a different type. Raises RunError."""
    # For a steering wheel angle, the road wheel angle is a placeholder that DriveLog.with_steering replaces.
    stamp_list, angles = [], []
    for _, message in storage.deserialise(topic):
        stamp_list.append(get_stamp(message, 0))
        angles.append(extract_steering_angle(storage.path, message, steering))
    stamps = np.array(stamp_list, np.int64)
    if not stamps.any():
        stamps = storage.read_log_times(topic.name, stamps)
    values, missing = np.array(angles), np.full(len(angles), math.nan)
    return {"header.stamp": stamps, "road_wheel_angle": values,
            "steering_wheel_angle": values if steering.quantity == "wheel" else missing, "valid": np.isfinite(values)}
