"""Decodes and encodes NCOM packets of structure A (72 bytes, little-endian), finds them in a byte stream, and computes
their GPS and UTC times.

    byte  0      sync 0xE7
          1-2    u16 milliseconds into the GPS minute
          3-20   6 x i24: acceleration x, y, z [1e-4 m/s^2], angular rate x, y, z [1e-5 rad/s], vehicle axes (FRD)
          21     navigation status          22  checksum 1 over 1..21
          23-38  f64 latitude, longitude [rad]   39-42 f32 altitude [m]
          43-60  6 x i24: velocity north, east, down [1e-4 m/s], heading, pitch, roll [1e-6 rad]
          61     checksum 2 over 1..60      62  status channel      63-70  batch S      71  checksum 3 over 1..70

An i24 of -8388608 means "invalid" and is decoded as NaN. GPS time counts from 1980-01-06T00:00:00 without leap seconds:
gps = minutes * 60 s + ms, UTC = gps - leap seconds. Some packets contain the minute, in channel 0. Times are integers.
Source: NCOM manual 260702. Checked by: tests/golden/test_ncom_vectors.py, test_packet_time.py.
"""

import math
import struct
from dataclasses import dataclass
from typing import Any, NamedTuple

from st_core.leap_seconds import GPS_EPOCH_UNIX, leap_seconds_at_gps

from .geometry import Number, Vector

NAN = math.nan
SYNC = 0xE7
PACKET_SIZE = 72
STRUCTURE_B = 11

# Index of the first byte of each field. A checksum is the low byte of the sum of all bytes from byte 1 up to it.
MILLISECONDS_BYTE, ACCELERATION_BYTE, ANGULAR_RATE_BYTE, STATUS_BYTE, CHECKSUM_1_BYTE = 1, 3, 12, 21, 22
LATITUDE_BYTE, LONGITUDE_BYTE, ALTITUDE_BYTE = 23, 31, 39
VELOCITY_BYTE, ANGLES_BYTE, CHECKSUM_2_BYTE = 43, 52, 61
CHANNEL_BYTE, BATCH_S_BYTE, CHECKSUM_3_BYTE = 62, 63, 71
BATCH_S = slice(BATCH_S_BYTE, CHECKSUM_3_BYTE)

ACCELERATION_UNIT = 1e-4  # m/s^2
ANGULAR_RATE_UNIT = 1e-5  # rad/s
VELOCITY_UNIT = 1e-4  # m/s
ANGLE_UNIT = 1e-6  # rad

INVALID_I24 = -0x800000
LARGEST_I24 = 0x7FFFFF

MINUTE_MS = 60_000
WEEK_MS = 604_800_000

# Valid GPS minutes: the manual defines smaller numbers as "unknown"; ROS stamps end in 2038.
FIRST_MINUTE, LAST_MINUTE = 1_000, 30_525_000

# Order of a packet relative to the newest one. SAME: equal time; DUPLICATE: equal bytes too.
NEW, SAME, LATE, DUPLICATE = 0, 1, 2, 3
# Milliseconds of the minute are ambiguous: a packet that would be ahead by this time or more is assumed to be late.
HALF_MINUTE_MS = 30_000
# After more than this many consecutive late packets in ascending order, the clock is assumed to have been set back.
MAX_LATE_RUN = 10
LONGEST_GAP_NS = 30_000_000_000  # longest pause on the receive clock after which the minute count continues
# Within this time of a minute change [ms], a sent minute that differs from the count by one must be sent twice.
CONFIRMATION_MS = 1_000
# A step of the packet time that exceeds the pause on the receive clock by more than this is a jump [ns].
MAX_STEP_EXCESS_NS = 1_000_000_000

_LAYOUT = struct.Struct("<xH 9s9s B x ddf 9s9s x B 8s x")
_VECTOR = struct.Struct("<HbHbHb")  # low 16 bits and high 8 bits of each i24


class NcomError(ValueError):
    """Raised for bytes without an NCOM packet, values that cannot be encoded, and an output file that is an input."""


class StatusRule(NamedTuple):
    """Contents of a packet with a given navigation status (byte 21)."""

    text: str
    # "regular" (a measurement); "trigger" (an event with its time in batch S); "status" (only batch S is valid); or
    # "empty" (nothing is valid).
    kind: str = "empty"
    # Validity of position, velocity, angles: "none", "valid", or "approximate" (before the first fix, not published).
    navigation: str = "none"
    has_time: bool = False  # bytes 1-2 are valid
    is_defined: bool = True  # the manual defines this status

    @property
    def has_status(self) -> bool:
        """Whether batch S is valid."""
        return self.kind != "empty"


