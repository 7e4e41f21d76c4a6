"""Axes, orientation and position: NED and FRD (forward, right, down) of the wire to ENU and FLU (forward, left, up) of
ROS, and WGS84 latitude, longitude, height to a local east-north-up frame.

    R_enu_flu = T R_no F,  T = [[0,1,0],[1,0,0],[0,0,-1]],  F = diag(1,-1,-1),  R_no = Rz(heading) Ry(pitch) Rx(roll)
    as fixed-axis angles: roll = roll, pitch = -pitch, yaw = pi/2 - heading

Plain floats: for single vectors numpy is ten times slower. Source: ncom.md sections 9 to 11 (REP-103). Checked by:
test_geometry.py (worked examples; ellipsoid radii as the short-distance limit), and st_sim against the inverse.
"""

from dataclasses import dataclass, field
from math import cos, isfinite, pi, radians, sin, sqrt, tau

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

SEMI_MAJOR_AXIS = 6_378_137.0
FLATTENING = 1 / 298.257223563
ECCENTRICITY_SQUARED = FLATTENING * (2 - FLATTENING)


def yaw_from_heading(heading: float) -> float:
    """Yaw from east, counter-clockwise [rad], in (-pi, pi], from a heading from north, clockwise [rad]."""
    yaw = (1.5 * pi - heading) % tau - pi
    return pi if yaw == -pi else yaw


class Attitude:
    """Orientation of the vehicle (FLU) in ENU from heading, pitch, roll as sent [rad] (NED to FRD)."""

    __slots__ = ("_rows", "pitch", "roll", "yaw")

    def __init__(self, heading: float, pitch: float, roll: float) -> None:
        self.yaw = yaw_from_heading(heading)
        self.pitch = -pitch
        self.roll = roll
        sy, cy = sin(self.yaw), cos(self.yaw)
        sp, cp = sin(self.pitch), cos(self.pitch)
        sr, cr = sin(roll), cos(roll)
        self._rows = (
            cy * cp,
            cy * sp * sr - sy * cr,
            cy * sp * cr + sy * sr,
            sy * cp,
            sy * sp * sr + cy * cr,
            sy * sp * cr - cy * sr,
            -sp,
            cp * sr,
            cp * cr,
        )

    def quaternion(self) -> Quaternion:
        """x, y, z, w of the rotation body to ENU, w >= 0."""
        sy, cy = sin(self.yaw / 2), cos(self.yaw / 2)
        sp, cp = sin(self.pitch / 2), cos(self.pitch / 2)
        sr, cr = sin(self.roll / 2), cos(self.roll / 2)
        x, y = sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy
        z, w = cr * cp * sy - sr * sp * cy, cr * cp * cy + sr * sp * sy
        return (x, y, z, w) if w >= 0 else (-x, -y, -z, -w)

    def to_body(self, enu: Vector) -> Vector:
        """Components along forward, left, up of a vector given as east, north, up."""
        a, b, c, d, e, f, g, h, i = self._rows
        x, y, z = enu
        return a * x + d * y + g * z, b * x + e * y + h * z, c * x + f * y + i * z

    def to_enu(self, body: Vector) -> Vector:
        """Components along east, north, up of a vector given as forward, left, up."""
        a, b, c, d, e, f, g, h, i = self._rows
        x, y, z = body
        return a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z

    def covariance_to_body(self, enu_variances: Vector) -> tuple[float, ...]:
        """R^T diag(east^2, north^2, up^2) R, row by row: covariance in body axes of independent ENU errors."""
        rows = self._rows
        ve, vn, vu = enu_variances
        xx, xy, xz = (
            ve * rows[0] * rows[j] + vn * rows[3] * rows[3 + j] + vu * rows[6] * rows[6 + j] for j in (0, 1, 2)
        )
        yy, yz = (ve * rows[1] * rows[j] + vn * rows[4] * rows[3 + j] + vu * rows[7] * rows[6 + j] for j in (1, 2))
        zz = ve * rows[2] ** 2 + vn * rows[5] ** 2 + vu * rows[8] ** 2
        return xx, xy, xz, xy, yy, yz, xz, yz, zz

    def orientation_covariance(self, roll: float, pitch: float, heading: float) -> tuple[float, ...]:
        """Rz(yaw) diag(roll^2, pitch^2, heading^2) Rz(yaw)^T, row by row: errors about the fixed axes, small pitch
        and roll.

        roll, pitch, heading: one standard deviation [rad].
        """
        s, c = sin(self.yaw), cos(self.yaw)
        r, p = roll * roll, pitch * pitch
        cross = (r - p) * s * c
        return c * c * r + s * s * p, cross, 0.0, cross, s * s * r + c * c * p, 0.0, 0.0, 0.0, heading * heading


