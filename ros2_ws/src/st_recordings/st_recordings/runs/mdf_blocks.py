"""The blocks of an MDF 4 file: whether they make sense on the way to the frames, and where the last whole frame ends.

Source: ASAM MDF 4.1; checked on a real CANedge2 file cut at every byte of a stretch.
"""

import math
import mmap
import struct
from typing import NamedTuple

Buffer = bytes | mmap.mmap
_HEADER = 24  # name, reserved, length, number of links
_UNFINISHED = b"UnFinMF "
_COUNTERS_OPEN, _LENGTH_OPEN, _LIST_OPEN = 1, 4, 16  # flags of an unfinalised file: what is incomplete
_MOST_INFLATED = 1032  # deflate cannot pack tighter
_MOST_WAYS = 5  # to pack records: three, each with the columns put together first or not (odd)
_LONGEST_RECORD = 65536  # bytes; a CAN FD frame has some 90
_MOST_CHANNELS = 10_000  # of a group; more are links in a circle
_VARIABLE_LENGTH_GROUP, _BUS_EVENT, _REMOTE_MASTER = 1, 2, 8  # flags of a channel group
_VALUE_ELSEWHERE, _MASTER, _VIRTUAL = 1, 2, (3, 6)  # types of a channel
_NUMBERS, _REALS = range(4), range(6)  # data types: integers, and with them what has a point
_TEXTS_AND_BYTES = range(6, 13)  # data types that may have a length of their own
_INVALIDATION = 3  # flags of a channel: it looks at the invalidation bits of its record
_LINEAR = (0, 1)  # conversions: none, offset and factor


class Damage(ValueError):
    """What is wrong with a file, in words for its owner."""


class _Block(NamedTuple):
    at: int
    name: bytes
    links: tuple[int, ...]
    content: int  # where it begins, behind the links
    end: int


def damage(data: Buffer) -> str:
    """What is missing or wrong in the blocks that lead to the frames; empty where nothing is.

    asammdf does not validate these, in C either: a channel outside its record ends the process, a record of a gigabyte
    is allocated, links in a circle are followed for ever. Names, comments and sources may be cut off: not needed.
    The data block of a file that was never finalised has no length, so its end is not looked at.
    """
    if len(data) < 64 + 104:
        return f"it ends after {len(data)} bytes, inside its header"
    if data[8:10] != b"4.":
        return "it is not of version 4 of the format"
    try:
        _Walk(data).file()
    except Damage as found:
        return str(found)
    return ""


