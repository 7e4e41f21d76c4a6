"""Reads the drive in a bag: a rosbag2 directory, a single .mcap or .db3 file, or a ROS 1 bag."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from st_core.sideslip import derive_yaw_rate

from ..bag_metadata import read_information
from .axes import convert_odometry
from .bag_storage import EXTENSIONS, ROS1_EXTENSION, Storage, Topic, describe_missing_files, list_bag_files, open_bag
from .cdr import CAN_FRAMES, CAN_MSGS_FRAME, NCOM, ODOMETRY, READ_ERRORS, STEERING, read_summary
from .errors import RunError, convert_errors, format_count
from .ins_log import InsLog, are_stored_out_of_order, select_usable_rows, yaw_from_quaternion
from .reconstruct import RECONSTRUCTED_SUFFIX, Reconstruction, find_steering_topic, read_steering_columns
from .run_types import LoadedRun, SteeringField, make_drive_log

KNOWN_TOPIC_PREFIXES = ("/ins/", "/can/", "/predictor/", "/evaluator/", "/identifier/", "/view/", "/tf",
                        "/diagnostics", "/clock", "/rosout", "/parameter_events", "/events/")
"""Prefixes of the topics that the suite or every ROS system publishes."""
SUITE_RECORDS = {"recording", "configuration"}  # metadata records that the recorder and the evaluator write first
CLOSING_RECORD = "rosbag2"  # metadata record that a recorder writes when it closes a recording
PREFERRED_TOPICS = {ODOMETRY: "ins/odometry", STEERING: "vehicle/steering"}  # type -> preferred end of the topic name
MAX_REPEATED_FRACTION = 0.75  # largest fraction of repeated stamps; above it, all stamps are meaningless
_ODOMETRY_FIELDS = ("header.stamp", "pose.pose.position.x", "pose.pose.position.y", "pose.pose.orientation.x",
                    "pose.pose.orientation.y", "pose.pose.orientation.z", "pose.pose.orientation.w",
                    "twist.twist.linear.x", "twist.twist.linear.y", "twist.twist.angular.z")
_STEERING_FIELDS = ("header.stamp", "steering_wheel_angle", "road_wheel_angle", "valid")


@dataclass(frozen=True, kw_only=True)
class BagDrive(LoadedRun):
    topics: dict[str, str]  # type -> name of the topic that was read
    records: dict[str, dict[str, str]]  # metadata records, name -> {key: text}
    frame: str  # frame_id of the first odometry message, or of reconstructed odometry
    unknown_topics: tuple[str, ...]  # "topic (type)" of topics neither read nor published by the suite or ROS
    conversions: tuple[str, ...]  # notes on stamps and odometry values that differ from the recorded messages


def is_bag(path: Path) -> bool:
    """Whether a path is a rosbag2 directory, one of its storage files, or a ROS 1 bag."""
    return (path / "metadata.yaml").is_file() if path.is_dir() else path.suffix.lower() in (*EXTENSIONS, ROS1_EXTENSION)


def has_odometry(path: Path) -> bool:
    """Whether a bag contains odometry, or INS packets and steering to reconstruct a drive; True if unknown."""
    if path.is_dir() and (path / "metadata.yaml").is_file():
        information = read_information(path)
        try:
            types = {t["topic_metadata"]["type"] for t in information["topics_with_message_count"]}
        except (KeyError, TypeError):
            return True
        if not types and "recording.recorder" in (information.get("custom_data") or ()):
            return True  # the suite's recorder was killed: it writes the topics when it closes the recording
    else:
        summary = read_summary(path) if path.is_file() and path.suffix.lower() == ".mcap" else None
        if summary is None:
            return True
        types = {schema.name for schema in summary.schemas.values()}
    return ODOMETRY in types or (NCOM in types and bool(types & {STEERING, CAN_FRAMES}))


def lacks_odometry(path: Path, files: Sequence[Path] = (), topics: str | None = None) -> bool:
    """Whether a bag has messages (of these topics), but neither odometry nor INS packets. files: see `open_bag`."""
    types = _read_types(path, files, topics)
    return bool(types) and not types & {ODOMETRY, NCOM}


def lacks_steering(path: Path) -> bool:
    """Whether a bag contains odometry, but neither steering nor CAN frames of the suite."""
    types = _read_types(path)
    return ODOMETRY in types and not types & {STEERING, CAN_FRAMES}


def may_need_can_frames(path: Path, files: Sequence[Path] = ()) -> bool:
    """Whether the steering may be in CAN frames of a different bridge (can_msgs/Frame). files: see `open_bag`."""
    types = _read_types(path, files)
    return types >= {ODOMETRY, CAN_MSGS_FRAME} and not types & {STEERING, CAN_FRAMES}


def may_carry_steering(topic: Topic) -> bool:
    """Whether a topic is a candidate for --steering-topic: not odometry, CAN frames, text, or of the suite or ROS."""
    return not topic.name.startswith(KNOWN_TOPIC_PREFIXES) and not topic.type_name.startswith("st_msgs/") and (
        topic.type_name not in (ODOMETRY, CAN_MSGS_FRAME, "std_msgs/msg/String"))


def _read_types(path: Path, files: Sequence[Path] = (), topics: str | None = None) -> set[str]:
    """Types of the recorded messages (of these topics); empty for an unreadable bag. files: see `open_bag`."""
    try:
        return {topic.type_name for topic in open_bag(path, files).topics if topics is None or topic.is_in(topics)}
    except RunError:
        return set()


def read_bag(path: Path, name: str | None = None, steering: SteeringField | None = None, odometry: str | None = None,
             files: Sequence[Path] = ()) -> BagDrive:
    """Reads odometry and steering of a recording, or reconstructs them from its raw packets and frames.

    steering: field with the steering angle, if it is not in st_msgs/Steering. odometry: the topic to read if several
    have the type nav_msgs/Odometry. files: see `open_bag`.
    Raises RunError for a file that is not a bag, was not closed, or lacks odometry or steering.
    """
    storage, records = open_bag(path, files), read_metadata_records(path)
    storage.use_definitions({ODOMETRY, *(t.type_name for t in storage.topics if steering and t.is_in(steering.topic))})
    reconstruction = Reconstruction(storage, records)
    types = storage.by_type.keys()
    required_fields: dict[Topic, tuple[str, ...]] = {}
    if reads_odometry := bool(odometry) or ODOMETRY in types or NCOM not in types:
        required_fields[_find_topic(storage, ODOMETRY, odometry)] = _ODOMETRY_FIELDS
    if steering is None and (STEERING in types or CAN_FRAMES not in types):
        required_fields[_find_topic(storage, STEERING)] = _STEERING_FIELDS
    auxiliary_fields = reconstruction.choose_auxiliary_fields()
    by_topic = storage.columns({**required_fields, **auxiliary_fields})
    columns = {topic.type_name: by_topic.get(topic.name) or storage.read_one_by_one(topic, fields)
               for topic, fields in required_fields.items()}
    topics = {topic.type_name: topic.name for topic in required_fields}
    if not reads_odometry:
        columns[ODOMETRY] = reconstruction.reconstruct_odometry(_ODOMETRY_FIELDS)
        topics[ODOMETRY] = storage.by_type[NCOM].name + RECONSTRUCTED_SUFFIX
    if steering is not None:
        topic = find_steering_topic(storage, steering)
        columns[STEERING], topics[STEERING] = read_steering_columns(storage, topic, steering), topic.name
    elif STEERING not in columns:
        columns[STEERING] = reconstruction.reconstruct_steering()
        topics[STEERING] = storage.by_type[CAN_FRAMES].name + RECONSTRUCTED_SUFFIX
    stamp_notes = _replace_meaningless_stamps(storage, topics, columns, bool(steering))
    frame = _read_frame_id(storage, topics[ODOMETRY]) if reads_odometry else reconstruction.map_frame()
    notes = [*describe_missing_files(path), *stamp_notes]
    ins_ns, values, missing, conversions = _select_odometry(columns[ODOMETRY], frame, notes)
    log = make_drive_log(path, name or path.stem, ins_time_ns=ins_ns, **values,
                         **_select_steering(columns[STEERING], missing, notes))
    stamps = {"INS": columns[ODOMETRY]["header.stamp"], "steering": columns[STEERING]["header.stamp"]}
    auxiliary_columns = {topic.type_name: by_topic[topic.name] for topic in auxiliary_fields if topic.name in by_topic}
    auxiliary = reconstruction.collect_auxiliary_data(auxiliary_columns, stamps, missing)
    unknown_topics = tuple(f"{t.name} ({t.type_name})" for t in storage.topics if not (
        t.name in topics.values() or t.type_name.startswith("st_msgs/") or t.name.startswith(KNOWN_TOPIC_PREFIXES)))
    provenance: dict[str, Any] = {"reader": "bag", "topics": topics, "recorded": records}
    if (origin := reconstruction.read_origin()) is not None:
        provenance["origin"] = [*map(math.radians, origin[:2]), origin[2]]
    return BagDrive(log=log, provenance=provenance, auxiliary=auxiliary, topics=topics, records=records, frame=frame,
                    unknown_topics=unknown_topics, conversions=(*stamp_notes, *conversions),
                    warnings=tuple(f"{path}: {note}" for note in (*notes, *conversions)))


def read_odometry(path: Path, odometry: str | None, files: Sequence[Path]) -> InsLog:
    """Reads the INS log in a bag, for a run with CAN logs. Raises RunError. Arguments: see `read_bag`."""
    storage = open_bag(path, files)
    storage.use_definitions([ODOMETRY])
    topic = _find_topic(storage, ODOMETRY, odometry)
    columns = storage.read_fields(topic, _ODOMETRY_FIELDS)
    notes = _replace_meaningless_stamps(storage, {ODOMETRY: topic.name}, {ODOMETRY: columns})
    ins_ns, values, _, conversions = _select_odometry(columns, _read_frame_id(storage, topic.name), notes)
    notes += conversions
    return InsLog(path, ins_ns, values, ins_ns, warnings=tuple(f"{path}: {note}" for note in notes))


def _replace_meaningless_stamps(storage: Storage, topics: Mapping[str, str],
                                columns: dict[str, dict[str, np.ndarray]], is_external: bool = False) -> list[str]:
    """Replaces meaningless stamps by the times of reception; returns a note on each replacement.

    A driver or simulator may leave header.stamp at a constant value such as 0, write whole seconds, or stamp two topics
    with unrelated clocks. The times of reception are still correct. Messages that are sent several times with
    the same values and stamp have correct stamps. is_external: whether a different system stamped the steering.
    """
    notes = []
    for type_name, topic in topics.items():
        stamps = columns[type_name]["header.stamp"]
        repeats = int((np.diff(stamps) == 0).sum())
        fields = [field for name, field in columns[type_name].items() if name != "header.stamp"]
        has_changed = np.any([np.diff(np.nan_to_num(np.asarray(field, float))) != 0 for field in fields], axis=0)
        are_resent = 2 * int((has_changed & (np.diff(stamps) == 0)).sum()) < int(has_changed.sum())
        if (repeats > MAX_REPEATED_FRACTION * len(stamps) and not are_resent) or (len(stamps) == 2 and repeats):
            columns[type_name]["header.stamp"] = storage.read_log_times(topic, stamps)
            problem = (f"all {len(stamps)} stamps of {topic} are {stamps[0] * 1e-9:g} s" if repeats == len(stamps) - 1
                       else f"{format_count(repeats, len(stamps), 'stamps')} of {topic} repeat the previous one")
            notes.append(f"{problem}; the times of reception are used")
    series = [(topic, columns[type_name]["header.stamp"]) for type_name, topic in topics.items()]
    are_recorded = not any(topic.endswith(RECONSTRUCTED_SUFFIX) for topic in topics.values())
    if len(series) > 1 and are_recorded and min(len(stamps) for _, stamps in series) > 1:
        aligned, clock_notes = storage.align_stamps(series, is_external)
        for type_name, stamps in zip(topics, aligned, strict=True):
            columns[type_name]["header.stamp"] = stamps
        notes += clock_notes
    return notes


def read_metadata_records(path: Path) -> dict[str, dict[str, str]]:
    """Metadata records of an MCAP recording except CLOSING_RECORD; empty for SQLite. Raises RunError if damaged."""
    records = _read_all_metadata_records(path)
    records.pop(CLOSING_RECORD, None)
    return records


def was_interrupted(path: Path) -> bool:
    """Whether the suite's recorder stopped before it closed the recording, e.g. on a full disk. Raises RunError."""
    records = _read_all_metadata_records(path)
    return bool(SUITE_RECORDS & records.keys()) and CLOSING_RECORD not in records


