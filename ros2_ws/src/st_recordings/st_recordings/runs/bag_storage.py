"""Reads topics, messages and definitions from bags of ROS 2 (MCAP, SQLite) and ROS 1 through one interface.

MCAP and SQLite are read without the reader of rosbags, which parses every definition in a bag and fails at the first
unsupported one. Only ROS 1 bags and bags that are compressed according to metadata.yaml are read with it.
"""

import sqlite3
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import yaml
import zstandard
from mcap.reader import NonSeekingReader
from mcap.summary import Summary
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from ..bag_metadata import read_information
from ..mcap_contents import MAGIC
from ..paths import natural_sort_key
from .cdr import READ_ERRORS, CdrLayout, add_definitions, get_field, load_typestore, read_blocks, read_summary
from .errors import RunError, check_readable, convert_errors, format_count

EXTENSIONS, ROS1_EXTENSION = (".mcap", ".db3"), ".bag"
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
DAMAGED = "cannot be read as a bag"
COPY_ADVICE, RECOVERY_ADVICE = "copy it again", "if the recording was interrupted, repair it with `st recover`"
MAX_DELAY_DIFFERENCE_NS = 500_000_000  # largest difference between delays from stamp to reception on a common clock
REINDEX_ADVICE = "if the recording was interrupted, repair it with `rosbag reindex`"


@dataclass(frozen=True)
class Topic:
    name: str
    type_name: str
    count: int

    def is_in(self, names: str) -> bool:
        """Whether a comma-separated list contains the topic's name, with or without a leading slash."""
        return self.name.lstrip("/") in (name.strip().lstrip("/") for name in names.split(","))


