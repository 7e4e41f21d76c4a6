"""Attitude, the WGS84 ellipsoid, and local frames on it, for single values and for columns.

NED and FRD (forward, right, down), as in a packet, become ENU and FLU (forward, left, up):

    R_enu_flu = T R_ned_frd F,  T = [[0,1,0],[1,0,0],[0,0,-1]],  F = diag(1,-1,-1),
    R_ned_frd = Rz(heading) Ry(pitch) Rx(roll);  about fixed ENU axes: (roll, -pitch, pi/2 - heading)

Source: NCOM manual 260702, REP-103. Checked by: test_geometry.py (worked examples; short distances against the radii of
the ellipsoid), and the inverse functions in st_sim.
"""

import math
from math import cos, isfinite, pi, radians, sin, tau
from typing import Any, TypeAlias

import numpy as np
from st_core.errors import StCoreError

Number: TypeAlias = Any
"""A float, or a column of floats."""
Vector: TypeAlias = tuple[Number, Number, Number]
Quaternion: TypeAlias = tuple[Number, Number, Number, Number]

SEMI_MAJOR_AXIS = 6_378_137.0  # m
FLATTENING = 1 / 298.257223563
ECCENTRICITY_SQUARED = FLATTENING * (2 - FLATTENING)

# For single values, the functions of `math` compute attitudes and positions in a quarter of the time.
_FLOAT_FUNCTIONS, _ARRAY_FUNCTIONS = (math.sin, math.cos, math.sqrt), (np.sin, np.cos, np.sqrt)


def _get_functions(value: Number) -> Any:
    """Sine, cosine and square root for values of this type."""
    return _ARRAY_FUNCTIONS if isinstance(value, np.ndarray) else _FLOAT_FUNCTIONS


class Attitude:
    """Orientation of the vehicle (FLU) in ENU: yaw, pitch (positive nose down) and roll about fixed axes [rad]."""

    __slots__ = ("_matrix", "pitch", "roll", "yaw")

    def __init__(self, yaw: Number, pitch: Number, roll: Number) -> None:
        self.yaw, self.pitch, self.roll = yaw, pitch, roll
        sin, cos, _ = _get_functions(yaw)
        sy, cy, sp, cp, sr, cr = sin(yaw), cos(yaw), sin(pitch), cos(pitch), sin(roll), cos(roll)
        self._matrix = (
            cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr,
            sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr,
            -sp, cp * sr, cp * cr)

    @classmethod
    def from_ned(cls, heading: Number, pitch: Number, roll: Number) -> "Attitude":
        """Attitude from packet angles [rad]: heading clockwise from north, pitch > 0 nose up, roll > 0 right down."""
        return cls(pi - (pi / 2 + heading) % tau, -pitch, roll)  # yaw in (-pi, pi], counter-clockwise from east

    def to_quaternion(self) -> Quaternion:
        """x, y, z, w of the rotation from body axes to ENU; w >= 0."""
        sin, cos, _ = _get_functions(self.yaw)
        yaw, pitch, roll = self.yaw / 2, self.pitch / 2, self.roll / 2
        sy, cy, sp, cp, sr, cr = sin(yaw), cos(yaw), sin(pitch), cos(pitch), sin(roll), cos(roll)
        w = cr * cp * cy + sr * sp * sy
        sign = 1.0 - 2.0 * (w < 0.0)
        return (sign * (sr * cp * cy - cr * sp * sy), sign * (cr * sp * cy + sr * cp * sy),
                sign * (cr * cp * sy - sr * sp * cy), sign * w)

    def to_body(self, enu: Vector) -> Vector:
        """Forward, left, up components of a vector given as east, north, up."""
        a, b, c, d, e, f, g, h, i = self._matrix
        x, y, z = enu
        return a * x + d * y + g * z, b * x + e * y + h * z, c * x + f * y + i * z

    def to_enu(self, body: Vector) -> Vector:
        """East, north, up components of a vector given as forward, left, up."""
        a, b, c, d, e, f, g, h, i = self._matrix
        x, y, z = body
        return a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z

    def rotate_covariance(self, enu_variances: Vector) -> tuple[float, ...]:
        """Covariance of independent ENU errors in body axes, row by row: R^T diag(enu_variances) R."""
        a, b, c, d, e, f, g, h, i = self._matrix
        ve, vn, vu = enu_variances
        xy, xz = ve * a * b + vn * d * e + vu * g * h, ve * a * c + vn * d * f + vu * g * i
        yz = ve * b * c + vn * e * f + vu * h * i
        return (ve * a * a + vn * d * d + vu * g * g, xy, xz, xy, ve * b * b + vn * e * e + vu * h * h, yz,
                xz, yz, ve * c * c + vn * f * f + vu * i * i)

    def rotate_orientation_covariance(self, attitude_variances: Vector) -> tuple[float, ...]:
        """Covariance about the ENU axes for small pitch and roll, row by row: Rz(yaw) diag(variances) Rz(yaw)^T.

        attitude_variances: of roll, pitch, heading [rad^2]."""
        sin, cos, _ = _get_functions(self.yaw)
        s, c = sin(self.yaw), cos(self.yaw)
        roll, pitch, heading = attitude_variances
        cross = (roll - pitch) * s * c
        return c * c * roll + s * s * pitch, cross, 0.0, cross, s * s * roll + c * c * pitch, 0.0, 0.0, 0.0, heading


def flu_from_frd(frd: Vector) -> Vector:
    """A vector (forward, right, down) as (forward, left, up), or vice versa."""
    return frd[0], -frd[1], -frd[2]


def compute_radii(latitude: Number) -> tuple[Number, Number]:
    """(meridian, normal) radius of curvature [m] at a geodetic latitude [rad]."""
    sin, _, sqrt = _get_functions(latitude)
    w = 1 - ECCENTRICITY_SQUARED * sin(latitude) ** 2
    normal = SEMI_MAJOR_AXIS / sqrt(w)
    return normal * (1 - ECCENTRICITY_SQUARED) / w, normal


def to_ecef(latitude: Number, longitude: Number, height: Number) -> Vector:
    """Earth-centred x, y, z [m] from latitude, longitude [rad] and height above the ellipsoid [m]."""
    sin, cos, _ = _get_functions(latitude)
    _, normal = compute_radii(latitude)
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

    def to_enu(self, latitude: Number, longitude: Number, altitude: Number) -> Vector:
        """East, north, up [m] of a position relative to the origin."""
        x, y, z = to_ecef(latitude, longitude, altitude)
        x0, y0, z0 = self._ecef
        dx, dy, dz = x - x0, y - y0, z - z0
        s_lat, c_lat, s_lon, c_lon = self._rotation
        outward = c_lon * dx + s_lon * dy
        return -s_lon * dx + c_lon * dy, -s_lat * outward + c_lat * dz, c_lat * outward + s_lat * dz


def compute_origin_offset(origin: tuple[float, float], latitude: float, longitude: float) -> tuple[float, float]:
    """East and north offset [m] of a point from the origin (latitude, longitude); angles in deg, altitudes 0.

    Raises StCoreError for an origin that is not finite.
    """
    if not (isfinite(origin[0]) and isfinite(origin[1])):
        raise StCoreError(f"the origin of the map ({origin[0]:g}, {origin[1]:g} deg) is unknown")
    frame = LocalFrame(radians(origin[0]), radians(origin[1]), 0.0)
    return frame.to_enu(radians(latitude), radians(longitude), 0.0)[:2]
