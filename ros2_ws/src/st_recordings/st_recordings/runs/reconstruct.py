"""Odometry and steering of a bag without such topics: both reconstructed from raw packets and frames, as the bridges
publish them, and further channels for the checks, read only where their layout is constant.
"""

import math
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from canedge_bridge.decode import SteeringCalibration
from oxts_bridge import file_decoder, packet_time
from oxts_bridge.motion import FIRST_FIX, GIVEN, Origin, reconstruct_odometry
from oxts_bridge.ncom import NcomError
from rosbags.typesys.store import Typestore
from st_core.checks import AuxiliaryData, InsQuality, Series
from st_core.errors import StCoreError
from st_core.vehicle import VehicleParameters

from .bag_storage import Storage, Topic, parameters, text_of
from .cdr import CAN_FRAMES, INS_ON_CAN, INS_STATUS, NCOM, WHEEL_FIELDS, WHEEL_SPEEDS, field_of
from .errors import RunError
from .ins_log import car_speed, is_newer, series
from .ncom import ins_quality, to_body
from .run_types import SteeringField

ORIGIN, FIX = "ins/origin", "sensor_msgs/msg/NavSatFix"
RECONSTRUCTED = " (reconstructed)"  # behind the name of the topic that it was computed from


class Reconstruction:
    """Of one recording. records: its metadata records: parameters of the nodes, DBC, table and vehicle."""

    def __init__(self, path: Path, storage: Storage, records: Mapping[str, Mapping[str, str]], store: Typestore):
        self._path, self._storage, self._store = path, storage, store
        self._records, self._nodes = records, parameters(records)
        self._topics = storage.topics()

    def has(self, type_name: str) -> bool:
        """Whether there are raw packets (NCOM) or frames (CAN_FRAMES)."""
        return any(t.type_name == type_name and t.count for t in self._topics)

    def topic(self, type_name: str) -> Topic:
        """Of those that are there."""
        return next(t for t in self._topics if t.type_name == type_name and t.count)

    @property
    def bus_is_described(self) -> bool:
        """Whether the recording includes the DBC and table of its frames."""
        return self.has(CAN_FRAMES) and None not in self._descriptions()

    def map_frame(self) -> str:
        return str(self._nodes.get("oxts_bridge", {}).get("map_frame", "map"))

    def odometry(self, fields: tuple[str, ...]) -> dict[str, np.ndarray]:
        """The fields of nav_msgs/Odometry, as oxts_bridge had published them. Raises RunError, without a fix too."""
        bridge = self._nodes.get("oxts_bridge", {})
        columns = self._storage.columns({self.topic(NCOM): ("header.stamp", "raw_packet")}, self._store)
        found = columns.get(self.topic(NCOM).name)
        if found is None:
            raise RunError(self._path, "its raw packets are not alike", "repair the bag with `st recover`")
        packets = zip(found["header.stamp"].tolist(), map(bytes, found["raw_packet"]), strict=True)
        rows = [(one.stamp_ns, *one.position, *one.orientation, *one.velocity[:2], one.rate[2])
                for one in reconstruct_odometry(packets, self._origin(bridge), not bridge.get("replay_file"),
                                          bridge.get("stamp_source") == "receive")]
        if not rows:
            raise RunError(self._path, "none of its raw packets has a fix and a time", "record with the unit locked")
        stamps, *values = zip(*rows, strict=True)
        names = [field for field in fields if not field.endswith("stamp")]
        # Altitude is not among the requested fields.
        chosen = [values[k] for k in (0, 1, *range(3, len(values)))]
        return {"header.stamp": np.array(stamps, np.int64),
                **{name: np.array(column) for name, column in zip(names, chosen, strict=True)}}

    def origin(self) -> tuple[float, float, float] | None:
        """Recorded origin of the map frame: latitude, longitude [deg], altitude [m]."""
        topic = next((t for t in self._topics if t.name.endswith(ORIGIN) and t.type_name == FIX and t.count), None)
        if topic is None:
            return None
        fix: Any = self._store.deserialize_cdr(next(self._storage.messages(topic.name)), topic.type_name)
        return fix.latitude, fix.longitude, fix.altitude

    def _origin(self, bridge: Mapping[str, Any]) -> Origin:
        if (recorded := self.origin()) is not None:
            return Origin(GIVEN, recorded)
        source = bridge.get("origin_source", FIRST_FIX)
        latitude, longitude, altitude = (float(bridge.get(f"origin_{name}", math.nan))
                                         for name in ("latitude", "longitude", "altitude"))
        return Origin(source, (latitude, longitude, altitude) if source == GIVEN else None)

    def steering(self) -> dict[str, np.ndarray]:
        """The fields of st_msgs/Steering, as canedge_bridge had published them. Raises RunError."""
        from .can_signals import steering_of

        bridge = self._nodes.get("canedge_bridge", {})
        signal = steering_of(self._signals, self._path, self._table)
        ratio, offset = (self._steering(bridge, name) for name in ("steering_ratio", "steering_wheel_offset"))
        calibration = SteeringCalibration(bridge.get("steering_sign", 1), offset, ratio)
        latency_ns = round(float(bridge.get("steering_latency", 0.0)) * 1e9)
        return {"header.stamp": signal.time_ns - latency_ns,
                "steering_wheel_angle": calibration.steering_wheel_angle(signal.values),
                "road_wheel_angle": calibration.road_wheel_angle(signal.values), "valid": signal.valid}

    def _steering(self, bridge: Mapping[str, Any], name: str) -> float:
        value = float(bridge.get(name, math.nan))
        if math.isfinite(value):
            return value
        text = text_of(self._records, str(bridge.get("vehicle_file", "")))
        try:
            return getattr(VehicleParameters.from_yaml(text or "", "the vehicle in the recording"), name)
        except StCoreError as error:
            raise RunError(self._path, f"the steering of its raw frames needs a vehicle file: {error}") from None

    def speeds(self) -> tuple[Series | None, Series | None]:
        """See `can_signals.speeds_of`."""
        from .can_signals import speeds_of

        return speeds_of(self._signals)

    def _descriptions(self) -> tuple[str | None, ...]:
        bridge = self._nodes.get("canedge_bridge", {})
        return tuple(text_of(self._records, str(bridge.get(name, ""))) for name in ("dbc_file", "signals_file"))

    @cached_property
    def _table(self) -> Any:
        from .can_signals import load_signal_table

        if not self.bus_is_described:
            raise RunError(self._path, "it has raw CAN frames, but not the DBC and table to decode them with",
                           "record vehicle/steering too")
        with tempfile.TemporaryDirectory() as folder:
            files = Path(folder, "can.dbc"), Path(folder, "signals.yaml")
            for file, text in zip(files, self._descriptions(), strict=True):
                file.write_text(text or "", encoding="utf-8")
            return load_signal_table(*files)

    @cached_property
    def _signals(self) -> Any:
        from .can_signals import decode_signals  # the CAN libraries: a second that other bags need not wait for
        from .frames import read_frames

        table = self._table
        try:
            frames = read_frames(self._storage.messages(self.topic(CAN_FRAMES).name))
        except ValueError as error:
            raise RunError(self._path, f"its raw CAN frames are damaged: {error}",
                           "repair the bag with `st recover`") from None
        return decode_signals(frames, table)


