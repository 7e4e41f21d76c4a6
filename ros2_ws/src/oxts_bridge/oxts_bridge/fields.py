"""Fields of the status channel table: position in the 8 bytes, number format, scale, and rule of validity."""

import re
import struct
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

from .ncom import NcomError

Value: TypeAlias = Any
"""Float, int or text depending on the field; None: invalid."""
Decoder = Callable[[int, bytes], Value]


@dataclass(frozen=True)
class Validity:
    """Condition under which a field is valid.

    accepts(raw, data): raw is the number of the field, data the 8 bytes. mark: number written for "invalid".
    flag: index of the validity byte of a group of fields, written as flag_valid or 0xFF.
    """

    text: str
    accepts: Callable[[int, bytes], bool]
    mark: int = -1
    flag: int | None = None
    flag_valid: int = 0


ALWAYS = Validity("always", lambda raw, data: True, mark=0)

# The 8 bytes given to a validity rule while a value is encoded: every flag byte is "valid".
_FLAGS_SET = bytes(6) + b"\0\x01"
_F32 = struct.Struct("<f")
_ALIASES = {"shifted": "i8", "digits6": "i24", "lo4": "bits0+4", "hi4": "bits4+4"}


class Bits(NamedTuple):
    """Place of an integer in the 8 bytes, read as one little-endian integer of 64 bits.

    raw = ((bytes >> shift & mask ^ flip) ^ sign) - sign.  sign: weight of the sign bit, 0 for unsigned numbers.
    """

    shift: int
    mask: int
    flip: int
    sign: int


def bits_of(kind: str, at: int) -> Bits:
    """Place of a number format at byte `at`, see Field."""
    kind = _ALIASES.get(kind, kind)
    before, _, bits = kind.partition("bits")
    if bits:
        first, count = bits.split("+")
        mask = (1 << int(count)) - 1
        return Bits(8 * at + int(first), mask, mask if before == "i" else 0, 0)
    width = int(kind[1:])
    return Bits(8 * at, (1 << width) - 1, 0, 1 << width - 1 if kind[0] == "i" else 0)


@dataclass(frozen=True)
class Field:
    """One value of a status channel: physical = number on the wire * scale + offset.

    name: the vendor's, or the project's where the vendor has none.  kind: see wire(), or text<n>, digits6 (i24 shown
    with six digits), constant (implied by the channel, value in offset).  at: first byte.  unit: of the physical value.
    cyclic: width in bits of a counter that wraps (unwrapped by status.StatusTracker).
    """

    name: str
    kind: str
    at: int
    unit: str = "1"
    scale: float = 1
    offset: float = 0
    validity: Validity = ALWAYS
    cyclic: int = 0

    def decoder(self) -> Decoder:
        """A function from the 8 bytes, as one integer and as bytes, to the physical value, None where it is invalid."""
        at, scale, offset, accepts = self.at, self.scale, self.offset, self.validity.accepts
        if self.kind == "constant":
            return lambda word, data: int(offset)
        if self.kind.startswith("text"):
            end = at + int(self.kind[4:])
            return lambda word, data: _text(data[at:end])
        if self.kind == "f32":  # negative = invalid; so is NaN
            return lambda word, data: value if (value := _F32.unpack_from(data, at)[0]) >= 0 else None
        shift, mask, flip, sign = bits_of(self.kind, at)
        if self.kind == "digits6":
            return lambda word, data: f"{raw:06d}" if (raw := (word >> shift & mask ^ sign) - sign) >= 0 else None
        if self.kind == "shifted":
            return lambda word, data: (raw >> 1) * scale if (raw := (word >> shift & mask ^ sign) - sign) & 1 else None
        if scale == 1 and not offset:
            return lambda word, data: (
                raw if accepts(raw := ((word >> shift & mask ^ flip) ^ sign) - sign, data) else None)
        return lambda word, data: (
            raw * scale + offset if accepts(raw := ((word >> shift & mask ^ flip) ^ sign) - sign, data) else None)

    def encode(self, buffer: bytearray, value: Value) -> None:
        """Write a value (None: the invalid mark) into the 8 bytes; encode_fields() writes the flags of groups.

        A scaled quantity is limited to the range of the format; a count or code that does not fit raises NcomError.
        """
        if self.kind == "constant":
            return
        if self.kind.startswith("text"):
            size = int(self.kind[4:])
            text = re.sub(r"\\x([0-9a-f]{2})", lambda match: chr(int(match[1], 16)), str(value or ""))
            buffer[self.at : self.at + size] = text.encode("latin-1", "replace")[:size].ljust(size, b"\0")
            return
        if self.kind == "f32":
            _F32.pack_into(buffer, self.at, -1.0 if value is None else value)
            return
        shift, mask, flip, _ = bits_of(self.kind, self.at)
        number = self.validity.mark if value is None else self._number(value)
        others = int.from_bytes(buffer, "little") & ~(mask << shift)
        buffer[:] = (others | (number & mask ^ flip) << shift).to_bytes(8, "little")

    def _number(self, value: float | int | str) -> int:
        """The valid number on the wire nearest to a value."""
        plain = self.scale == 1 and not self.offset
        _, mask, _, sign = bits_of(self.kind, self.at)
        low, high = -sign, mask - sign
        number = int(value) if plain else round(max(low, min(high, (float(value) - self.offset) / self.scale)))
        if self.kind == "shifted":
            return max(-64, min(63, number)) << 1 | 1
        accepts = self.validity.accepts
        if low <= number <= high and accepts(number, _FLAGS_SET):
            return number
        if plain:
            raise NcomError(f"{self.name}: {value} does not fit ({low} to {high}, {self.validity.text})")
        while not accepts(number, _FLAGS_SET):
            number += 1 if number <= 0 else -1
        return number


def encode_fields(channel: int, fields: Collection[Field], values: Mapping[str, Value]) -> bytes:
    """The 8 bytes of the fields of a channel, see channels.encode_channel()."""
    values = {name: None if value != value else value for name, value in values.items()}  # noqa: PLR0124 - NaN
    buffer = bytearray(b"\xff" * 8)
    groups: dict[int, list[Field]] = {}
    for field in fields:
        if field.validity.flag is not None:
            groups.setdefault(field.validity.flag, []).append(field)
    for flag, group in groups.items():
        given = [values.get(field.name) is not None for field in group]
        if any(given) and not all(given):
            raise NcomError(f"channel {channel}: {', '.join(f.name for f in group)} are valid together or not at all")
        buffer[flag] = group[0].validity.flag_valid if any(given) else 0xFF
    if any(f.validity.text.startswith("b6 < 150") and values.get(f.name) is not None for f in fields):
        buffer[6] = 0
    for field in fields:
        value = values.get(field.name)
        if value is not None or field.validity.flag is None:
            field.encode(buffer, value)
    return bytes(buffer)


def _text(data: bytes) -> str | None:
    """Text up to the first zero byte; unprintable bytes are written as \\xNN so that a CSV row stays one line."""
    return "".join(chr(c) if 32 <= c < 127 else f"\\x{c:02x}" for c in data.split(b"\0")[0]) or None
