"""Verifies and computes the counters and checksums of CAN messages."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum


class Mode(StrEnum):
    """Reaction to a wrong counter or checksum: OFF: none, WARN: pass the frame on as invalid, DROP: discard it."""

    OFF = "off"
    WARN = "warn"
    DROP = "drop"


def xor_nibble(data: bytes, arbitration_id: int) -> int:
    """The check nibble for which the XOR of all nibbles of the frame is 0; data: payload with the check nibble at 0.

    Source: derived from 1963 recorded frames of 0x002, all at one steering angle.
    """
    value = 0
    for byte in data:
        value ^= byte
    return (value >> 4) ^ (value & 0xF)


def sum8_id(data: bytes, arbitration_id: int) -> int:
    """Low byte of the sum of all bytes and both bytes of the identifier; data: payload with the check byte at 0.

    Source: derived from 3247 recorded frames of 0x284 at up to 100 km/h, 2035 of 0x284 and 0x285 at rest.
    """
    return (sum(data) + (arbitration_id >> 8) + (arbitration_id & 0xFF)) & 0xFF


@dataclass(frozen=True)
class Rule:
    """A checksum. bits: width. compute: computes it from the payload, with these bits at 0, and the arbitration id."""

    bits: int
    compute: Callable[[bytes, int], int]


RULES = {"xor_nibble": Rule(4, xor_nibble), "sum8_id": Rule(8, sum8_id)}


@dataclass(frozen=True)
class Field:
    """Position of an unsigned counter or checksum of at most 8 bits, within one byte of a frame.

    byte: index in the payload. shift: number of bits below the field in that byte. bits: width of the field.
    """

    byte: int
    shift: int
    bits: int

    @property
    def mask(self) -> int:
        return (1 << self.bits) - 1

    def read(self, data: bytes) -> int:
        return (data[self.byte] >> self.shift) & self.mask

    def with_value(self, data: bytes, value: int) -> bytes:
        changed = bytearray(data)
        changed[self.byte] = changed[self.byte] & ~(self.mask << self.shift) & 0xFF | (value & self.mask) << self.shift
        return bytes(changed)


def compute_checksum(rule: Rule, field: Field, data: bytes, arbitration_id: int) -> int:
    """The correct checksum of a frame; the bits of `field` in `data` are ignored."""
    return rule.compute(field.with_value(data, 0), arbitration_id)


class CounterCheck:
    """Checks the counter of one message.

    Every step other than +1 is a fault; a step of k > 1 counts as k - 1 lost frames (modulo the counter's range). The
    received value is always the new reference, so one lost frame counts as one fault. The first frame, and the first
    after a gap longer than `restart_after_ns`, are not checked.
    """

    def __init__(self, field: Field, restart_after_ns: int):
        self._field = field
        self._restart_after_ns = restart_after_ns
        self._last: int | None = None
        self._last_ns = 0
        self.lost = 0

    def accepts(self, data: bytes, time_ns: int) -> bool:
        value = self._field.read(data)
        last, last_ns = self._last, self._last_ns
        self._last, self._last_ns = value, time_ns
        if last is None or not 0 <= time_ns - last_ns <= self._restart_after_ns:
            return True
        step = (value - last) & self._field.mask
        self.lost += max(step - 1, 0)
        return step == 1

    def skip(self, time_ns: int) -> None:
        """Assume that a frame with invalid content has the next counter value."""
        if self._last is not None:
            self._last = (self._last + 1) & self._field.mask
            self._last_ns = time_ns
