"""Axes and signs against examples and the matrix product R_enu_flu = T R_ned_frd F; conversion from the earth to the
local frame against closed forms and the radii of the ellipsoid.
"""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oxts_bridge.geometry import Attitude, LocalFrame, compute_radii, flu_from_frd, to_ecef
from oxts_bridge.status import compute_legacy_origin, wrap_degrees

POLAR_RADIUS = 6356752.314245179  # of WGS 84 [m]
T = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])  # NED to ENU
F = np.diag([1.0, -1, -1])  # FLU to FRD


def r_ned_frd(heading, pitch, roll):
    """Vehicle (FRD) to navigation (NED): Rz Ry Rx."""
    (sh, ch), (sp, cp), (sr, cr) = ((math.sin(a), math.cos(a)) for a in (heading, pitch, roll))
    rz = np.array([[ch, -sh, 0], [sh, ch, 0], [0, 0, 1]])
    ry = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    rx = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    return rz @ ry @ rx


def from_quaternion(x, y, z, w):
    return np.array([[1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                     [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                     [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]])


@pytest.mark.parametrize(("degrees", "quaternion"), [
    ((30, 5, -10), (-0.053680547, -0.081168145, 0.494330919, 0.863809628)),
    ((0, 0, 0), (0, 0, 0.707106781, 0.707106781)),
    ((359, 10, 20), (0.182467931, 0.063223137, 0.710349539, 0.676839583)),
])
def test_orientation_examples(degrees, quaternion):
    """degrees: heading, pitch, roll."""
    assert Attitude.from_ned(*map(math.radians, degrees)).to_quaternion() == pytest.approx(quaternion, abs=1e-9)


def test_velocity_example():
    attitude = Attitude.from_ned(*map(math.radians, (30, 5, -10)))
    assert attitude.to_body((5, 10, 0.5)) == pytest.approx((11.16136377, 0.74210656, -0.35105068), abs=1e-8)


def test_frd_to_flu():
    assert flu_from_frd((1.0, 2.0, -9.81)) == (1.0, -2.0, 9.81)


@pytest.mark.parametrize(("heading", "yaw"), [
    (0, 90), (90, 0), (180, -90), (-90, 180), (270, 180), (30, 60), (359, 91)])
def test_yaw_from_heading(heading, yaw):
    assert math.degrees(Attitude.from_ned(math.radians(heading), 0.0, 0.0).yaw) == pytest.approx(yaw)


angles = st.tuples(st.floats(-3.14, 3.14), st.floats(-1.5, 1.5), st.floats(-3.14, 3.14))
vectors = st.tuples(*[st.floats(-100, 100)] * 3)


@given(angles=angles, enu=vectors)
def test_rotation_is_the_matrix_product(angles, enu):
    attitude = Attitude.from_ned(*angles)
    matrix = T @ r_ned_frd(*angles) @ F
    assert from_quaternion(*attitude.to_quaternion()) == pytest.approx(matrix, abs=1e-9)
    assert attitude.to_body(enu) == pytest.approx(matrix.T @ enu, abs=1e-9)
    assert attitude.to_enu(attitude.to_body(enu)) == pytest.approx(enu, abs=1e-9)


@given(angles=angles, sigma=st.tuples(*[st.floats(0.001, 10)] * 3))
def test_velocity_covariance_is_rotated_to_body_axes(angles, sigma):
    matrix = T @ r_ned_frd(*angles) @ F
    covariance = Attitude.from_ned(*angles).rotate_covariance(tuple(np.square(sigma)))
    expected = matrix.T @ np.diag(np.square(sigma)) @ matrix
    assert np.reshape(covariance, (3, 3)) == pytest.approx(expected, abs=1e-9)


@given(heading=st.floats(-3.14, 3.14), sigma=st.tuples(*[st.floats(0.001, 1)] * 3))
def test_orientation_covariance_is_rotated_to_map_axes(heading, sigma):
    attitude = Attitude.from_ned(heading, 0.0, 0.0)
    s, c = math.sin(attitude.yaw), math.cos(attitude.yaw)
    rz = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    covariance = attitude.rotate_orientation_covariance(tuple(np.square(sigma)))
    expected = rz @ np.diag(np.square(sigma)) @ rz.T
    assert np.reshape(covariance, (3, 3)) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize(("position", "ecef"), [
    ((0, 0, 0), (6378137.0, 0, 0)),
    ((0, math.pi / 2, 10), (0, 6378147.0, 0)),
    ((math.pi / 2, 0, 0), (0, 0, POLAR_RADIUS)),
    ((-math.pi / 2, 1, 5), (0, 0, -POLAR_RADIUS - 5)),
])
def test_ecef_coordinates_on_the_axes(position, ecef):
    assert to_ecef(*position) == pytest.approx(ecef, abs=1e-6)


@given(latitude=st.floats(-1.4, 1.4), longitude=st.floats(-3.1, 3.1), north=st.floats(-50, 50), east=st.floats(-50, 50))
def test_short_distances_agree_with_the_radii_of_curvature(latitude, longitude, north, east):
    meridian, normal = compute_radii(latitude)
    frame = LocalFrame(latitude, longitude, 100.0)
    point = (latitude + north / (meridian + 100), longitude + east / ((normal + 100) * math.cos(latitude)), 103.0)
    # At a distance d <= 50 m the parallel deviates by tan(latitude) d^2 / 2R, and the earth curves down by d^2 / 2R.
    assert frame.to_enu(*point) == pytest.approx((east, north, 3.0), abs=5e-3)


def test_earth_curves_down_over_10_km():
    frame = LocalFrame(math.radians(52), 0.0, 0.0)
    _, normal = compute_radii(math.radians(52))
    up = frame.to_enu(math.radians(52), 10_000 / (normal * math.cos(math.radians(52))), 0.0)[2]
    assert up == pytest.approx(-(10_000**2) / (2 * normal), rel=2e-3)


def along_heading(east, north, heading):
    """x along a heading [rad, clockwise from north], y to its left."""
    sin, cos = math.sin(heading), math.cos(heading)
    return east * sin + north * cos, -east * cos + north * sin


@given(x=st.floats(-3000, 3000), y=st.floats(-3000, 3000), heading=st.floats(-180, 180))
def test_origin_from_channel_25_gives_its_local_coordinates(x, y, heading):
    position = (math.radians(52), math.radians(-1.25), 100.0)
    latitude, longitude, altitude, angle = compute_legacy_origin(x, y, heading, *position)
    latitude, longitude = math.radians(latitude), math.radians(longitude)
    east, north, _ = LocalFrame(latitude, longitude, altitude).to_enu(*position)
    # Old firmware computes with a flat earth.
    assert along_heading(east, north, math.radians(angle)) == pytest.approx((x, y), abs=4.0)
    meridian, normal = compute_radii(latitude)
    flat_north = (position[0] - latitude) * (meridian + 100)
    flat_east = (position[1] - longitude) * (normal + 100) * math.cos(latitude)
    assert along_heading(flat_east, flat_north, math.radians(angle)) == pytest.approx((x, y), abs=1e-6)


@pytest.mark.parametrize(("angle", "wrapped"), [(180, 180), (-180, 180), (190, -170), (-190, 170), (540, 180), (0, 0)])
def test_wrap_degrees(angle, wrapped):
    assert wrap_degrees(angle) == pytest.approx(wrapped)


def test_origin_that_is_not_finite_is_rejected():
    with pytest.raises(ValueError, match="not finite"):
        LocalFrame(math.nan, 0.0, 0.0)
