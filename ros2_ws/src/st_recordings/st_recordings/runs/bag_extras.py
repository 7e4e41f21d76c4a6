"""Further channels of a bag for the checks: optional, and read only where their layout is constant."""

from collections.abc import Mapping, Sequence

import numpy as np
from oxts_bridge import file_decoder, packet_time
from oxts_bridge.ncom import NcomError
from rosbags.typesys.store import Typestore
from st_core.checks import AuxiliaryData, InsQuality, Series

from .bag_storage import Storage, Topic
from .cdr import Layouts
from .extras import car_speed, series
from .messages import INS_ON_CAN, INS_STATUS, NCOM, WHEEL_FIELDS, WHEEL_SPEEDS
from .ncom import to_body
from .reconstruct import Reconstruction
from .status_channels import ins_quality

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
    ins_speed = _ins_on_can(by_type[INS_ON_CAN]) if INS_ON_CAN in by_type else None
    if WHEEL_SPEEDS not in by_type and again.bus_is_described:
        wheels, ins_speed = again.speeds()
    if NCOM in by_type and (quality is None or ins_speed is None):
        of_packets = _packets(by_type[NCOM]["raw_packet"])
        quality, ins_speed = quality or of_packets[0], ins_speed or of_packets[1]
    return AuxiliaryData(stamps, {name: count for name, count in missing.items() if count},
                  wheels, ins_speed, quality)


def _wheels(columns: Mapping[str, np.ndarray]) -> Series | None:
    speeds = {}
    for name, field in WHEEL_FIELDS.items():
        here = columns["valid"].astype(bool) & np.isfinite(columns[field])
        found = series(columns["header.stamp"][here], columns[field][here])
        if found is not None:
            speeds[name] = found.time_ns, found.values
    return car_speed(speeds)


def _ins_on_can(columns: Mapping[str, np.ndarray]) -> Series | None:
    return series(columns["header.stamp"], columns["velocity_x"])


def _packets(raw: np.ndarray) -> tuple[InsQuality | None, Series | None]:
    """Quality, and forward speed of the packets themselves."""
    try:
        columns = file_decoder.decode_file(np.ascontiguousarray(raw, np.uint8).tobytes())
    except NcomError:
        return None, None
    timed = np.flatnonzero((columns.kind == file_decoder.REGULAR) & (columns.order == packet_time.NEW)
                           & (columns.utc_ns != file_decoder.UNKNOWN_TIME))
    newer = np.diff(np.maximum.accumulate(columns.utc_ns[timed]), prepend=columns.utc_ns[timed][:1] - 1) > 0
    rows = timed[newer]
    if not len(rows):
        return None, None
    north, east, down = columns.velocity_ned[:, rows]
    forward = to_body(np.stack([east, north, -down]), np.pi / 2 - columns.heading[rows], -columns.pitch[rows],
                      columns.roll[rows])[0]
    fix = ~columns.approximate[rows]
    return ins_quality(columns, rows), series(columns.utc_ns[rows][fix], forward[fix])


def _status(storage: Storage, topic: Topic, store: Typestore) -> InsQuality | None:
    """About one message a second, with texts of all lengths."""
    layouts = Layouts(store, topic.type_name)
    rows = []
    try:
        for data in storage.messages(topic.name):
            layout = layouts.of(data)
            rows.append([layout.value(data, field) for field in _STATUS])
    except Exception:  # rosbags raises whatever struct and numpy raise; the extras are optional
        return None
    if not rows:
        return None
    time_ns = np.array([row[0] for row in rows], np.int64)
    values = np.array([row[1:] for row in rows], float)
    newer = np.diff(np.maximum.accumulate(time_ns), prepend=time_ns[0] - 1) > 0
    time_ns, (status, mode, north, east, heading) = time_ns[newer], values[newer].T
    return InsQuality(time_ns, status, mode, np.hypot(north, east), heading)
