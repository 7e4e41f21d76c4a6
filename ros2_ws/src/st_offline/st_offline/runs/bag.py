"""rosbag2 recordings (directories, bare .mcap and .db3 files): odometry and steering of any recorder, as a drive."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader, AnyReaderError
from rosbags.interfaces import Connection
from rosbags.rosbag2 import ReaderError
from rosbags.typesys.store import Typestore
from st_core.errors import StCoreError
from st_core.log import DriveLog

from ..paths import project_root
from .cdr import Layout, typestore
from .errors import RunError, check_readable
from .mcap_columns import blocks, summary_of

EXTENSIONS = (".mcap", ".db3")
ODOMETRY, STEERING = "nav_msgs/msg/Odometry", "st_msgs/msg/Steering"
# Where several topics have the type: the one whose name ends like this.
PREFERRED = {ODOMETRY: "ins/odometry", STEERING: "vehicle/steering"}
_ODOMETRY_FIELDS = ("header.stamp", "pose.pose.position.x", "pose.pose.position.y", "pose.pose.orientation.x",
                    "pose.pose.orientation.y", "pose.pose.orientation.z", "pose.pose.orientation.w",
                    "twist.twist.linear.x", "twist.twist.linear.y", "twist.twist.angular.z")
_STEERING_FIELDS = ("header.stamp", "steering_wheel_angle", "road_wheel_angle", "valid")


@dataclass(frozen=True)
class BagDrive:
    """topics: type -> topic that was read. records: what the recording says about itself, name -> {key: text}."""

    log: DriveLog
    topics: Mapping[str, str]
    records: Mapping[str, Mapping[str, str]]
    warnings: tuple[str, ...]


def definitions() -> Path:
    """The .msg files of the suite's own messages."""
    return project_root() / "ros2_ws" / "src" / "st_msgs" / "msg"


def is_bag(path: Path) -> bool:
    """Whether a path is a rosbag2 directory or a storage file of one."""
    return (path / "metadata.yaml").is_file() if path.is_dir() else path.suffix.lower() in EXTENSIONS