_FIELDS = {WHEEL_SPEEDS: ("header.stamp", *WHEEL_FIELDS.values(), "valid"), INS_ON_CAN: ("header.stamp", "velocity_x"),
           NCOM: ("raw_packet",)}
_STATUS = ("header.stamp", "navigation_status", "position_mode", "position_accuracy_north", "position_accuracy_east",
           "heading_accuracy")


def extra_fields(topics: Sequence[Topic]) -> dict[Topic, tuple[str, ...]]:
    """The topics that are read, one of a type, and their fields. Packets only if no other topic has their content."""
    of_type = {topic.type_name: topic for topic in topics if topic.count}
    fields_of = {of_type[name]: fields for name, fields in _FIELDS.items() if name in of_type}
    if NCOM in of_type and INS_ON_CAN in of_type and INS_STATUS in of_type:
        fields_of.pop(of_type[NCOM])
    return fields_of


def bag_extras(storage: Storage, topics: Sequence[Topic], columns: Mapping[Topic, Mapping[str, np.ndarray]],
               stamps: Mapping[str, np.ndarray], missing: Mapping[str, int], store: Typestore,
               again: Reconstruction) -> AuxiliaryData:
    """columns: of the topics of `extra_fields` that could be read. stamps, missing: of odometry and steering. again: of
    the same recording, for the speeds where no topic has them.
    """
    by_type = {topic.type_name: found for topic, found in columns.items()}
    status = next((topic for topic in topics if topic.type_name == INS_STATUS and topic.count), None)
    quality = _status(storage, status, store) if status else None
    wheels = _wheels(by_type[WHEEL_SPEEDS]) if WHEEL_SPEEDS in by_type else None
    on_can = by_type.get(INS_ON_CAN)
    ins_speed = series(on_can["header.stamp"], on_can["velocity_x"]) if on_can else None
    if WHEEL_SPEEDS not in by_type and again.bus_is_described:
        wheels, ins_speed = again.speeds()
    if NCOM in by_type and (quality is None or ins_speed is None):
        of_packets = _packets(by_type[NCOM]["raw_packet"])
        quality, ins_speed = quality or of_packets[0], ins_speed or of_packets[1]
    return AuxiliaryData(stamps, {name: count for name, count in missing.items() if count}, wheels, ins_speed, quality)