class Storage(ABC):
    """One recording, of one or several files.

    path: bag directory or file. topics: those that contain messages. store: message types for `deserialise`.
    """

    def __init__(self, path: Path):
        """A subclass calls this once it can count messages."""
        self.path, self.store = path, load_typestore()
        counts: Counter[tuple[str, str]] = Counter()
        for name, type_name, count in self._count_messages():
            counts[name, type_name] += count
        self.topics = [Topic(*topic, count) for topic, count in counts.items() if count]
        self.by_type = {topic.type_name: topic for topic in reversed(self.topics)}  # type -> its first topic

    @abstractmethod
    def _count_messages(self) -> Iterable[tuple[str, str, int]]:
        """(topic, type, number of messages) of each file and publisher; entries of the same topic are added up."""

    @abstractmethod
    def timed_messages(self, topic: str) -> Iterator[tuple[int, bytes]]:
        """Yields (log time [ns], serialised message) of a topic, in file order for MCAP, else in order of log time."""

    @abstractmethod
    def definitions(self) -> dict[str, tuple[str, str]]:
        """Type -> ("ros2msg" or "ros2idl", text), for the message definitions in the recording."""

    def use_definitions(self, types: Iterable[str]) -> None:
        """Replaces types in `store` by their definitions in the recording."""
        self.store = add_definitions(self.store, self.definitions(), types)

    def messages(self, topic: str) -> Iterator[bytes]:
        """Yields the serialised messages of a topic in the order of `timed_messages`."""
        return (data for _, data in self.timed_messages(topic))

    def deserialise(self, topic: Topic) -> Iterator[tuple[int, Any]]:
        """Yields (log time [ns], message) of a topic. Raises RunError for a damaged message."""
        for log_ns, data in self.timed_messages(topic.name):
            # rosbags passes on exceptions of struct and numpy
            with convert_errors(self.path, f"a message of {topic.name} is damaged", "record it again", Exception):
                message = self.store.deserialize_cdr(data, topic.type_name)
            yield log_ns, message

    def columns(self, fields: Mapping[Topic, Sequence[str]]) -> dict[str, dict[str, np.ndarray]]:
        """Numeric fields (CdrLayout) of all messages, by topic name and field. Omits topics without messages or without
        one of the fields, with messages of different layouts or, in an indexed MCAP file, with several publishers."""
        by_topic = {}
        for topic, names in fields.items():
            rows = [np.frombuffer(data, np.uint8) for data in self.messages(topic.name)]
            collector = _FieldCollector(topic.type_name, names, self.store)
            if rows:
                sizes = np.array([len(row) for row in rows])
                collector.add(np.concatenate(rows), np.cumsum(sizes) - sizes, sizes)
            if collector.is_uniform and collector.parts:
                by_topic[topic.name] = collector.columns()
        return by_topic

    def read_fields(self, topic: Topic, fields: Sequence[str]) -> dict[str, np.ndarray]:
        """Numeric fields of all messages of a topic, even if `columns` omits the topic. Raises RunError."""
        return self.columns({topic: fields}).get(topic.name) or self.read_one_by_one(topic, fields)

    def read_one_by_one(self, topic: Topic, fields: Sequence[str]) -> dict[str, np.ndarray]:
        """The columns of `read_fields`, read by deserialising every message. Raises RunError."""
        with convert_errors(self.path, f"its definition of {topic.type_name} differs from the ROS 2 definition",
                            "use a topic of a type that is defined as in ROS 2", AttributeError):
            rows = [[get_field(message, field) for field in fields] for _, message in self.deserialise(topic)]
        return {field: np.array([row[k] for row in rows]) for k, field in enumerate(fields)}

    def read_log_times(self, topic: str, stamps: np.ndarray) -> np.ndarray:
        """Log times [ns], in simulation time if the bag has /clock; `stamps` if the counts differ. Raises RunError."""
        times = np.array([log_ns for log_ns, _ in self.timed_messages(topic)], np.int64)
        if len(times) != len(stamps):
            return stamps
        clock = next((t for t in self.topics if t.type_name == "rosgraph_msgs/msg/Clock" and t.count > 1), None)
        if clock is None:
            return times
        ticks = [(log_ns, tick.clock.sec * 1_000_000_000 + tick.clock.nanosec) for log_ns, tick in
                 self.deserialise(clock)]
        received, simulated = (np.array(sorted(ticks)) - ticks[0]).T
        return ticks[0][1] + np.round(np.interp(times - ticks[0][0], received, simulated)).astype(np.int64)

    def align_stamps(self, stamps: Sequence[tuple[str, np.ndarray]], compares_clocks: bool = True
                     ) -> tuple[list[np.ndarray], list[str]]:
        """(times of each topic [ns] on one clock, notes). The times are the stamps if they share a clock; the times of
        reception if only these overlap; else the stamps, shifted to the clock of the first topic.

        An INS may stamp with GPS time, 18 s ahead of UTC. Stamps are not changed if neither they nor the times of
        reception overlap, or if the delay from stamp to reception varies, as for computed topics. compares_clocks:
        False assumes that overlapping stamps share a clock.
        """
        series, topics = [times for _, times in stamps], " and ".join(topic for topic, _ in stamps)
        is_common = _overlap(series)
        if is_common and not compares_clocks:
            return series, []
        log_times = [self.read_log_times(topic, times) for topic, times in stamps]
        if not is_common and _overlap(log_times):
            return log_times, [f"the stamps of {topics} do not overlap in time; the times of reception are used"]
        delays = [received - stamped for received, stamped in zip(log_times, series, strict=True)]
        shifts = [int(np.median(delay)) for delay in delays]
        delays_vary = any(np.ptp(np.percentile(delay, (5, 95))) > MAX_DELAY_DIFFERENCE_NS for delay in delays)
        if not is_common or delays_vary or max(shifts) - min(shifts) <= MAX_DELAY_DIFFERENCE_NS:
            return series, []
        ahead, behind = (stamps[shifts.index(shift)][0] for shift in (min(shifts), max(shifts)))
        return [times + shift - shifts[0] for times, shift in zip(series, shifts, strict=True)], [
            f"compared with the times of reception, the clock of {ahead} is {(max(shifts) - min(shifts)) * 1e-9:.3f} s "
            f"ahead of that of {behind}; all stamps were moved to the clock of {stamps[0][0]}"]


def _overlap(series: Sequence[np.ndarray]) -> bool:
    """Whether the time spans of all series overlap; times of 0 are ignored."""
    valid = [times[times != 0] for times in series]
    return all(map(len, valid)) and bool(max(times.min() for times in valid) <= min(times.max() for times in valid))


def open_bag(path: Path, files: Sequence[Path] = ()) -> Storage:
    """Opens a bag directory or a single storage file. Raises RunError for a file that is missing, not a bag, not
    closed or damaged. files: the parts of a split recording in order, if there are two or more."""
    if len(files) < 2:
        files = list_bag_files(path) if path.is_dir() else [path]
    for file in files:
        check_readable(file)
    if path.suffix.lower() == ROS1_EXTENSION or (path.is_dir() and read_information(path).get("compression_mode")):
        return RosbagsStorage(path)
    suffixes = {f.suffix.lower() for f in files}
    if suffixes == {".mcap"}:
        return McapStorage(path, files)
    if suffixes == {".db3"}:
        return SqliteStorage(path, files)
    if suffixes == {*EXTENSIONS}:
        raise RunError(path, "this folder has storage files in two formats (.mcap, .db3)",
                       "move those of one format into another folder")
    problem = "this is not a bag" if path.is_file() else "this folder contains no storage file of a bag (.mcap, .db3)"
    raise RunError(path, problem, "give the folder that `ros2 bag record` or the recorder wrote")


