"""Axes and signs: the worked examples of ncom.md section 10, and R_enu_flu = T R_no F written out with matrices."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oxts_bridge.attitude import Attitude, enu_from_ned, flu_from_frd, yaw_from_heading

T = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
F = np.diag([1.0, -1, -1])


def r_no(heading, pitch, roll):
    """Vehicle (FRD) to navigation (NED): Rz Ry Rx."""
    (sh, ch), (sp, cp), (sr, cr) = ((math.sin(a), math.cos(a)) for a in (heading, pitch, roll))
    rz = np.array([[ch, -sh, 0], [sh, ch, 0], [0, 0, 1]])
    ry = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    rx = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    return rz @ ry @ rx


def from_quaternion(x, y, z, w):
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


@pytest.mark.parametrize(
    ("degrees", "quaternion"),
    [
        ((30, 5, -10), (-0.053680547, -0.081168145, 0.494330919, 0.863809628)),
        ((0, 0, 0), (0, 0, 0.707106781, 0.707106781)),
        ((359, 10, 20), (0.182467931, 0.063223137, 0.710349539, 0.676839583)),
    ],
)
def test_worked_orientations(degrees, quaternion):
    assert Attitude(*map(math.radians, degrees)).quaternion() == pytest.approx(quaternion, abs=1e-9)


def test_worked_velocity():
    attitude = Attitude(*map(math.radians, (30, 5, -10)))
    assert enu_from_ned((10, 5, -0.5)) == (5, 10, 0.5)
    assert attitude.to_body((5, 10, 0.5)) == pytest.approx((11.16136377, 0.74210656, -0.35105068), abs=1e-8)


def test_body_signs():
    assert flu_from_frd((1.0, 2.0, -9.81)) == (1.0, -2.0, 9.81)


@pytest.mark.parametrize(
    ("heading", "yaw"), [(0, 90), (90, 0), (180, -90), (-90, 180), (270, 180), (30, 60), (359, 91)]
)
def test_yaw_from_heading(heading, yaw):
    assert math.degrees(yaw_from_heading(math.radians(heading))) == pytest.approx(yaw)


angles = st.tuples(st.floats(-3.14, 3.14), st.floats(-1.5, 1.5), st.floats(-3.14, 3.14))
vectors = st.tuples(*[st.floats(-100, 100)] * 3)


@given(angles=angles, enu=vectors)
def test_rotation_is_the_matrix_product(angles, enu):
    attitude = Attitude(*angles)
    matrix = T @ r_no(*angles) @ F
    assert from_quaternion(*attitude.quaternion()) == pytest.approx(matrix, abs=1e-9)
    assert attitude.to_body(enu) == pytest.approx(matrix.T @ enu, abs=1e-9)
    assert attitude.to_enu(attitude.to_body(enu)) == pytest.approx(enu, abs=1e-9)


@given(angles=angles, sigma=st.tuples(*[st.floats(0.001, 10)] * 3))
def test_velocity_covariance_is_rotated(angles, sigma):
    matrix = T @ r_no(*angles) @ F
    wanted = matrix.T @ np.diag(np.square(sigma)) @ matrix
    got = Attitude(*angles).covariance_to_body(tuple(s * s for s in sigma))
    assert np.reshape(got, (3, 3)) == pytest.approx(wanted, abs=1e-9)


@given(heading=st.floats(-3.14, 3.14), sigma=st.tuples(*[st.floats(0.001, 1)] * 3))
def test_orientation_covariance_is_turned_to_the_fixed_axes(heading, sigma):
    roll, pitch, about_up = sigma
    attitude = Attitude(heading, 0.0, 0.0)
    s, c = math.sin(attitude.yaw), math.cos(attitude.yaw)
    rz = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    wanted = rz @ np.diag(np.square(sigma)) @ rz.T
    assert np.reshape(attitude.orientation_covariance(roll, pitch, about_up), (3, 3)) == pytest.approx(
        wanted, abs=1e-12
    )
