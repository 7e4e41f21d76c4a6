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

from mcap import records as mcap_records
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, McapRecord, Message, MessageIndex, MetadataIndex, Schema
from mcap.stream_reader import StreamReader, get_chunk_data_stream

MAX_DROPPED_CHUNKS = 100  # number of most recent chunks that can be dropped when the disk is full
MAGIC = b"\x89MCAP0\r\n"
_LISTED_RECORDS = (Opcode.CHUNK, Opcode.MESSAGE_INDEX, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE, Opcode.METADATA,
                   Opcode.ATTACHMENT)
_HEAD = struct.Struct("<BQ")  # opcode, length of the content
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time


class Record(NamedTuple):
    opcode: int
    offset: int  # position in the file
    content: bytes  # without the 9 bytes of opcode and length

    @property
    def raw(self) -> bytes:
        return _HEAD.pack(self.opcode, len(self.content)) + self.content


class WritableStream(Protocol):
    def write(self, data: bytes, /) -> int: ...
    def tell(self) -> int: ...


def _serialise(*records: McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return builder.end()


def read_records(stream: BinaryIO, size: int) -> Iterator[Record]:
    """Yields the complete records of a file of `size` bytes; ends silently at a truncated record."""
    offset = stream.seek(len(MAGIC))
    while offset + _HEAD.size <= size:
        opcode, length = _HEAD.unpack(stream.read(_HEAD.size))
        if opcode == 0 or offset + _HEAD.size + length > size:
            return
        yield Record(opcode, offset, stream.read(length))
        offset += _HEAD.size + length


@dataclass
class _ChunkEntry:
    index: ChunkIndex
    messages: Mapping[int, MessageIndex]  # by channel id
    counts: dict[int, int]  # messages by channel id

    def times(self) -> list[int]:
        return [self.index.message_start_time, self.index.message_end_time] if self.counts else []


class Contents:
    """Inventory of the records in one file, for its index section. Times are log times [ns since 1970]."""

    def __init__(self) -> None:
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.metadata: dict[str, dict[str, str]] = {}
        self._chunks: deque[_ChunkEntry] = deque()  # the newest MAX_DROPPED_CHUNKS
        # Index entries of older chunks, serialised to save memory because a long recording has tens of thousands.
        self._older_indexes = bytearray()
        self._older_chunk_count = 0
        # Messages in older chunks or outside of chunks: number by channel id, first and last time.
        self._older_messages: Counter[int] = Counter()
        self._older_times: list[int] = []
        self._metadata_indexes: list[MetadataIndex] = []
        self._attachment_indexes: list[mcap_records.AttachmentIndex] = []

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

    def add(self, record: Record, offset: int) -> bool:
        """Adds one record of the data section; returns False, and adds nothing, if it is invalid. Record types that the
        inventory does not need are ignored.

        offset: position of the record in the file that will get the index.
        """
        if record.opcode not in _LISTED_RECORDS:
            return True
        try:
            parsed = next(StreamReader(BytesIO(record.raw), skip_magic=True, emit_chunks=True).records)
            if isinstance(parsed, Message) and parsed.channel_id not in self.channels:
                return False
            if isinstance(parsed, MessageIndex) and parsed.channel_id not in self._chunks[-1].counts:
                return False
            messages = self._index_messages(parsed) if isinstance(parsed, Chunk) else {}
        except Exception:  # any, because the library does not check the bytes
            return False
        self._add(parsed, offset, len(record.raw), messages)
        return True

    def _add(self, record: McapRecord, offset: int, length: int, messages: Mapping[int, MessageIndex]) -> None:
        """Adds a parsed record. messages: for a chunk, message indexes to be written if the file lacks them."""
        match record:
            case Chunk():
                self._add_chunk(record, messages, offset, length)
            case MessageIndex():
                newest_chunk = self._chunks[-1]
                newest_chunk.counts.setdefault(record.channel_id, len(record.records))
                newest_chunk.index.message_index_offsets[record.channel_id] = offset
                newest_chunk.index.message_index_length += length
            case Schema():
                self.schemas[record.id] = record
            case Channel():
                self.channels[record.id] = record
            case Message():
                self._add_older({record.channel_id: 1}, [record.log_time])
            case mcap_records.Metadata():
                self.metadata[record.name] = record.metadata
                self._metadata_indexes.append(MetadataIndex(offset=offset, length=length, name=record.name))
            case mcap_records.Attachment():
                self._attachment_indexes.append(mcap_records.AttachmentIndex(
                    offset=offset, length=length, log_time=record.log_time, create_time=record.create_time,
                    data_size=len(record.data), name=record.name, media_type=record.media_type))

    def _index_messages(self, chunk: Chunk) -> dict[int, MessageIndex]:
        """Indexes the messages of a chunk by channel id, and adds its schemas and channels; raises if it is damaged."""
        stream, size = get_chunk_data_stream(chunk, validate_crc=True)
        data = stream.read(size)
        if len(data) != chunk.uncompressed_size:
            raise ValueError("the declared size of a chunk is wrong")
        schemas, channels = dict(self.schemas), dict(self.channels)
        messages: dict[int, MessageIndex] = {}
        position = 0
        while position < size:
            opcode, length = _HEAD.unpack_from(data, position)
            start, end = position + _HEAD.size, position + _HEAD.size + length
            if end > size:
                raise ValueError("a record extends beyond the end of its chunk")
            if opcode == Opcode.MESSAGE:
                channel_id, _, log_time, _ = _MESSAGE.unpack_from(data, start)
                if channel_id not in channels:
                    raise ValueError("a message has an unknown channel")
                messages.setdefault(channel_id, MessageIndex(channel_id, [])).records.append((log_time, position))
            elif opcode == Opcode.SCHEMA:
                schema = Schema.read(ReadDataStream(BytesIO(data[start:end])))
                schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                channel = Channel.read(ReadDataStream(BytesIO(data[start:end])))
                channels[channel.id] = channel
            position = end
        self.schemas, self.channels = schemas, channels
        return messages

    def _add_chunk(self, chunk: Chunk, messages: Mapping[int, MessageIndex], offset: int, length: int) -> None:
        if self._chunks:
            self._chunks[-1].messages = {}  # only the newest chunk may lack its message indexes in the file
        index = ChunkIndex(
            chunk_length=length, chunk_start_offset=offset,
            compression=chunk.compression, compressed_size=len(chunk.data),
            message_end_time=chunk.message_end_time, message_index_length=0, message_index_offsets={},
            message_start_time=chunk.message_start_time, uncompressed_size=chunk.uncompressed_size)
        self._chunks.append(_ChunkEntry(index, messages, {i: len(m.records) for i, m in messages.items()}))
        if len(self._chunks) > MAX_DROPPED_CHUNKS:
            oldest_chunk = self._chunks.popleft()
            self._older_indexes += _serialise(oldest_chunk.index)
            self._older_chunk_count += 1
            self._add_older(oldest_chunk.counts, oldest_chunk.times())

    def _add_older(self, counts: Mapping[int, int], times: Sequence[int]) -> None:
        self._older_messages.update(counts)
        times = [*self._older_times, *times]
        self._older_times = [min(times), max(times)] if times else []

    def append(self, stream: WritableStream, *records: McapRecord) -> None:
        """Writes records and adds them to the inventory, which is unchanged after an OSError."""
        parts = [_serialise(record) for record in records]
        offset = stream.tell()
        stream.write(b"".join(parts))
        for record, part in zip(records, parts, strict=True):
            self._add(record, offset, len(part), {})
            offset += len(part)

    def drop_last_chunk(self) -> int | None:
        """Removes the newest chunk, and the index entries of metadata after it, from the inventory.

        Returns its position in the file; None without a chunk, or after MAX_DROPPED_CHUNKS have been dropped.
        """
        if not self._chunks:
            return None
        offset = self._chunks.pop().index.chunk_start_offset
        self._metadata_indexes = [i for i in self._metadata_indexes if i.offset < offset]
        return offset

    def finish(self, stream: WritableStream) -> None:
        """Appends the end of the file: missing message indexes of the last chunk, end of data, summary and footer."""
        if self._chunks:
            newest_chunk = self._chunks[-1]
            missing_ids = newest_chunk.messages.keys() - newest_chunk.index.message_index_offsets.keys()
            self.append(stream, *(newest_chunk.messages[channel_id] for channel_id in missing_ids))
        data_end = _serialise(mcap_records.DataEnd(0))
        stream.write(data_end + self._make_summary(stream.tell() + len(data_end)) + MAGIC)

    def _make_summary(self, summary_start: int) -> bytes:
        counts, (start_ns, end_ns) = self.counts(), self.times()
        statistics = mcap_records.Statistics(
            attachment_count=len(self._attachment_indexes), channel_count=len(self.channels),
            channel_message_counts=counts, chunk_count=self._older_chunk_count + len(self._chunks),
            message_count=counts.total(), metadata_count=len(self._metadata_indexes),
            message_start_time=start_ns, message_end_time=end_ns, schema_count=len(self.schemas))
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
                length = builder.count - group_start
                offsets.append(mcap_records.SummaryOffset(opcode, summary_start + group_start, length))
        offset_start = summary_start + builder.count
        summary = builder.end() + _serialise(*offsets)
        crc = zlib.crc32(struct.pack("<BQQQ", Opcode.FOOTER, 20, summary_start, offset_start), zlib.crc32(summary))
        return summary + _serialise(mcap_records.Footer(
            summary_start=summary_start, summary_offset_start=offset_start, summary_crc=crc))