def list_bag_files(directory: Path) -> list[Path]:
    """Storage files of a bag directory, in order of their first messages, or by number if one has no known time."""
    files = sorted((f for f in directory.iterdir() if f.suffix.lower() in EXTENSIONS), key=natural_sort_key)
    spans = {f: read_time_span(f) for f in files} if len(files) > 1 else {}
    return sorted(files, key=lambda f: spans[f] or (0, 0)) if spans and all(spans.values()) else files


def describe_missing_files(path: Path) -> list[str]:
    """A note on missing files: those listed in metadata.yaml or, for one file of a numbered recording, earlier ones."""
    listed_paths = read_information(path).get("relative_file_paths")
    listed_names = [Path(str(file)).name for file in listed_paths] if isinstance(listed_paths, list) else []
    missing_names = [name for name in listed_names if not (path / name).is_file()]
    if missing_names:
        count = format_count(len(missing_names), len(listed_names), "files")
        return [f"{count} listed in metadata.yaml are missing: {', '.join(missing_names)[:200]}"]
    return [note] if path.is_file() and (note := _describe_missing_before(path)) else []


def _describe_missing_before(file: Path) -> str:
    """A note on files missing before this one (drive_1 before drive_2); empty if the gap in time contradicts that."""
    stem, _, number = file.stem.rpartition("_")
    files = {int(end): other for other in file.parent.iterdir() if other.suffix == file.suffix
               and other.stem.rpartition("_")[0] == stem and (end := other.stem.rpartition("_")[2]).isdecimal()}
    previous_number = max((k for k in files if number.isdecimal() and k < int(number)), default=None)
    if previous_number is None or (count := int(number) - previous_number - 1) == 0:
        return ""
    previous_span, own_span = read_time_span(files[previous_number]), read_time_span(file)
    if previous_span is None or own_span is None:
        return ""
    lengths = [previous_span[1] - previous_span[0], own_span[1] - own_span[0]]
    if not 0.5 * count * min(lengths) < own_span[0] - previous_span[1] < 2 * count * max(lengths):
        return ""
    return (f"{count} file{'s' if count > 1 else ''} between {files[previous_number].name} and this one "
            f"{'are' if count > 1 else 'is'} missing, so these two are read as separate runs")


def read_time_span(file: Path) -> tuple[int, int] | None:
    """First and last log time [ns since 1970] in a storage file; None if it is empty or cannot be read."""
    try:
        if file.suffix.lower() == ".db3":
            ((first, last),) = _query(file, "SELECT MIN(timestamp), MAX(timestamp) FROM messages")
            return None if first is None else (first, last)
        summary = read_summary(file)
        if summary is not None and summary.statistics is not None:
            return summary.statistics.message_start_time, summary.statistics.message_end_time
        times = [message.log_time for _, _, message in _stream(file)]
        return (min(times), max(times)) if times else None
    except (RunError, OSError):
        return None


def _stream(file: Path) -> Iterator[Any]:
    """Yields (schema, channel, message) of an MCAP file one by one, even if it has no index. Raises RunError."""
    with convert_errors(file, DAMAGED, RECOVERY_ADVICE, *READ_ERRORS), file.open("rb") as stream:
        yield from NonSeekingReader(stream).iter_messages(log_time_order=False)


def _query(file: Path, text: str, *values: Any) -> Iterator[tuple[Any, ...]]:
    """Yields the rows that a query of an SQLite file returns. Raises RunError."""
    uri = f"{file.absolute().as_uri()}?mode=ro"
    with convert_errors(file, DAMAGED, COPY_ADVICE, sqlite3.Error), closing(sqlite3.connect(uri, uri=True)) as data:
        yield from data.execute(text, values)