def enu_from_ned(ned: Vector) -> Vector:
    """(north, east, down) to (east, north, up)."""
    return ned[1], ned[0], -ned[2]


def flu_from_frd(frd: Vector) -> Vector:
    """(forward, right, down) to (forward, left, up)."""
    return frd[0], -frd[1], -frd[2]


def radii(latitude: float) -> tuple[float, float]:
    """(meridian, normal) radius of curvature [m] at a geodetic latitude [rad]."""
    w = 1 - ECCENTRICITY_SQUARED * sin(latitude) ** 2
    normal = SEMI_MAJOR_AXIS / sqrt(w)
    return normal * (1 - ECCENTRICITY_SQUARED) / w, normal


def to_ecef(latitude: float, longitude: float, height: float) -> tuple[float, float, float]:
    """Earth-centred x, y, z [m] of latitude, longitude [rad], height above the ellipsoid [m]."""
    normal = radii(latitude)[1]
    across = (normal + height) * cos(latitude)
    return (
        across * cos(longitude),
        across * sin(longitude),
        (normal * (1 - ECCENTRICITY_SQUARED) + height) * sin(latitude),
    )


@dataclass(frozen=True)
class LocalFrame:
    """East-north-up frame at an origin.

    latitude, longitude: [rad]; altitude: [m], of the same kind (geoid or ellipsoid) as the positions.
    """

    latitude: float
    longitude: float
    altitude: float
    _ecef: tuple[float, float, float] = field(init=False, repr=False)
    _rotation: tuple[float, float, float, float] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if not (isfinite(self.latitude) and isfinite(self.longitude) and isfinite(self.altitude)):
            raise ValueError(f"origin {self.latitude}, {self.longitude}, {self.altitude} is not finite")
        object.__setattr__(self, "_ecef", to_ecef(self.latitude, self.longitude, self.altitude))
        object.__setattr__(
            self, "_rotation", (sin(self.latitude), cos(self.latitude), sin(self.longitude), cos(self.longitude))
        )

    def enu(self, latitude: float, longitude: float, altitude: float) -> tuple[float, float, float]:
        """East, north, up [m] of a position from the origin."""
        x, y, z = to_ecef(latitude, longitude, altitude)
        x0, y0, z0 = self._ecef
        dx, dy, dz = x - x0, y - y0, z - z0
        s_lat, c_lat, s_lon, c_lon = self._rotation
        outward = c_lon * dx + s_lon * dy
        return -s_lon * dx + c_lon * dy, -s_lat * outward + c_lat * dz, c_lat * outward + s_lat * dz


def ellipsoidal_height(altitude: float, undulation: float) -> float:
    """altitude + undulation: height above the ellipsoid [m] of an altitude above the geoid [m].

    The manual prints a minus sign; real recordings show the plus (ncom.md section 9).
    """
    return altitude + undulation


def origin_from_channel_25(
    x: float, y: float, heading_deg: float, latitude: float, longitude: float, altitude: float
) -> tuple[float, float, float, float]:
    """Local frame of old firmware: latitude, longitude [rad], altitude [m] of its origin and its heading [deg].

    x, y: present position in the local frame [m], heading_deg: of its x axis from north. latitude, longitude [rad],
    altitude [m]: present position. The latitude is iterated because the radii are those at the origin.
    """
    heading = radians(heading_deg)
    north = x * cos(heading) + y * sin(heading)
    east = x * sin(heading) - y * cos(heading)
    origin = latitude
    for _ in range(4):
        meridian, normal = radii(origin)
        origin = latitude - north / (meridian + altitude)
    return origin, longitude - east / ((normal + altitude) * cos(origin)), altitude, heading_deg


def wrap_degrees(angle: float) -> float:
    """The angle [deg] in (-180, 180]."""
    wrapped = (angle + 180.0) % 360.0 - 180.0
    return 180.0 if wrapped == -180.0 else wrapped
