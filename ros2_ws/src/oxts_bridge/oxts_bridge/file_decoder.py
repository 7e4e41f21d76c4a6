"""A whole NCOM file as numpy columns, with the same packets, times and counts as stream.NcomParser.

This second implementation is 30 times faster than the parser; tests/golden and test_stream.py compare the two.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from . import ncom
from .channels import TRIGGER_CHANNELS, UTC_CHANNEL, known, trigger_nanoseconds, utc_offset
from .ncom import BATCH_S, BY_STATUS, PACKET_SIZE, STATUS_AT, Counters, NcomError, is_valid_position, next_packet
from .packet_time import DUPLICATE, FIRST_MINUTE, LAST_MINUTE, LATE, MINUTE_MS, NEW, packet_times, utc_times

KINDS = ("empty", "regular", "status", "trigger")
EMPTY, REGULAR, STATUS, TRIGGER = range(4)
UNKNOWN_TIME = np.iinfo(np.int64).min

# Rows checked per step: few right after a fault, then growing, so that a clean file takes a few large steps.
_FIRST_ROWS, _MAX_ROWS = 64, 1 << 16

_KIND = np.array([KINDS.index(rule.kind) for rule in BY_STATUS], np.int8)
_HAS_TIME = np.array([rule.time for rule in BY_STATUS])
_HAS_IMU = np.array([rule.imu for rule in BY_STATUS])
_HAS_STATUS = np.array([rule.status for rule in BY_STATUS])
_HAS_NAVIGATION = np.array([rule.navigation != "none" for rule in BY_STATUS])
_IS_APPROXIMATE = np.array([rule.navigation == "approximate" for rule in BY_STATUS])
_IS_KNOWN = np.array([rule.known for rule in BY_STATUS])
_HAS_MINUTE = np.isin(np.arange(256), list(ncom.MINUTE_STATUSES))
_NO_OFFSET = 1
_UTC_OFFSET = np.array([_NO_OFFSET if (offset := utc_offset(bytes([*[0] * 7, byte]))) is None else offset
                        for byte in range(256)])
_KNOWN_CHANNEL = np.array([known(channel) for channel in range(256)])


@dataclass
class Columns:
    """One entry per accepted packet, in file order; structure B packets are included as EMPTY.

    offset: byte position.  raw: (n, 72) uint8.  kind: index into KINDS.  order: as stream.Received.order.
    gps_ns: since 1980-01-06, utc_ns: since 1970, UNKNOWN_TIME where unknown.  milliseconds, navigation_status,
    channel: as sent. acceleration [m/s^2], angular_rate [rad/s]: (3, n), vehicle FRD.  latitude, longitude [rad],
    altitude [m] as sent.  velocity_ned: (3, n) [m/s].  heading, pitch, roll [rad].  NaN = invalid.
    approximate: navigation before the first fix.  has_status: batch S is valid.
    """

    offset: np.ndarray
    raw: np.ndarray
    kind: np.ndarray
    order: np.ndarray
    gps_ns: np.ndarray
    utc_ns: np.ndarray
    milliseconds: np.ndarray
    navigation_status: np.ndarray
    channel: np.ndarray
    acceleration: np.ndarray
    angular_rate: np.ndarray
    latitude: np.ndarray
    longitude: np.ndarray
    altitude: np.ndarray
    velocity_ned: np.ndarray
    heading: np.ndarray
    pitch: np.ndarray
    roll: np.ndarray
    approximate: np.ndarray
    has_status: np.ndarray
    counters: Counters
    time_jumps: int

    def __len__(self) -> int:
        return len(self.offset)

    def batch_s(self, index: int) -> bytes:
        """The 8 status bytes of a packet."""
        return self.raw[index, BATCH_S].tobytes()


def decode_file(source: str | Path | bytes) -> Columns:
    """Columns of an NCOM file, given as a path or as its bytes.

    Raises NcomError, naming the file and its content, if it contains no packet; OSError if it cannot be read.
    """
    if isinstance(source, str | Path):
        data, name = Path(source).read_bytes(), str(source)
    else:
        data, name = bytes(source), "input"
    counters = Counters()
    offset = find_packets(data, counters)
    if not len(offset):
        raise NcomError(_no_packet_message(name, data))
    return _decode(data, offset, counters)


def find_packets(data: bytes, counters: Counters) -> np.ndarray:
    """Byte offsets of all packets; fills packets, checksum_errors and skipped_bytes of the counters."""
    bytes_ = np.frombuffer(data, np.uint8)
    found: list[np.ndarray] = []
    at, size, rows = 0, len(data), _FIRST_ROWS
    while size - at >= PACKET_SIZE:
        count = min(rows, (size - at) // PACKET_SIZE)
        block = bytes_[at : at + count * PACKET_SIZE].reshape(count, PACKET_SIZE)
        good = block[:, 0] == ncom.SYNC
        good &= np.add.reduce(block[:, 1:ncom.CHECKSUM_3_AT], axis=1, dtype=np.uint8) == block[:, ncom.CHECKSUM_3_AT]
        run = count if good.all() else int(good.argmin())
        found.append(np.arange(at, at + run * PACKET_SIZE, PACKET_SIZE))
        at += run * PACKET_SIZE
        rows = min(_MAX_ROWS, 4 * rows)
        if run < count:
            at, rows = next_packet(data, at, True, counters)[0], _FIRST_ROWS
    next_packet(data, at, True, counters)  # counts the bytes after the last packet
    offset = np.concatenate(found) if found else np.empty(0, np.int64)
    counters.packets = len(offset)
    return offset


def _decode(data: bytes, offset: np.ndarray, counters: Counters) -> Columns:
    raw = _rows(data, offset)
    n = len(raw)
    buffer = raw.reshape(-1).data
    status, channel = raw[:, STATUS_AT].copy(), raw[:, ncom.CHANNEL_AT].copy()
    milliseconds = np.ndarray((n,), "<u2", buffer, ncom.MILLISECONDS_AT, (PACKET_SIZE,)).astype(np.int64)
    has_status = _HAS_STATUS[status]
    gps_ns, order, jumps = _times(raw, status, milliseconds, (channel == 0) & has_status)
    kind = _KIND[status]
    _trigger_times(raw, kind, gps_ns, order)
    heading, pitch, roll = _i24(buffer, n, ncom.ANGLES_AT, ncom.ANGLE_UNIT)

    with np.errstate(invalid="ignore"):  # private or empty packets may hold signalling NaN
        altitude = np.ndarray((n,), "<f4", buffer, ncom.ALTITUDE_AT, (PACKET_SIZE,)).astype(np.float64)
    columns = Columns(
        offset=offset,
        raw=raw,
        kind=kind,
        order=order,
        gps_ns=gps_ns,
        utc_ns=_utc_times(raw, status, channel, gps_ns),
        milliseconds=milliseconds,
        navigation_status=status,
        channel=channel,
        acceleration=_i24(buffer, n, ncom.ACCELERATION_AT, ncom.ACCELERATION_UNIT),
        angular_rate=_i24(buffer, n, ncom.ANGULAR_RATE_AT, ncom.ANGULAR_RATE_UNIT),
        latitude=np.ndarray((n,), "<f8", buffer, ncom.LATITUDE_AT, (PACKET_SIZE,)).copy(),
        longitude=np.ndarray((n,), "<f8", buffer, ncom.LONGITUDE_AT, (PACKET_SIZE,)).copy(),
        altitude=altitude,
        velocity_ned=_i24(buffer, n, ncom.VELOCITY_AT, ncom.VELOCITY_UNIT),
        heading=heading,
        pitch=pitch,
        roll=roll,
        approximate=_IS_APPROXIMATE[status],
        has_status=has_status,
        counters=counters,
        time_jumps=jumps,
    )
    _fill_counters(columns)
    _mask_invalid(columns)
    return columns


def _utc_times(raw: np.ndarray, status: np.ndarray, channel: np.ndarray, gps_ns: np.ndarray) -> np.ndarray:
    """UTC [ns since 1970]; an offset applies from the packet that carries it onwards."""
    carriers = np.flatnonzero((channel == UTC_CHANNEL) & _HAS_MINUTE[status])
    offsets = _UTC_OFFSET[raw[carriers, BATCH_S.stop - 1]]
    known = offsets != _NO_OFFSET
    return utc_times(gps_ns, UNKNOWN_TIME, carriers[known], offsets[known])


def _times(raw: np.ndarray, status: np.ndarray, milliseconds: np.ndarray,
           is_channel_0: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """GPS time [ns] and order of every packet of the series, and the number of time jumps."""
    gps_ns, order = np.full(len(raw), UNKNOWN_TIME), np.zeros(len(raw), np.int8)
    sent = np.ndarray((len(raw),), "<i4", raw.reshape(-1).data, ncom.BATCH_S_AT, (PACKET_SIZE,)).astype(np.int64)
    minutes = np.where(is_channel_0 & (sent >= FIRST_MINUTE) & (sent <= LAST_MINUTE), sent, -1)
    timed = np.flatnonzero(_HAS_TIME[status] & (milliseconds < MINUTE_MS))
    hints = np.flatnonzero((status == ncom.STATUS_ONLY) & (minutes >= 0))
    gps_ms, order[timed], jumps = packet_times(
        milliseconds[timed], minutes[timed], timed, [(i, int(minutes[i])) for i in hints.tolist()],
        lambda a, b: bool((raw[timed[a]] == raw[timed[b]]).all()))
    gps_ns[timed] = np.where(gps_ms >= 0, gps_ms * 1_000_000, UNKNOWN_TIME)
    return gps_ns, order, jumps


def _rows(data: bytes, offset: np.ndarray) -> np.ndarray:
    """(n, 72) bytes; a view of the data if the packets are contiguous."""
    bytes_ = np.frombuffer(data, np.uint8)
    breaks = np.flatnonzero(np.diff(offset) != PACKET_SIZE) + 1
    starts, ends = [0, *breaks], [*breaks, len(offset)]
    runs = [bytes_[offset[start] : offset[end - 1] + PACKET_SIZE] for start, end in zip(starts, ends, strict=True)]
    return (runs[0] if len(runs) == 1 else np.concatenate(runs)).reshape(-1, PACKET_SIZE)


def _i24(buffer: memoryview, n: int, at: int, unit: float) -> np.ndarray:
    """(3, n) physical values of three consecutive i24, each read as the upper 24 bits of an i32."""
    number = np.ndarray((3, n), "<i4", buffer, at - 1, (3, PACKET_SIZE)) >> 8
    values = number * unit
    values[number == ncom.INVALID_I24] = np.nan
    return values


def _trigger_times(raw: np.ndarray, kind: np.ndarray, gps_ns: np.ndarray, order: np.ndarray) -> None:
    previous = b""
    for i in np.flatnonzero(kind == TRIGGER):
        packet = raw[i].tobytes()
        time = trigger_nanoseconds(packet[BATCH_S]) if packet[ncom.CHANNEL_AT] in TRIGGER_CHANNELS else None
        if time is None:
            kind[i] = EMPTY
        else:
            gps_ns[i] = time
            order[i] = DUPLICATE if packet == previous else NEW
        previous = packet


def _fill_counters(columns: Columns) -> None:
    counters, raw, status, order = columns.counters, columns.raw, columns.navigation_status, columns.order
    first = np.add.reduce(raw[:, 1:ncom.CHECKSUM_1_AT], axis=1, dtype=np.uint8)
    second = first + np.add.reduce(raw[:, ncom.CHECKSUM_1_AT:ncom.CHECKSUM_2_AT], axis=1, dtype=np.uint8)
    wrong = (first != raw[:, ncom.CHECKSUM_1_AT]) | (second != raw[:, ncom.CHECKSUM_2_AT])
    structure_b = status == ncom.STRUCTURE_B
    counters.structure_b = int(structure_b.sum())
    counters.inner_checksum_warnings = int((wrong & ~structure_b).sum())
    counters.impossible_times = int((_HAS_TIME[status] & (columns.milliseconds >= MINUTE_MS)).sum())
    counters.unknown_statuses = int((~_IS_KNOWN[status]).sum())
    counters.unknown_channels = int((columns.has_status & ~_KNOWN_CHANNEL[columns.channel]).sum())
    counters.triggers = int((_KIND[status] == TRIGGER).sum())
    counters.duplicates = int((order == DUPLICATE).sum())
    counters.late = int((order == LATE).sum())


def _mask_invalid(columns: Columns) -> None:
    """Set NaN where the navigation status declares values invalid, and for impossible positions."""
    status, usable = columns.navigation_status, columns.kind != EMPTY
    no_imu = ~(_HAS_IMU[status] & usable)
    if no_imu.any():
        columns.acceleration[:, no_imu] = columns.angular_rate[:, no_imu] = np.nan
    no_navigation = ~(_HAS_NAVIGATION[status] & usable)
    columns.approximate &= usable
    if no_navigation.any():
        columns.velocity_ned[:, no_navigation] = np.nan
        for angle in (columns.heading, columns.pitch, columns.roll):
            angle[no_navigation] = np.nan
    with np.errstate(invalid="ignore"):
        impossible = ~is_valid_position(columns.latitude, columns.longitude, columns.altitude)
    columns.counters.impossible_positions = int((impossible & ~no_navigation).sum())
    impossible |= no_navigation
    if impossible.any():
        for value in (columns.latitude, columns.longitude, columns.altitude):
            value[impossible] = np.nan


def _no_packet_message(name: str, data: bytes) -> str:
    if not data:
        return f"{name}: empty file, contains no NCOM packet"
    head = data[:4]
    content = {
        b"OggS": "an Ogg container (.xcom files are one; export NCOM from it first)",
        b"\x7fELF": "a program",
        b"PK\x03\x04": "a zip archive",
        b"MDF ": "an MDF log",
    }.get(head)
    if content is None:
        printable = sum(32 <= c < 127 or c in b"\t\r\n" for c in data[:512])
        content = "text" if printable > 0.95 * len(data[:512]) else f"bytes {head.hex(' ')} ..."
    return f"{name}: no NCOM packet in {len(data)} bytes (a packet has {PACKET_SIZE}); the file starts with {content}"
