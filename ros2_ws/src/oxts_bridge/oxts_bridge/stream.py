"""Parses a byte stream, given in pieces of any size, into timed NCOM packets; no input raises an exception."""

from collections import deque
from dataclasses import dataclass
from statistics import median

from . import channels, ncom
from .ncom import DUPLICATE, LATE, NEW, SAME, Counters, GpsClock, Packet, StatusRule

_NO_VECTOR = (ncom.NAN, ncom.NAN, ncom.NAN)
HOST_MINUTE_DELAY_NS = 2_000_000_000  # time without channel 0 after which the minute is taken from the host's clock
GAP_STEP_RATIO = 1.75  # a step longer than this many typical steps is a gap
_CLOCK_SAMPLES = 1000  # number of stored clock offsets: four seconds at 250 Hz


@dataclass(slots=True)
class ReceivedPacket:
    """One accepted packet."""

    packet: Packet  # values, NaN if invalid or, for a position, impossible
    raw: bytes  # the 72 bytes
    offset: int  # index of the first byte in the stream
    kind: str  # regular, status, trigger or empty (no valid part)
    rule: StatusRule
    gps_ns: int | None  # GPS time of the measurement or event [ns since 1980-01-06], None while unknown
    utc_ns: int | None  # the same time in UTC [ns since 1970]
    order: int  # relative to the newest packet: NEW (newer), SAME (equal time), DUPLICATE (equal bytes), LATE (older)
    # GPS time of an event (edge of an input or output), if this packet is the first to report it, else None. The status
    # channel identifies the input or output and its edge; byte 7 of batch S counts the events.
    event_ns: int | None
    received_ns: int | None  # host time of receipt [ns since 1970], None if unknown


class NcomParser:
    """Parses datagrams or pieces of a file; a packet may span several of them.

    utc_offset: UTC - GPS as sent by the unit [s]; None until sent. minute_from_host: whether the GPS minute is from the
    host's clock, because a live stream has no channel 0 (normally sent in every 10th packet).
    """

    def __init__(self) -> None:
        self.clock = GpsClock()
        self.counters = Counters()
        self.utc_offset: int | None = None
        self.minute_from_host = False
        self._untimed_since_ns: int | None = None  # time of receipt of the first packet without a minute
        self._tail = b""
        self._consumed = 0  # bytes of the stream before the tail
        self._in_sync = True  # a packet is expected at the beginning of the tail
        self._last_raw = b""
        self._last_trigger = b""
        self._events: dict[int, tuple[int, int]] = {}  # by channel: count and time of the newest event

    def restart(self) -> None:
        """Prepare for a new stream: discard time, incomplete packet and events; keep counters and UTC offset."""
        jumps, self.clock = self.clock.jumps, GpsClock()
        self.clock.jumps = jumps
        self._tail, self._in_sync = b"", True
        self._last_raw = self._last_trigger = b""
        self._events.clear()

    def feed(self, data: bytes, received_ns: int | None = None) -> list[ReceivedPacket]:
        """Accepted packets completed by these bytes, in order; received_ns: host time of receipt [ns since 1970]."""
        buffer = self._tail + data if self._tail else bytes(data)
        packets: list[ReceivedPacket] = []
        start = 0
        while start < len(buffer):
            start, self._in_sync = ncom.find_next_packet(buffer, start, self._in_sync, self.counters)
            raw = buffer[start : start + ncom.PACKET_SIZE]
            if len(raw) < ncom.PACKET_SIZE:
                break
            received = self._accept(raw, self._consumed + start, received_ns)
            if received is not None:
                packets.append(received)
            start += ncom.PACKET_SIZE
        self._tail = buffer[start:]
        self._consumed += start
        return packets

    def _accept(self, raw: bytes, offset: int, received_ns: int | None) -> ReceivedPacket | None:
        counters = self.counters
        counters.packets += 1
        status = raw[ncom.STATUS_BYTE]
        if status == ncom.STRUCTURE_B:
            counters.structure_b += 1
            return None
        if not ncom.inner_checksums_match(raw):
            counters.inner_checksum_warnings += 1
        rule = ncom.STATUS_RULES[status]
        packet = ncom.decode(raw)
        kind, order = rule.kind, NEW
        gps_ns: int | None = None
        minute = self._read_status(packet) if kind != "empty" else None
        if rule.has_time and packet.milliseconds >= ncom.MINUTE_MS:
            counters.impossible_times += 1
        elif rule.has_time:
            gps_ns, order = self._compute_time(packet, raw, minute, received_ns)
        elif kind == "trigger":
            counters.triggers += 1
            gps_ns = channels.decode_event_time(packet.channel, packet.batch_s)
            if gps_ns is None:
                kind = "empty"
            elif raw == self._last_trigger:
                order = DUPLICATE
                counters.duplicates += 1
            self._last_trigger = raw
        elif not rule.is_defined:
            counters.unknown_statuses += 1
        counters.impossible_positions += _mask_invalid(packet, rule, kind)
        utc_ns = None if gps_ns is None else ncom.to_unix_nanoseconds(gps_ns, self.utc_offset)
        event_ns = None
        if packet.channel in channels.TRIGGER_CHANNELS and rule.has_status and order in (NEW, SAME):
            event_ns = self._detect_event(packet.channel, packet.batch_s, kind == "trigger")
        return ReceivedPacket(packet, raw, offset, kind, rule, gps_ns, utc_ns, order, event_ns, received_ns)

    def _compute_time(self, packet: Packet, raw: bytes, minute: int | None,
                      received_ns: int | None) -> tuple[int | None, int]:
        """GPS time [ns] and order of a measurement."""
        gps_ms, order = self.clock.step(packet.milliseconds, minute, received_ns)
        if order == SAME and raw == self._last_raw:
            order = DUPLICATE
            self.counters.duplicates += 1
        elif order == LATE:
            self.counters.late += 1
        self._last_raw = raw
        self.minute_from_host &= minute is None
        if gps_ms is not None:
            self._untimed_since_ns = None
            return gps_ms * 1_000_000, order
        if received_ns is not None and order == NEW:  # a late packet must not set the minute of the newest one
            if self._untimed_since_ns is None:
                self._untimed_since_ns = received_ns
            if received_ns - self._untimed_since_ns > HOST_MINUTE_DELAY_NS:
                self.clock.initialise_minute(ncom.compute_host_minute(received_ns, packet.milliseconds))
                self.minute_from_host = True
        return None, order

    def _detect_event(self, channel: int, data: bytes, is_trigger: bool) -> int | None:
        """GPS time [ns] of an event that no earlier packet reported, else None.

        Units repeat events in regular packets, so the first count seen in a regular packet is of an old event.
        """
        gps_ns = channels.decode_event_time(channel, data)
        if gps_ns is None:
            return None
        previous = self._events.get(channel)
        self._events[channel] = data[7], gps_ns
        if previous is None:
            return gps_ns if is_trigger else None
        count, last_ns = previous
        return gps_ns if data[7] != count and (is_trigger or gps_ns > last_ns) else None

    def _read_status(self, packet: Packet) -> int | None:
        """GPS minute in channel 0, else None. Also sets the UTC offset from channel 16, and counts unknown channels."""
        channel, status, data = packet.channel, packet.navigation_status, packet.batch_s
        self.counters.unknown_channels += channel not in channels.FIELDS
        if channel not in (0, channels.UTC_CHANNEL) or status not in ncom.MINUTE_STATUSES:
            return None
        if channel == channels.UTC_CHANNEL:
            offset = channels.decode_utc_offset(data)
            self.utc_offset = self.utc_offset if offset is None else offset
            return None
        minute = int.from_bytes(data[:4], "little", signed=True)
        if not ncom.FIRST_MINUTE <= minute <= ncom.LAST_MINUTE:
            return None
        if status == ncom.STATUS_ONLY:
            self.clock.initialise_minute(minute)
        return minute


