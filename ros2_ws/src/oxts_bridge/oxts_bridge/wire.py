"""How numbers lie in the 8 bytes of a status channel: reading and writing them, free of any meaning."""

import struct
from collections.abc import Callable
from typing import Any, NamedTuple


class Wire(NamedTuple):
    """read(data) -> number; write(buffer, number): an integer, of f32 a float. low..high: what fits."""

    read: Callable[[bytes], Any]
    write: Callable[[bytearray, Any], None]
    low: int
    high: int


_INTEGERS = {
    "u8": (1, False),
    "i8": (1, True),
    "u16": (2, False),
    "i16": (2, True),
    "u24": (3, False),
    "i24": (3, True),
    "u32": (4, False),
    "i32": (4, True),
    "u64": (8, False),
}


def wire(kind: str, at: int) -> Wire:
    """The reader and writer of a kind at byte `at`.

    kind: u8..u64, i8..i32 (little-endian); lo4, hi4: half a byte; bits<first>+<count>: bits of a byte,
    ibits<first>+<count>: of the inverted byte; shifted: i8 whose bit 0 is its validity; f32.
    """
    if kind in _INTEGERS:
        return _integer(at, *_INTEGERS[kind])
    if kind == "shifted":
        return _integer(at, 1, True)
    if kind == "f32":
        return Wire(
            lambda data: _F32.unpack_from(data, at)[0], lambda buffer, value: _F32.pack_into(buffer, at, value), 0, 0
        )
    if kind in ("lo4", "hi4"):
        return _bits(at, 0 if kind == "lo4" else 4, 4, 0)
    first, count = kind.partition("bits")[2].split("+")
    return _bits(at, int(first), int(count), 0xFF if kind.startswith("ibits") else 0)


def _integer(at: int, size: int, signed: bool) -> Wire:
    end = at + size
    everything = (1 << 8 * size) - 1

    def write(buffer: bytearray, number: int) -> None:
        buffer[at:end] = (number & everything).to_bytes(size, "little")

    low, high = (-(everything + 1) // 2, everything // 2) if signed else (0, everything)
    if size == 1 and not signed:
        return Wire(lambda data: data[at], write, low, high)
    if size in _STRUCTS:
        unpack = struct.Struct(f"<{_STRUCTS[size].lower() if signed else _STRUCTS[size]}").unpack_from
        return Wire(lambda data: unpack(data, at)[0], write, low, high)
    return Wire(lambda data: int.from_bytes(data[at:end], "little", signed=signed), write, low, high)


def _bits(at: int, first: int, count: int, invert: int) -> Wire:
    mask = (1 << count) - 1

    def write(buffer: bytearray, number: int) -> None:
        bits = (number ^ invert & mask) & mask
        buffer[at] = buffer[at] & ~(mask << first) & 0xFF | bits << first

    return Wire(lambda data: (data[at] ^ invert) >> first & mask, write, 0, mask)


_STRUCTS = {1: "B", 2: "H", 4: "I", 8: "Q"}
_F32 = struct.Struct("<f")