def _wheels(columns: Mapping[str, np.ndarray]) -> Series | None:
    speeds = {}
    for name, field in WHEEL_FIELDS.items():
        here = columns["valid"].astype(bool) & np.isfinite(columns[field])
        found = series(columns["header.stamp"][here], columns[field][here])
        if found is not None:
            speeds[name] = found.time_ns, found.values
    return car_speed(speeds)


def _packets(raw: np.ndarray) -> tuple[InsQuality | None, Series | None]:
    """Quality, and forward speed of the packets themselves."""
    try:
        columns = file_decoder.decode_file(np.ascontiguousarray(raw, np.uint8).tobytes())
    except NcomError:
        return None, None
    timed = np.flatnonzero((columns.kind == file_decoder.REGULAR) & (columns.order == packet_time.NEW)
                           & (columns.utc_ns != file_decoder.UNKNOWN_TIME))
    rows = timed[is_newer(columns.utc_ns[timed])]
    if not len(rows):
        return None, None
    north, east, down = columns.velocity_ned[:, rows]
    forward = to_body(np.stack([east, north, -down]), np.pi / 2 - columns.heading[rows], -columns.pitch[rows],
                      columns.roll[rows])[0]
    fix = ~columns.approximate[rows]
    return ins_quality(columns, rows), series(columns.utc_ns[rows][fix], forward[fix])


def _status(storage: Storage, topic: Topic, store: Typestore) -> InsQuality | None:
    """About one message a second, with texts of all lengths."""
    try:
        rows = [[field_of(message, field) for field in _STATUS]
                for _, message in deserialised("", storage, topic, store)]
    except (RunError, AttributeError):  # the extras are optional
        return None
    if not rows:
        return None
    time_ns = np.array([row[0] for row in rows], np.int64)
    values = np.array([row[1:] for row in rows], float)
    used = is_newer(time_ns)
    time_ns, (status, mode, north, east, heading) = time_ns[used], values[used].T
    return InsQuality(time_ns, status, mode, np.hypot(north, east), heading)


