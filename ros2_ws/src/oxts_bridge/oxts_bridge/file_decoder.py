"""Decodes a whole NCOM file into numpy columns, over ten times as fast as stream.NcomParser and with equal results.

Contiguous packets are decoded together; after a fault, find_next_packet() and GpsClock find the next packet and its
time, as in the parser. Checked by: tests/golden and test_stream.py, which compare both decoders.
"""

from collections import deque
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from st_core.leap_seconds import GPS_EPOCH_UNIX, leap_seconds_at_gps_times

from . import ncom
from .channels import UTC_CHANNEL, decode_event_time, decode_utc_offset
from .ncom import BATCH_S, PACKET_SIZE, STATUS_RULES, Counters, NcomError, Packet, find_next_packet, is_valid_position

CAPTURE_MAGIC = (b"\xd4\xc3\xb2\xa1", b"\xa1\xb2\xc3\xd4", b"\x4d\x3c\xb2\xa1", b"\xa1\xb2\x3c\x4d", b"\n\r\r\n")
"""First bytes of a network capture: pcap in either byte order with times in us or ns, and pcapng."""
KINDS = ("empty", "regular", "status", "trigger")
EMPTY, REGULAR, STATUS, TRIGGER = range(4)
UNKNOWN_TIME = np.iinfo(np.int64).min

# Number of packets verified together: few after a fault, then four times as many at each step.
_FIRST_ROWS, _MAX_ROWS = 64, 1 << 16
# After a fault, the times of this many packets are computed one by one before columns are used again.
_SINGLE_STEPS = 16

_FIELDS = np.dtype({
    "names": ("milliseconds", "status", "latitude", "longitude", "altitude", "channel", "minute"),
    "formats": ("<u2", "u1", "<f8", "<f8", "<f4", "u1", "<i4"),
    "offsets": (ncom.MILLISECONDS_BYTE, ncom.STATUS_BYTE, ncom.LATITUDE_BYTE, ncom.LONGITUDE_BYTE, ncom.ALTITUDE_BYTE,
                ncom.CHANNEL_BYTE, ncom.BATCH_S_BYTE),
    "itemsize": PACKET_SIZE})

# ncom.STATUS_RULES as arrays, indexed by navigation status.
_KIND = np.array([KINDS.index(rule.kind) for rule in STATUS_RULES], np.int8)
_HAS_TIME = np.array([rule.has_time for rule in STATUS_RULES])
_HAS_STATUS = np.array([rule.has_status for rule in STATUS_RULES])
_HAS_NAVIGATION = np.array([rule.navigation != "none" for rule in STATUS_RULES])
_IS_APPROXIMATE = np.array([rule.navigation == "approximate" for rule in STATUS_RULES])
_SETS_CLOCK = np.isin(np.arange(256), list(ncom.MINUTE_STATUSES))
_INVALID_UTC_OFFSET = 1  # s; UTC - GPS is never positive
_UTC_OFFSET = np.array([  # indexed by byte 7 of channel 16
    _INVALID_UTC_OFFSET if offset is None else offset
    for offset in (decode_utc_offset(bytes([*[0] * 7, byte])) for byte in range(256))])


@dataclass(kw_only=True)
class Columns(Packet):
    """The accepted packets of a file as columns, in file order; structure B packets have kind EMPTY."""

    offset: np.ndarray  # index of the first byte in the file
    raw: np.ndarray  # (n, 72) uint8
    kind: np.ndarray  # index into KINDS
    order: np.ndarray  # as in ReceivedPacket
    gps_ns: np.ndarray  # [ns since 1980-01-06], UNKNOWN_TIME where unknown
    utc_ns: np.ndarray  # [ns since 1970], UNKNOWN_TIME where unknown
    is_approximate: np.ndarray  # whether the navigation values were sent before the first fix
    has_status: np.ndarray  # whether batch S is valid
    checksum_errors: int  # as in Counters
    skipped_bytes: int  # as in Counters

    def __len__(self) -> int:
        return len(self.offset)

    def take(self, rows: np.ndarray) -> Packet:
        """The packets at these indices, without batch_s."""
        return Packet(*(getattr(self, field.name)[..., rows] for field in fields(Packet)[:-1]))