class McapStorage(Storage):
    def __init__(self, path: Path, files: Sequence[Path]):
        self._files: list[tuple[Path, Summary | None]] = []
        encodings: set[str] = set()
        for file in files:
            with file.open("rb") as stream:
                head = stream.read(8)
                stream.seek(-min(8, file.stat().st_size), 2)
                tail = stream.read(8)
            if head != MAGIC:
                raise RunError(file, "cannot be read as a bag (not MCAP)", "correct its extension")
            summary = read_summary(file)
            if summary is None and tail != MAGIC:
                raise RunError(file, "cannot be read as a bag (it was not closed)", RECOVERY_ADVICE)
            self._files.append((file, summary))
            channels = summary.channels.values() if summary else [c for _, c, _ in islice(_stream(file), 1000)]
            encodings |= {channel.message_encoding for channel in channels}
        if encodings and "cdr" not in encodings:
            raise RunError(self._files[0][0], f"its messages are encoded as {', '.join(sorted(map(str, encodings)))}, "
                           "but only CDR, the encoding of ROS 2, can be read",
                           "give the .bag of ROS 1 from which it was converted" if "ros1" in encodings else
                           "export its topics as .csv, for example with PlotJuggler")
        super().__init__(path)

    def definitions(self) -> dict[str, tuple[str, str]]:
        return {s.name: (s.encoding, s.data.decode("utf-8", "replace")) for file, summary in self._files for s in (
            summary.schemas.values() if summary else (s for s, _, _ in islice(_stream(file), 1000) if s))}

    def _count_messages(self) -> Iterator[tuple[str, str, int]]:
        for file, summary in self._files:
            if summary is None:
                yield from ((c.topic, schema.name if schema else "", 1) for schema, c, _ in _stream(file))
                continue
            assert summary.statistics is not None  # ensured by read_summary
            for channel in summary.channels.values():
                schema = summary.schemas.get(channel.schema_id)
                count = summary.statistics.channel_message_counts.get(channel.id, 0)
                yield channel.topic, schema.name if schema else "", count

    def timed_messages(self, topic: str) -> Iterator[tuple[int, bytes]]:
        for file, summary in self._files:
            channels = [n for n, c in summary.channels.items() if c.topic == topic] if summary else []
            if summary is None or len(channels) > 1:  # each publisher has a channel, and their messages are interleaved
                yield from ((message.log_time, message.data) for _, channel, message in _stream(file)
                            if channel.topic == topic)
                continue
            with convert_errors(file, DAMAGED, RECOVERY_ADVICE, *READ_ERRORS):
                for _, block in read_blocks(file, summary, channels):
                    rows = zip(block.log_time_ns.tolist(), block.starts.tolist(), block.sizes.tolist(), strict=True)
                    yield from ((ns, block.buffer[start : start + size].tobytes()) for ns, start, size in rows)

    def columns(self, fields: Mapping[Topic, Sequence[str]]) -> dict[str, dict[str, np.ndarray]]:
        if any(summary is None for _, summary in self._files):
            return super().columns(fields)
        by_topic = {topic.name: _FieldCollector(topic.type_name, names, self.store) for topic, names in fields.items()}
        for file, summary in self._files:
            assert summary is not None and summary.statistics is not None  # ensured by read_summary
            channels = {number: by_topic[channel.topic] for number, channel in summary.channels.items()
                        if channel.topic in by_topic and channel.message_encoding == "cdr"}
            remaining = {number: summary.statistics.channel_message_counts.get(number, 0) for number in channels}
            publishers = Counter(summary.channels[number].topic for number, count in remaining.items() if count)
            for topic, count in publishers.items():
                by_topic[topic].is_uniform &= count == 1  # blocks of several publishers are not in order
            with convert_errors(file, DAMAGED, RECOVERY_ADVICE, *READ_ERRORS):
                for number, block in read_blocks(file, summary, channels):
                    remaining[number] -= len(block.starts)
                    channels[number].add(block.buffer, block.starts, block.sizes)
            for number, count in remaining.items():
                channels[number].is_uniform &= count == 0
        return {name: fields.columns() for name, fields in by_topic.items() if fields.is_uniform and fields.parts}


class SqliteStorage(Storage):
    def __init__(self, path: Path, files: Sequence[Path]):
        self._files = files
        super().__init__(path)

    def _count_messages(self) -> Iterable[Any]:
        text = ("SELECT topics.name, topics.type, COUNT(*) FROM topics "
                "JOIN messages ON messages.topic_id = topics.id GROUP BY topics.id")
        return (row for file in self._files for row in _query(file, text))

    def timed_messages(self, topic: str) -> Iterator[tuple[int, bytes]]:
        text = ("SELECT messages.timestamp, messages.data FROM messages JOIN topics ON messages.topic_id = topics.id "
                "WHERE topics.name = ? ORDER BY messages.timestamp")
        for file in self._files:
            for log_ns, data in _query(file, text, topic):
                message = data
                if data[:4] == ZSTD_MAGIC:  # metadata.yaml, which states the compression, may be missing
                    with suppress(zstandard.ZstdError):  # the reader of the message reports the damage
                        message = zstandard.decompress(data)
                yield log_ns, message

    def definitions(self) -> dict[str, tuple[str, str]]:
        definitions: dict[str, tuple[str, str]] = {}
        for file in self._files:
            if any(_query(file, "SELECT name FROM sqlite_master WHERE name = 'message_definitions'")):
                rows = _query(file, "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions")
                definitions |= {str(name): (str(encoding), str(text)) for name, encoding, text in rows}
        return definitions


