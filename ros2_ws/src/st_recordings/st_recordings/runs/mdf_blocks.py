"""Validates the blocks that lead to the frames of an MDF 4 file, and finds the end of the last complete frame.

Source: ASAM MDF 4.3.
"""

import math
import mmap
import struct
from dataclasses import dataclass
from typing import NamedTuple

Buffer = bytes | mmap.mmap
_HEAD_LENGTH = 24  # bytes of a block before its links: name, reserved, length, number of links
_UNFINISHED_MAGIC = b"UnFinMF "
_COUNTERS_UNFINISHED, _LENGTH_UNFINISHED, _LIST_UNFINISHED = 1, 4, 16  # flags of an unfinalised file
_MAX_INFLATION = (1032, 32768, 255)  # largest ratio of unpacked to packed bytes with deflate, zstd, LZ4
_MAX_COMPRESSION_METHOD = 5  # methods with odd numbers transpose the records first
_MAX_RECORD_SIZE = 65536  # bytes; a CAN FD frame has about 90
_VARIABLE_LENGTH_GROUP, _BUS_EVENT, _REMOTE_MASTER = 1, 2, 8  # flags of a channel group
VARIABLE_LENGTH, _MASTER, VIRTUAL = 1, 2, (3, 6)  # channel types; a master channel contains the time
_INTEGER_TYPES, _REAL_TYPES = range(4), range(6)  # data types: integers; integers and floating-point numbers
_TEXT_AND_BYTE_TYPES = range(6, 13)  # data types of variable length
_INVALIDATION_FLAGS = 3  # channel flags: all values are invalid, or an invalidation bit of the record decides
_LINEAR_CONVERSIONS = (0, 1)  # conversion types: none; offset and factor


class DamageError(ValueError):
    """A file is truncated or damaged. The text describes the damage, without the name of the file."""


class _Block(NamedTuple):
    """One block of the file; all offsets are from the start of the file [byte]."""

    offset: int
    name: bytes
    links: tuple[int, ...]  # offsets of other blocks, 0 for none
    content: int  # start of the content, which follows the links
    end: int


@dataclass
class RecordLayout:
    """Layout of the records in a data group."""

    start: int  # offset of the first record
    size: int  # of all records [bytes]
    id_size: int  # bytes of a record identifier
    frame_records: dict[int, tuple[int, bool]]  # identifier -> (size [bytes], whether its payload is separate)
    payload_records: set[int]  # identifiers of the separate payload records


def describe_truncation(head: bytes, size: int) -> str:
    """Describes how an MDF 4 file is truncated before its first data group; empty for other files. head: first 96
    bytes or more."""
    if head[:4] != b"MDF " or head[8:10] != b"4.":
        return ""
    offset = int.from_bytes(head[88:96], "little")
    return f"it ends at byte {size}, before its first data group at byte {offset}" if offset >= size else ""


def check_blocks(data: Buffer) -> RecordLayout | None:
    """Layout of the last data group with unsorted records, or None; checks all blocks that lead to the frames.
    Raises DamageError if a block is missing or invalid.

    asammdf does not validate these blocks: it crashes on a channel outside its record, allocates a record of a
    gigabyte, and follows circular links forever. Names, comments and sources may be missing. The data block of an
    unfinalised file may have no length; its end is then not checked.
    """
    if len(data) < 64 + 104:
        raise DamageError(f"it ends after {len(data)} bytes, within its header")
    return max(_BlockChecker(data).layouts, key=lambda layout: layout.start, default=None)


