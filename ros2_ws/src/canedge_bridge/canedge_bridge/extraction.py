"""Extracts physical values of DBC signals from one frame, or from all frames of a log at once.

The same code serves both: `data` is the bytes of one frame, or an array (length, n) from `stack_bytes` with byte k of
n frames in row k. `data[k]` is therefore a number or an array. Checked by: test_extraction.py, against cantools.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from cantools.database.can import Message as DbcMessage
from cantools.database.can import Signal as DbcSignal

EXTENDED = 0x8000_0000  # flag of a 29-bit identifier, as in DBC files and in Linux
PADDING = frozenset((0x00, 0x55, 0xAA, 0xCC, 0xFF))
"""Bytes that controllers append to fill a frame up to the next valid length."""

Data = bytes | np.ndarray


def strip_padding(data: bytes, length: int) -> bytes | None:
    """The first `length` bytes of a frame; None if it is shorter, or if anything but equal padding bytes follows."""
    tail = data[length:]
    if len(data) < length or (tail and (tail[0] not in PADDING or tail.count(tail[0]) != len(tail))):
        return None
    return data[:length]


def has_length(payload: np.ndarray, lengths: np.ndarray, length: int) -> np.ndarray:
    """Mask (n,) of the frames that `strip_padding` accepts. payload: (n, width) uint8. lengths: (n,), in bytes."""
    is_accepted = lengths == length
    longer = np.flatnonzero(lengths > length)
    if longer.size:
        tail = payload[longer, length:]
        inside = np.arange(length, payload.shape[1]) < lengths[longer, None]
        is_accepted[longer] = np.isin(tail[:, 0], list(PADDING)) & ((tail == tail[:, :1]) | ~inside).all(axis=1)
    return is_accepted


def stack_bytes(payload: np.ndarray, length: int) -> np.ndarray:
    """The first `length` bytes of n frames, (length, n) uint64: one row per byte. payload: (n, >= length) uint8."""
    return payload[:, :length].T.astype(np.uint64, order="C")


def raw_range(signal: DbcSignal) -> tuple[int, int]:
    """Smallest and largest integer that a signal can hold."""
    lowest = -(1 << signal.length - 1) if signal.is_signed else 0
    return lowest, lowest + (1 << signal.length) - 1


@dataclass(frozen=True)
class Field:
    """Position of an unsigned integer of up to 64 bits in a frame."""

    high_bytes: tuple[int, ...]  # indices of the bytes above low_byte, most significant first
    low_byte: int  # index of the least significant byte
    shift: int  # number of bits in low_byte below the integer
    bits: int  # width

    @classmethod
    def from_signal(cls, signal: DbcSignal) -> "Field":
        first, bit = divmod(signal.start, 8)
        if signal.byte_order == "little_endian":  # the start bit is the lowest
            last = first + (bit + signal.length - 1) // 8
            return cls(tuple(range(last, first, -1)), first, bit, signal.length)
        last, from_highest = divmod(8 * first + 7 - bit + signal.length - 1, 8)  # the start bit is the highest
        return cls(tuple(range(first, last)), last, 7 - from_highest, signal.length)

    @cached_property
    def mask(self) -> int:
        return (1 << self.bits) - 1

    def read(self, data: Data) -> Any:
        number = 0
        for k in self.high_bytes:
            number = number << 8 | data[k]
        # The lowest byte is shifted before it is added: 64 bits can span nine bytes, which do not fit into a uint64.
        return (number << 8 - self.shift | data[self.low_byte] >> self.shift) & self.mask


class Extractor:
    """Extracts the physical value of one DBC signal: scale * raw value + offset. selectors: (field, values) of the
    multiplexers; the signal is in the frame if each field has one of its values."""

    def __init__(self, message: DbcMessage, signal: DbcSignal) -> None:
        is_float = signal.conversion.is_float
        self.signal, self._field = signal, Field.from_signal(signal)
        self._sign_bit = 1 << signal.length - 1 if signal.is_signed and not is_float else 0
        self._float_bytes = signal.length // 8 if is_float else 0
        self._scale, self._offset = signal.scale, signal.offset
        self.selectors: list[tuple[Field, tuple[int, ...]]] = []
        while signal.multiplexer_signal:
            multiplexer = message.get_signal_by_name(signal.multiplexer_signal)
            self.selectors.append((Field.from_signal(multiplexer), tuple(signal.multiplexer_ids or ())))
            signal = multiplexer

    def is_present(self, data: Data) -> Any:
        """Whether the signal is in the frame; True, not an array, for a signal that is not multiplexed."""
        is_present: Any = True
        for field, values in self.selectors:
            number, is_selected = field.read(data), False
            for value in values:
                is_selected = is_selected | (number == value)
            is_present = is_present & is_selected
        return is_present

    def extract(self, data: Data) -> Any:
        """Physical value in the unit of the DBC."""
        number = self._field.read(data)
        if self._sign_bit:
            number = number - ((number & self._sign_bit) << 1)  # two's complement; uint64 arrays wrap modulo 2**64
        if self._float_bytes:
            number = np.asarray(number, f"u{self._float_bytes}").view(f"f{self._float_bytes}").astype(np.float64)
        elif isinstance(number, np.ndarray):
            number = number.view(np.int64 if self._sign_bit else np.uint64).astype(np.float64)
        return number * self._scale + self._offset
