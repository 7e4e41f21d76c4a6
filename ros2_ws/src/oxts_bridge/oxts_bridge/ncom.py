"""One NCOM packet (structure A, 72 bytes, little-endian) to and from physical values.

    byte  0      sync 0xE7
          1-2    u16 milliseconds into the GPS minute
          3-20   6 x i24: acceleration x, y, z [1e-4 m/s^2], angular rate x, y, z [1e-5 rad/s]     (vehicle axes, FRD)
          21     navigation status          22  checksum 1 over 1..21
          23-38  f64 latitude, longitude [rad]   39-42 f32 altitude [m]
          43-60  6 x i24: velocity north, east, down [1e-4 m/s], heading, pitch, roll [1e-6 rad]
          61     checksum 2 over 1..60      62  status channel      63-70  batch S      71  checksum 3 over 1..70

An i24 of -8388608 means "invalid" and is NaN here. Source: NCOM manual 260702; checked by
tests/golden/test_ncom_vectors.py.
"""

import math
import struct
from dataclasses import dataclass
from typing import Any

NAN = math.nan
SYNC = 0xE7
PACKET_SIZE = 72
STRUCTURE_B = 11

# First bytes of the fields, as in _LAYOUT below. Each checksum is of all bytes after the sync up to it.
MILLISECONDS_AT, ACCELERATION_AT, ANGULAR_RATE_AT, STATUS_AT, CHECKSUM_1_AT = 1, 3, 12, 21, 22
LATITUDE_AT, LONGITUDE_AT, ALTITUDE_AT = 23, 31, 39
VELOCITY_AT, ANGLES_AT, CHECKSUM_2_AT = 43, 52, 61
CHANNEL_AT, BATCH_S_AT, CHECKSUM_3_AT = 62, 63, 71
BATCH_S = slice(BATCH_S_AT, CHECKSUM_3_AT)

ACCELERATION_UNIT = 1e-4
ANGULAR_RATE_UNIT = 1e-5
VELOCITY_UNIT = 1e-4
ANGLE_UNIT = 1e-6

INVALID_I24 = -0x800000
LARGEST_I24 = 0x7FFFFF

# An i24 is read as its low 16 bits (unsigned) and its high 8 bits (signed).
_LAYOUT = struct.Struct("<xH HbHbHb HbHbHb B x ddf HbHbHb HbHbHb x B 8s x")


class NcomError(ValueError):
    """Bytes that are not a structure A packet, or a packet that cannot be put into bytes."""


@dataclass(slots=True)
class Packet:
    """What one packet says, in the wire's frames: navigation NED, vehicle FRD (x forward, y right, z down). NaN =
    invalid.

    milliseconds: into the GPS minute, 0..59999 (larger numbers are kept as sent).
    acceleration: specific force x, y, z [m/s^2], about -9.81 on z at rest, |a| <= 838.8607.
    angular_rate: x, y, z [rad/s] relative to inertial space, |w| <= 83.88607.
    navigation_status: 0..255, see navigation.py.
    latitude, longitude: geodetic [rad].  altitude: [m], above the geoid unless the unit is configured otherwise.
    velocity_ned: north, east, down [m/s], |v| <= 838.8607.
    heading: from true north clockwise [rad], pitch: nose up + [rad], roll: right side down + [rad].
    channel: number of the status channel in batch_s; batch_s: its 8 bytes, see channels.py.
    """

    milliseconds: int = 0
    acceleration: tuple[float, float, float] = (NAN, NAN, NAN)
    angular_rate: tuple[float, float, float] = (NAN, NAN, NAN)
    navigation_status: int = 0
    latitude: float = NAN
    longitude: float = NAN
    altitude: float = NAN
    velocity_ned: tuple[float, float, float] = (NAN, NAN, NAN)
    heading: float = NAN
    pitch: float = NAN
    roll: float = NAN
    channel: int = 255
    batch_s: bytes = b"\xff" * 8


def decode(data: bytes) -> Packet:
    """The physical values of 72 bytes. Checksums are the parser's business and not looked at here.

    Raises NcomError for another length, a wrong sync byte, or structure B (navigation status 11, vendor-internal).
    """
    if len(data) != PACKET_SIZE or data[0] != SYNC:
        raise NcomError(f"not an NCOM packet: {len(data)} bytes starting with {data[:1].hex() or 'nothing'}")
    if data[STATUS_AT] == STRUCTURE_B:
        raise NcomError("structure B packet (navigation status 11): its contents are private to the vendor")
    return decode_unchecked(data)


