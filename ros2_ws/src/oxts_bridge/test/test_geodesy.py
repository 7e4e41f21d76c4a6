"""Earth to local frame, against closed forms and the ellipsoid's radii."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from oxts_bridge.geodesy import (
    LocalFrame,
    ellipsoidal_height,
    origin_from_channel_25,
    radii,
    to_ecef,
    wrap_degrees,
)

POLAR_RADIUS = 6356752.314245179


@pytest.mark.parametrize(
    ("place", "ecef"),
    [
        ((0, 0, 0), (6378137.0, 0, 0)),
        ((0, math.pi / 2, 10), (0, 6378147.0, 0)),
        ((math.pi / 2, 0, 0), (0, 0, POLAR_RADIUS)),
        ((-math.pi / 2, 1, 5), (0, 0, -POLAR_RADIUS - 5)),
    ],
)
def test_points_on_the_axes(place, ecef):
    assert to_ecef(*place) == pytest.approx(ecef, abs=1e-6)


@given(latitude=st.floats(-1.4, 1.4), longitude=st.floats(-3.1, 3.1), north=st.floats(-50, 50), east=st.floats(-50, 50))
def test_short_distances_follow_the_radii_of_curvature(latitude, longitude, north, east):
    meridian, normal = radii(latitude)
    frame = LocalFrame(latitude, longitude, 100.0)
    there = (latitude + north / (meridian + 100), longitude + east / ((normal + 100) * math.cos(latitude)), 103.0)
    # Over 50 m the curvature of the parallel bends the way by tan(latitude) * d^2 / 2R, and the earth drops by d^2 /
    # 2R.
    assert frame.enu(*there) == pytest.approx((east, north, 3.0), abs=5e-3)


def test_far_points_are_not_on_a_flat_earth():
    frame = LocalFrame(math.radians(52), 0.0, 0.0)
    _, normal = radii(math.radians(52))
    up = frame.enu(math.radians(52), 10_000 / (normal * math.cos(math.radians(52))), 0.0)[2]
    assert up == pytest.approx(-(10_000**2) / (2 * normal), rel=2e-3)


def along_heading(east, north, heading):
    """x along a heading [rad, clockwise from north], y to its left."""
    sin, cos = math.sin(heading), math.cos(heading)
    return east * sin + north * cos, -east * cos + north * sin


def test_ellipsoidal_height_adds_the_undulation():
    """53.102 N 2.473 W: ground at 54 m above the sea, geoid 51.7 m above the ellipsoid."""
    assert ellipsoidal_height(54.0, 51.7) == pytest.approx(105.7)


@given(x=st.floats(-3000, 3000), y=st.floats(-3000, 3000), heading=st.floats(-180, 180))
def test_old_local_frame_puts_the_car_where_it_says(x, y, heading):
    here = (math.radians(52), math.radians(-1.25), 100.0)
    latitude, longitude, altitude, angle = origin_from_channel_25(x, y, heading, *here)
    east, north, _ = LocalFrame(latitude, longitude, altitude).enu(*here)
    # flat formula of old firmware
    assert along_heading(east, north, math.radians(angle)) == pytest.approx((x, y), abs=4.0)
    meridian, normal = radii(latitude)
    flat_north = (here[0] - latitude) * (meridian + 100)
    flat_east = (here[1] - longitude) * (normal + 100) * math.cos(latitude)
    assert along_heading(flat_east, flat_north, math.radians(angle)) == pytest.approx((x, y), abs=1e-6)


@pytest.mark.parametrize(("angle", "wrapped"), [(180, 180), (-180, 180), (190, -170), (-190, 170), (540, 180), (0, 0)])
def test_wrap(angle, wrapped):
    assert wrap_degrees(angle) == pytest.approx(wrapped)


def test_an_origin_must_be_somewhere():
    with pytest.raises(ValueError, match="not finite"):
        LocalFrame(math.nan, 0.0, 0.0)