RAW_IMU, INITIALISING, LOCKING, LOCKED, EXPIRED, BLOCKED, STATUS_ONLY = 1, 2, 3, 4, 6, 7, 10
_DEFINED_RULES: dict[int, StatusRule] = {
    0: StatusRule("nothing valid"),
    RAW_IMU: StatusRule("raw IMU", "regular"),
    INITIALISING: StatusRule("initialising", "regular", "approximate", has_time=True),
    LOCKING: StatusRule("locking", "regular", "valid", has_time=True),
    LOCKED: StatusRule("locked", "regular", "valid", has_time=True),
    5: StatusRule("reserved (unlocked)"),
    EXPIRED: StatusRule("firmware expired"),
    BLOCKED: StatusRule("firmware blocked"),
    STATUS_ONLY: StatusRule("status only", "status"),
    STRUCTURE_B: StatusRule("structure B"),
    20: StatusRule("trigger while initialising", "trigger", "approximate"),
    21: StatusRule("trigger while locking", "trigger", "valid"),
    22: StatusRule("trigger while locked", "trigger", "valid"),
}
STATUS_RULES: tuple[StatusRule, ...] = tuple(
    _DEFINED_RULES.get(n, StatusRule(f"reserved ({n})", is_defined=False)) for n in range(256))
# Statuses in which channel 0 sets the GPS minute, and channel 16 the UTC offset. Files start with status-only packets.
# Raw IMU (status 1) is excluded because the unit's clock is not set yet.
MINUTE_STATUSES = frozenset((INITIALISING, LOCKING, LOCKED, STATUS_ONLY))

# Names of the GNSS modes, numbered from 0, for position, velocity and orientation.
_SOLUTIONS = ("Doppler", "SPS", "differential", "float", "integer")
MODES = dict(enumerate((
    "none", "search", "Doppler", "SPS", "differential", "RTK float", "RTK integer", "SBAS", "OmniSTAR VBS",
    "OmniSTAR HP", "no data", "blanked", *(f"post-processed {name}" for name in _SOLUTIONS), "OmniSTAR XP", "CDGPS",
    "not recognised", *(f"gx {name}" for name in _SOLUTIONS), *(f"ix {name}" for name in _SOLUTIONS),
    "PPP converging", "PPP", "unknown")))

NO_FIX, FIX, SBAS_FIX, GBAS_FIX = -1, 0, 1, 2  # sensor_msgs/NavSatStatus
_FIX_STATUS = {
    **dict.fromkeys((3, 13, 21, 26), FIX),
    **dict.fromkeys((7, 8, 9, 17, 18, 30, 31), SBAS_FIX),
    **dict.fromkeys((4, 5, 6, 14, 15, 16, 22, 23, 24, 27, 28, 29), GBAS_FIX),
}
# Modes 0 to 7 in ascending order of accuracy; SBAS (7) lies between SPS (3) and differential (4).
_MODES_BY_ACCURACY = (0, 1, 2, 3, 7, 4, 5, 6)


def describe_mode(mode: int | None) -> str:
    """Name of a position, velocity or orientation mode; "" for None, "unknown (n)" for an undefined number."""
    return "" if mode is None else MODES.get(mode, f"unknown ({mode})")


def rank_mode(mode: int | None) -> int:
    """Accuracy rank of a GNSS mode, from 0 (none) to 7 (integer), equal for RTK, post-processed, gx and ix solutions;
    -1 for any other mode and for None."""
    for first in (12, 20, 25):  # mode of the Doppler solution of each family
        if mode is not None and 0 <= mode - first < len(_SOLUTIONS):
            mode = 2 + mode - first
    return _MODES_BY_ACCURACY.index(mode) if mode in _MODES_BY_ACCURACY else -1


def get_fix_status(mode: int | None) -> int:
    """NavSatStatus.status for a position mode; NO_FIX for modes without a position, None and undefined numbers."""
    return NO_FIX if mode is None else _FIX_STATUS.get(mode, NO_FIX)


