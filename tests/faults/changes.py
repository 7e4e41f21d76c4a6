"""Alterations of datagrams on their way: bytes of packets and frames in, bytes out."""

import random
import struct
import time
from collections import deque
from collections.abc import Callable, Sequence
from functools import cache

from canedge_bridge.decode import Decoder
from st_recordings.paths import config

from .wires import Change, datagram, frame_data, identifier

STEERING = 0x002
EARTH_RADIUS = 6_371_000.0  # m
_MINUTE_MS = 60_000
_NONE: Sequence[bytes] = ()


def silent() -> Change:
    return lambda data: _NONE


def twice(data: bytes) -> Sequence[bytes]:
    return (data, data)


def signed(packet: bytearray) -> bytes:
    """Updates the three checksums of a packet."""
    packet[22] = sum(packet[1:22]) & 0xFF
    packet[61] = sum(packet[1:61]) & 0xFF
    packet[71] = sum(packet[1:71]) & 0xFF
    return bytes(packet)


def edited(edit: Callable[[bytearray], None]) -> Change:
    """Edits every packet in place and updates its checksums."""

    def change(data: bytes) -> Sequence[bytes]:
        packet = bytearray(data)
        edit(packet)
        return (signed(packet),)

    return change


def position_mode(mode: int) -> Change:
    """Sets the position mode in status channel 0."""

    def edit(packet: bytearray) -> None:
        if packet[62] == 0:
            packet[63 + 5] = mode

    return edited(edit)


def moved(latitude: float) -> Change:
    """Moves the position to the north [rad]."""

    def edit(packet: bytearray) -> None:
        packet[23:31] = struct.pack("<d", struct.unpack_from("<d", packet, 23)[0] + latitude)

    return edited(edit)


def at_latitude(latitude: float) -> Change:
    """Sets the latitude [rad], which may be impossible."""

    def edit(packet: bytearray) -> None:
        packet[23:31] = struct.pack("<d", latitude)

    return edited(edit)


YAW_RATE = slice(18, 21)  # 24 bits, little endian, right turn +


def yaw_rate_times(factor: float) -> Change:
    def edit(packet: bytearray) -> None:
        value = int.from_bytes(packet[YAW_RATE], "little", signed=True)
        packet[YAW_RATE] = round(factor * value).to_bytes(3, "little", signed=True)

    return edited(edit)


def yaw_rate_late(packets: int) -> Change:
    """Delays the yaw rate by a number of packets; the first packets get the first value."""
    rates: deque[bytes] = deque(maxlen=packets + 1)

    def edit(packet: bytearray) -> None:
        rates.append(bytes(packet[YAW_RATE]))
        packet[YAW_RATE] = rates[0]

    return edited(edit)


def shifted(milliseconds: int) -> Change:
    """Shifts the GPS time of every packet, including the minutes in status channel 0."""

    def edit(packet: bytearray) -> None:
        before = struct.unpack_from("<H", packet, 1)[0]
        minutes, after = divmod(before + milliseconds, _MINUTE_MS)
        packet[1:3] = struct.pack("<H", after)
        if packet[62] == 0:
            packet[63:67] = struct.pack("<i", struct.unpack_from("<i", packet, 63)[0] + minutes)

    return edited(edit)


class Restart:
    """A unit that is switched off and on: silent, then initialising, then locking [s since the first packet]."""

    SILENT, INITIALISING = 2.0, 4.0

    def __init__(self) -> None:
        self._since: float | None = None

    def change(self, data: bytes) -> Sequence[bytes]:
        self._since = self._since or time.monotonic()
        age = time.monotonic() - self._since
        if age < self.SILENT:
            return _NONE
        packet = bytearray(data)
        packet[21] = 2 if age < self.INITIALISING else 3
        return (signed(packet),)


class Refix:
    """A lost and regained fix: RTK float drifts to the north, then RTK integer returns to the true position."""

    FLOAT, DRIFT = 2.0, 0.4  # s, m/s
    RTK_FLOAT = 5

    def __init__(self) -> None:
        self._since: float | None = None
        self._float = position_mode(self.RTK_FLOAT)

    def change(self, data: bytes) -> Sequence[bytes]:
        self._since = self._since or time.monotonic()
        age = time.monotonic() - self._since
        if age > self.FLOAT:
            return (data,)
        (drifted,) = moved(self.DRIFT * age / EARTH_RADIUS)(data)
        return self._float(drifted)


