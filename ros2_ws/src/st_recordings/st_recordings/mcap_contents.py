"""Keeps an inventory of the records in an MCAP file, and writes the index section that closes the file.

The layout is specified at https://mcap.dev/spec. A file truncated by a crash or a full disk has chunks but no index,
and the writer of the mcap library cannot add one.
"""

import struct
import zlib
from collections import Counter, deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from typing import Any, BinaryIO, NamedTuple, Protocol

from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    McapRecord,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.stream_reader import get_chunk_data_stream

DROPPABLE_CHUNKS = 100
"""Number of most recent chunks that can be dropped when the disk is full."""
MAGIC = b"\x89MCAP0\r\n"
_HEAD = struct.Struct("<BQ")  # opcode, length of the content
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time


class Record(NamedTuple):
    """One record of a file."""

    opcode: int
    offset: int  # position in the file
    content: bytes  # without the 9 bytes of opcode and length

    @property
    def raw(self) -> bytes:
        return _HEAD.pack(self.opcode, len(self.content)) + self.content


class WritableStream(Protocol):
    def write(self, data: bytes, /) -> int: ...
    def tell(self) -> int: ...


class DamagedError(ValueError):
    """A record of full length has invalid content."""


def _serialise(*records: McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return builder.end()


def read_records(stream: BinaryIO, size: int, offset: int = len(MAGIC)) -> Iterator[Record]:
    """Yields the complete records of a file of `size` bytes from `offset` on; ends silently at a truncated record."""
    stream.seek(offset)
    while offset + _HEAD.size <= size:
        opcode, length = _HEAD.unpack(stream.read(_HEAD.size))
        if opcode == 0 or offset + _HEAD.size + length > size:
            return
        yield Record(opcode, offset, stream.read(length))
        offset += _HEAD.size + length


@dataclass
class _ChunkEntry:
    index: ChunkIndex
    messages: dict[int, MessageIndex]  # by channel id
    counts: dict[int, int]  # messages by channel id

    def times(self) -> list[int]:
        return [self.index.message_start_time, self.index.message_end_time] if self.counts else []

    def add_message_index(self, channel_id: int, offset: int, length: int) -> None:
        self.index.message_index_offsets[channel_id] = offset
        self.index.message_index_length += length


class Contents:
    """Inventory of one file, from which its index section is written. Times are log times [ns]."""

    def __init__(self) -> None:
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.metadata: dict[str, dict[str, str]] = {}
        self._chunks: deque[_ChunkEntry] = deque()  # the newest DROPPABLE_CHUNKS
        # Index entries of older chunks, serialised to save memory because a long recording has tens of thousands.
        self._older_indexes = bytearray()
        self._older_count = 0
        # Messages in older chunks or outside of chunks: number by channel id, first and last time.
        self._older_messages: Counter[int] = Counter()
        self._older_times: list[int] = []
        self._metadata_indexes: list[MetadataIndex] = []
        self._attachment_indexes: list[AttachmentIndex] = []
        self._definitions_end = 0

    def counts(self) -> Counter[int]:
        """Number of messages by channel id."""
        total = Counter(self._older_messages)
        for entry in self._chunks:
            total.update(entry.counts)
        return total

    def times(self) -> tuple[int, int]:
        """First and last log time; (0, 0) without messages."""
        times = self._older_times + [t for entry in self._chunks for t in entry.times()]
        return (min(times), max(times)) if times else (0, 0)

    def add(self, record: Record, offset: int) -> None:
        """Adds one record of the data section. offset: position of the record in the file that will get the index.

        Raises DamagedError for invalid content, which is not added.
        """
        try:
            self._add(record, offset)
        except DamagedError:
            raise
        except Exception as error:  # any, because decoders do not check the bytes
            raise DamagedError(f"{type(error).__name__}: {error}") from error

    def _add(self, record: Record, offset: int) -> None:
        stream = ReadDataStream(BytesIO(record.content))
        length = _HEAD.size + len(record.content)
        if record.opcode == Opcode.CHUNK:
            self._read_chunk(Chunk.read(stream), offset, length)
        elif record.opcode == Opcode.MESSAGE_INDEX:
            channel_id = MessageIndex.read(stream).channel_id
            if not self._chunks or channel_id not in self._chunks[-1].counts:
                raise DamagedError(f"index of channel {channel_id}, which is not in the chunk before it")
            self._chunks[-1].add_message_index(channel_id, offset, length)
        elif record.opcode == Opcode.SCHEMA:
            schema = Schema.read(stream)
            self.schemas[schema.id] = schema
        elif record.opcode == Opcode.CHANNEL:
            channel = Channel.read(stream)
            self.channels[channel.id] = channel
        elif record.opcode == Opcode.MESSAGE:
            channel_id, _, log_time, _ = _MESSAGE.unpack_from(record.content)
            if channel_id not in self.channels:
                raise DamagedError(f"message of unknown channel {channel_id}")
            self._add_older({channel_id: 1}, [log_time])
        elif record.opcode == Opcode.METADATA:
            entry = Metadata.read(stream)
            self.metadata[entry.name] = entry.metadata
            self._metadata_indexes.append(MetadataIndex(offset=offset, length=length, name=entry.name))
        elif record.opcode == Opcode.ATTACHMENT:
            self._attachment_indexes.append(_read_attachment_index(stream, offset, length))

    def _read_chunk(self, chunk: Chunk, offset: int, length: int) -> None:
        stream, size = get_chunk_data_stream(chunk, validate_crc=True)
        data = stream.read(size)
        if len(data) != chunk.uncompressed_size:
            raise DamagedError(f"chunk has {len(data)} bytes, {chunk.uncompressed_size} declared")
        schemas, channels = dict(self.schemas), dict(self.channels)
        messages: dict[int, MessageIndex] = {}
        position = 0
        while position < size:
            opcode, inner = _HEAD.unpack_from(data, position)
            start, end = position + _HEAD.size, position + _HEAD.size + inner
            if end > size:
                raise DamagedError("record reaches beyond its chunk")
            if opcode == Opcode.MESSAGE:
                channel_id, _, log_time, _ = _MESSAGE.unpack_from(data, start)
                if channel_id not in channels:
                    raise DamagedError(f"message of unknown channel {channel_id}")
                messages.setdefault(channel_id, MessageIndex(channel_id, [])).records.append((log_time, position))
            elif opcode == Opcode.SCHEMA:
                schema = Schema.read(ReadDataStream(BytesIO(data[start:end])))
                schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                channel = Channel.read(ReadDataStream(BytesIO(data[start:end])))
                channels[channel.id] = channel
            position = end
        self.schemas, self.channels = schemas, channels
        self._add_chunk(chunk, messages, offset, length)

    def _add_chunk(self, chunk: Chunk, messages: dict[int, MessageIndex], offset: int, length: int) -> None:
        if self._chunks:
            self._chunks[-1].messages = {}  # its index is in the file; only the newest chunk may lack one
        index = ChunkIndex(
            chunk_length=length, chunk_start_offset=offset,
            compression=chunk.compression, compressed_size=len(chunk.data),
            message_end_time=chunk.message_end_time, message_index_length=0, message_index_offsets={},
            message_start_time=chunk.message_start_time, uncompressed_size=chunk.uncompressed_size,
        )
        self._chunks.append(_ChunkEntry(index, messages, {i: len(m.records) for i, m in messages.items()}))
        if len(self._chunks) > DROPPABLE_CHUNKS:
            oldest = self._chunks.popleft()
            self._older_indexes += _serialise(oldest.index)
            self._older_count += 1
            self._add_older(oldest.counts, oldest.times())

    def _add_older(self, counts: Mapping[int, int], times: Sequence[int]) -> None:
        self._older_messages.update(counts)
        times = [*self._older_times, *times]
        self._older_times = [min(times), max(times)] if times else []

    def append_chunk(self, stream: WritableStream, chunk: Chunk, messages: dict[int, MessageIndex]) -> None:
        """Writes a new chunk with its message indexes; after an OSError the inventory is unchanged."""
        parts = [_serialise(record) for record in (chunk, *messages.values())]
        offset = stream.tell()
        stream.write(b"".join(parts))
        self._add_chunk(chunk, messages, offset, len(parts[0]))
        offset += len(parts[0])
        for channel_id, part in zip(messages, parts[1:], strict=True):
            self._chunks[-1].add_message_index(channel_id, offset, len(part))
            offset += len(part)

    def append_definitions(self, stream: WritableStream, records: Sequence[Schema | Channel]) -> None:
        """Writes schemas and channels."""
        stream.write(_serialise(*records))
        self._definitions_end = stream.tell()
        self.schemas.update({r.id: r for r in records if isinstance(r, Schema)})
        self.channels.update({r.id: r for r in records if isinstance(r, Channel)})

    def append_metadata(self, stream: WritableStream, name: str, entries: dict[str, str]) -> None:
        offset, data = stream.tell(), _serialise(Metadata(name=name, metadata=entries))
        stream.write(data)
        self.metadata[name] = entries
        self._metadata_indexes.append(MetadataIndex(offset=offset, length=len(data), name=name))

    def drop_after(self, length: int) -> None:
        """Removes the content after the first `length` bytes of the file from the inventory, at most DROPPABLE_CHUNKS
        chunks."""
        while self._chunks and self._chunks[-1].index.chunk_start_offset >= length:
            self._chunks.pop()
        self._definitions_end = min(self._definitions_end, length)
        self._metadata_indexes = [i for i in self._metadata_indexes if i.offset < length]

    def end_offset(self) -> int:
        """End of the last record that was appended; 0 if there is none."""
        ends = [self._definitions_end, *(i.offset + i.length for i in self._metadata_indexes)]
        if self._chunks:
            newest = self._chunks[-1].index
            ends.append(newest.chunk_start_offset + newest.chunk_length + newest.message_index_length)
        return max(ends)

    def last_chunk_offset(self) -> int | None:
        """Start of the newest chunk; None if no chunk can be dropped."""
        return self._chunks[-1].index.chunk_start_offset if self._chunks else None

    def finish(self, stream: WritableStream) -> None:
        """Appends the end of the file: missing message indexes of the last chunk, end of data, summary and footer."""
        if self._chunks:
            newest = self._chunks[-1]
            for channel_id in newest.messages.keys() - newest.index.message_index_offsets.keys():
                data = _serialise(newest.messages[channel_id])
                newest.add_message_index(channel_id, stream.tell(), len(data))
                stream.write(data)
        stream.write(_serialise(DataEnd(0)))
        stream.write(self._summary(stream.tell()) + MAGIC)

    def _summary(self, summary_start: int) -> bytes:
        counts, (start_ns, end_ns) = self.counts(), self.times()
        statistics = Statistics(
            attachment_count=len(self._attachment_indexes), channel_count=len(self.channels),
            channel_message_counts=counts, chunk_count=self._older_count + len(self._chunks),
            message_count=counts.total(), metadata_count=len(self._metadata_indexes),
            message_start_time=start_ns, message_end_time=end_ns, schema_count=len(self.schemas),
        )
        groups: dict[Opcode, Sequence[Any]] = {
            Opcode.SCHEMA: list(self.schemas.values()),
            Opcode.CHANNEL: list(self.channels.values()),
            Opcode.STATISTICS: [statistics],
            Opcode.CHUNK_INDEX: [entry.index for entry in self._chunks],
            Opcode.ATTACHMENT_INDEX: self._attachment_indexes,
            Opcode.METADATA_INDEX: self._metadata_indexes,
        }
        builder, offsets = RecordBuilder(), []
        for opcode, records in groups.items():
            group_start = builder.count
            if opcode == Opcode.CHUNK_INDEX:
                builder.write(self._older_indexes)
            for record in records:
                record.write(builder)
            if builder.count > group_start:
                offsets.append(SummaryOffset(opcode, summary_start + group_start, builder.count - group_start))
        offset_start = summary_start + builder.count
        summary = builder.end() + _serialise(*offsets)
        crc = zlib.crc32(struct.pack("<BQQQ", Opcode.FOOTER, 20, summary_start, offset_start), zlib.crc32(summary))
        return summary + _serialise(Footer(summary_start=summary_start, summary_offset_start=offset_start,
                                           summary_crc=crc))


def _read_attachment_index(stream: ReadDataStream, offset: int, length: int) -> AttachmentIndex:
    log_time, create_time = stream.read8(), stream.read8()
    name, media_type = stream.read_prefixed_string(), stream.read_prefixed_string()
    return AttachmentIndex(offset=offset, length=length, log_time=log_time, create_time=create_time,
                           data_size=stream.read8(), name=name, media_type=media_type)
