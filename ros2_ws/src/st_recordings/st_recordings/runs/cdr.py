"""Converts ROS messages between columns of numbers and serialised bytes (CDR), and reads messages of an MCAP file.

Messages of one type have the same byte layout if their strings and the lengths of their sequences are equal. The offset
of each number then follows from the definition and one example, so no Python object per message is needed.
"""

import os
import struct
from collections.abc import Collection, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from io import BytesIO
from itertools import zip_longest
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Chunk, ChunkIndex
from mcap.stream_reader import CRCValidationError, get_chunk_data_stream
from mcap.summary import Summary
from numpy.lib.stride_tricks import sliding_window_view
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from ..paths import project_root
from .ins_log import SPEEDS

ODOMETRY, STEERING = "nav_msgs/msg/Odometry", "st_msgs/msg/Steering"
NCOM, WHEEL_SPEEDS, CAN_FRAMES = "st_msgs/msg/Ncom", "st_msgs/msg/WheelSpeeds", "st_msgs/msg/CanFrames"
INS_ON_CAN, INS_STATUS = "st_msgs/msg/InsOnCan", "st_msgs/msg/InsStatus"
CAN_MSGS_FRAME = "can_msgs/msg/Frame"  # recorded by other bridges; an SQLite bag may lack its definition
_CAN_FRAME_DEFINITION = """std_msgs/Header header
uint32 id
bool is_rtr
bool is_extended
bool is_error
uint8 dlc
uint8[8] data
"""
# Signal of the signal table -> field of st_msgs/WheelSpeeds.
WHEEL_FIELDS = {name: name.removeprefix("wheel_speed_") for name in SPEEDS}
READ_ERRORS = (ValueError, struct.error, zstandard.ZstdError, RuntimeError, OSError, OverflowError, MemoryError,
               McapError)
"""Exceptions that are raised while reading an MCAP file that is damaged or contradicts its index."""
_DTYPES = {"float64": "<f8", "float32": "<f4", "int64": "<i8", "uint64": "<u8", "int32": "<i4", "uint32": "<u4",
           "int16": "<i2", "uint16": "<u2", "int8": "i1", "uint8": "u1", "byte": "u1", "char": "u1", "bool": "?"}
_ENCAPSULATION_LENGTH = 4  # bytes before the body; alignment is relative to the body
_RECORD_HEAD_LENGTH = 9  # bytes of an MCAP record: opcode, length
_MESSAGE_HEAD_LENGTH = _RECORD_HEAD_LENGTH + 22  # channel, sequence, log time, publish time


@cache
def load_typestore() -> Typestore:
    """Loads the message types of ROS 2 Jazzy, can_msgs/Frame, and the suite's own messages, st_msgs."""
    store = get_typestore(Stores.ROS2_JAZZY)
    types: dict[str, Any] = dict(get_types_from_msg(_CAN_FRAME_DEFINITION, CAN_MSGS_FRAME))
    for file in sorted((project_root() / "ros2_ws/src/st_msgs/msg").glob("*.msg")):
        types.update(get_types_from_msg(file.read_text(), f"st_msgs/msg/{file.stem}"))
    store.register(types)
    return store


def add_definitions(store: Typestore, definitions: Mapping[str, tuple[str, str]], types: Iterable[str]) -> Typestore:
    """A type store in which these types have their recorded definitions; the given store if none differs, or if the
    definitions contradict each other.

    definitions: from bag_storage.Storage.definitions; a definition that cannot be parsed is ignored.
    """
    recorded_types: dict[str, Any] = {}
    for name in types:
        encoding, text = definitions.get(name, ("", ""))
        try:
            if text:
                recorded_types |= get_types_from_idl(text) if encoding == "ros2idl" else get_types_from_msg(text, name)
        except Exception:  # any, from the parser of rosbags
            continue
    if all(name in store.fielddefs and _normalise(store.fielddefs[name][1]) == _normalise(fields)
           for name, (_, fields) in recorded_types.items()):
        return store
    merged_store = get_typestore(Stores.EMPTY)
    try:
        merged_store.register({**store.fielddefs, **recorded_types})
    except Exception:  # any, from rosbags: the definitions contradict each other
        return store
    return merged_store


def _normalise(fields: Any) -> list[tuple[str, Any]]:
    return [(field[0].lower(), field[1]) for field in fields]


@dataclass(frozen=True)
class Field:
    """One number, or `count` consecutive numbers, of a numpy dtype at byte `offset` of the serialised message."""

    offset: int
    dtype: str
    count: int = 1

    @property
    def width(self) -> int:
        return int(np.dtype(self.dtype).itemsize) * self.count