class Random:
    """Changes each packet independently with a given probability; the same packets every time."""

    def __init__(self, probability: float):
        self._probability, self._random = probability, random.Random(1)

    def lose(self, data: bytes) -> Sequence[bytes]:
        return _NONE if self._random.random() < self._probability else (data,)

    def corrupt(self, data: bytes) -> Sequence[bytes]:
        """Changes two bytes of the north velocity such that the final checksum stays valid."""
        if self._random.random() >= self._probability:
            return (data,)
        packet = bytearray(data)
        packet[44], packet[47] = (packet[44] + 0x20) & 0xFF, (packet[47] - 0x20) & 0xFF
        return (bytes(packet),)


class Swap:
    """Swaps every pair of packets."""

    def __init__(self) -> None:
        self._held = b""

    def change(self, data: bytes) -> Sequence[bytes]:
        if not self._held:
            self._held = data
            return _NONE
        held, self._held = self._held, b""
        return (data, held)


class Burst:
    """Holds packets back, and sends them together once per period [s]."""

    def __init__(self, period: float):
        self._period, self._held, self._since = period, [], time.monotonic()

    def change(self, data: bytes) -> Sequence[bytes]:
        self._held.append(data)
        if time.monotonic() - self._since < self._period:
            return _NONE
        held, self._held, self._since = self._held, [], time.monotonic()
        return held


class Once:
    """Sends one datagram in place of all others."""

    def __init__(self, instead: bytes):
        self._instead: list[bytes] = [instead]

    def change(self, data: bytes) -> Sequence[bytes]:
        instead, self._instead = self._instead, []
        return instead


@cache
def _decoder() -> Decoder:
    return Decoder(config("can/leaf_ze0.dbc"), config("can/leaf_ze0.yaml"))


class Steering:
    """Faults of the steering sensor; all other frames pass unchanged."""

    def __init__(self) -> None:
        table = _decoder().table
        self._spec = next(m for m in table.messages.values() if m.key == (STEERING, False))
        self._first = b""
        self._jumped = False

    def wrong_checksum(self, data: bytes) -> Sequence[bytes]:
        if identifier(data) != STEERING:
            return (data,)
        frame, field = bytearray(frame_data(data)), self._spec.checksum.field
        frame[field.low_byte] ^= 1 << field.shift
        return (datagram(STEERING, bytes(frame)),)

    def stuck_counter(self, data: bytes) -> Sequence[bytes]:
        if identifier(data) != STEERING:
            return (data,)
        return (self._encoded(self._angle(frame_data(data)), 5),)

    def frozen(self, data: bytes) -> Sequence[bytes]:
        if identifier(data) != STEERING:
            return (data,)
        frame = frame_data(data)
        self._first = self._first or frame
        return (self._encoded(self._angle(self._first), self._spec.counter.field.read(frame)),)

    def flipped(self, data: bytes) -> Sequence[bytes]:
        if identifier(data) != STEERING:
            return (data,)
        frame = frame_data(data)
        return (self._encoded(-self._angle(frame), self._spec.counter.field.read(frame)),)

    def jump(self, data: bytes) -> Sequence[bytes]:
        if self._jumped or identifier(data) != STEERING:
            return (data,)
        self._jumped = True
        frame = frame_data(data)
        return (self._encoded(self._angle(frame) + 1.57, self._spec.counter.field.read(frame)),)

    def _angle(self, frame: bytes) -> float:
        (signal,) = self._spec.signals
        read = _decoder().table.database.get_message_by_name(self._spec.name).decode(frame, decode_choices=False)
        return signal.gain * read[signal.dbc.name] + signal.bias

    def _encoded(self, angle: float, counter: int) -> bytes:
        frame = _decoder().encode(self._spec.name, {"steering_wheel_angle": angle}, counter)
        return datagram(STEERING, bytes(frame.data))
