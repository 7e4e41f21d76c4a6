"""Bytes from anywhere, in any portions, to timed NCOM packets. Never raises on what the bytes hold."""

from dataclasses import dataclass

from . import channels, gps_time
from .gps_time import DUPLICATE, LATE, NEW, SAME, GpsClock, unix_nanoseconds
from .navigation import BY_STATUS, MINUTE_STATUSES, STATUS_ONLY, Rule
from .ncom import NAN, PACKET_SIZE, STATUS_AT, STRUCTURE_B, Packet, decode_unchecked, inner_checksums_match, is_place
from .resync import Counters, next_packet

_NO_VECTOR = (NAN, NAN, NAN)


@dataclass(slots=True)
class Received:
    """One accepted packet.

    packet: its values; parts that its navigation status declares invalid are NaN.  raw: its 72 bytes.
    offset: of its first byte in the stream.  kind: regular, status, trigger or empty (nothing in it may be used).
    gps_ns: GPS time since 1980-01-06 of the measurement or event [ns], None while unknown.  utc_ns: the same as UTC
    since 1970.
    order: NEW, or SAME (instant as the packet before), DUPLICATE (all bytes too), LATE (older than one already seen).
    received_ns: when the host got it, as given to feed().
    """

    packet: Packet
    raw: bytes
    offset: int
    kind: str
    rule: Rule
    gps_ns: int | None
    utc_ns: int | None
    order: int
    received_ns: int | None

    @property
    def fresh(self) -> bool:
        """Whether this is news: a consumer that publishes only fresh packets never publishes an instant twice or
        backwards."""
        return self.order == NEW


class NcomParser:
    """Streaming parser with its own clock. Feed datagrams or pieces of a file; portions may cut packets anywhere."""

    def __init__(self) -> None:
        self.clock = GpsClock()
        self.counters = Counters()
        self.utc_offset: int | None = None
        self._tail = b""
        self._consumed = 0
        self._in_step = True
        self._last_raw = b""
        self._last_trigger = b""

    @property
    def time_jumps(self) -> int:
        return self.clock.jumps

    def restart(self) -> None:
        """Forget the time and the remains of a cut packet: what comes next is another stream. Counters go on."""
        jumps, self.clock = self.clock.jumps, GpsClock()
        self.clock.jumps = jumps
        self._tail, self._in_step = b"", True

    def feed(self, data: bytes, received_ns: int | None = None) -> list[Received]:
        """All packets completed by these bytes, in order. received_ns: host receive time of the bytes [ns since
        1970]."""
        buffer = self._tail + data if self._tail else bytes(data)
        size = len(buffer)
        packets: list[Received] = []
        at = 0
        while True:
            at, self._in_step = next_packet(buffer, at, self._in_step, self.counters)
            if size - at < PACKET_SIZE:
                break
            received = self._accept(buffer[at : at + PACKET_SIZE], self._consumed + at, received_ns)
            if received is not None:
                packets.append(received)
            at += PACKET_SIZE
        self._tail = buffer[at:]
        self._consumed += at
        return packets

    def _accept(self, raw: bytes, offset: int, received_ns: int | None) -> Received | None:
        counters = self.counters
        counters.packets += 1
        status = raw[STATUS_AT]
        if status == STRUCTURE_B:
            counters.structure_b += 1
            return None
        if not inner_checksums_match(raw):
            counters.inner_checksum_warnings += 1
        rule = BY_STATUS[status]
        packet = decode_unchecked(raw)
        kind = rule.kind
        order = NEW
        gps_ns: int | None = None
        minute = self._status_channel(packet, status) if rule.status else None
        if rule.time:
            gps_ns, order = self._step(packet, raw, minute, received_ns)
        elif rule.trigger:
            gps_ns, order = self._trigger(packet, raw)
            if gps_ns is None:
                kind = "empty"
        elif not rule.known:
            counters.unknown_statuses += 1
        counters.impossible_positions += _mask(packet, rule, kind)
        utc_ns = None if gps_ns is None else unix_nanoseconds(gps_ns, self.utc_offset)
        return Received(packet, raw, offset, kind, rule, gps_ns, utc_ns, order, received_ns)

    def _step(self, packet: Packet, raw: bytes, minute: int | None, received_ns: int | None) -> tuple[int | None, int]:
        """GPS time [ns] and order of a measurement."""
        gps_ms, order = self.clock.step(packet.milliseconds, minute, received_ns)
        if order == SAME and raw == self._last_raw:
            order = DUPLICATE
            self.counters.duplicates += 1
        elif order == LATE:
            self.counters.late += 1
        self._last_raw = raw
        return None if gps_ms is None else gps_ms * 1_000_000, order

    def _trigger(self, packet: Packet, raw: bytes) -> tuple[int | None, int]:
        """GPS time [ns] and order of an event; no time where the packet holds none."""
        self.counters.triggers += 1
        before, self._last_trigger = self._last_trigger, raw
        if packet.channel not in channels.TRIGGER_CHANNELS:
            return None, NEW
        gps_ns = channels.trigger_nanoseconds(packet.batch_s)
        if gps_ns is None or raw != before:
            return gps_ns, NEW
        self.counters.duplicates += 1
        return gps_ns, DUPLICATE

    def _status_channel(self, packet: Packet, status: int) -> int | None:
        """What the clock needs from batch S; returns the minute of channel 0 if it is there and valid."""
        channel = packet.channel
        if not channels.known(channel):
            self.counters.unknown_channels += 1
        if status not in MINUTE_STATUSES:
            return None
        if channel == gps_time.UTC_CHANNEL and (offset := gps_time.sent_utc_offset(packet.batch_s[7])) is not None:
            self.utc_offset = offset
        if channel != 0:
            return None
        minute = int.from_bytes(packet.batch_s[0:4], "little", signed=True)
        if not gps_time.FIRST_MINUTE <= minute <= gps_time.LAST_MINUTE:
            return None
        if status == STATUS_ONLY:
            self.clock.hint(minute)
        return minute


def _mask(packet: Packet, rule: Rule, kind: str) -> bool:
    """NaN for what the navigation status declares invalid, and for positions that are none: then True."""
    if kind == "empty" or not rule.imu:
        packet.acceleration = packet.angular_rate = _NO_VECTOR
    if kind == "empty" or rule.navigation == "none":
        packet.latitude = packet.longitude = packet.altitude = NAN
        packet.velocity_ned = _NO_VECTOR
        packet.heading = packet.pitch = packet.roll = NAN
    elif not is_place(packet.latitude, packet.longitude, packet.altitude):
        packet.latitude = packet.longitude = packet.altitude = NAN
        return True
    return False