def _read_all_metadata_records(path: Path) -> dict[str, dict[str, str]]:
    records: dict[str, dict[str, str]] = {}
    for file in [path] if path.is_file() else list_bag_files(path):
        if file.suffix.lower() == ".mcap" and read_summary(file) is not None:
            problem, advice = "its metadata records are damaged", "repair the bag with `st recover`"
            with convert_errors(file, problem, advice, *READ_ERRORS), file.open("rb") as stream:
                records.update({m.name: dict(m.metadata) for m in make_reader(stream).iter_metadata()})
    return records


def _find_topic(storage: Storage, type_name: str, name: str | None = None) -> Topic:
    """The topic of a type with the given name; without a name, the preferred topic. Raises RunError."""
    path, candidates = storage.path, [t for t in storage.topics if t.type_name == type_name]
    if name is not None:
        named_topic = next((t for t in storage.topics if t.name.lstrip("/") == name.lstrip("/")), None)
        if named_topic in candidates:
            return named_topic
        problem = f"is of type {named_topic.type_name}" if named_topic else "is not a topic with messages"
        raise RunError(path, f"--odometry-topic: {name} {problem}",
                       f"topics of type {type_name}: {', '.join(sorted(t.name for t in candidates)) or 'none'}")
    if not candidates:
        topics = ", ".join(sorted(f"{t.name} ({t.type_name})" for t in storage.topics))[:300] or "nothing"
        has_candidates = type_name == STEERING and any(map(may_carry_steering, storage.topics))
        option = ", or name the topic of the steering angle with --steering-topic" if has_candidates else ""
        raise RunError(path, f"it contains no message of type {type_name}; recorded: {topics}",
                       f"also record the topic {PREFERRED_TOPICS[type_name]}, or another of this type{option}")
    preferred_topics = [t for t in candidates if t.name.endswith(PREFERRED_TOPICS[type_name])] or candidates
    if len(preferred_topics) > 1:
        names = ", ".join(sorted(t.name for t in preferred_topics))
        raise RunError(path, f"several topics are of type {type_name}: {names}",
                       "name one of them with --odometry-topic" if type_name == ODOMETRY else
                       f"record only one of them, or one with a name that ends with {PREFERRED_TOPICS[type_name]}")
    return preferred_topics[0]