@dataclass(slots=True)
class Packet:
    """Values of a packet in the transmitted axes: NED, and FRD of the vehicle (forward, right, down). NaN = invalid.

    The fields of several packets are columns: arrays (n,), vectors (3, n), batch_s (8, n) uint8.

    milliseconds: into the GPS minute, 0..59999; a larger number is kept, but yields no time.
    acceleration: specific force x, y, z [m/s^2], z about -9.81 at rest; each at most 838.8607.
    angular_rate: x, y, z [rad/s] relative to inertial space; each at most 83.88607.
    navigation_status: 0..255, see STATUS_RULES.
    latitude, longitude: geodetic [rad].  altitude: [m], above the geoid unless the unit is configured otherwise.
    velocity_ned: north, east, down [m/s]; each at most 838.8607.
    heading: clockwise from true north [rad].  pitch [rad]: positive nose up.  roll [rad]: positive right side down.
    channel: number of the status channel.  batch_s: the 8 bytes of this channel, see channels.py.
    """

    milliseconds: Any = 0
    acceleration: Any = (NAN, NAN, NAN)
    angular_rate: Any = (NAN, NAN, NAN)
    navigation_status: Any = 0
    latitude: Number = NAN
    longitude: Number = NAN
    altitude: Number = NAN
    velocity_ned: Any = (NAN, NAN, NAN)
    heading: Number = NAN
    pitch: Number = NAN
    roll: Number = NAN
    channel: Any = 255
    batch_s: Any = b"\xff" * 8


def decode(data: bytes) -> Packet:
    """Physical values of a packet; the checksums are not verified.

    Raises NcomError for a wrong length or sync byte, or structure B (navigation status 11, vendor-internal).
    """
    if len(data) != PACKET_SIZE or data[0] != SYNC:
        raise NcomError(f"not an NCOM packet: {len(data)} bytes starting with {data[:1].hex() or 'nothing'}")
    if data[STATUS_BYTE] == STRUCTURE_B:
        raise NcomError("structure B packet (navigation status 11): its layout is not published")
    (milliseconds, acceleration, angular_rate, status, latitude, longitude, altitude, velocity, angles, channel,
     batch_s) = _LAYOUT.unpack(data)
    return Packet(milliseconds, _decode_vector(acceleration, ACCELERATION_UNIT),
                  _decode_vector(angular_rate, ANGULAR_RATE_UNIT), status, latitude, longitude, altitude,
                  _decode_vector(velocity, VELOCITY_UNIT), *_decode_vector(angles, ANGLE_UNIT), channel, batch_s)


def _decode_vector(data: bytes, unit: float) -> Vector:
    x_low, x_high, y_low, y_high, z_low, z_high = _VECTOR.unpack(data)
    # Written out because this runs for every packet: a call per component would take twice as long.
    x, y, z = x_high << 16 | x_low, y_high << 16 | y_low, z_high << 16 | z_low
    return (NAN if x == INVALID_I24 else x * unit, NAN if y == INVALID_I24 else y * unit,
            NAN if z == INVALID_I24 else z * unit)


def encode(packet: Packet) -> bytes:
    """The 72 bytes of a packet with its checksums.

    Values of i24 fields are rounded (half to even) to their unit and limited to +/- 8388607 units; NaN becomes
    INVALID_I24. Angles are not wrapped: keep the heading within +/- pi, as the INS does. Raises NcomError for structure
    B, a batch_s that is not 8 bytes, or an integer or altitude outside the range of its field.
    """
    if len(packet.batch_s) != 8:
        raise NcomError(f"batch_s must have 8 bytes, not {len(packet.batch_s)}")
    if packet.navigation_status == STRUCTURE_B:
        raise NcomError("structure B packets (navigation status 11) cannot be encoded")
    try:
        data = bytearray(_LAYOUT.pack(
            packet.milliseconds, _encode_vector(packet.acceleration, ACCELERATION_UNIT),
            _encode_vector(packet.angular_rate, ANGULAR_RATE_UNIT), packet.navigation_status, packet.latitude,
            packet.longitude, packet.altitude, _encode_vector(packet.velocity_ned, VELOCITY_UNIT),
            _encode_vector((packet.heading, packet.pitch, packet.roll), ANGLE_UNIT), packet.channel, packet.batch_s))
    except (struct.error, OverflowError) as error:
        raise NcomError(f"a value is outside the range of its field: {error}") from None
    data[0] = SYNC
    for end in (CHECKSUM_1_BYTE, CHECKSUM_2_BYTE, CHECKSUM_3_BYTE):
        data[end] = sum(data[1:end]) & 0xFF
    return bytes(data)


