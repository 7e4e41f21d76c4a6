"""Fields of the status channel table: position in the 8 bytes, number format, scale, and rule of validity."""

import re
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

from .ncom import NcomError

Value: TypeAlias = Any
"""Float, int or text depending on the field; None: invalid."""
Decoder = Callable[[bytes], Value]


@dataclass(frozen=True)
class Validity:
    """Condition under which a field is valid.

    accepts(raw, data): raw is the number of the field, data the 8 bytes; None: always valid. mark: number written for
    "invalid". flag: index of the validity byte of a group of fields, written as flag_valid or 0xFF.
    """

    text: str
    accepts: Callable[[int, bytes], bool] | None = None
    mark: int = -1
    flag: int | None = None
    flag_valid: int = 0


ALWAYS = Validity("always", mark=0)
AGE = Validity("b6 < 150", lambda raw, data: data[6] < 150, flag=6)
ZERO = Validity("b6 = 0", lambda raw, data: data[6] == 0, flag=6)
NOT_255 = Validity("b6 < 255", lambda raw, data: data[6] < 255, flag=6)
HIGH_BIT = Validity("bit 7 = 0", lambda raw, data: raw < 0x80, mark=0xFF)
NOT_NEGATIVE = Validity(">= 0", lambda raw, data: raw >= 0, mark=-1)
POSITIVE = Validity("> 0", lambda raw, data: raw > 0, mark=0)
BIT0 = Validity("bit 0 = 1", lambda raw, data: bool(raw & 1), mark=0)
MINUTE_MS = Validity("< 60000", lambda raw, data: raw < 60000, mark=0xFFFF)
GPS_MINUTE = Validity(">= 1000", lambda raw, data: raw >= 1000, mark=0)
OMNISTAR_STATUS = Validity("b4 < 255", lambda raw, data: data[4] < 255, flag=4)
INVERTED_B6 = Validity("bit 7 of b6 = 0", lambda raw, data: data[6] < 0x80, flag=6, flag_valid=0x7F)
INVERTED_B7 = Validity("bit 7 of b7 = 0", lambda raw, data: data[7] < 0x80, flag=7, flag_valid=0x7F)
LONG_RANGE = Validity("b6 < 150 and b7 > 0", lambda raw, data: data[6] < 150 and data[7] != 0, flag=6)


def not_(*marks: int) -> Validity:
    """Valid unless the number is one of the marks; the first is the one that encoders write."""
    return Validity("not " + ", ".join(map(str, marks)), lambda raw, data: raw not in marks, mark=marks[0])


def aged_not(*marks: int) -> Validity:
    """As not_(), and the age in b6 must be below 150."""
    return Validity(
        "b6 < 150 and not " + ", ".join(map(str, marks)),
        lambda raw, data: data[6] < 150 and raw not in marks,
        mark=marks[0],
    )


BYTE = not_(0xFF)
WORD = not_(0xFFFF)
NIBBLE = not_(0xF)

# The 8 bytes given to a validity rule while a value is encoded: every flag byte is "valid".
_FLAGS_SET = bytes(6) + b"\0\x01"


class Wire(NamedTuple):
    """Number format in the 8 bytes: read(data) -> number; write(buffer, number), a float for f32. low..high: range."""

    read: Callable[[bytes], Any]
    write: Callable[[bytearray, Any], None]
    low: int
    high: int


_INTEGERS = {"u8": (1, False), "i8": (1, True), "u16": (2, False), "i16": (2, True), "u24": (3, False),
             "i24": (3, True), "u32": (4, False), "i32": (4, True), "u64": (8, False)}
_STRUCTS = {1: "B", 2: "H", 4: "I", 8: "Q"}
_F32 = struct.Struct("<f")


def wire(kind: str, at: int) -> Wire:
    """Reader and writer of a number format at byte `at`.

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


@dataclass(frozen=True)
class Field:
    """One value of a status channel: physical = number on the wire * scale + offset.

    name: the vendor's, or the project's where the vendor has none.  kind: see wire(), or text<n>, digits6 (i24 shown
    with six digits), constant (implied by the channel, value in offset).  at: first byte.  unit: of the physical value.
    cyclic: width in bits of a counter that wraps (unwrapped by status.StatusTracker).
    manual: documented by the manual only, unknown to the vendor's public decoder.
    """

    name: str
    kind: str
    at: int
    unit: str = "1"
    scale: float = 1
    offset: float = 0
    validity: Validity = ALWAYS
    cyclic: int = 0
    manual: bool = False

    def decoder(self) -> Decoder:
        """A function from the 8 bytes to the physical value, None where it is invalid."""
        at, scale, offset, accepts = self.at, self.scale, self.offset, self.validity.accepts
        if self.kind == "constant":
            return lambda data: int(offset)
        if self.kind.startswith("text"):
            end = at + int(self.kind[4:])
            return lambda data: _text(data[at:end])
        read = wire(_wire_kind(self.kind), at).read
        if self.kind == "f32":
            return lambda data: value if (value := read(data)) >= 0 else None  # negative = invalid; so is NaN
        if self.kind == "digits6":
            return lambda data: f"{raw:06d}" if (raw := read(data)) >= 0 else None
        if self.kind == "shifted":
            return lambda data: (raw >> 1) * scale if (raw := read(data)) & 1 else None
        if accepts is None:
            return read if scale == 1 and not offset else lambda data: read(data) * scale + offset
        if scale == 1 and not offset:
            return lambda data: raw if accepts(raw := read(data), data) else None
        return lambda data: raw * scale + offset if accepts(raw := read(data), data) else None

    def encode(self, buffer: bytearray, value: Value) -> None:
        """Write a value (None: the invalid mark) into the 8 bytes; encode_channel() writes the flags of groups.

        A scaled quantity is limited to the range of the format; a count or code that does not fit raises NcomError.
        """
        if self.kind == "constant":
            return
        if self.kind.startswith("text"):
            size = int(self.kind[4:])
            buffer[self.at : self.at + size] = _text_bytes(str(value or ""))[:size].ljust(size, b"\0")
            return
        write = wire(_wire_kind(self.kind), self.at).write
        if self.kind == "f32":
            write(buffer, -1.0 if value is None else value)
        else:
            write(buffer, self.validity.mark if value is None else self._number(value))

    def _number(self, value: float | int | str) -> int:
        plain = self.scale == 1 and not self.offset
        line = wire(_wire_kind(self.kind), self.at)
        if plain:
            number = int(value)
        else:
            number = round(max(line.low, min(line.high, (float(value) - self.offset) / self.scale)))
        if self.kind == "shifted":
            return max(-64, min(63, number)) << 1 | 1
        accepts = self.validity.accepts or (lambda raw, data: True)
        if line.low <= number <= line.high and accepts(number, _FLAGS_SET):
            return number
        if plain:
            raise NcomError(f"{self.name}: {value} does not fit ({line.low} to {line.high}, {self.validity.text})")
        while not accepts(number, _FLAGS_SET):
            number += 1 if number <= 0 else -1
        return number


def _wire_kind(kind: str) -> str:
    return "i24" if kind == "digits6" else kind


def _text(data: bytes) -> str | None:
    """Text up to the first zero byte; unprintable bytes are written as \\xNN so that a CSV row stays one line."""
    return "".join(chr(c) if 32 <= c < 127 else f"\\x{c:02x}" for c in data.split(b"\0")[0]) or None


def _text_bytes(text: str) -> bytes:
    return re.sub(r"\\x([0-9a-f]{2})", lambda match: chr(int(match[1], 16)), text).encode("latin-1", "replace")