class CdrLayout:
    """Byte layout of the messages of one type that have the strings and sequence lengths of an example.

    template: the serialised example. fields: path, such as "pose.pose.position.x" -> Field. A time is
    one field of two numbers, sec and nanosec; if its path ends with "stamp", its column contains nanoseconds instead.
    """

    def __init__(self, store: Typestore, type_name: str, example: Any):
        """Raises KeyError for a type with wide strings, ValueError for one that rosbags serialises differently."""
        self._store = store
        self.template = np.frombuffer(bytes(store.serialize_cdr(example, type_name)), np.uint8)
        self.fields: dict[str, Field] = {}
        end = self._add_fields(type_name, example, "", 0) + _ENCAPSULATION_LENGTH
        if not end <= len(self.template) < end + 4:
            raise ValueError(f"{type_name}: the layout has {end} bytes, but the message {len(self.template)}")
        self._is_fixed = np.ones(len(self.template), dtype=bool)
        self._is_fixed[:_ENCAPSULATION_LENGTH] = self._is_fixed[end:] = False
        for field in self.fields.values():
            self._is_fixed[field.offset : field.offset + field.width] = False

    def _add_fields(self, type_name: str, value: Any, path: str, offset: int) -> int:
        """Adds the fields of a (nested) message, given its offset in the body; returns the offset of its end."""
        if type_name in ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration"):
            offset = _align(offset, 4)
            self.fields[path] = Field(offset + _ENCAPSULATION_LENGTH, "<i4", 2)
            return offset + 8
        prefix = f"{path}." if path else ""
        for name, (node, detail) in self._store.fielddefs[type_name][1]:
            offset = self._add_member(node, detail, getattr(value, name), prefix + name, offset)
        return offset

    def _add_member(self, node: int, detail: Any, value: Any, path: str, offset: int) -> int:
        if node == Nodetype.NAME:
            return self._add_fields(detail, value, path, offset)
        if node == Nodetype.BASE:
            if detail[0] == "string":
                return _align(offset, 4) + 4 + len(value.encode()) + 1
            return self._add_numbers(_DTYPES[detail[0]], 1, path, offset)
        (inner, inner_detail), _ = detail
        if node == Nodetype.SEQUENCE:
            offset = _align(offset, 4) + 4
        if inner == Nodetype.BASE and inner_detail[0] != "string":
            return self._add_numbers(_DTYPES[inner_detail[0]], len(value), path, offset) if len(value) else offset
        for index, element in enumerate(value):
            offset = self._add_member(inner, inner_detail, element, f"{path}.{index}", offset)
        return offset

    def _add_numbers(self, dtype: str, count: int, path: str, offset: int) -> int:
        field = Field(_align(offset, np.dtype(dtype).itemsize) + _ENCAPSULATION_LENGTH, dtype, count)
        self.fields[path] = field
        return field.offset - _ENCAPSULATION_LENGTH + field.width

    def serialise(self, n: int, columns: Mapping[str, np.ndarray]) -> np.ndarray:
        """Serialises n messages to (n, length) uint8; fields without a column have the values of the example.

        columns: path -> (n,) or (n, count); stamps in ns.
        """
        rows = np.repeat(self.template[None, :], n, axis=0)
        for path, column in columns.items():
            field, values = self.fields[path], np.asarray(column)
            if path.endswith("stamp"):
                values = np.stack(np.divmod(values, 1_000_000_000), axis=1)
            typed_values = np.ascontiguousarray(values.reshape(n, field.count), dtype=field.dtype)
            rows[:, field.offset : field.offset + field.width] = typed_values.view(np.uint8).reshape(n, field.width)
        return rows

    def column(self, buffer: np.ndarray, starts: np.ndarray, path: str) -> np.ndarray:
        """One field of the messages that begin at `starts` in a uint8 buffer: (n,) or (n, count); stamps in ns."""
        field = self.fields[path]
        values = sliding_window_view(buffer, field.width)[starts + field.offset].view(field.dtype)
        if path.endswith("stamp"):
            return values[:, 0].astype(np.int64) * 1_000_000_000 + values[:, 1].astype(np.uint32).astype(np.int64)
        return values if field.count > 1 else values[:, 0]

    def fits(self, buffer: np.ndarray, starts: np.ndarray, sizes: np.ndarray) -> bool:
        """Whether the messages at `starts`, of `sizes` bytes, have this layout; padding to four bytes is allowed."""
        size_fits = ((sizes >= len(self.template)) & (sizes < len(self.template) + 4)).all()
        fixed_bytes = np.nonzero(self._is_fixed)[0]
        return bool(size_fits) and all((buffer[starts + k] == self.template[k]).all() for k in fixed_bytes)


def get_field(message: Any, path: str) -> Any:
    """Gets the field at a path of a deserialised message; a stamp in ns."""
    for part in path.split("."):
        message = getattr(message, part)
    return message.sec * 1_000_000_000 + message.nanosec if path.endswith("stamp") else message


