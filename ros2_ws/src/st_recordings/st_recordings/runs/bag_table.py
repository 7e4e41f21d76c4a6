"""Reads the drive in a bag without odometry as a table: numeric fields of its messages, such as NavSatFix, Imu and
TwistStamped, are columns with names such as /imu/data/angular_velocity/z."""

from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np
from st_core.log import INS_SIGNALS
from st_core.vehicle import VehicleParameters

from .bag_storage import Storage, Topic, open_bag
from .cdr import ODOMETRY, CdrLayout
from .columns import Layout, find_columns, find_missing
from .csv import QUATERNION_CHANNELS, ROAD_WHEEL, STEERING_WHEEL, build_drive
from .csv_table import parse_table
from .errors import RunError
from .reconstruct import find_steering_topic, read_steering_columns
from .run_types import LoadedRun, SteeringField

EXPORT_ADVICE = (f"record {ODOMETRY}, for example from robot_localization, or export the topics as one CSV file with "
                 "PlotJuggler and name the columns in a run.yaml")
STEERING_ANGLES = (ROAD_WHEEL, STEERING_WHEEL)
FIX_TYPES = ("sensor_msgs/msg/NavSatFix", "gps_msgs/msg/GPSFix", "gps_common/msg/GPSFix")


def read_bag_as_table(path: Path, vehicle: VehicleParameters | None, steering: SteeringField | None,
                      files: Sequence[Path] = (), ins_topics: str | None = None) -> LoadedRun | None:
    """Reads the drive; None if no message contains a channel of a drive. Raises RunError. ins_topics: separated by
    commas; their channels are not read from other topics. Other arguments: see `read_bag`."""
    storage = open_bag(path, files)
    storage.use_definitions({topic.type_name for topic in storage.topics})
    parts = _read_topics(storage, ins_topics)
    if not parts:
        return None
    if steering is not None:
        topic = find_steering_topic(storage, steering)
        columns = read_steering_columns(storage, topic, steering)
        channel = ROAD_WHEEL if steering.quantity == "road" else STEERING_WHEEL
        parts = [(name, stamps, {column: values for column, values in part.items() if column not in STEERING_ANGLES})
                 for name, stamps, part in parts]
        parts.append((topic.name, columns["header.stamp"], {channel: columns[ROAD_WHEEL]}))
    for channel in STEERING_ANGLES:
        if len(topics := [name for name, _, part in parts if channel in part]) > 1:
            raise RunError(path, f"topics {' and '.join(topics)} may each contain the {channel}",
                           "name the right one with --steering-topic")
    aligned, notes = storage.align_stamps([(name, stamps) for name, stamps, _ in parts])
    warnings = [f"{path}: {note}" for note in notes]
    merged = _merge_topics(aligned, parts)
    lines = (",".join(map(repr, row)) for row in zip(*(values.tolist() for values in merged.values()), strict=True))
    table = parse_table(path, [*merged], "\n".join(lines), ",", Layout(), warnings)
    velocity_column = table.sources["velocity_x"].name if "velocity_x" in table.sources else ""
    frame_id = next((_find_fields(storage, topic)[2] for topic in storage.topics
                     if velocity_column.startswith(f"{topic.name}/")), "")
    try:
        return build_drive(table, vehicle, frame_id=frame_id)
    except RunError as error:
        subject = f"--odometry-topic: {ins_topics}" if ins_topics else "it"
        problem = f"{subject} contains no message of type {ODOMETRY}, and if it is read as a table, {error.problem}"
        advice = "" if {*STEERING_ANGLES} & table.sources.keys() else (
            "name the topic of the steering angle with --steering-topic; or ")
        if "may each" in problem:
            advice = "name the topics of the INS with --odometry-topic, separated by commas; or "
        raise RunError(path, problem, advice + EXPORT_ADVICE) from None


def _merge_topics(times: Sequence[np.ndarray], parts: Sequence[tuple[str, np.ndarray, dict[str, np.ndarray]]]
                  ) -> dict[str, np.ndarray]:
    """Time [s] and the columns of all topics at all their times, NaN where a topic has no message. times: of each topic
    [ns]. parts: (topic, stamps, columns); messages with stamp 0 are left out, of equal times all but the first."""
    kept = [np.flatnonzero(stamps)[np.unique(topic_times[stamps != 0], return_index=True)[1]]
            for topic_times, (_, stamps, _) in zip(times, parts, strict=True)]
    all_times = np.unique(np.concatenate([topic_times[rows] for topic_times, rows in zip(times, kept, strict=True)]))
    merged = {"t [s]": all_times / 1e9}
    for topic_times, rows, (_, _, columns) in zip(times, kept, parts, strict=True):
        for name, values in columns.items():
            merged[name] = np.full(len(all_times), np.nan)
            merged[name][np.searchsorted(all_times, topic_times[rows])] = values[rows]
    return merged