def decode_file(source: str | Path | bytes) -> Columns:
    """Columns of an NCOM file, given as a path or as its bytes.

    Raises NcomError if it contains no packet, OSError if it cannot be read.
    """
    data = Path(source).read_bytes() if isinstance(source, str | Path) else source
    counters = Counters()
    offset = _find_packets(data, counters)
    if not len(offset):
        raise NcomError(_describe_missing_packet("input" if data is source else str(source), data))
    rows = np.lib.stride_tricks.sliding_window_view(np.frombuffer(data, np.uint8), PACKET_SIZE)
    is_contiguous = offset[-1] - offset[0] == (len(offset) - 1) * PACKET_SIZE
    raw = np.ascontiguousarray(rows[offset[0] : offset[-1] + 1 : PACKET_SIZE] if is_contiguous else rows[offset])
    packets = raw.view(_FIELDS).ravel()
    status, channel = packets["status"].copy(), packets["channel"].copy()
    kind, gps_ns, order = _compute_times(raw, packets)
    layout = ((ncom.ACCELERATION_BYTE, ncom.ACCELERATION_UNIT), (ncom.ANGULAR_RATE_BYTE, ncom.ANGULAR_RATE_UNIT),
              (ncom.VELOCITY_BYTE, ncom.VELOCITY_UNIT), (ncom.ANGLES_BYTE, ncom.ANGLE_UNIT))
    acceleration, angular_rate, velocity, (heading, pitch, roll) = (
        _decode_vectors(raw, first_byte, unit) for first_byte, unit in layout)
    with np.errstate(invalid="ignore"):  # structure B and empty packets may contain a signalling NaN
        altitude = packets["altitude"].astype(np.float64)
    columns = Columns(
        offset=offset, raw=raw, kind=kind, order=order, gps_ns=gps_ns,
        utc_ns=_compute_utc_times(raw, status, channel, gps_ns), milliseconds=packets["milliseconds"].astype(np.int64),
        navigation_status=status, channel=channel, batch_s=raw[:, BATCH_S].T,
        acceleration=acceleration, angular_rate=angular_rate, velocity_ned=velocity,
        latitude=packets["latitude"].copy(), longitude=packets["longitude"].copy(), altitude=altitude,
        heading=heading, pitch=pitch, roll=roll,
        is_approximate=_IS_APPROXIMATE[status], has_status=_HAS_STATUS[status],
        checksum_errors=counters.checksum_errors, skipped_bytes=counters.skipped_bytes)
    _mask_invalid(columns)
    return columns


