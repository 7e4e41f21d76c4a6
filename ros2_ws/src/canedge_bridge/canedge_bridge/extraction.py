"""SI values of some signals of a frame: the payload as one integer, a shift and a mask for each.

cantools decodes every signal of a message into a dictionary, which takes up to twenty times as long. What it says is
what is said here, to the last bit. Checked by: test_extraction.py.
"""

import struct
from collections.abc import Sequence

from cantools.database.can import Signal as DbcSignal

from .signals import ANGLES, SignalSpec, wrap

_FLOATS = {16: struct.Struct("<e"), 32: struct.Struct("<f"), 64: struct.Struct("<d")}


class Extractor:
    """The signals of one message of `length` bytes that is neither multiplexed nor a container."""

    def __init__(self, length: int, signals: Sequence[SignalSpec]):
        self._big_endian = any(s.dbc.byte_order == "big_endian" for s in signals)
        self._places = tuple(
            (s.name, s.dbc.byte_order == "big_endian", _shift(s.dbc, length), (1 << s.dbc.length) - 1,
             1 << (s.dbc.length - 1) if s.dbc.is_signed and not s.dbc.is_float else 0,
             _FLOATS[s.dbc.length] if s.dbc.is_float else None,
             s.dbc.scale, s.dbc.offset, s.gain, s.bias, s.name in ANGLES)
            for s in signals)

    def si(self, data: bytes) -> dict[str, float]:
        """Our name -> value. data: as many bytes as the message has."""
        little = int.from_bytes(data, "little")
        big = int.from_bytes(data, "big") if self._big_endian else 0
        values = {}
        for name, from_big, shift, mask, sign, floating, scale, offset, gain, bias, is_angle in self._places:
            raw = (big if from_big else little) >> shift & mask
            if raw & sign:
                raw -= mask + 1
            elif floating is not None:
                raw = floating.unpack(raw.to_bytes(floating.size, "little"))[0]
            value = gain * (raw * scale + offset) + bias
            values[name] = wrap(value) if is_angle else value
        return values


def _shift(signal: DbcSignal, length: int) -> int:
    """Of the signal's lowest bit in the payload as an integer of its byte order."""
    if signal.byte_order == "little_endian":
        return signal.start
    # The DBC counts bits of a byte from its low end, bytes from the front; the integer's top bit is byte 0, bit 7.
    first_bit = 8 * (signal.start // 8) + 7 - signal.start % 8
    return 8 * length - first_bit - signal.length