def _read_topics(storage: Storage, ins_topics: str | None) -> list[tuple[str, np.ndarray, dict[str, np.ndarray]]]:
    """(topic, stamps [ns], columns) of the topics with channels. Raises RunError for a named topic without them."""
    # Odometry in a bag with named INS topics is from another source, and is left out.
    topics, ins_channels = [topic for topic in storage.topics if topic.type_name != ODOMETRY], set[str]()
    for name in ins_topics.split(",") if ins_topics else ():
        channels = {channel for topic in topics if topic.is_in(name) for channel in _find_fields(storage, topic)[1]}
        if channels <= {*STEERING_ANGLES}:
            raise RunError(storage.path, f"--odometry-topic: {name} has no messages with channels of an INS",
                           f"topics: {', '.join(sorted(topic.name for topic in topics))}")
        ins_channels |= channels
    return [(topic.name, *part) for topic in topics if (
        part := _read_columns(storage, topic, () if ins_topics and topic.is_in(ins_topics) else ins_channels))[1]]


def has_ins_channels(path: Path) -> bool:
    """Whether the messages of a bag contain every INS channel of a drive, or channels from which it can be derived."""
    try:
        storage = open_bag(path)
        storage.use_definitions({topic.type_name for topic in storage.topics})
        fields_of_topics = [_find_fields(storage, topic)[1] for topic in storage.topics]
    except RunError:
        return False
    return not find_missing({channel for fields in fields_of_topics for channel in fields}, (), INS_SIGNALS)


def _find_fields(storage: Storage, topic: Topic) -> tuple[str, dict[str, tuple[str, str, float]], str]:
    """(field with the stamp, channel -> (name of its column, field, factor to SI), frame_id) of the first message of a
    topic; no channels if the type is unknown or has no stamp."""
    try:
        example = storage.store.deserialize_cdr(next(storage.messages(topic.name)), topic.type_name)
        layout = CdrLayout(storage.store, topic.type_name, example)
    except Exception:  # any, from rosbags
        return "", {}, ""
    has_orientation = -1.0 not in getattr(example, "orientation_covariance", ())[:1]  # REP 145
    paths = [path for path, field in layout.fields.items()
             if field.count == 1 and (has_orientation or not path.startswith("orientation."))]
    names = [f"{topic.name}/{path.replace('.', '/')}" for path in paths]
    fields = {channel: (names[source.column], paths[source.column], source.factor)
             for channel, source in find_columns(storage.path, names, Layout()).items() if channel != "t"}
    stamp = next((path for path in ("header.stamp", "stamp") if path in layout.fields), "")
    return stamp, fields if stamp else {}, getattr(getattr(example, "header", None), "frame_id", "")


def _read_columns(storage: Storage, topic: Topic, excluded: Collection[str]
                  ) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """(stamps [ns], columns) of fields that may be channels; no columns if the type is unknown or has no stamp.

    An INS field that is 0 or NaN in every message is left out, because the driver does not fill it.
    """
    stamp, fields, _ = _find_fields(storage, topic)
    fields = {channel: field for channel, field in fields.items() if channel not in excluded}
    if not fields:
        return np.empty(0), {}
    status = ["status.status"] if topic.type_name in FIX_TYPES else []
    columns = storage.read_fields(topic, [stamp, *status, *(field for _, field, _ in fields.values())])
    stamps = columns[stamp] if columns[stamp].any() else storage.read_log_times(topic.name, columns[stamp])
    if status:
        lacks_fix = columns[status[0]] == -1  # position and velocity are then old or arbitrary
        columns |= {field: np.where(lacks_fix, np.nan, columns[field]) for _, field, _ in fields.values()}
    empty_channels = {channel for channel, (_, field, _) in fields.items() if not np.nan_to_num(columns[field]).any()}
    empty_channels -= {*STEERING_ANGLES, *(() if empty_channels >= {*QUATERNION_CHANNELS} else QUATERNION_CHANNELS)}
    channels = {channel: columns[field] for channel, (_, field, _) in fields.items() if channel not in empty_channels}
    steering = {channel: fields[channel][2] * channels[channel] for channel in STEERING_ANGLES if channel in channels}
    return stamps, {**{fields[channel][0]: values for channel, values in channels.items() if channel not in steering},
                    **steering}
