"""Status channels (byte 62 and batch S): 8 bytes to named values and back by channel_table.py; names of GNSS modes.

Source of the modes: ncom.md section 8.
"""

from collections.abc import Mapping

from .channel_table import LONG_RANGE_CHANNEL, TABLE
from .fields import Field, Value
from .ncom import NcomError
from .packet_time import LAST_MINUTE

FIELDS: dict[int, dict[str, Field]] = {
    channel: {field.name: field for field in fields} for channel, fields in TABLE.items()
}
_DECODERS = {channel: tuple((field.name, field.decoder()) for field in fields) for channel, fields in TABLE.items()}
UTC_CHANNEL = 16
_READ_UTC_OFFSET = FIELDS[UTC_CHANNEL]["TimeUtcOffset"].decoder()


def decode_channel(channel: int, data: bytes) -> dict[str, Value]:
    """All fields of a channel by name: physical value in the unit of the table, None = invalid. Unknown channel: empty.

    Cyclic counters are returned as sent; status.StatusTracker unwraps them and adds values that depend on several
    channels or on the time.
    """
    values = {name: decode(data) for name, decode in _DECODERS.get(channel, ())}
    # 0xFF: the numbers are saturated
    if channel == LONG_RANGE_CHANNEL and values["GAPx"] is not None and data[7] != 0xFF:
        values = {name: value * data[7] for name, value in values.items()}
    return values


def encode_channel(channel: int, values: Mapping[str, Value]) -> bytes:
    """The 8 bytes of a channel; a missing field, None or NaN becomes invalid (0 where the field has no such mark).

    decode_channel(n, encode_channel(n, v)) equals v within the resolution of each field. Raises NcomError for an
    unknown channel or field, a code out of range, and an incomplete group of values with one validity byte.
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
    """GPS time of an event [ns since 1980-01-06] from the 8 bytes of a trigger channel, resolution 4 us.

    None: no event yet.
    """
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


def utc_offset(data: bytes) -> int | None:
    """UTC - GPS time [s] from the 8 bytes of channel 16; None if invalid or positive (UTC is never ahead of GPS)."""
    offset = _READ_UTC_OFFSET(data)
    return None if offset is None or offset > 0 else int(offset)


def known(channel: int) -> bool:
    """Whether the layout of a channel is published; other channels are counted and not decoded."""
    return channel in TABLE


_POST = ("Doppler", "SPS", "differential", "float", "integer")
MODES = dict(enumerate((
    "none", "search", "Doppler", "SPS", "differential", "RTK float", "RTK integer", "SBAS", "OmniSTAR VBS",
    "OmniSTAR HP", "no data", "blanked", *(f"post-processed {name}" for name in _POST), "OmniSTAR XP", "CDGPS",
    "not recognised", *(f"gx {name}" for name in _POST), *(f"ix {name}" for name in _POST), "PPP converging", "PPP",
    "unknown")))

NO_FIX, FIX, SBAS_FIX, GBAS_FIX = -1, 0, 1, 2
_STATUS = {
    **dict.fromkeys((3, 13, 21, 26), FIX),
    **dict.fromkeys((7, 8, 9, 17, 18, 30, 31), SBAS_FIX),
    **dict.fromkeys((4, 5, 6, 14, 15, 16, 22, 23, 24, 27, 28, 29), GBAS_FIX),
}
_QUALITY = {mode: rank for rank, mode in enumerate((0, 1, 2, 3, 7, 4, 5, 6))}


def mode_text(mode: int | None) -> str:
    """Name of a position, velocity or orientation mode; empty before the first, "unknown (n)" without a name."""
    return "" if mode is None else MODES.get(mode, f"unknown ({mode})")


def quality(mode: int | None) -> int:
    """Rank of a live GNSS mode, none 0 to RTK integer 7; -1 for other modes, which have no order."""
    return -1 if mode is None else _QUALITY.get(mode, -1)


def fix_status(mode: int | None) -> int:
    """NavSatStatus.status of a position mode. NO_FIX for unknown numbers and before the first."""
    return NO_FIX if mode is None else _STATUS.get(mode, NO_FIX)
