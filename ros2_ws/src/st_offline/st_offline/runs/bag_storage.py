"""The storages of rosbag2 behind one small interface: which topics there are, and the bytes of one of them.

MCAP and sqlite3 are read here, because a library that looks at every definition in a bag stops at the first foreign
one it does not understand; what else rosbag2 can write (compressed files and messages) goes through rosbags.
"""

import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import yaml
from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader
from mcap.summary import Summary
from rosbags.highlevel import AnyReader, AnyReaderError
from rosbags.rosbag2 import ReaderError
from rosbags.typesys.store import Typestore

from .cdr import Layout
from .errors import RunError
from .mcap_columns import DAMAGE, Block, blocks, summary_of

MCAP_MAGIC = b"\x89MCAP0\r\n"
NOT_CLOSED = "if it was cut off while recording, repair it with `st recover`"


@dataclass(frozen=True)
class Topic:
    name: str
    type_name: str
    count: int


class Storage(Protocol):
    """One recording, of one or several files."""

    def topics(self) -> list[Topic]: ...

    def messages(self, topic: str) -> Iterator[bytes]:
        """Serialised messages, in the order of the file."""

    def columns(self, topic: Topic, fields: Sequence[str], store: Typestore) -> dict[str, np.ndarray] | None:
        """The quick way to some numbers of all messages (cdr.Layout), None where it cannot be gone."""


def open_storage(path: Path, files: Sequence[Path], store: Typestore) -> Storage:
    """Raises RunError for what is none, or was not closed."""
    if path.is_dir() and _is_compressed(path):
        return Rosbags(path, store)
    suffixes = {f.suffix.lower() for f in files}
    if suffixes == {".mcap"}:
        return Mcap(files)
    if suffixes == {".db3"}:
        return Sqlite(files)
    raise RunError(path, "no storage file (.mcap, .db3) is in this bag, or several kinds are",
                   "give the folder that ros2 bag or the recorder made")