def _align(offset: int, size: int) -> int:
    return -(-offset // size) * size


@dataclass(frozen=True)
class Block:
    """Messages of one channel in one chunk, at the offsets `starts` with `sizes` [bytes] in `buffer` (uint8)."""

    buffer: np.ndarray
    starts: np.ndarray
    sizes: np.ndarray
    log_time_ns: np.ndarray  # since 1970


def read_summary(path: Path) -> Summary | None:
    """Reads channels, schemas and chunk indexes of an MCAP file that was closed properly.

    Returns None for a file that cannot be read or lacks a complete index: truncated, not MCAP, without chunks, or
    written without message indexes or without statistics, channels or schemas in its summary.
    """
    try:
        with path.open("rb") as stream:
            summary = make_reader(stream).get_summary()
    except READ_ERRORS:
        return None
    if summary is None or not summary.chunk_indexes or summary.statistics is None:
        return None
    counts = summary.statistics.channel_message_counts
    indexed_channels = set().union(*(chunk.message_index_offsets for chunk in summary.chunk_indexes))
    has_channels = all(channel in summary.channels for channel, count in counts.items() if count)
    has_schemas = all(c.schema_id in summary.schemas or not c.schema_id for c in summary.channels.values())
    is_indexed = indexed_channels >= {channel for channel, count in counts.items() if count}
    is_complete = sum(counts.values()) == summary.statistics.message_count
    return summary if has_channels and has_schemas and is_indexed and is_complete else None


def read_blocks(path: Path, summary: Summary, channels: Collection[int]) -> Iterator[tuple[int, Block]]:
    """Yields (channel, block of its messages in one chunk), chunk by chunk in file order. Raises one of READ_ERRORS."""
    chunks = [chunk for chunk in sorted(summary.chunk_indexes, key=lambda c: c.chunk_start_offset)
              if not chunk.message_index_offsets.keys().isdisjoint(channels)]
    with path.open("rb") as stream, ThreadPoolExecutor(1) as pool:
        # A thread decompresses the next chunk while this one is read; decompression releases the GIL.
        pending = [pool.submit(_read_chunk, stream, chunk) for chunk in chunks[:1]]
        for chunk, next_chunk in zip_longest(chunks, chunks[1:]):
            buffer = np.frombuffer(pending.pop().result(), np.uint8)
            pending += [pool.submit(_read_chunk, stream, next_chunk)] if next_chunk else []
            for channel in channels:
                if channel in chunk.message_index_offsets:
                    yield channel, _read_block(stream, chunk, channel, buffer)


def _read_block(stream: BinaryIO, chunk: ChunkIndex, channel: int, buffer: np.ndarray) -> Block:
    stream.seek(chunk.message_index_offsets[channel])
    head = stream.read(_RECORD_HEAD_LENGTH + 6)
    if len(head) < _RECORD_HEAD_LENGTH + 6 or head[0] != Opcode.MESSAGE_INDEX:
        raise ValueError("a message index is missing")
    entries = stream.read(struct.unpack_from("<I", head, _RECORD_HEAD_LENGTH + 2)[0])
    times, offsets = np.frombuffer(entries, "<u8").astype(np.int64).reshape(-1, 2).T
    uint64_at = np.ndarray((max(len(buffer) - 7, 0),), "<u8", buffer.data, 0, (1,))
    if len(offsets) and not 0 <= int(offsets.min()) <= int(offsets.max()) <= len(buffer) - _MESSAGE_HEAD_LENGTH:
        raise ValueError("a message index points outside its chunk")
    sizes = uint64_at[offsets + 1].astype(np.int64) - 22
    if (sizes < 0).any() or (sizes > len(buffer) - _MESSAGE_HEAD_LENGTH - offsets).any():
        raise ValueError("a message extends beyond its chunk")
    return Block(buffer, offsets + _MESSAGE_HEAD_LENGTH, sizes, times)


def _read_chunk(stream: BinaryIO, chunk: ChunkIndex) -> bytes:
    record = os.pread(stream.fileno(), chunk.chunk_length, chunk.chunk_start_offset)
    if not 0 < chunk.chunk_length <= len(record) or record[0] != Opcode.CHUNK:
        raise ValueError("a chunk is missing")
    if chunk.compression not in ("", "zstd", "lz4"):
        raise ValueError(f"unknown compression {chunk.compression!r}")
    try:
        content, size = get_chunk_data_stream(Chunk.read(ReadDataStream(BytesIO(record[_RECORD_HEAD_LENGTH:]))), True)
    except CRCValidationError:
        raise ValueError(f"the chunk at byte {chunk.chunk_start_offset} is damaged: wrong checksum") from None
    return content.read(size)
