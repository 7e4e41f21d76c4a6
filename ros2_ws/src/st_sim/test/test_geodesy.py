"""The map on the ellipsoid, against the bridge's differently written conversion and against radii of curvature."""

import math

import pytest
from oxts_bridge.geometry import LocalFrame
from st_sim.geodesy import Origin, from_ecef, to_ecef

ORIGIN = Origin(51.448, 5.49, 65.0)


@pytest.mark.parametrize("point", [(0.0, 0.0, 0.0), (100.0, -50.0, 2.0), (-3000.0, 8000.0, 30.0), (20000.0, 1.0, -5.0)])
def test_there_and_back_through_the_bridge(point):
    frame = LocalFrame(math.radians(51.448), math.radians(5.49), 65.0)
    assert frame.enu(*ORIGIN.to_geodetic(*point)) == pytest.approx(point, abs=1e-6)


def test_short_distances_follow_the_radii():
    sine = math.sin(math.radians(51.448))
    e2 = 0.00669437999014
    normal = 6378137.0 / math.sqrt(1 - e2 * sine**2)
    meridian = normal * (1 - e2) / (1 - e2 * sine**2)
    latitude, longitude, height = ORIGIN.to_geodetic(1.0, 1.0, 0.0)
    assert latitude - math.radians(51.448) == pytest.approx(1.0 / (meridian + 65.0), rel=1e-6)
    assert longitude - math.radians(5.49) == pytest.approx(
        1.0 / (normal + 65.0) / math.cos(math.radians(51.448)), rel=1e-6
    )
    assert height == pytest.approx(65.0, abs=1e-6)


@pytest.mark.parametrize("latitude", [-89.0, -37.5, 0.0, 12.0, 51.4, 88.9])
@pytest.mark.parametrize("height", [-50.0, 0.0, 3000.0])
def test_earth_fixed_round_trip(latitude, height):
    back = from_ecef(*to_ecef(math.radians(latitude), 2.1, height))
    assert back[0] == pytest.approx(math.radians(latitude), abs=1e-12)
    assert back[1] == pytest.approx(2.1, abs=1e-12) and back[2] == pytest.approx(height, abs=1e-6)