class StreamStatistics:
    """Rate, gaps and clock offset of the regular packets."""

    def __init__(self) -> None:
        self.gaps = 0
        self._typical_step_ns = 0
        self._last_gps_ns: int | None = None
        self._offsets: deque[int] = deque(maxlen=_CLOCK_SAMPLES)  # packet time minus receive time [ns]
        self._steps, self._total_ns, self._longest_step_ns = 0, 0, 0  # since summarise_steps()

    def add(self, received: ReceivedPacket) -> None:
        """Count a new regular packet, unless its time is unknown."""
        if received.gps_ns is None:
            return
        if self._last_gps_ns is not None and (step := received.gps_ns - self._last_gps_ns) > 0:
            self._steps += 1
            self._total_ns += step
            self._longest_step_ns = max(self._longest_step_ns, step)
            typical = self._typical_step_ns or step
            # Adapts slowly: a changed rate becomes typical, but a lost packet has little effect.
            self._typical_step_ns = typical + min(step - typical, typical) // 64
            self.gaps += step > GAP_STEP_RATIO * typical
        self._last_gps_ns = received.gps_ns
        if received.received_ns is not None and received.utc_ns is not None:
            self._offsets.append(received.utc_ns - received.received_ns)

    def summarise_steps(self) -> tuple[float, float]:
        """Mean rate [1/s] and longest step [s] since the previous call; 0 without a step."""
        rate = self._steps / (self._total_ns * 1e-9) if self._total_ns else 0.0
        longest = self._longest_step_ns * 1e-9
        self._steps, self._total_ns, self._longest_step_ns = 0, 0, 0
        return rate, longest

    def summarise_clock_offset(self) -> tuple[float, float, float] | None:
        """Median, 1st percentile and newest of packet time minus receive time [s], normally < 0; None if unknown."""
        offsets = list(self._offsets.copy())
        if not offsets:
            return None
        newest, ordered = offsets[-1], sorted(offsets)
        return median(ordered) * 1e-9, ordered[len(ordered) // 100] * 1e-9, newest * 1e-9


def _mask_invalid(packet: Packet, rule: StatusRule, kind: str) -> bool:
    """Replace invalid values with NaN; returns whether the position is impossible although declared valid."""
    if kind not in ("regular", "trigger"):
        packet.acceleration = packet.angular_rate = _NO_VECTOR
    if kind == "empty" or rule.navigation == "none":
        packet.latitude = packet.longitude = packet.altitude = ncom.NAN
        packet.velocity_ned = _NO_VECTOR
        packet.heading = packet.pitch = packet.roll = ncom.NAN
    elif not ncom.is_valid_position(packet.latitude, packet.longitude, packet.altitude):
        packet.latitude = packet.longitude = packet.altitude = ncom.NAN
        return True
    return False
