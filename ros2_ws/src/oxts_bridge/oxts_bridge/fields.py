"""Building blocks of the status channel table: where a value lies in the 8 bytes, its scale, and when it is valid."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

from .ncom import NcomError
from .wire import wire

Value: TypeAlias = Any
"""A float, int or text as the field says; None: invalid."""
Decoder = Callable[[bytes], Value]


@dataclass(frozen=True)
class Validity:
    """When a field counts.

    accepts(raw, data): raw is the field's own number, data the 8 bytes; None: always. mark: the number written for
    "invalid".
    flag: index of a byte that speaks for a whole group, written as flag_valid or 0xFF.
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
    """Valid unless the number is one of these; the first is what an encoder writes."""
    return Validity("not " + ", ".join(map(str, marks)), lambda raw, data: raw not in marks, mark=marks[0])


def aged_not(*marks: int) -> Validity:
    """As not_, and the age in b6 must be below 150."""
    return Validity(
        "b6 < 150 and not " + ", ".join(map(str, marks)),
        lambda raw, data: data[6] < 150 and raw not in marks,
        mark=marks[0],
    )


BYTE = not_(0xFF)
WORD = not_(0xFFFF)
NIBBLE = not_(0xF)

# What a validity rule sees while a value is being written: every flag byte says "valid".
_FLAGS_SET = bytes(6) + b"\0\x01"


@dataclass(frozen=True)
class Field:
    """One value of a status channel: physical = number on the wire * scale + offset.

    name: the vendor's (ours where the vendor has none).  kind: see wire.wire(), or text<n>, digits6 (i24 shown with six
    digits), constant (implied by the channel, value in offset).  at: first byte.  unit: of the physical value.
    cyclic: width in bits of a counter that wraps (the number here is not unwrapped, status.py does that).
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
        """A function from the 8 bytes to the physical value, None where the unit says "invalid"."""
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
        """Write a value (None: the invalid mark) into the 8 bytes; flags of groups are the channel's business.

        A scaled quantity is limited to what the wire can carry; a count or code that does not fit raises NcomError.
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
    """Up to the first zero byte; what is not printable is shown as \\xNN so that a CSV stays one line."""
    return "".join(chr(c) if 32 <= c < 127 else f"\\x{c:02x}" for c in data.split(b"\0")[0]) or None


def _text_bytes(text: str) -> bytes:
    return re.sub(r"\\x([0-9a-f]{2})", lambda match: chr(int(match[1], 16)), text).encode("latin-1", "replace")