class _Walk:
    """From the header to the records, every block once."""

    def __init__(self, data: Buffer):
        self._data, self._size = data, len(data)
        self._unfinished = data[:8] == _UNFINISHED
        # asammdf sets right what is open from version 4.10 on.
        self._open = struct.unpack_from("<H", data, 60)[0] if data[8:12] >= b"4.10" else 0
        self._seen: set[int] = set()

    def file(self) -> None:
        header = self._block(64, (b"##HD",), links=6, content=32)
        for link, name in ((1, b"##FH"), (3, b"##AT"), (4, b"##EV")):
            self._chain(header.links[link], name)
        at = header.links[0]
        while at:
            at = self._data_group(at)

    def _block(self, at: int, names: tuple[bytes, ...], links: int = 0, content: int = 0) -> _Block:
        """The block at a place, one of these, with at least so many links and bytes of content."""
        if at + _HEADER > self._size:
            raise Damage(f"its index points to byte {at}, it has {self._size}")
        if at in self._seen:
            raise Damage(f"its index leads to byte {at} twice")
        self._seen.add(at)
        name = bytes(self._data[at : at + 4])
        if name not in names:
            expected = " or ".join(n[2:].decode() for n in names)
            raise Damage(f"a block {expected} is missing at byte {at}")
        length, count = struct.unpack_from("<QQ", self._data, at + 8)
        end, content_at = at + length, at + _HEADER + 8 * count
        if name == b"##DT" and self._unfinished and not _HEADER <= length <= self._size - at:
            end = self._size
        if end > self._size:
            raise Damage(f"the block at byte {at} ends at {end}, the file at {self._size}")
        if count < links or content_at + content > end:
            raise Damage(f"the block at byte {at} is too short for its content")
        return _Block(at, name, struct.unpack_from(f"<{count}Q", self._data, at + _HEADER), content_at, end)

    def _chain(self, at: int, name: bytes) -> None:
        """Blocks that nothing depends on, except that they come to an end."""
        while at and at + _HEADER + 8 <= self._size and self._data[at : at + 4] == name:
            if at in self._seen:
                raise Damage(f"its index leads to byte {at} twice")
            self._seen.add(at)
            at = struct.unpack_from("<Q", self._data, at + _HEADER)[0]

    def _data_group(self, at: int) -> int:
        """Returns where the next one is."""
        block = self._block(at, (b"##DG",), links=4, content=8)
        id_size = self._data[block.content]
        if id_size not in (0, 1, 2, 4, 8):
            raise Damage(f"the block at byte {at} has record identifiers of {id_size} bytes")
        claimed, records, group = 0, set(), block.links[1]
        while group:
            group, record, size = self._group(group, id_size)
            claimed += size
            if record in records:
                raise Damage(f"two kinds of records of the block at byte {at} have the identifier {record}")
            records.add(record)
        held = self._records(block.links[2], b"DT")
        if claimed > held and not self._open & _COUNTERS_OPEN:
            raise Damage(f"the block at byte {at} claims {claimed} bytes of records and has {held}")
        return block.links[0]

    def _group(self, at: int, id_size: int) -> tuple[int, int, int]:
        """(where the next one is, identifier of its records, bytes they claim)."""
        block = self._block(at, (b"##CG",), links=6, content=32)
        record, count, flags, _, _, size, invalid = _channel_group(self._data, at)
        if flags & _REMOTE_MASTER or len(block.links) != 6 or block.end != block.content + 32:
            raise Damage(f"the block at byte {at} describes records unlike any CAN logger")
        if flags & _VARIABLE_LENGTH_GROUP:
            if block.links[1]:
                raise Damage(f"the records of the block at byte {at} have channels and no fixed length")
            return block.links[0], record, 0
        if size + invalid > _LONGEST_RECORD:
            raise Damage(f"the block at byte {at} has records of {size + invalid} bytes")
        self._channels(block.links[1], size, invalid, flags)
        return block.links[0], record, count * (size + invalid + id_size)

    def _channels(self, first: int, size: int, invalid: int, group_flags: int) -> None:
        waiting = [first]
        while waiting:
            at = waiting.pop()
            if not at:
                continue
            block = self._block(at, (b"##CN",), links=8, content=72)
            if block.end != block.content + 72:
                raise Damage(f"the block at byte {at} is too long for its content")
            self._channel(block, size, invalid)
            waiting.append(block.links[0])
            if part := block.links[1]:
                if self._data[part : part + 4] == b"##CA" and not group_flags & _BUS_EVENT:
                    continue
                waiting.append(part)

    def _channel(self, block: _Block, size: int, invalid: int) -> None:
        content = struct.unpack_from("<BBBBIIII", self._data, block.content)
        kind, _, data_type, bit, byte, bits, flags, invalid_bit = content
        if kind in _VIRTUAL:
            return
        end = byte + (bit + bits + 7) // 8
        if end > size:
            raise Damage(f"the channel at byte {block.at} ends at byte {end} of a record, the record at {size}")
        if bit > 7 or (data_type in _NUMBERS and not 0 < bits <= 64):
            raise Damage(f"the channel at byte {block.at} has {bits} bits from bit {bit} of its byte on")
        if flags & _INVALIDATION and invalid and invalid_bit >= 8 * invalid:
            raise Damage(f"the channel at byte {block.at} has its invalidation bit outside the record")
        if kind == _VALUE_ELSEWHERE:
            if bits not in (32, 64) or bit or data_type not in _TEXTS_AND_BYTES:
                raise Damage(f"the channel at byte {block.at} has its values elsewhere, at an unknown place")
            if self._data[block.links[5] : block.links[5] + 4] != b"##CG":  # its group is in the chain of groups
                self._records(block.links[5], b"SD")
        if kind == _MASTER:
            if data_type not in _REALS:
                raise Damage(f"the channel at byte {block.at} is the time and not a real number")
            if block.links[4]:
                self._conversion_of_time(block.links[4])

    def _conversion_of_time(self, at: int) -> None:
        """asammdf reads a broken one as none: microseconds would be seconds. Groups share them."""
        self._seen.discard(at)
        block = self._block(at, (b"##CC",), links=4, content=24)
        kind, _, _, _, values = struct.unpack_from("<BBHHH", self._data, block.content)
        if kind not in _LINEAR or (kind and (values != 2 or block.content + 40 > block.end)):
            raise Damage(f"the block at byte {at} gives invalid times")
        if kind:
            offset, factor = struct.unpack_from("<2d", self._data, block.content + 24)
            if not math.isfinite(offset) or not 0 < factor < math.inf:
                raise Damage(f"the block at byte {at} gives invalid times ({offset:g} + {factor:g} x)")

    def _records(self, at: int, kind: bytes) -> int:
        """Bytes of records at a link: a block of them, packed or not, or a list of such blocks."""
        held, lists = 0, 0
        waiting = [at]
        while waiting:
            at = waiting.pop()
            if not at:
                continue
            block = self._block(at, (b"##" + kind, b"##DZ", b"##DL", b"##HL"))
            if block.name == b"##DZ":
                held += self._unpacked(block, kind)
            elif block.name == b"##DL":
                waiting += block.links
                lists += 1
            elif block.name == b"##HL":
                waiting += block.links[:1]
            else:
                held += (self._size if self._open & _LENGTH_OPEN else block.end) - block.content
        if lists > 1 and self._open & (_LIST_OPEN | _LENGTH_OPEN):  # asammdf would look for their end for ever
            raise Damage("it was never finalised, and its records are in more than one list")
        return held

    def _unpacked(self, block: _Block, kind: bytes) -> int:
        if block.content + 24 > block.end:
            raise Damage(f"the block at byte {block.at} is too short for its content")
        what, way, columns, unpacked, packed = struct.unpack_from("<2sBxIQQ", self._data, block.content)
        if what != kind or way > _MOST_WAYS or (way % 2 and not columns):
            raise Damage(f"the block at byte {block.at} is not packed in a known way")
        if block.content + 24 + packed > block.end or unpacked > _MOST_INFLATED * packed:
            raise Damage(f"the block at byte {block.at} cannot hold the {unpacked} bytes it claims")
        return unpacked