def steering_topic(where: Any, topics: list[Topic], steering: SteeringField, store: Typestore) -> Topic:
    """The topic named. Raises RunError where it is not in the bag, empty, or of a type that is not known."""
    found = next((t for t in topics if t.name.lstrip("/") == steering.topic.lstrip("/") and t.count), None)
    if found is None:
        names = ", ".join(sorted(t.name for t in topics if t.count))[:300] or "no messages"
        raise RunError(where, f"--steering-topic: no message of {steering.topic} is in it; it has {names}",
                       "name one of them")
    if found.type_name not in store.fielddefs:
        raise RunError(where, f"--steering-topic: the type {found.type_name} of {found.name} is not known, and the bag "
                       "has no definition of it", "record it as MCAP, which includes definitions")
    return found


def steering_value(where: Any, message: Any, steering: SteeringField) -> float:
    """The angle in a message [rad, left +].

    Raises RunError, naming the fields there are, where the path ends at no number.
    """
    value = message
    for part in steering.field.split("."):
        fields = [name for name in getattr(value, "__dataclass_fields__", {}) if not name.startswith("__")]
        if part.isdigit() and _is_list(value) and int(part) < len(value):
            value = value[int(part)]
            continue
        if part not in fields:
            has = f"no {part!r}; it has {', '.join(fields)}" if fields else f"no {part!r}; nothing is below it"
            raise RunError(where, f"--steering-field: {steering.field!r} is not in {steering.topic}: {has}",
                           "give the path to one number, as drive.steering_angle")
        value = getattr(value, part)
    if _is_list(value):
        raise RunError(where, f"--steering-field: {steering.field!r} of {steering.topic} is a list of {len(value)}",
                       f"add the place in it, as {steering.field}.0")
    if isinstance(value, bool | str) or not isinstance(value, int | float | np.number):
        raise RunError(where, f"--steering-field: {steering.field!r} of {steering.topic} is not a number",
                       "give the path to one number, as drive.steering_angle")
    return steering.scale * float(value)


def _is_list(value: Any) -> bool:
    return hasattr(value, "__getitem__") and hasattr(value, "__len__") and not isinstance(value, str | bytes)


def stamp_of(message: Any, log_ns: int) -> int:
    """header.stamp [ns]; when the message was recorded where it has none, or it was left empty."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    return (stamp.sec * 1_000_000_000 + stamp.nanosec if stamp else 0) or log_ns


def deserialised(where: Any, storage: Storage, topic: Topic, store: Typestore) -> Iterator[tuple[int, Any]]:
    """(log time [ns], message) of a topic. Raises RunError for a damaged one."""
    for log_ns, data in storage.timed(topic.name):
        try:
            message = store.deserialize_cdr(data, topic.type_name)
        except Exception as error:  # rosbags raises whatever struct and numpy raise
            raise RunError(where, f"a message of {topic.name} is damaged ({type(error).__name__})",
                           "record it again, or repair the bag with `st recover`") from None
        yield log_ns, message


def steering_columns(where: Any, storage: Storage, topic: Topic, steering: SteeringField,
                     store: Typestore) -> dict[str, np.ndarray]:
    """The fields of st_msgs/Steering, of a topic of another type. What is not measured is NaN. Raises RunError."""
    stamps, angles = [], []
    for log_ns, message in deserialised(where, storage, topic, store):
        stamps.append(stamp_of(message, log_ns))
        angles.append(steering_value(where, message, steering))
    values, missing = np.array(angles), np.full(len(angles), math.nan)
    wheel = steering.quantity == "wheel"
    # Of a hand wheel, the vehicle file makes the road wheels' angle (DriveLog.with_steering).
    return {"header.stamp": np.array(stamps, np.int64), "road_wheel_angle": values,
            "steering_wheel_angle": values if wheel else missing, "valid": np.isfinite(values)}