def decode_unchecked(data: bytes) -> Packet:
    """As decode(), for 72 bytes already known to be a structure A packet."""
    (ms, x0, x1, y0, y1, z0, z1, p0, p1, q0, q1, r0, r1, status, latitude, longitude, altitude,
     n0, n1, e0, e1, d0, d1, h0, h1, t0, t1, l0, l1, channel, batch_s) = _LAYOUT.unpack(data)
    # Written out because this runs for every packet: a call per component would double its time.
    return Packet(
        ms,
        (
            NAN if x1 == -128 and not x0 else (x1 << 16 | x0) * ACCELERATION_UNIT,
            NAN if y1 == -128 and not y0 else (y1 << 16 | y0) * ACCELERATION_UNIT,
            NAN if z1 == -128 and not z0 else (z1 << 16 | z0) * ACCELERATION_UNIT,
        ),
        (
            NAN if p1 == -128 and not p0 else (p1 << 16 | p0) * ANGULAR_RATE_UNIT,
            NAN if q1 == -128 and not q0 else (q1 << 16 | q0) * ANGULAR_RATE_UNIT,
            NAN if r1 == -128 and not r0 else (r1 << 16 | r0) * ANGULAR_RATE_UNIT,
        ),
        status,
        latitude,
        longitude,
        altitude,
        (
            NAN if n1 == -128 and not n0 else (n1 << 16 | n0) * VELOCITY_UNIT,
            NAN if e1 == -128 and not e0 else (e1 << 16 | e0) * VELOCITY_UNIT,
            NAN if d1 == -128 and not d0 else (d1 << 16 | d0) * VELOCITY_UNIT,
        ),
        NAN if h1 == -128 and not h0 else (h1 << 16 | h0) * ANGLE_UNIT,
        NAN if t1 == -128 and not t0 else (t1 << 16 | t0) * ANGLE_UNIT,
        NAN if l1 == -128 and not l0 else (l1 << 16 | l0) * ANGLE_UNIT,
        channel,
        batch_s,
    )


def encode(packet: Packet) -> bytes:
    """The 72 bytes of a packet, checksums filled. encode(decode(p)) == p for every packet with right checksums.

    Values are rounded to the wire's unit (half to even) and limited to +/- 8388607 units; NaN becomes the invalid mark.
    Angles are written as given: keep the heading within +/- pi, which is what units send. Raises NcomError for a
    batch_s that is not 8 bytes or an integer field outside its range.
    """
    if len(packet.batch_s) != 8:
        raise NcomError(f"batch_s has {len(packet.batch_s)} bytes, 8 wanted")
    if packet.navigation_status == STRUCTURE_B:
        raise NcomError("structure B packets (navigation status 11) cannot be made")
    early: list[int] = []
    for values, unit in ((packet.acceleration, ACCELERATION_UNIT), (packet.angular_rate, ANGULAR_RATE_UNIT)):
        for value in values:
            early += _i24_parts(value, unit)
    late: list[int] = []
    for value in packet.velocity_ned:
        late += _i24_parts(value, VELOCITY_UNIT)
    for value in (packet.heading, packet.pitch, packet.roll):
        late += _i24_parts(value, ANGLE_UNIT)
    try:
        data = bytearray(_LAYOUT.pack(
            packet.milliseconds, *early, packet.navigation_status, packet.latitude, packet.longitude, packet.altitude,
            *late, packet.channel, packet.batch_s))
    except (struct.error, OverflowError) as error:
        raise NcomError(f"packet does not fit the wire: {error}") from None
    data[0] = SYNC
    return _fill_checksums(data)


def is_place(latitude: Any, longitude: Any, altitude: Any) -> Any:
    """Whether these [rad, rad, m], numbers or arrays, can be a position."""
    return (abs(latitude) <= math.pi / 2) & (abs(longitude) <= 2 * math.pi) & (abs(altitude) < math.inf)


def inner_checksums_match(data: bytes) -> bool:
    """Whether checksums 1 and 2 of a structure A packet are right (the parser counts, but accepts, wrong ones)."""
    first = sum(data[1:CHECKSUM_1_AT])
    second = first + sum(data[CHECKSUM_1_AT:CHECKSUM_2_AT])
    return first & 0xFF == data[CHECKSUM_1_AT] and second & 0xFF == data[CHECKSUM_2_AT]


def _fill_checksums(data: bytearray) -> bytes:
    data[CHECKSUM_1_AT] = sum(data[1:CHECKSUM_1_AT]) & 0xFF
    data[CHECKSUM_2_AT] = sum(data[1:CHECKSUM_2_AT]) & 0xFF
    data[CHECKSUM_3_AT] = sum(data[1:CHECKSUM_3_AT]) & 0xFF
    return bytes(data)


def _i24_parts(value: float, unit: float) -> tuple[int, int]:
    """(low 16 bits, high 8 bits signed) of a value in its unit."""
    if math.isnan(value):
        raw = INVALID_I24
    elif abs(value) >= LARGEST_I24 * unit:
        raw = LARGEST_I24 if value > 0 else -LARGEST_I24
    else:
        raw = round(value / unit)
    return raw & 0xFFFF, raw >> 16