def end_of_last_frame(data: Buffer) -> int | None:
    """Where the last whole frame of an unfinalised file ends: behind a record with its whole payload.

    Records of an unsorted data group: an identifier, then a fixed number of bytes, or a length and as many bytes.
    Source: ASAM MDF 4.1; checked on a real file cut at every byte of a stretch. None for a file without such a group.
    """
    try:
        found = _data_group(data)
    except (struct.error, IndexError, ValueError, RecursionError):
        return None
    if found is None:
        return None
    position, id_size, fixed, variable = found
    end, open_payloads = None, 0
    while position + id_size <= len(data):
        record = int.from_bytes(data[position : position + id_size], "little")
        if record in variable:
            if position + id_size + 4 > len(data):
                break
            size = 4 + struct.unpack_from("<I", data, position + id_size)[0]
            change = -1
        elif record in fixed:
            size, owns_payload = fixed[record]
            change = 1 if owns_payload else 0
        else:
            break
        position += id_size + size
        if position > len(data):
            break
        open_payloads += change
        if open_payloads <= 0:
            end = position
    return end


def _data_group(data: Buffer) -> tuple[int, int, dict[int, tuple[int, bool]], set[int]] | None:
    """(start of the records, bytes of an identifier, id -> (size, has a payload elsewhere), ids of such payloads)."""
    group = _links(data, 64)[0]
    first = _links(data, group)
    id_size = data[group + 24 + 8 * len(first)]
    block = first[2]
    if not id_size or data[block : block + 4] != b"##DT":
        return None
    fixed: dict[int, tuple[int, bool]] = {}
    variable: set[int] = set()
    at, seen = first[1], set()
    while at and at not in seen:
        seen.add(at)
        links = _links(data, at)
        record, _, flags, _, _, size, invalid = _channel_group(data, at)
        if flags & 1:
            variable.add(record)
        else:
            fixed[record] = (size + invalid, _has_payload_elsewhere(data, links[1]))
        at = links[0]
    return block + 24, id_size, fixed, variable


def _has_payload_elsewhere(data: Buffer, channel: int) -> bool:
    for _ in range(_MOST_CHANNELS):
        if not channel:
            return False
        links = _links(data, channel)
        if data[channel + 24 + 8 * len(links)] == 1:  # variable length
            return True
        composition = links[1]
        if composition and data[composition : composition + 4] == b"##CN" and _has_payload_elsewhere(data, composition):
            return True
        channel = links[0]
    raise ValueError("channels without end")


def _channel_group(data: Buffer, at: int) -> tuple[int, ...]:
    """Record id, number of records, flags, two more, bytes of a record, bytes of its invalidation bits."""
    return struct.unpack_from("<QQHHIII", data, at + 24 + 8 * len(_links(data, at)))


def _links(data: Buffer, at: int) -> tuple[int, ...]:
    """The links of a block; its header is 4 bytes of name, 4 reserved, length, number of links."""
    if data[at : at + 2] != b"##":
        raise ValueError("not a block")
    count = struct.unpack_from("<Q", data, at + 16)[0]
    return struct.unpack_from(f"<{count}Q", data, at + 24)