def _find_packets(data: bytes, counters: Counters) -> np.ndarray:
    """Byte offsets of all packets. Counts checksum_errors and skipped_bytes in `counters`."""
    octets = np.frombuffer(data, np.uint8)
    offsets: list[np.ndarray] = []
    start, size, rows = 0, len(data), _FIRST_ROWS
    while size - start >= PACKET_SIZE:
        count = min(rows, (size - start) // PACKET_SIZE)
        block = octets[start : start + count * PACKET_SIZE].reshape(count, PACKET_SIZE)
        end = ncom.CHECKSUM_3_BYTE
        is_packet = np.add.reduce(block[:, 1:end], axis=1, dtype=np.uint8) == block[:, end]
        is_packet &= block[:, 0] == ncom.SYNC
        n_packets = count if is_packet.all() else int(is_packet.argmin())
        offsets.append(np.arange(start, start + n_packets * PACKET_SIZE, PACKET_SIZE))
        start += n_packets * PACKET_SIZE
        rows = min(_MAX_ROWS, 4 * rows)
        if n_packets < count:
            start, rows = find_next_packet(data, start, True, counters)[0], _FIRST_ROWS
    find_next_packet(data, start, True, counters)  # only to count the bytes after the last packet
    return np.concatenate(offsets) if offsets else np.empty(0, np.int64)


def _decode_vectors(raw: np.ndarray, first: int, unit: float) -> np.ndarray:
    """Physical values (3, n) of three consecutive i24; each is read as the upper 24 bits of an i32."""
    number = np.ndarray((3, len(raw)), "<i4", raw.reshape(-1).data, first - 1, (3, PACKET_SIZE)) >> 8
    values = number * unit
    values[number == ncom.INVALID_I24] = np.nan
    return values


def _compute_times(raw: np.ndarray, packets: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Kind, GPS time [ns] and order of every packet."""
    status, ms, minutes = packets["status"], packets["milliseconds"], packets["minute"]
    kind, gps_ns, order = _KIND[status], np.full(len(raw), UNKNOWN_TIME), np.zeros(len(raw), np.int8)
    timed = np.flatnonzero(_HAS_TIME[status] & (ms < ncom.MINUTE_MS))
    is_minute = (minutes >= ncom.FIRST_MINUTE) & (minutes <= ncom.LAST_MINUTE)
    sets_minute = _SETS_CLOCK[status] & (packets["channel"] == 0) & is_minute
    status_packets = np.flatnonzero(sets_minute & (status == ncom.STATUS_ONLY))
    gps_ms, timed_order = compute_packet_times(
        ms[timed].astype(np.int64), np.where(sets_minute[timed], minutes[timed], -1),
        list(zip(np.searchsorted(timed, status_packets).tolist(), minutes[status_packets].tolist(), strict=True)))
    same = np.flatnonzero(timed_order == ncom.SAME)
    repeats = (raw[timed[same]] == raw[timed[same - 1]]).all(axis=1)
    timed_order[same[repeats]] = ncom.DUPLICATE
    gps_ns[timed] = np.where(gps_ms >= 0, gps_ms * 1_000_000, UNKNOWN_TIME)
    order[timed] = timed_order
    previous = b""
    for i in np.flatnonzero(kind == TRIGGER):
        packet = raw[i].tobytes()
        event_ns = decode_event_time(packet[ncom.CHANNEL_BYTE], packet[BATCH_S])
        if event_ns is None:
            kind[i] = EMPTY
        else:
            gps_ns[i], order[i] = event_ns, ncom.DUPLICATE if packet == previous else ncom.NEW
        previous = packet
    return kind, gps_ns, order


def compute_packet_times(ms: np.ndarray, minutes: np.ndarray,
                         status_minutes: list[tuple[int, int]]) -> tuple[np.ndarray, np.ndarray]:
    """GPS time [ms] (-1 unknown) and order (NEW, SAME, LATE) of packets.

    The results are the same as from a GpsClock that steps through all packets. Once the clock has settled, times are
    computed by counting minute rollovers, up to the next late packet or the next transmitted minute that differs from
    the count; there, the clock steps through _SINGLE_STEPS packets again.

    ms: milliseconds of the minute. minutes: GPS minute sent with the packet, -1 if none. status_minutes: (index,
    minute) for each status-only packet that sent a minute; index: number of timed packets before it.
    """
    step = np.diff(ms, prepend=ms[:1])
    ahead = step % ncom.MINUTE_MS
    is_late = ahead >= ncom.HALF_MINUTE_MS
    wraps = np.cumsum((step < 0) & ~is_late)
    # Minute of each packet that contains one, minus the rollovers up to it: constant while the count is correct.
    with_minute = np.flatnonzero(minutes >= 0)
    bases = minutes[with_minute] - wraps[with_minute]
    stops = np.unique(np.concatenate([np.flatnonzero(is_late), with_minute[1:][np.diff(bases) != 0], [len(ms)]]))
    times = np.full(len(ms), -1, np.int64)
    order = np.where(ahead > 0, ncom.NEW, ncom.SAME).astype(np.int8)
    pending_minutes, clock, start = deque(status_minutes), ncom.GpsClock(), 0
    while start < len(ms):
        if clock.is_settled:
            base, k = clock.minute - wraps[start - 1], np.searchsorted(with_minute, start)
            stop = int(stops[np.searchsorted(stops, start)])
            if k < len(with_minute) and bases[k] != base:
                stop = min(stop, int(with_minute[k]))
            if stop > start:
                times[start:stop] = (wraps[start:stop] + base) * ncom.MINUTE_MS + ms[start:stop]
                clock.minute, clock.milliseconds = divmod(int(times[stop - 1]), ncom.MINUTE_MS)
            start = stop
        for i in range(start, min(start + _SINGLE_STEPS, len(ms))):
            while pending_minutes and pending_minutes[0][0] <= i:
                clock.initialise_minute(pending_minutes.popleft()[1])
            time, order[i] = clock.step(int(ms[i]), None if minutes[i] < 0 else int(minutes[i]))
            times[i] = -1 if time is None else time
            start = i + 1
    return times, order


def _compute_utc_times(raw: np.ndarray, status: np.ndarray, channel: np.ndarray, gps_ns: np.ndarray) -> np.ndarray:
    """UTC [ns since 1970] of each packet.

    UTC - GPS sent in a packet applies from this packet on; before the first one, the leap-second table is used.
    """
    is_timed = gps_ns != UNKNOWN_TIME
    offset = -leap_seconds_at_gps_times(np.where(is_timed, gps_ns // 1_000_000_000, 0))
    offset_packets = np.flatnonzero((channel == UTC_CHANNEL) & _SETS_CLOCK[status])
    offsets = _UTC_OFFSET[raw[offset_packets, BATCH_S.stop - 1]]
    offset_packets, offsets = offset_packets[offsets != _INVALID_UTC_OFFSET], offsets[offsets != _INVALID_UTC_OFFSET]
    if len(offset_packets):
        offset[offset_packets[0]:] = np.repeat(offsets, np.diff(offset_packets, append=len(gps_ns)))
    return np.where(is_timed, gps_ns + (GPS_EPOCH_UNIX + offset) * 1_000_000_000, UNKNOWN_TIME)


def _mask_invalid(columns: Columns) -> None:
    """Replace values that the navigation status declares invalid, and impossible positions, with NaN."""
    columns.is_approximate &= columns.kind != EMPTY
    no_imu = (columns.kind != REGULAR) & (columns.kind != TRIGGER)
    no_navigation = no_imu | ~_HAS_NAVIGATION[columns.navigation_status]
    with np.errstate(invalid="ignore"):
        impossible = ~is_valid_position(columns.latitude, columns.longitude, columns.altitude)
    for names, is_invalid in ((("acceleration", "angular_rate"), no_imu),
                              (("velocity_ned", "heading", "pitch", "roll"), no_navigation),
                              (("latitude", "longitude", "altitude"), no_navigation | impossible)):
        rows = np.flatnonzero(is_invalid)
        for name in names:
            getattr(columns, name)[..., rows] = np.nan


def _describe_missing_packet(name: str, data: bytes) -> str:
    if not data:
        return f"{name}: the file is empty"
    head = data[:4]
    capture = "a network capture without complete NCOM packets: record whole datagrams of port 3000 (tcpdump -s 0)"
    content = {
        **dict.fromkeys(CAPTURE_MAGIC, capture),
        b"OggS": "an Ogg container (if it is an .xcom file, export NCOM from it first)",
        b"MDF ": "an MDF log",
    }.get(head)
    if content is None:
        printable = sum(32 <= c < 127 or c in b"\t\r\n" for c in data[:512])
        content = "text" if printable > 0.95 * len(data[:512]) else f"of unknown type (it starts with {head.hex(' ')})"
    return f"{name}: no NCOM packet in {len(data)} bytes (one packet is {PACKET_SIZE} bytes); the file is {content}"