def _read_frame_id(storage: Storage, topic: str) -> str:
    """header.frame_id of the first odometry message; empty if the definition of a header in the bag lacks it."""
    message: Any = storage.store.deserialize_cdr(next(storage.messages(topic)), ODOMETRY)
    return str(getattr(message.header, "frame_id", ""))


def _select_odometry(odometry: Mapping[str, np.ndarray], frame_id: str, notes: list[str]) -> tuple[
        np.ndarray, dict[str, np.ndarray], dict[str, int], list[str]]:
    """(times [ns], INS channels of the usable messages, channel -> number of missing values, notes on conversions)."""
    x, y, *quaternion, velocity_x, velocity_y, yaw_rate = (odometry[field] for field in _ODOMETRY_FIELDS[1:])
    values = {"x": x, "y": y, "yaw": yaw_from_quaternion(*quaternion), "velocity_x": velocity_x,
              "velocity_y": velocity_y, "yaw_rate": yaw_rate}
    missing = {signal: int((~np.isfinite(value)).sum()) for signal, value in values.items()}
    is_usable = np.isfinite(np.stack(list(values.values()))).all(axis=0)
    time_ns, rows = _select_usable_messages(odometry["header.stamp"], is_usable, "odometry messages", missing, notes)
    if not np.nan_to_num(quaternion).any():
        notes.append("the orientation quaternion is 0 in all odometry messages: record the heading in it")
    values = {name: value[rows] for name, value in values.items()}
    values["yaw"] = np.unwrap(values["yaw"])
    conversions = convert_odometry(values, frame_id)
    if len(rows) > 2 and np.ptp(values["yaw"]) > 0 and not values["yaw_rate"].any():
        values["yaw_rate"] = derive_yaw_rate(time_ns, values["yaw"])
        conversions.append("yaw_rate is 0 in all odometry messages; the derivative of yaw is used")
    return time_ns, values, missing, conversions


