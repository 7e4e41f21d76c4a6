"""Messages of some topics straight out of the chunks of an MCAP file, by its message index: no object per message."""

import os
import struct
from collections import deque
from collections.abc import Collection, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import lz4.frame
import numpy as np
import zstandard
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.records import ChunkIndex
from mcap.summary import Summary

_RECORD_HEAD = 9  # opcode, length
_MESSAGE_HEAD = _RECORD_HEAD + 22  # channel, sequence, log time, publish time
_CHUNK, _MESSAGE_INDEX = 0x06, 0x07
# What a file that contradicts its index, or was damaged, makes `blocks` raise.
DAMAGE = (ValueError, struct.error, zstandard.ZstdError, RuntimeError, OSError, OverflowError, MemoryError)


@dataclass(frozen=True)
class Block:
    """Messages of one channel in one chunk: they begin at `starts` in `buffer` (uint8) and are `sizes` bytes long."""

    buffer: np.ndarray
    starts: np.ndarray
    sizes: np.ndarray
    log_time_ns: np.ndarray


def summary_of(path: Path) -> Summary | None:
    """Channels, schemas and chunks of a file that was closed; None for one without an index of its messages (cut, not
    MCAP, or written without message index, or without channels and schemas behind the data)."""
    try:
        with path.open("rb") as stream:
            summary = make_reader(stream).get_summary()
    except (McapError, *DAMAGE):
        return None
    if summary is None or not summary.chunk_indexes or summary.statistics is None:
        return None
    counts = summary.statistics.channel_message_counts
    indexed = set().union(*(chunk.message_index_offsets for chunk in summary.chunk_indexes))
    known = all(number in summary.channels for number, count in counts.items() if count)
    named = all(c.schema_id in summary.schemas or not c.schema_id for c in summary.channels.values())
    whole = known and named and indexed >= {number for number, count in counts.items() if count}
    return summary if whole and sum(counts.values()) == summary.statistics.message_count else None


def blocks(path: Path, summary: Summary, channels: Collection[int]) -> Iterator[tuple[int, Block]]:
    """The messages of some channels with the number of each, chunk by chunk. Raises one of DAMAGE."""
    chunks = [chunk for chunk in sorted(summary.chunk_indexes, key=lambda c: c.chunk_start_offset)
              if not chunk.message_index_offsets.keys().isdisjoint(channels)]
    with path.open("rb") as stream:
        for chunk, content in _unpacked(stream, chunks):
            buffer = np.frombuffer(content, np.uint8)
            for channel in channels:
                if channel in chunk.message_index_offsets:
                    yield channel, _block(stream, chunk, channel, buffer)


def _unpacked(stream: BinaryIO, chunks: Sequence[ChunkIndex]) -> Iterator[tuple[ChunkIndex, bytes]]:
    """Chunks with their content. Unpacking takes most of the time and leaves the interpreter free: one is ahead."""
    with ThreadPoolExecutor(1) as pool:
        coming: deque[tuple[ChunkIndex, Future[bytes]]] = deque()
        for chunk in chunks:
            coming.append((chunk, pool.submit(_content, stream, chunk)))
            if len(coming) > 1:
                first, content = coming.popleft()
                yield first, content.result()
        for last, content in coming:
            yield last, content.result()


def _block(stream: BinaryIO, chunk: ChunkIndex, channel: int, buffer: np.ndarray) -> Block:
    times, offsets = _index(stream, chunk.message_index_offsets[channel])
    words = np.ndarray((max(len(buffer) - 7, 0),), "<u8", buffer.data, 0, (1,))
    if len(offsets) and not 0 <= int(offsets.min()) <= int(offsets.max()) <= len(buffer) - _MESSAGE_HEAD:
        raise ValueError("a message index points outside its chunk")
    sizes = words[offsets + 1].astype(np.int64) - 22
    if (sizes < 0).any() or (sizes > len(buffer) - _MESSAGE_HEAD - offsets).any():
        raise ValueError("a message reaches beyond its chunk")
    return Block(buffer, offsets + _MESSAGE_HEAD, sizes, times)


def _content(stream: BinaryIO, chunk: ChunkIndex) -> bytes:
    record = os.pread(stream.fileno(), chunk.chunk_length, chunk.chunk_start_offset)
    if len(record) < chunk.chunk_length or record[0] != _CHUNK:
        raise ValueError("a chunk is missing")
    name_length = struct.unpack_from("<I", record, _RECORD_HEAD + 28)[0]
    data = record[_RECORD_HEAD + 28 + 4 + name_length + 8 :]
    if chunk.compression == "zstd":
        return zstandard.ZstdDecompressor().decompress(data, max_output_size=chunk.uncompressed_size)
    if chunk.compression == "lz4":
        return lz4.frame.decompress(data)
    if chunk.compression:
        raise ValueError(f"compression {chunk.compression!r} is not known")
    return data


def _index(stream: BinaryIO, at: int) -> tuple[np.ndarray, np.ndarray]:
    """(log times, offsets in the chunk) of the messages of one channel."""
    stream.seek(at)
    head = stream.read(_RECORD_HEAD + 6)
    if len(head) < _RECORD_HEAD + 6 or head[0] != _MESSAGE_INDEX:
        raise ValueError("a message index is missing")
    size = struct.unpack_from("<I", head, _RECORD_HEAD + 2)[0]
    entries = np.frombuffer(stream.read(size), "<u8").reshape(-1, 2)
    return entries[:, 0].astype(np.int64), entries[:, 1].astype(np.int64)