class RosbagsStorage(Storage):
    """A bag of ROS 2 with compressed files or messages, or of ROS 1 with messages converted to those of ROS 2."""

    def __init__(self, path: Path):
        is_ros1 = path.suffix.lower() == ROS1_EXTENSION
        with convert_errors(path, DAMAGED, REINDEX_ADVICE if is_ros1 else COPY_ADVICE, Exception):  # any, of rosbags
            self._reader = AnyReader([path], default_typestore=load_typestore())
            self._reader.open()
        super().__init__(path)
        if is_ros1:
            recorded_types = {name: fields for name, fields in self._reader.typestore.fielddefs.items()
                              if name not in ("std_msgs/msg/Header", "builtin_interfaces/msg/Time")}  # differ in ROS 2
            self.store = get_typestore(Stores.EMPTY)
            self.store.register({**load_typestore().fielddefs, **recorded_types})

    def _count_messages(self) -> Iterable[tuple[str, str, int]]:
        return ((c.topic, c.msgtype, c.msgcount) for c in self._reader.connections)

    def timed_messages(self, topic: str) -> Iterator[tuple[int, bytes]]:
        connections = [c for c in self._reader.connections if c.topic == topic]
        with convert_errors(self.path, DAMAGED, COPY_ADVICE, Exception):  # rosbags raises any type
            for connection, log_ns, data in self._reader.messages(connections=connections):
                yield log_ns, bytes(data if self._reader.is2 else self.store.ros1_to_cdr(data, connection.msgtype))

    def definitions(self) -> dict[str, tuple[str, str]]:
        if not self._reader.is2:
            return {}
        formats = {1: "ros2msg", 2: "ros2idl"}  # rosbags.interfaces.MessageDefinitionFormat
        return {c.msgtype: (formats.get(c.msgdef.format.value, ""), c.msgdef.data) for c in self._reader.connections}


class _FieldCollector:
    """Collects fields of the messages of one topic. is_uniform: whether these can be read together as columns."""

    def __init__(self, type_name: str, fields: Sequence[str], store: Typestore):
        self._type_name, self._fields, self._store = type_name, fields, store
        self._layout: CdrLayout | None = None
        self.is_uniform, self.parts = True, list[dict[str, np.ndarray]]()

    def add(self, buffer: np.ndarray, starts: np.ndarray, sizes: np.ndarray) -> None:
        """Adds messages that begin at `starts` and are `sizes` bytes long."""
        if not self.is_uniform or not len(starts):
            return
        if self._layout is None:
            first_message = buffer[starts[0] : starts[0] + sizes[0]].tobytes()
            try:
                example = self._store.deserialize_cdr(first_message, self._type_name)
                self._layout = CdrLayout(self._store, self._type_name, example)
            except Exception:  # rosbags raises any type; reading the messages one by one reports it
                self.is_uniform = False
                return
        layout = self._layout
        self.is_uniform = layout.fields.keys() >= {*self._fields} and layout.fits(buffer, starts, sizes)
        if self.is_uniform:
            self.parts.append({field: layout.column(buffer, starts, field) for field in self._fields})

    def columns(self) -> dict[str, np.ndarray]:
        return {field: np.concatenate([part[field] for part in self.parts]) for field in self._fields}


def parse_parameters(records: Mapping[str, Mapping[str, str]]) -> dict[str, dict[str, Any]]:
    """Node -> parameters, from the metadata records of a recording; empty if they contain none."""
    try:
        document = yaml.safe_load(records.get("configuration", {}).get("parameters.yaml", "")) or {}
        return {node: dict(section["ros__parameters"]) for node, section in document.items()}
    except (yaml.YAMLError, AttributeError, KeyError, TypeError):
        return {}


def find_file_text(records: Mapping[str, Mapping[str, str]], file: str) -> str | None:
    """Text of the recorded configuration file with this path; None if the recording does not contain it."""
    parts = Path("/", file).parts
    # In the records, the key of a file is the shortest unique trailing part of its path.
    return next((text for key, text in records.get("configuration", {}).items()
                 if file and parts[-len(Path(key).parts):] == Path(key).parts), None)