class _BlockChecker:
    """Checks every block once, from the header to the records."""

    def __init__(self, data: Buffer):
        self._data, self._size = data, len(data)
        self._is_unfinished = data[:8] == _UNFINISHED_MAGIC
        # Since MDF 4.10, flags mark the unfinished parts, which asammdf completes.
        self._unfinished_parts = struct.unpack_from("<H", data, 60)[0] if data[8:12] >= b"4.10" else 0
        self._visited: set[int] = set()
        self.layouts: list[RecordLayout] = []  # of the data groups with unsorted records
        header = self._read_block(64, (b"##HD",), links=6, content=32)
        for link, name in ((1, b"##FH"), (3, b"##AT"), (4, b"##EV")):
            offset = header.links[link]
            # The content of these chains is not needed; only a circular one is rejected.
            while offset and offset + _HEAD_LENGTH + 8 <= self._size and data[offset : offset + 4] == name:
                self._mark_visited(offset)
                offset = struct.unpack_from("<Q", data, offset + _HEAD_LENGTH)[0]
        offset = header.links[0]
        while offset:
            offset = self._check_data_group(offset)

    def _read_block(self, offset: int, names: tuple[bytes, ...], links: int = 0, content: int = 0) -> _Block:
        """Reads the block at an offset. links: minimum number of links. content: minimum size of the content [byte]."""
        if offset + _HEAD_LENGTH > self._size:
            raise DamageError(f"a block refers to byte {offset}, but the file ends at byte {self._size}")
        self._mark_visited(offset)
        name = bytes(self._data[offset : offset + 4])
        if name not in names:
            expected_types = " or ".join(n[2:].decode() for n in names)
            raise DamageError(f"no block of type {expected_types} is at byte {offset}")
        length, count = struct.unpack_from("<QQ", self._data, offset + 8)
        end, first_link = offset + length, offset + _HEAD_LENGTH
        content_offset = first_link + 8 * count
        if name == b"##DT" and self._is_unfinished and not _HEAD_LENGTH <= length <= self._size - offset:
            end = self._size
        if end > self._size:
            raise DamageError(f"the block at byte {offset} should end at byte {end}, but the file ends at {self._size}")
        if count < links or content_offset + content > end:
            raise DamageError(f"the block at byte {offset} is too short for its content")
        return _Block(offset, name, struct.unpack_from(f"<{count}Q", self._data, first_link), content_offset, end)

    def _mark_visited(self, offset: int) -> None:
        if offset in self._visited:
            raise DamageError(f"two links refer to the block at byte {offset}")
        self._visited.add(offset)

    def _check_data_group(self, offset: int) -> int:
        """Checks a data group; returns the offset of the next one."""
        block = self._read_block(offset, (b"##DG",), links=4, content=8)
        id_size = self._data[block.content]
        if id_size not in (0, 1, 2, 4, 8):
            raise DamageError(f"the block at byte {offset} has record identifiers of {id_size} bytes")
        layout = RecordLayout(block.links[2] + _HEAD_LENGTH, 0, id_size, {}, set())
        expected, group = 0, block.links[1]
        while group:
            group, size = self._check_channel_group(group, layout)
            expected += size
        if id_size and self._data[block.links[2] : block.links[2] + 4] == b"##DT":
            self.layouts.append(layout)
        layout.size = size = self._measure_records(block.links[2], b"DT")
        if expected > size and not self._unfinished_parts & _COUNTERS_UNFINISHED:
            raise DamageError(f"the block at byte {offset} declares {expected} bytes of records, but there are {size}")
        return block.links[0]

    def _check_channel_group(self, offset: int, layout: RecordLayout) -> tuple[int, int]:
        """Adds a channel group to the layout; returns (offset of the next group, bytes of its fixed-size records)."""
        block = self._read_block(offset, (b"##CG",), links=6, content=32)
        record_id, count, flags, _, _, size, invalidation_size = struct.unpack_from(
            "<QQHHIII", self._data, block.content)
        if record_id in layout.frame_records or record_id in layout.payload_records:
            raise DamageError(f"the channel group at byte {offset} repeats the record identifier {record_id}")
        if flags & _REMOTE_MASTER or len(block.links) != 6 or block.end != block.content + 32:
            raise DamageError(f"the channel group at byte {offset} describes records that no CAN logger writes")
        if flags & _VARIABLE_LENGTH_GROUP:
            if block.links[1]:
                raise DamageError(f"the channel group at byte {offset} has channels, but records of variable length")
            layout.payload_records.add(record_id)
            return block.links[0], 0
        record_size = size + invalidation_size
        if record_size > _MAX_RECORD_SIZE:
            raise DamageError(f"the channel group at byte {offset} has impossible records of {record_size} bytes")
        has_separate_payload = self._check_channels(block.links[1], size, invalidation_size, flags)
        layout.frame_records[record_id] = record_size, has_separate_payload
        return block.links[0], count * (record_size + layout.id_size)

    def _check_channels(self, first: int, size: int, invalidation_size: int, group_flags: int) -> bool:
        """Checks the channels of a group; returns whether one of them has variable length."""
        pending_links, has_variable_length = [first], False
        while pending_links:
            offset = pending_links.pop()
            if not offset:
                continue
            block = self._read_block(offset, (b"##CN",), links=8, content=72)
            if block.end != block.content + 72:
                raise DamageError(f"the block at byte {offset} is longer than a channel block")
            self._check_channel(block, size, invalidation_size)
            has_variable_length |= self._data[block.content] == VARIABLE_LENGTH
            pending_links.append(block.links[0])
            part = block.links[1]
            if group_flags & _BUS_EVENT or self._data[part : part + 4] != b"##CA":
                pending_links.append(part)
        return has_variable_length

    def _check_channel(self, block: _Block, size: int, invalidation_size: int) -> None:
        channel_type, _, data_type, bit, byte, bits, flags, invalidation_bit = struct.unpack_from(
            "<BBBBIIII", self._data, block.content)
        name = f"channel at byte {block.offset}"
        if channel_type in VIRTUAL:
            return
        end = byte + (bit + bits + 7) // 8
        if end > size:
            raise DamageError(f"the {name} ends at byte {end} of a record of {size} bytes")
        if bit > 7 or (data_type in _INTEGER_TYPES and not 0 < bits <= 64):
            raise DamageError(f"the {name} has an invalid start bit {bit} or length of {bits} bits")
        if flags & _INVALIDATION_FLAGS and 0 < 8 * invalidation_size <= invalidation_bit:
            raise DamageError(f"the invalidation bit of the {name} is outside the record")
        if channel_type == VARIABLE_LENGTH:
            if bits not in (32, 64) or bit or data_type not in _TEXT_AND_BYTE_TYPES:
                raise DamageError(f"the {name} has an invalid reference to its values")
            if self._data[block.links[5] : block.links[5] + 4] != b"##CG":  # _check_data_group checks channel groups
                self._measure_records(block.links[5], b"SD")
        if channel_type == _MASTER:
            if data_type not in _REAL_TYPES:
                raise DamageError(f"the time {name} is not numeric")
            if block.links[4]:
                self._check_time_conversion(block.links[4])

    def _check_time_conversion(self, offset: int) -> None:
        # asammdf ignores an invalid conversion and would read microseconds as seconds.
        self._visited.discard(offset)  # groups may share a conversion
        block = self._read_block(offset, (b"##CC",), links=4, content=24)
        conversion, _, _, _, values = struct.unpack_from("<BBHHH", self._data, block.content)
        if conversion not in _LINEAR_CONVERSIONS or (conversion and (values != 2 or block.content + 40 > block.end)):
            raise DamageError(f"the time conversion at byte {offset} is not linear")
        if conversion:
            start, factor = struct.unpack_from("<2d", self._data, block.content + 24)
            if not math.isfinite(start) or not 0 < factor < math.inf:
                raise DamageError(f"the time conversion at byte {offset} is invalid ({start:g} + {factor:g} x)")

    def _measure_records(self, offset: int, name: bytes) -> int:
        """Uncompressed size [byte] of the records at an offset, in one block (compressed or not) or in several."""
        size, list_count, pending_links = 0, 0, [offset]
        while pending_links:
            offset = pending_links.pop()
            if not offset:
                continue
            is_packed = self._data[offset : offset + 4] == b"##DZ"
            block = self._read_block(offset, (b"##" + name, b"##DZ", b"##DL", b"##HL"), content=24 if is_packed else 0)
            if is_packed:
                content, method, columns, unpacked_size, packed_size = struct.unpack_from(
                    "<2sBxIQQ", self._data, block.content)
                if content != name or method > _MAX_COMPRESSION_METHOD or (method % 2 and not columns):
                    raise DamageError(f"the block at byte {offset} has invalid compression parameters")
                largest_size = _MAX_INFLATION[method // 2] * packed_size
                if block.content + 24 + packed_size > block.end or unpacked_size > largest_size:
                    raise DamageError(f"the block at byte {offset} is too short to unpack to {unpacked_size} bytes")
                size += unpacked_size
            elif block.name == b"##DL":
                pending_links += block.links
                list_count += 1
            elif block.name == b"##HL":
                pending_links += block.links[:1]
            else:
                size += (self._size if self._unfinished_parts & _LENGTH_UNFINISHED else block.end) - block.content
        if list_count > 1 and self._unfinished_parts & (_LIST_UNFINISHED | _LENGTH_UNFINISHED):
            # asammdf would look for the end of the lists forever.
            raise DamageError("it was not finalised, and its records are in more than one list")
        return size


def find_end_of_last_frame(data: Buffer, layout: RecordLayout) -> int | None:
    """Offset after the last record with a complete payload in an unfinalised file; None without such a record.

    A record consists of an identifier and a fixed number of bytes, or of an identifier, a length and that many bytes.
    """
    offset, end, open_payloads = layout.start, None, 0
    while offset + layout.id_size <= len(data):
        record_id = int.from_bytes(data[offset : offset + layout.id_size], "little")
        if record_id in layout.payload_records:
            if offset + layout.id_size + 4 > len(data):
                break
            size = 4 + struct.unpack_from("<I", data, offset + layout.id_size)[0]
            change = -1
        elif record_id in layout.frame_records:
            size, has_separate_payload = layout.frame_records[record_id]
            change = int(has_separate_payload)
        else:
            break
        offset += layout.id_size + size
        if offset > len(data):
            break
        open_payloads += change
        if open_payloads <= 0:
            end = offset
    return end