def _select_steering(steering: Mapping[str, np.ndarray], missing: dict[str, int], notes: list[str]) -> dict[str, Any]:
    """Steering columns of DriveLog from the usable messages; adds the number of the other messages to `missing`."""
    is_usable = np.isfinite(steering["road_wheel_angle"]) & steering["valid"].astype(bool)
    missing["road_wheel_angle"] = n_missing = int((~is_usable).sum())
    time_ns, rows = _select_usable_messages(
        steering["header.stamp"], is_usable, "steering messages", {"the steering angle": n_missing}, notes)
    wheel_angle = steering["steering_wheel_angle"][rows]
    return {"steering_time_ns": time_ns, "road_wheel_angle": steering["road_wheel_angle"][rows],
            "steering_wheel_angle": wheel_angle if np.isfinite(wheel_angle).all() else None}


def _select_usable_messages(time_ns: np.ndarray, is_usable: np.ndarray, noun: str, missing: Mapping[str, int],
                            notes: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """(strictly ascending times [ns] of the usable messages, their indices); adds notes on the other messages.

    missing: channel -> number of messages without a usable value.
    """
    time = np.asarray(time_ns, np.int64)
    rows = np.flatnonzero(is_usable & (time != 0))
    if n_unusable := len(time) - len(rows):
        reasons = [f"usable value of {', '.join(names)}"] if (names := [k for k, n in missing.items() if n]) else []
        reasons += ["stamp"] if (time == 0).any() else []
        count = format_count(n_unusable, len(time), noun)
        notes.append(f"{count} have no {' or no '.join(reasons)}; they were left out")
    if are_stored_out_of_order(time[rows]):
        rows = rows[np.argsort(time[rows], kind="stable")]
        notes.append(f"{noun} are stored out of order; they were sorted by their stamps")
    selection, time_notes = select_usable_rows(time[rows], noun)
    notes += time_notes
    return time[rows[selection]], rows[selection]
