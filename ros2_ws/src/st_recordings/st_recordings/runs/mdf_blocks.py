"""The blocks of an MDF 4 file: whether they make sense on the way to the frames, and where the last whole frame ends.

Source: ASAM MDF 4.1; checked on a real CANedge2 file cut at every byte of a stretch.
"""

import math
import mmap
import struct
from dataclasses import dataclass
from typing import NamedTuple

Buffer = bytes | mmap.mmap
_HEADER = 24  # name, reserved, length, number of links
_UNFINISHED = b"UnFinMF "
_COUNTERS_OPEN, _LENGTH_OPEN, _LIST_OPEN = 1, 4, 16  # flags of an unfinalised file: what is incomplete
_MOST_INFLATED = 1032  # deflate cannot pack tighter
_MOST_WAYS = 5  # to pack records: three, each with the columns put together first or not (odd)
_LONGEST_RECORD = 65536  # bytes; a CAN FD frame has some 90
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


@dataclass
class Layout:
    """Records of an unsorted data group: their start, bytes of an identifier, identifier -> (size, whether a payload is
    elsewhere), identifiers of such payloads."""

    start: int
    id_size: int
    fixed: dict[int, tuple[int, bool]]
    variable: set[int]


def check_blocks(data: Buffer) -> Layout | None:
    """The layout of the records of an unsorted file. Raises Damage for what is missing or wrong in the blocks that lead
    to the frames.

    asammdf does not validate these, in C either: a channel outside its record ends the process, a record of a gigabyte
    is allocated, links in a circle are followed for ever. Names, comments and sources may be cut off: not needed.
    The data block of a file that was never finalised has no length, so its end is not looked at.
    """
    if len(data) < 64 + 104:
        raise Damage(f"it ends after {len(data)} bytes, inside its header")
    return next(iter(_Walk(data).layouts), None)


class _Walk:
    """From the header to the records, every block once."""

    def __init__(self, data: Buffer):
        self._data, self._size = data, len(data)
        self._unfinished = data[:8] == _UNFINISHED
        # asammdf sets right what is open from version 4.10 on.
        self._open = struct.unpack_from("<H", data, 60)[0] if data[8:12] >= b"4.10" else 0
        self._seen: set[int] = set()
        self.layouts: list[Layout | None] = []  # of the data groups
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
        self._visit(at)
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

    def _visit(self, at: int) -> None:
        if at in self._seen:
            raise Damage(f"its index leads to byte {at} twice")
        self._seen.add(at)

    def _chain(self, at: int, name: bytes) -> None:
        """Blocks that nothing depends on, except that they come to an end."""
        while at and at + _HEADER + 8 <= self._size and self._data[at : at + 4] == name:
            self._visit(at)
            at = struct.unpack_from("<Q", self._data, at + _HEADER)[0]

    def _data_group(self, at: int) -> int:
        """Returns where the next one is."""
        block = self._block(at, (b"##DG",), links=4, content=8)
        id_size = self._data[block.content]
        if id_size not in (0, 1, 2, 4, 8):
            raise Damage(f"the block at byte {at} has record identifiers of {id_size} bytes")
        layout = Layout(block.links[2] + _HEADER, id_size, {}, set())
        claimed, group = 0, block.links[1]
        while group:
            group, size = self._group(group, layout)
            claimed += size
        unsorted = id_size and self._data[block.links[2] : block.links[2] + 4] == b"##DT"
        self.layouts.append(layout if unsorted else None)
        held = self._records(block.links[2], b"DT")
        if claimed > held and not self._open & _COUNTERS_OPEN:
            raise Damage(f"the block at byte {at} claims {claimed} bytes of records and has {held}")
        return block.links[0]

    def _group(self, at: int, layout: Layout) -> tuple[int, int]:
        """(where the next one is, bytes its records claim); adds them to the layout."""
        block = self._block(at, (b"##CG",), links=6, content=32)
        record, count, flags, _, _, size, invalid = struct.unpack_from("<QQHHIII", self._data, block.content)
        if record in layout.fixed or record in layout.variable:
            raise Damage(f"two kinds of records of the block before byte {at} have the identifier {record}")
        if flags & _REMOTE_MASTER or len(block.links) != 6 or block.end != block.content + 32:
            raise Damage(f"the block at byte {at} describes records unlike any CAN logger")
        if flags & _VARIABLE_LENGTH_GROUP:
            if block.links[1]:
                raise Damage(f"the records of the block at byte {at} have channels and no fixed length")
            layout.variable.add(record)
            return block.links[0], 0
        if size + invalid > _LONGEST_RECORD:
            raise Damage(f"the block at byte {at} has records of {size + invalid} bytes")
        layout.fixed[record] = size + invalid, self._channels(block.links[1], size, invalid, flags)
        return block.links[0], count * (size + invalid + layout.id_size)

    def _channels(self, first: int, size: int, invalid: int, group_flags: int) -> bool:
        """Whether one of them has its values elsewhere."""
        waiting, elsewhere = [first], False
        while waiting:
            at = waiting.pop()
            if not at:
                continue
            block = self._block(at, (b"##CN",), links=8, content=72)
            if block.end != block.content + 72:
                raise Damage(f"the block at byte {at} is too long for its content")
            self._channel(block, size, invalid)
            elsewhere |= self._data[block.content] == _VALUE_ELSEWHERE
            waiting.append(block.links[0])
            if part := block.links[1]:
                if self._data[part : part + 4] == b"##CA" and not group_flags & _BUS_EVENT:
                    continue
                waiting.append(part)
        return elsewhere

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
        held, lists, waiting = 0, 0, [at]
        while waiting:
            at = waiting.pop()
            if not at:
                continue
            packed = self._data[at : at + 4] == b"##DZ"
            block = self._block(at, (b"##" + kind, b"##DZ", b"##DL", b"##HL"), content=24 if packed else 0)
            if packed:
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
        what, way, columns, unpacked, packed = struct.unpack_from("<2sBxIQQ", self._data, block.content)
        if what != kind or way > _MOST_WAYS or (way % 2 and not columns):
            raise Damage(f"the block at byte {block.at} is not packed in a known way")
        if block.content + 24 + packed > block.end or unpacked > _MOST_INFLATED * packed:
            raise Damage(f"the block at byte {block.at} cannot hold the {unpacked} bytes it claims")
        return unpacked


def end_of_last_frame(data: Buffer, layout: Layout) -> int | None:
    """End of the last whole frame of an unfinalised file: behind a record with its whole payload; None without one.

    Records are an identifier, then a fixed number of bytes, or a length and as many bytes.
    """
    position, end, open_payloads = layout.start, None, 0
    while position + layout.id_size <= len(data):
        record = int.from_bytes(data[position : position + layout.id_size], "little")
        if record in layout.variable:
            if position + layout.id_size + 4 > len(data):
                break
            size = 4 + struct.unpack_from("<I", data, position + layout.id_size)[0]
            change = -1
        elif record in layout.fixed:
            size, owns_payload = layout.fixed[record]
            change = 1 if owns_payload else 0
        else:
            break
        position += layout.id_size + size
        if position > len(data):
            break
        open_payloads += change
        if open_payloads <= 0:
            end = position
    return end