def _is_compressed(path: Path) -> bool:
    try:
        about = yaml.safe_load((path / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
        return bool(about.get("compression_mode"))
    except (OSError, yaml.YAMLError, KeyError, TypeError, AttributeError):
        return False


class Mcap:
    def __init__(self, files: Sequence[Path]):
        self._files: list[tuple[Path, Summary | None]] = []
        for file in files:
            with file.open("rb") as stream:
                head = stream.read(8)
                stream.seek(-min(8, file.stat().st_size), 2)
                tail = stream.read(8)
            if head != MCAP_MAGIC:
                raise RunError(file, "cannot be read as a bag (not MCAP)", "give it the extension of what it is")
            summary = summary_of(file)
            if summary is None and tail != MCAP_MAGIC:
                raise RunError(file, "cannot be read as a bag (it was not closed)", NOT_CLOSED)
            self._files.append((file, summary))

    def topics(self) -> list[Topic]:
        counts: dict[tuple[str, str], int] = {}
        for file, summary in self._files:
            if summary is not None and summary.statistics is not None:
                for channel in summary.channels.values():
                    schema = summary.schemas.get(channel.schema_id)
                    key = channel.topic, schema.name if schema else ""
                    counts[key] = counts.get(key, 0) + summary.statistics.channel_message_counts.get(channel.id, 0)
            else:
                for schema, channel, _ in self._stream(file):
                    key = channel.topic, schema.name if schema else ""
                    counts[key] = counts.get(key, 0) + 1
        return [Topic(name, type_name, count) for (name, type_name), count in counts.items()]

    def messages(self, topic: str) -> Iterator[bytes]:
        for file, summary in self._files:
            if summary is None or summary.statistics is None:
                yield from (message.data for _, channel, message in self._stream(file) if channel.topic == topic)
                continue
            channels = [number for number, channel in summary.channels.items() if channel.topic == topic]
            for block in chain.from_iterable(self._blocks(file, summary, number) for number in channels):
                for start, size in zip(block.starts.tolist(), block.sizes.tolist(), strict=True):
                    yield block.buffer[start : start + size].tobytes()

    @staticmethod
    def _blocks(file: Path, summary: Summary, channel: int) -> Iterator[Block]:
        try:
            yield from blocks(file, summary, channel)
        except DAMAGE as error:
            raise RunError(file, f"cannot be read as a bag ({_short(error)})", NOT_CLOSED) from None

    @staticmethod
    def _stream(file: Path) -> Iterator[Any]:
        try:
            with file.open("rb") as stream:
                yield from NonSeekingReader(stream).iter_messages(log_time_order=False)
        except (McapError, *DAMAGE) as error:
            raise RunError(file, f"cannot be read as a bag ({_short(error)})", NOT_CLOSED) from None

    def columns(self, topic: Topic, fields: Sequence[str], store: Typestore) -> dict[str, np.ndarray] | None:
        parts: list[dict[str, np.ndarray]] = []
        layout = None
        for file, summary in self._files:
            if summary is None or summary.statistics is None:
                return None
            for channel in summary.channels.values():
                if channel.topic != topic.name or channel.message_encoding != "cdr":
                    continue
                seen = 0
                for block in self._blocks(file, summary, channel.id):
                    seen += len(block.starts)
                    if layout is None:
                        first = block.buffer[block.starts[0] : block.starts[0] + block.sizes[0]].tobytes()
                        layout = Layout(store, topic.type_name, store.deserialize_cdr(first, topic.type_name))
                    if not (block.sizes == len(layout)).all() or not layout.fits(block.buffer, block.starts):
                        return None
                    parts.append({field: layout.column(block.buffer, block.starts, field) for field in fields})
                if seen != summary.statistics.channel_message_counts.get(channel.id, 0):
                    return None
        return {field: np.concatenate([part[field] for part in parts]) for field in fields} if parts else None


class Sqlite:
    def __init__(self, files: Sequence[Path]):
        self._files = list(files)
        self.topics()

    def _query(self, file: Path, text: str, *values: Any) -> Iterator[tuple[Any, ...]]:
        try:
            with closing(sqlite3.connect(f"file:{file}?mode=ro", uri=True)) as database:
                yield from database.execute(text, values)
        except sqlite3.Error as error:
            raise RunError(file, f"cannot be read as a bag ({_short(error)})", "copy it again") from None

    def topics(self) -> list[Topic]:
        counts: dict[tuple[str, str], int] = {}
        for file in self._files:
            text = ("SELECT topics.name, topics.type, COUNT(messages.id) FROM topics "
                    "LEFT JOIN messages ON messages.topic_id = topics.id GROUP BY topics.id")
            for name, type_name, count in self._query(file, text):
                counts[name, type_name] = counts.get((name, type_name), 0) + count
        return [Topic(name, type_name, count) for (name, type_name), count in counts.items()]

    def messages(self, topic: str) -> Iterator[bytes]:
        text = ("SELECT messages.data FROM messages JOIN topics ON messages.topic_id = topics.id "
                "WHERE topics.name = ? ORDER BY messages.timestamp")
        for file in self._files:
            for (data,) in self._query(file, text, topic):
                yield data

    def columns(self, topic: Topic, fields: Sequence[str], store: Typestore) -> dict[str, np.ndarray] | None:
        rows = [np.frombuffer(data, np.uint8) for data in self.messages(topic.name)]
        if not rows:
            return None
        layout = Layout(store, topic.type_name, store.deserialize_cdr(rows[0].tobytes(), topic.type_name))
        if any(len(row) != len(layout) for row in rows):
            return None
        buffer = np.concatenate(rows)
        starts = np.arange(len(rows)) * len(layout)
        if not layout.fits(buffer, starts):
            return None
        return {field: layout.column(buffer, starts, field) for field in fields}


class Rosbags:
    def __init__(self, path: Path, store: Typestore):
        self._path = path
        try:
            self._reader = AnyReader([path], default_typestore=store)
            self._reader.open()
        except (AnyReaderError, ReaderError, OSError, KeyError) as error:
            raise RunError(path, f"cannot be read as a bag ({_short(error)})", NOT_CLOSED) from None

    def topics(self) -> list[Topic]:
        return [Topic(c.topic, c.msgtype, c.msgcount) for c in self._reader.connections]

    def messages(self, topic: str) -> Iterator[bytes]:
        chosen = [c for c in self._reader.connections if c.topic == topic]
        return (bytes(data) for _, _, data in self._reader.messages(connections=chosen))

    def columns(self, topic: Topic, fields: Sequence[str], store: Typestore) -> None:
        return None


def _short(error: Exception) -> str:
    return (" ".join(str(error).split()) or type(error).__name__)[:120]