def _encode_vector(values: Vector, unit: float) -> bytes:
    raw = [INVALID_I24 if math.isnan(value)
           else round(max(-LARGEST_I24, min(LARGEST_I24, value / unit))) for value in values]
    return b"".join(number.to_bytes(3, "little", signed=True) for number in raw)


def is_valid_position(latitude: Any, longitude: Any, altitude: Any) -> Any:
    """Whether latitude, longitude [rad] and altitude [m] (numbers or arrays) are finite and in range."""
    return (abs(latitude) <= math.pi / 2) & (abs(longitude) <= 2 * math.pi) & (abs(altitude) < math.inf)


def inner_checksums_match(data: bytes) -> bool:
    """Whether checksums 1 and 2 are correct."""
    first = sum(data[1:CHECKSUM_1_BYTE])
    second = first + sum(data[CHECKSUM_1_BYTE:CHECKSUM_2_BYTE])
    return first & 0xFF == data[CHECKSUM_1_BYTE] and second & 0xFF == data[CHECKSUM_2_BYTE]


@dataclass
class Counters:
    """Counts since the start of the stream."""

    packets: int = 0
    checksum_errors: int = 0  # checksum 3 is wrong where a packet was expected
    skipped_bytes: int = 0  # not part of a packet
    inner_checksum_warnings: int = 0  # checksum 1 or 2 is wrong, 3 is correct: accepted, as by the vendor's tools
    late: int = 0  # measured before the newest packet
    duplicates: int = 0  # bytes equal to those of the previous measurement or trigger packet
    unknown_statuses: int = 0  # reserved navigation status: ignored
    unknown_channels: int = 0  # status channel without a published layout
    structure_b: int = 0  # vendor-internal, dropped
    triggers: int = 0  # trigger packets, including repeated ones and those without an event
    impossible_times: int = 0  # milliseconds of the minute above 59999: the packet has no time
    impossible_positions: int = 0  # NaN or out of range although the navigation status declares a position: masked


def find_next_packet(data: bytes, start: int, in_sync: bool, counters: Counters) -> tuple[int, bool]:
    """(index of the next whole packet, or else of the first byte to keep; whether a packet is expected there).

    in_sync: a packet is expected at `start`. Counts checksum_errors and skipped_bytes. Out of sync, a packet is
    accepted only if all three checksums are correct and its navigation status is defined, because checksum 3 alone
    matches by chance for one in 256 false sync bytes; for structure B, checksum 3 suffices.
    """
    while start < len(data):
        if data[start] == SYNC:
            raw = data[start : start + PACKET_SIZE]
            if len(raw) < PACKET_SIZE:
                break
            if sum(raw[1:CHECKSUM_3_BYTE]) & 0xFF == raw[CHECKSUM_3_BYTE]:
                status = raw[STATUS_BYTE]
                if in_sync or status == STRUCTURE_B or (STATUS_RULES[status].is_defined and inner_checksums_match(raw)):
                    return start, True
            counters.checksum_errors += in_sync
        next_sync = data.find(SYNC, start + 1)
        next_start = len(data) if next_sync < 0 else next_sync
        counters.skipped_bytes += next_start - start
        start, in_sync = next_start, False
    return start, in_sync


