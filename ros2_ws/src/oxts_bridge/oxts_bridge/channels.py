"""Status channels (byte 62 and batch S): 8 bytes to named values and back, from the one table in channel_table.py."""

from collections.abc import Mapping

from .channel_table import LONG_RANGE_CHANNEL, TABLE, TRIGGER_CHANNELS
from .fields import Field, Value
from .gps_time import LAST_MINUTE
from .ncom import NcomError

FIELDS: dict[int, dict[str, Field]] = {
    channel: {field.name: field for field in fields} for channel, fields in TABLE.items()
}
_DECODERS = {channel: tuple((field.name, field.decoder()) for field in fields) for channel, fields in TABLE.items()}


def decode_channel(channel: int, data: bytes) -> dict[str, Value]:
    """All fields of a channel from its 8 bytes: physical value in the field's unit, None = invalid. Unknown channel:
    empty.

    Cyclic counters come as sent; status.StatusTracker unwraps them and adds what needs several channels or the time.
    """
    values = {name: decode(data) for name, decode in _DECODERS.get(channel, ())}
    # 0xFF: the numbers are saturated
    if channel == LONG_RANGE_CHANNEL and values["GAPx"] is not None and data[7] != 0xFF:
        values = {name: value * data[7] for name, value in values.items()}
    return values


def encode_channel(channel: int, values: Mapping[str, Value]) -> bytes:
    """The 8 bytes of a channel; a field left out, None or NaN becomes invalid (0 where the channel has no such mark).

    decode_channel(n, encode_channel(n, v)) gives v back within the field's resolution. Raises NcomError for an
    unknown channel or field, a code out of range, and a group with one validity byte that is given only in part.
    """
    fields = FIELDS.get(channel)
    if fields is None:
        raise NcomError(f"status channel {channel} has no published layout")
    for name in values:
        if name not in fields:
            raise NcomError(f"channel {channel} has no field {name}; it has {', '.join(fields)}")
    if channel == LONG_RANGE_CHANNEL:
        return _encode_long_range(values)
    values = {name: None if value != value else value for name, value in values.items()}  # noqa: PLR0124 - NaN
    buffer = bytearray(b"\xff" * 8)
    groups: dict[int, list[Field]] = {}
    for field in fields.values():
        if field.validity.flag is not None:
            groups.setdefault(field.validity.flag, []).append(field)
    for flag, group in groups.items():
        given = [values.get(field.name) is not None for field in group]
        if any(given) and not all(given):
            raise NcomError(f"channel {channel}: {', '.join(f.name for f in group)} are valid together or not at all")
        buffer[flag] = group[0].validity.flag_valid if any(given) else 0xFF
    if any(f.validity.text.startswith("b6 < 150") and values.get(f.name) is not None for f in fields.values()):
        buffer[6] = 0
    for field in fields.values():
        value = values.get(field.name)
        if value is not None or field.validity.flag is None:
            field.encode(buffer, value)
    return bytes(buffer)


def trigger_nanoseconds(data: bytes) -> int | None:
    """GPS time of an event since 1980-01-06 [ns] from the 8 bytes of a trigger channel, resolution 4 us; None: no
    event yet."""
    minutes = int.from_bytes(data[0:4], "little", signed=True)
    if not 0 < minutes <= LAST_MINUTE or not data[7]:
        return None
    fine = data[6] - 256 if data[6] > 127 else data[6]
    return minutes * 60_000_000_000 + int.from_bytes(data[4:6], "little") * 1_000_000 + fine * 4_000


def _encode_long_range(values: Mapping[str, Value]) -> bytes:
    lengths: list[Value] = [values.get(name) for name in ("GAPx", "GAPy", "GAPz")]
    if all(length is None for length in lengths):
        return b"\xff" * 6 + b"\xff\x00"
    if any(length is None for length in lengths):
        raise NcomError("channel 57: GAPx, GAPy, GAPz are valid together or not at all")
    factor = max(1, -(-max(abs(round(length * 1000)) for length in lengths) // 0x7FFF))
    if factor > 0xFE:
        raise NcomError(f"channel 57: a lever arm of {max(map(abs, lengths))} m does not fit (8322 m)")
    buffer = bytearray(b"\0" * 7 + bytes([factor]))
    for field, length in zip(TABLE[LONG_RANGE_CHANNEL], lengths, strict=True):
        field.encode(buffer, length / factor)
    return bytes(buffer)


def known(channel: int) -> bool:
    """Whether the layout of a channel is published; others are kept raw and counted."""
    return channel in TABLE


__all__ = ["FIELDS", "TABLE", "TRIGGER_CHANNELS", "decode_channel", "encode_channel", "known", "trigger_nanoseconds"]
