"""Converts the motion in a packet to ROS axes and units, and its position to a local map frame.

NED and FRD (forward, right, down) as sent become ENU and FLU (forward, left, up); WGS84 latitude, longitude and height
become coordinates of a local east-north-up frame:

    R_enu_flu = T R_no F,  T = [[0,1,0],[1,0,0],[0,0,-1]],  F = diag(1,-1,-1),  R_no = Rz(heading) Ry(pitch) Rx(roll)
    as fixed-axis angles: roll = roll, pitch = -pitch, yaw = pi/2 - heading

Plain floats, because numpy is ten times slower for single vectors. Source: NCOM manual 260702, REP-103.
Checked by: test_geometry.py (worked examples; short distances against the ellipsoid radii), and the inverse in st_sim.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from math import cos, degrees, isfinite, isnan, pi, radians, sin, tau
from typing import NamedTuple

from .ncom import ECCENTRICITY_SQUARED, radii
from .packet_time import NEW, SAME
from .status import StatusTracker
from .stream import HostMinute, NcomParser, Received

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

FIRST_FIX, GIVEN, UNIT = "first_fix", "given", "unit"
# A unit with a local frame sends it at least every 200 packets; after this time [ns], the unit is taken to have none.
LOCAL_FRAME_TIMEOUT_NS = 10_000_000_000


def yaw_from_heading(heading: float) -> float:
    """Yaw in (-pi, pi], counter-clockwise from east [rad], of a heading clockwise from north [rad]."""
    yaw = (1.5 * pi - heading) % tau - pi
    return pi if yaw == -pi else yaw


class Attitude:
    """Orientation of the vehicle (FLU) in ENU, from heading, pitch and roll as sent [rad]."""

    __slots__ = ("_rows", "pitch", "roll", "yaw")

    def __init__(self, heading: float, pitch: float, roll: float) -> None:
        self.yaw = yaw_from_heading(heading)
        self.pitch = -pitch
        self.roll = roll
        sy, cy = sin(self.yaw), cos(self.yaw)
        sp, cp = sin(self.pitch), cos(self.pitch)
        sr, cr = sin(roll), cos(roll)
        self._rows = (
            cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr,
            sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr,
            -sp, cp * sr, cp * cr)

    def quaternion(self) -> Quaternion:
        """x, y, z, w of the rotation from body axes to ENU; w >= 0."""
        sy, cy = sin(self.yaw / 2), cos(self.yaw / 2)
        sp, cp = sin(self.pitch / 2), cos(self.pitch / 2)
        sr, cr = sin(self.roll / 2), cos(self.roll / 2)
        x, y = sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy
        z, w = cr * cp * sy - sr * sp * cy, cr * cp * cy + sr * sp * sy
        return (x, y, z, w) if w >= 0 else (-x, -y, -z, -w)

    def to_body(self, enu: Vector) -> Vector:
        """Forward, left, up components of a vector given as east, north, up."""
        a, b, c, d, e, f, g, h, i = self._rows
        x, y, z = enu
        return a * x + d * y + g * z, b * x + e * y + h * z, c * x + f * y + i * z

    def to_enu(self, body: Vector) -> Vector:
        """East, north, up components of a vector given as forward, left, up."""
        a, b, c, d, e, f, g, h, i = self._rows
        x, y, z = body
        return a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z

    def covariance_to_body(self, enu_variances: Vector) -> tuple[float, ...]:
        """Covariance of independent ENU errors in body axes, row by row: R^T diag(enu_variances) R."""
        rows = self._rows
        ve, vn, vu = enu_variances
        xx, xy, xz = (
            ve * rows[0] * rows[j] + vn * rows[3] * rows[3 + j] + vu * rows[6] * rows[6 + j] for j in (0, 1, 2)
        )
        yy, yz = (ve * rows[1] * rows[j] + vn * rows[4] * rows[3 + j] + vu * rows[7] * rows[6 + j] for j in (1, 2))
        zz = ve * rows[2] ** 2 + vn * rows[5] ** 2 + vu * rows[8] ** 2
        return xx, xy, xz, xy, yy, yz, xz, yz, zz

    def orientation_covariance(self, attitude_variances: Vector) -> tuple[float, ...]:
        """Covariance about the fixed axes at small pitch and roll, row by row: Rz(yaw) diag(variances) Rz(yaw)^T.

        attitude_variances: of roll, pitch, heading [rad^2]."""
        s, c = sin(self.yaw), cos(self.yaw)
        roll, pitch, heading = attitude_variances
        cross = (roll - pitch) * s * c
        return c * c * roll + s * s * pitch, cross, 0.0, cross, s * s * roll + c * c * pitch, 0.0, 0.0, 0.0, heading


def flu_from_frd(frd: Vector) -> Vector:
    """Converts a vector from (forward, right, down) to (forward, left, up)."""
    return frd[0], -frd[1], -frd[2]


def to_ecef(latitude: float, longitude: float, height: float) -> tuple[float, float, float]:
    """Earth-centred x, y, z [m] from latitude, longitude [rad] and height above the ellipsoid [m]."""
    normal = radii(latitude)[1]
    axis_distance = (normal + height) * cos(latitude)
    z = (normal * (1 - ECCENTRICITY_SQUARED) + height) * sin(latitude)
    return axis_distance * cos(longitude), axis_distance * sin(longitude), z


class LocalFrame:
    """East-north-up frame, tangent to the ellipsoid at an origin."""

    def __init__(self, latitude: float, longitude: float, altitude: float) -> None:
        """Origin: latitude, longitude [rad], altitude [m] above the reference (geoid or ellipsoid) of the positions.

        Raises ValueError for an origin that is not finite.
        """
        if not (isfinite(latitude) and isfinite(longitude) and isfinite(altitude)):
            raise ValueError(f"origin {latitude}, {longitude}, {altitude} is not finite")
        self._ecef = to_ecef(latitude, longitude, altitude)
        self._rotation = sin(latitude), cos(latitude), sin(longitude), cos(longitude)

    def enu(self, latitude: float, longitude: float, altitude: float) -> tuple[float, float, float]:
        """East, north, up [m] of a position relative to the origin."""
        x, y, z = to_ecef(latitude, longitude, altitude)
        x0, y0, z0 = self._ecef
        dx, dy, dz = x - x0, y - y0, z - z0
        s_lat, c_lat, s_lon, c_lon = self._rotation
        outward = c_lon * dx + s_lon * dy
        return -s_lon * dx + c_lon * dy, -s_lat * outward + c_lat * dz, c_lat * outward + s_lat * dz


class Accuracy(NamedTuple):
    """Standard deviations reported by the unit; NaN if unknown (never sent, or declared outdated).

    position: east, north, up [m]. velocity: east, north, up [m/s]. attitude: roll, pitch, heading [rad].
    """

    position: Vector
    velocity: Vector
    attitude: Vector

    @classmethod
    def from_status(cls, status: StatusTracker) -> "Accuracy":
        get = status.number
        return cls((get("EastAcc"), get("NorthAcc"), get("AltAcc")), (get("VeAcc"), get("VnAcc"), get("VdAcc")),
                   (radians(get("RollAcc")), radians(get("PitchAcc")), radians(get("HeadingAcc"))))


def variances(deviations: Vector) -> Vector | None:
    """Squares of three standard deviations; None if one is unknown."""
    a, b, c = deviations
    return None if isnan(a + b + c) else (a**2, b**2, c**2)


@dataclass(slots=True)
class Motion:
    """Motion of the INS point at one instant.

    latitude, longitude [rad], altitude [m]: as sent.  velocity: ENU [m/s].  body_velocity [m/s], angular_velocity
    [rad/s], acceleration [m/s^2]: FLU.  acceleration: specific force, +9.8 up at rest.
    """

    latitude: float
    longitude: float
    altitude: float
    attitude: Attitude
    velocity: Vector
    body_velocity: Vector
    angular_velocity: Vector
    acceleration: Vector

    def position(self, frame: LocalFrame) -> Vector:
        """East, north, up [m] in a local frame."""
        return frame.enu(self.latitude, self.longitude, self.altitude)


def extract_motion(received: Received) -> Motion | None:
    """The motion in a packet; None unless it has a fix and valid position, velocity, angles and angular rates."""
    if received.rule.navigation != "valid" or received.kind not in ("regular", "trigger"):
        return None
    packet = received.packet
    total = sum(packet.velocity_ned) + sum(packet.angular_rate) + packet.latitude + packet.heading
    total += packet.pitch + packet.roll
    if not isfinite(total):
        return None
    attitude = Attitude(packet.heading, packet.pitch, packet.roll)
    north, east, down = packet.velocity_ned
    velocity = east, north, -down
    return Motion(packet.latitude, packet.longitude, packet.altitude, attitude, velocity, attitude.to_body(velocity),
                  flu_from_frd(packet.angular_rate), flu_from_frd(packet.acceleration))


class Origin:
    """Origin of the map frame: the first fix, a given point, or the unit's own local frame; constant once chosen.

    frame: None until chosen. geodetic: latitude, longitude [deg], altitude [m] of the origin. source: as configured.
    used: source of the chosen origin ("" before), FIRST_FIX also if the unit sends no local frame within 10 s.
    """

    def __init__(self, source: str, given: tuple[float, float, float] | None = None) -> None:
        """given: latitude, longitude [deg], altitude [m] as the unit sends it; required for source GIVEN."""
        self.source = source
        self.used = ""
        self.frame: LocalFrame | None = None
        self.geodetic: tuple[float, float, float] | None = None
        self._waiting_since_ns: int | None = None  # for the unit's local frame
        if given is not None:
            self._set(GIVEN, *given)

    def update(self, motion: Motion, status: StatusTracker, now_ns: int) -> LocalFrame | None:
        """The map frame, chosen now if not before; None while waiting for the unit's local frame.

        now_ns: time on any monotonic clock [ns].
        """
        if self.frame is not None:
            return self.frame
        if self.source == UNIT:
            local_frame = status.local_frame
            if local_frame is not None:
                return self._set(UNIT, *local_frame[:3])
            if self._waiting_since_ns is None:
                self._waiting_since_ns = now_ns
            if 0 <= now_ns - self._waiting_since_ns < LOCAL_FRAME_TIMEOUT_NS:
                return None
        return self._set(FIRST_FIX, degrees(motion.latitude), degrees(motion.longitude), motion.altitude)

    def _set(self, used: str, latitude: float, longitude: float, altitude: float) -> LocalFrame:
        self.used = used
        self.geodetic = latitude, longitude, altitude
        self.frame = LocalFrame(radians(latitude), radians(longitude), altitude)
        return self.frame


def reconstruct_odometry(packets: Iterable[tuple[int, bytes]], origin: Origin, live: bool = True,
                         by_receive_time: bool = False) -> Iterator[tuple[int, Vector, Motion]]:
    """(UTC [ns since 1970], ENU position relative to the origin [m], motion) of each odometry message that the live
    node publishes for recorded packets, bit-identical.

    packets: (time of receipt [ns since 1970], 72 bytes), in order of receipt. origin: as configured in the node.
    live: the packets came from a unit, not from a replayed file. by_receive_time: stamp_source was "receive".
    """
    parser, status, minute = NcomParser(), StatusTracker(), HostMinute()
    for received_ns, raw in packets:
        for received in parser.feed(raw, received_ns if live else None):
            received.received_ns = received_ns
            if received.order not in (NEW, SAME):
                continue
            if origin.frame is None:
                status.update_from(received)
            motion = extract_motion(received)
            frame = None if motion is None else origin.update(motion, status, received_ns)
            if received.kind != "regular" or received.order != NEW:
                continue
            if live:
                minute.update(received, received_ns, parser.clock)
            stamp = received_ns if by_receive_time else received.utc_ns
            if motion is not None and frame is not None and stamp is not None:
                yield stamp, motion.position(frame), motion