def holds_odometry(path: Path) -> bool:
    """A look at the list of topics, for folders with all kinds of recordings; True where it cannot be told."""
    if path.is_dir() and (path / "metadata.yaml").is_file():
        try:
            about = yaml.safe_load((path / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
            return any(t["topic_metadata"]["type"] == ODOMETRY for t in about["topics_with_message_count"])
        except (OSError, yaml.YAMLError, KeyError, TypeError):
            return True
    if path.is_file() and path.suffix.lower() == ".mcap":
        summary = summary_of(path)
        return summary is None or any(s.name == ODOMETRY for s in summary.schemas.values())
    return True


def read_bag(path: Path, name: str | None = None) -> BagDrive:
    """Odometry and steering of a recording; topics of other types, known or not, are passed over.

    Raises RunError for what is no bag, was not closed, or lacks one of the two.
    """
    for file in [path] if path.is_file() else storage_files(path):
        check_readable(file)
    store = typestore(definitions())
    columns: dict[str, dict[str, np.ndarray]] = {}
    topics, warnings = {}, []
    try:
        with AnyReader([path], default_typestore=store) as reader:
            for type_name, fields in ((ODOMETRY, _ODOMETRY_FIELDS), (STEERING, _STEERING_FIELDS)):
                connection = _connection(path, reader.connections, type_name)
                topics[type_name] = connection.topic
                columns[type_name] = _read_topic(path, reader, store, connection, fields)
    except (AnyReaderError, ReaderError) as error:
        raise RunError(path, f"cannot be read as a bag ({' '.join(str(error).split())[:120]})",
                       "if it was cut off while recording, repair it with `st recover`") from None
    log, notes = _drive(path, name or path.stem, columns[ODOMETRY], columns[STEERING])
    warnings += notes
    return BagDrive(log, topics, records_of(path), tuple(f"{path}: {note}" for note in warnings))


def records_of(path: Path) -> dict[str, dict[str, str]]:
    """Metadata records of an MCAP recording, as the recorder and `st import` leave them; empty for other storage."""
    records: dict[str, dict[str, str]] = {}
    for file in [path] if path.is_file() else storage_files(path):
        if file.suffix.lower() == ".mcap" and summary_of(file) is not None:
            with file.open("rb") as stream:
                records.update({m.name: dict(m.metadata) for m in make_reader(stream).iter_metadata()})
    records.pop("rosbag2", None)
    return records


def storage_files(directory: Path) -> list[Path]:
    return sorted(f for f in directory.iterdir() if f.suffix.lower() in EXTENSIONS)


def _connection(path: Path, connections: Sequence[Connection], type_name: str) -> Connection:
    found = [c for c in connections if c.msgtype == type_name and c.msgcount]
    if not found:
        there = sorted({f"{c.topic} ({c.msgtype})" for c in connections if c.msgcount})
        what = ", ".join(there)[:300] or "no messages"
        raise RunError(path, f"no message of type {type_name} is in it; it has {what}",
                       f"record the topic {PREFERRED[type_name]} too")
    preferred = [c for c in found if c.topic.endswith(PREFERRED[type_name])]
    topics = {c.topic for c in preferred or found}
    if len(topics) > 1:
        raise RunError(path, f"several topics are of type {type_name}: {', '.join(sorted(topics))}",
                       f"leave one of them, or name one .../{PREFERRED[type_name]}")
    return (preferred or found)[0]


def _read_topic(path: Path, reader: AnyReader, store: Typestore, connection: Connection,
                fields: Sequence[str]) -> dict[str, np.ndarray]:
    files = [path] if path.is_file() else storage_files(path)
    if all(f.suffix.lower() == ".mcap" for f in files):
        found = _from_chunks(files, store, connection, fields)
        if found is not None:
            return found
    rows = []
    for wanted, _, raw in reader.messages(connections=[c for c in reader.connections if c.topic == connection.topic]):
        message = reader.deserialize(raw, wanted.msgtype)
        rows.append([_value(message, field) for field in fields])
    return {field: np.array([row[k] for row in rows]) for k, field in enumerate(fields)}


def _value(message: Any, path: str) -> Any:
    for part in path.split("."):
        message = getattr(message, part)
    return message.sec * 1_000_000_000 + message.nanosec if path.endswith("stamp") else message


def _from_chunks(files: Sequence[Path], store: Typestore, connection: Connection,
                 fields: Sequence[str]) -> dict[str, np.ndarray] | None:
    """The quick way; None where the files or messages are not made for it (no index, frame ids that change)."""
    parts: list[dict[str, np.ndarray]] = []
    layout = None
    for file in files:
        summary = summary_of(file)
        if summary is None or summary.statistics is None:
            return None
        channels = [c for c in summary.channels.values()
                    if c.topic == connection.topic and c.message_encoding == "cdr"]
        for channel in channels:
            seen = 0
            for block in blocks(file, summary, channel.id):
                seen += len(block.starts)
                if layout is None:
                    first = block.buffer[block.starts[0] : block.starts[0] + block.sizes[0]].tobytes()
                    layout = Layout(store, connection.msgtype, store.deserialize_cdr(first, connection.msgtype))
                if not (block.sizes == len(layout)).all() or not layout.fits(block.buffer, block.starts):
                    return None
                parts.append({field: layout.column(block.buffer, block.starts, field) for field in fields})
            if seen != summary.statistics.channel_message_counts.get(channel.id, 0):
                return None
    return {field: np.concatenate([part[field] for part in parts]) for field in fields} if parts else None


def _drive(path: Path, name: str, odometry: Mapping[str, np.ndarray], steering: Mapping[str, np.ndarray],
           ) -> tuple[DriveLog, list[str]]:
    notes: list[str] = []
    qx, qy, qz, qw = (odometry[f"pose.pose.orientation.{k}"] for k in "xyzw")
    values = {
        "x": odometry["pose.pose.position.x"], "y": odometry["pose.pose.position.y"],
        "yaw": np.arctan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz)),
        "velocity_x": odometry["twist.twist.linear.x"], "velocity_y": odometry["twist.twist.linear.y"],
        "yaw_rate": odometry["twist.twist.angular.z"],
    }
    good = np.isfinite(np.stack(list(values.values()))).all(axis=0)
    ins_ns, rows = _rising(odometry["header.stamp"], good, "odometry", notes)
    good = np.isfinite(steering["road_wheel_angle"]) & steering["valid"].astype(bool)
    steering_ns, steering_rows = _rising(steering["header.stamp"], good, "steering", notes)
    wheel = steering["steering_wheel_angle"][steering_rows]
    try:
        log = DriveLog(
            name, ins_time_ns=ins_ns, **{k: np.unwrap(v[rows]) if k == "yaw" else v[rows] for k, v in values.items()},
            steering_time_ns=steering_ns, road_wheel_angle=steering["road_wheel_angle"][steering_rows],
            steering_wheel_angle=wheel if np.isfinite(wheel).all() else None,
        )
    except StCoreError as error:
        raise RunError(path, str(error)) from None
    return log, notes


def _rising(time_ns: np.ndarray, good: np.ndarray, what: str, notes: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """(times that rise strictly, their rows); as live, what is not newer than the newest before is refused."""
    rows = np.nonzero(good)[0]
    time = np.asarray(time_ns, np.int64)[rows]
    keep = np.ones(len(time), dtype=bool)
    if len(time) > 1:
        keep[1:] = time[1:] > np.maximum.accumulate(time)[:-1]
    if not good.all():
        notes.append(f"{int((~good).sum())} {what} messages hold no usable value; they were left out")
    if not keep.all():
        notes.append(f"{int((~keep).sum())} {what} messages are not newer than the one before; they were left out")
    return time[keep], rows[keep]
