"""Reads and writes metadata.yaml of rosbag2 (version 9, as in ROS 2 Jazzy), and finds definitions of message types."""

import json
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from .paths import replace_file

FILE_NAME = "metadata.yaml"
INFINITE_NS = 2**63 - 1  # ns; means that a duration is not set, or that a bag or file is empty and has no start
MAX_CUSTOM_DATA_LENGTH = 200  # characters; longer texts stay in the MCAP metadata records only
TYPE_SEPARATOR = "=" * 80  # between the types of a `ros2msg` definition
PRIMITIVE_TYPES = {"bool", "byte", "char", "float32", "float64", "string", "wstring", "int8", "uint8", "int16",
                   "uint16", "int32", "uint32", "int64", "uint64"}
_FIELD = re.compile(r"^\s*([A-Za-z][\w/]*)(?:<=\d+)?(?:\[[^\]]*\])?\s+[A-Za-z]\w*")


class UnknownTypeError(LookupError):
    """The definition of a message type, or its hash, is not installed."""


Qos = dict[str, Any]
"""Quality of service that a publisher offers, as rosbag2 stores it."""


def make_qos(reliability: str = "reliable", durability: str = "volatile", history: str = "keep_last", depth: int = 50,
             deadline_ns: int = INFINITE_NS, lifespan_ns: int = INFINITE_NS, liveliness: str = "automatic",
             liveliness_lease_ns: int = INFINITE_NS) -> Qos:
    """Quality of service as rosbag2 stores it. INFINITE_NS: the duration is not set."""
    return {"history": history, "depth": depth, "reliability": reliability, "durability": durability,
            "deadline": _format_duration(deadline_ns), "lifespan": _format_duration(lifespan_ns),
            "liveliness": liveliness, "liveliness_lease_duration": _format_duration(liveliness_lease_ns),
            "avoid_ros_namespace_conventions": False}


def _format_duration(nanoseconds: int) -> dict[str, int]:
    seconds, remainder = divmod(min(nanoseconds, INFINITE_NS), 1_000_000_000)
    return {"sec": seconds, "nsec": remainder}


def format_qos(qos: list[Qos]) -> str:
    """Formats QoS entries as the YAML text that rosbag2 stores in the metadata of an MCAP channel."""
    return yaml.safe_dump(qos, sort_keys=False).strip() if qos else ""


@dataclass
class BagTopic:
    """One topic of a bag. qos: of its publishers. count: number of its messages."""

    name: str
    type_name: str
    type_hash: str
    qos: list[Qos]
    count: int = 0


@dataclass
class BagFile:
    """One storage file. start_ns, end_ns: first and last log time [ns since 1970], both 0 if count is 0."""

    name: str
    count: int = 0
    start_ns: int = 0
    end_ns: int = 0


@dataclass
class BagInformation:
    """Content of metadata.yaml."""

    files: Sequence[BagFile]
    topics: list[BagTopic]
    custom: Mapping[str, str] = field(default_factory=dict)

    def to_document(self) -> dict[str, Any]:
        nonempty_files = [f for f in self.files if f.count]
        start = min((f.start_ns for f in nonempty_files), default=INFINITE_NS)
        end = max((f.end_ns for f in nonempty_files), default=INFINITE_NS)
        return {"rosbag2_bagfile_information": {
            "version": 9, "storage_identifier": "mcap", "duration": {"nanoseconds": end - start},
            "starting_time": {"nanoseconds_since_epoch": start}, "message_count": sum(f.count for f in self.files),
            "topics_with_message_count": [
                {"topic_metadata": {"name": t.name, "type": t.type_name, "serialization_format": "cdr",
                                    "offered_qos_profiles": t.qos, "type_description_hash": t.type_hash},
                 "message_count": t.count} for t in self.topics],
            "compression_format": "", "compression_mode": "", "relative_file_paths": [f.name for f in self.files],
            "files": [
                {"path": f.name, "starting_time": {"nanoseconds_since_epoch": f.start_ns if f.count else INFINITE_NS},
                 "duration": {"nanoseconds": f.end_ns - f.start_ns}, "message_count": f.count} for f in self.files],
            "custom_data": dict(self.custom) or None, "ros_distro": "jazzy"}}

    def to_yaml(self) -> str:
        # JSON makes copies of shared QoS entries, for which YAML would write anchors, unlike rosbag2.
        return yaml.safe_dump(json.loads(json.dumps(self.to_document())), sort_keys=False)

    def save(self, directory: Path) -> None:
        """Replaces the metadata.yaml of a directory. Raises OSError."""
        replace_file(directory / FILE_NAME, self.to_yaml())


def read_information(directory: Path) -> dict[str, Any]:
    """Content of metadata.yaml in a bag directory; empty if the file is missing, unreadable or invalid."""
    try:
        content = yaml.safe_load((directory / FILE_NAME).read_text(encoding="utf-8"))["rosbag2_bagfile_information"]
    except (OSError, UnicodeDecodeError, yaml.YAMLError, KeyError, TypeError):
        return {}
    return content if isinstance(content, dict) else {}


def collect_custom_data(records: Mapping[str, Mapping[str, str]]) -> dict[str, str]:
    """Entry `custom_data` of metadata.yaml, "record.key" -> text: short one-line texts of all records but rosbag2."""
    return {f"{name}.{key}": text for name, entries in records.items() if name != "rosbag2"
            for key, text in entries.items() if len(text) <= MAX_CUSTOM_DATA_LENGTH and "\n" not in text}


def _find_interface_file(type_name: str, suffix: str) -> Path:
    package, _, name = type_name.replace("/msg/", "/").partition("/")
    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        path = Path(prefix, "share", package, "msg", name + suffix)
        if prefix and path.is_file():
            return path
    missing = f"share/{package}/msg/{name}{suffix}"
    raise UnknownTypeError(f"message type {type_name} is not installed: no {missing} in AMENT_PREFIX_PATH")


@cache
def read_definition(type_name: str) -> str:
    """The `ros2msg` text of a type ("pkg/msg/Type") and of all types that it uses. Raises UnknownTypeError."""
    texts: dict[str, str] = {}
    pending = [type_name]
    while pending:
        name = pending.pop(0)
        if name in texts:
            continue
        texts[name] = _find_interface_file(name, ".msg").read_text().rstrip("\n") + "\n"
        for line in texts[name].splitlines():
            match = _FIELD.match(line.split("#", 1)[0])
            if match is None or (field_type := match.group(1)) in PRIMITIVE_TYPES:
                continue
            if "/" not in field_type:
                field_type = f"{'std_msgs' if field_type == 'Header' else name.partition('/')[0]}/{field_type}"
            pending.append(field_type.replace("/msg/", "/"))
    return "".join(text if name == type_name else f"{TYPE_SEPARATOR}\nMSG: {name}\n{text}"
                   for name, text in texts.items())


@cache
def read_type_hash(type_name: str) -> str:
    """Reads the hash (RIHS01_...) of an installed message type. Raises UnknownTypeError."""
    for entry in json.loads(_find_interface_file(type_name, ".json").read_text())["type_hashes"]:
        if entry["type_name"] == type_name:
            return str(entry["hash_string"])
    raise UnknownTypeError(f"message type {type_name}: its description file has no hash")
