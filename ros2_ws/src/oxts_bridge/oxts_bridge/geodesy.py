"""Where the vehicle is: WGS84 latitude, longitude, height to a local east-north-up frame through ECEF.

Source: ncom.md sections 9 and 11. Checked by: test_geodesy.py (ellipsoid radii as the short-distance limit), and
st_sim against the way back.
"""

from dataclasses import dataclass, field
from math import cos, isfinite, radians, sin, sqrt

SEMI_MAJOR_AXIS = 6_378_137.0
FLATTENING = 1 / 298.257223563
ECCENTRICITY_SQUARED = FLATTENING * (2 - FLATTENING)


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

    latitude, longitude: [rad]; altitude: [m], of the same kind as the positions that are put in.
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
    """Height above the ellipsoid [m] of an altitude above the geoid [m]: plus, not minus as the manual prints
    (ncom.md 9)."""
    return altitude + undulation


def origin_from_channel_25(
    x: float, y: float, heading_deg: float, latitude: float, longitude: float, altitude: float
) -> tuple[float, float, float, float]:
    """Local frame of old firmware: origin latitude, longitude [rad], altitude [m], heading [deg] from the present
    position.

    x, y: present position in the local frame [m], heading_deg: of its x axis from north. latitude, longitude [rad],
    altitude [m]: present position. The latitude is iterated because the radii belong to the origin.
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
    """To (-180, 180]."""
    wrapped = (angle + 180.0) % 360.0 - 180.0
    return 180.0 if wrapped == -180.0 else wrapped
