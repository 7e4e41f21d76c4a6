"""Axes: the wire's NED and FRD (forward, right, down) to ROS' ENU and FLU (forward, left, up). Plain floats, no arrays.

    R_enu_flu = T R_no F,  T = [[0,1,0],[1,0,0],[0,0,-1]],  F = diag(1,-1,-1),  R_no = Rz(heading) Ry(pitch) Rx(roll)
    as fixed-axis angles: roll = roll, pitch = -pitch, yaw = pi/2 - heading

Source: ncom.md section 10 (REP-103). Checked by: test_attitude.py with its worked examples.
"""

from math import cos, pi, sin, tau

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


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
        """R^T diag(east^2, north^2, up^2) R, row by row: a covariance of independent east, north, up errors in body
        axes."""
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