def to_unix_nanoseconds(gps_nanoseconds: int, utc_offset: int | None = None) -> int:
    """UTC [ns since 1970] from GPS time [ns since 1980-01-06].

    utc_offset: UTC - GPS as sent by the unit [s], negative; None: leap-second table.
    """
    if utc_offset is None:
        utc_offset = -leap_seconds_at_gps(gps_nanoseconds // 1_000_000_000)
    return gps_nanoseconds + (GPS_EPOCH_UNIX + utc_offset) * 1_000_000_000


def compute_host_minute(received_ns: int, milliseconds: int) -> int:
    """The GPS minute in which a packet with these milliseconds is nearest to a host time [ns since 1970].

    Correct if the host's clock is within half a minute of UTC.
    """
    gps_ms = received_ns // 1_000_000 - GPS_EPOCH_UNIX * 1000
    gps_ms += leap_seconds_at_gps(gps_ms // 1000) * 1000
    return round((gps_ms - milliseconds) / MINUTE_MS)


class GpsClock:
    """Tracks the GPS time of packets: all contain milliseconds of the minute, and some the minute (channel 0).

    The clock counts a minute whenever the milliseconds wrap; a sent minute takes precedence over the count.
    minute, milliseconds: time of the newest packet, None until known. jumps: number of time steps that go back, exceed
    the pause on the receive clock (0 in a file) by more than 1 s, or end at a sent minute that differs from the count.
    """

    def __init__(self) -> None:
        self.minute: int | None = None
        self.milliseconds: int | None = None
        self.jumps = 0
        self._received_ns: int | None = None
        self._unconfirmed_difference: int | None = None  # difference of the last sent minute from the count
        self._late_count = 0  # length of the current run of late packets
        self._late_ms = 0  # milliseconds of the newest late packet
        self._late_minute: int | None = None  # minute of the newest late packet

    @property
    def is_settled(self) -> bool:
        """Whether the time is known and neither a minute change nor a run of late packets awaits confirmation."""
        return self._compute_time() is not None and self._unconfirmed_difference is None and self._late_count == 0

    def initialise_minute(self, minute: int) -> None:
        """Set the minute, from a status-only packet (no milliseconds) or the host's clock, if none is known yet."""
        if self.minute is None:
            self.minute = minute

    def step(self, ms: int, minute: int | None = None, received_ns: int | None = None) -> tuple[int | None, int]:
        """(GPS time [ms] of the next packet, None while no minute is known; its order NEW, SAME or LATE).

        ms: milliseconds of the minute. minute: sent in channel 0, None if the packet has none. received_ns: host time
        of receipt, None for packets from a file.
        """
        pause = 0 if received_ns is None or self._received_ns is None else received_ns - self._received_ns
        self._received_ns = received_ns
        if self.milliseconds is None:
            return self._restart(ms, self.minute if minute is None else minute), NEW
        if pause > LONGEST_GAP_NS:
            return self._restart(ms, minute), NEW
        ahead = (ms - self.milliseconds) % MINUTE_MS
        if ahead >= HALF_MINUTE_MS:
            return self._step_back(ms, minute, MINUTE_MS - ahead)
        jumped = ahead * 1_000_000 - pause > MAX_STEP_EXCESS_NS
        if self.minute is not None and ms < self.milliseconds:
            self.minute += 1
        self.milliseconds, self._late_count = ms, 0
        if minute is not None:
            jumped |= self._correct_minute(ms, minute)
        self.jumps += jumped
        return self._compute_time(), NEW if ahead else SAME

    def _compute_time(self) -> int | None:
        """GPS time of the newest packet [ms]."""
        if self.minute is None or self.milliseconds is None:
            return None
        return self.minute * MINUTE_MS + self.milliseconds

    def _correct_minute(self, ms: int, minute: int) -> bool:
        """Replace the counted minute by a sent minute, unless this must be confirmed; returns whether time jumps."""
        difference = None if self.minute is None else minute - self.minute
        is_near_change = ms < CONFIRMATION_MS or ms >= MINUTE_MS - CONFIRMATION_MS
        if is_near_change and difference in (-1, 1) and self._unconfirmed_difference != difference:
            self._unconfirmed_difference = difference
            return False
        self.minute, self._unconfirmed_difference = minute, None
        return bool(difference)

    def _step_back(self, ms: int, minute: int | None, behind: int) -> tuple[int | None, int]:
        """(GPS time [ms], order) of a packet that seems late by `behind` [ms]; order NEW if the clock was set back."""
        now = self._compute_time()
        if minute is not None and now is not None and minute * MINUTE_MS + ms > now:  # a later minute was sent
            self.jumps += 1
            return self._restart(ms, minute), NEW
        if self._late_count and (ms - self._late_ms) % MINUTE_MS < HALF_MINUTE_MS:
            self._late_count += 1
            if self._late_minute is not None and ms < self._late_ms:
                self._late_minute += 1
        else:
            self._late_count, self._late_minute = 1, None
        self._late_ms = ms
        if minute is not None:
            self._late_minute = minute
        if self._late_count > MAX_LATE_RUN:
            self.jumps += 1
            return self._restart(ms, self._late_minute), NEW
        if minute is not None:
            return minute * MINUTE_MS + ms, LATE
        return None if now is None else now - behind, LATE

    def _restart(self, ms: int, minute: int | None) -> int | None:
        self.milliseconds, self.minute = ms, minute
        self._unconfirmed_difference, self._late_count = None, 0
        return self._compute_time()
