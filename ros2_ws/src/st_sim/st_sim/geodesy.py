"""A flat map on the round earth: local east, north, up to latitude, longitude, height on WGS84."""

import math
from dataclasses import dataclass, field

SEMI_MAJOR = 6378137.0
FLATTENING = 1 / 298.257223563
_E2 = FLATTENING * (2 - FLATTENING)


@dataclass(frozen=True)
class Origin:
    """Where the map has its zero.

    Geodetic degrees and ellipsoidal height [m]. x east, y north, z up of the tangent plane there.
    """

    latitude_deg: float
    longitude_deg: float
    height: float
    _rotation: tuple[float, ...] = field(init=False, repr=False)
    _centre: tuple[float, float, float] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        latitude, longitude = math.radians(self.latitude_deg), math.radians(self.longitude_deg)
        object.__setattr__(
            self, "_rotation", (math.sin(latitude), math.cos(latitude), math.sin(longitude), math.cos(longitude))
        )
        object.__setattr__(self, "_centre", to_ecef(latitude, longitude, self.height))

    def to_geodetic(self, x: float, y: float, z: float) -> tuple[float, float, float]:
        """Latitude, longitude [rad] and ellipsoidal height [m] of a point of the map."""
        s_lat, c_lat, s_lon, c_lon = self._rotation
        across = c_lat * z - s_lat * y
        cx, cy, cz = self._centre
        return from_ecef(cx - s_lon * x + c_lon * across, cy + c_lon * x + s_lon * across, cz + c_lat * y + s_lat * z)


def to_ecef(latitude: float, longitude: float, height: float) -> tuple[float, float, float]:
    normal = SEMI_MAJOR / math.sqrt(1 - _E2 * math.sin(latitude) ** 2)
    flat = (normal + height) * math.cos(latitude)
    return flat * math.cos(longitude), flat * math.sin(longitude), (normal * (1 - _E2) + height) * math.sin(latitude)


def from_ecef(x: float, y: float, z: float) -> tuple[float, float, float]:
    """Bowring's formula and one correction: below a micrometre near the ground (test_geodesy.py)."""
    flat = math.hypot(x, y)
    semi_minor = SEMI_MAJOR * (1 - FLATTENING)
    second = _E2 / (1 - _E2)
    reduced = math.atan2(z * SEMI_MAJOR, flat * semi_minor)
    latitude = math.atan2(
        z + second * semi_minor * math.sin(reduced) ** 3, flat - _E2 * SEMI_MAJOR * math.cos(reduced) ** 3
    )
    sine = math.sin(latitude)
    normal = SEMI_MAJOR / math.sqrt(1 - _E2 * sine**2)
    height = flat * math.cos(latitude) + z * sine - SEMI_MAJOR**2 / normal
    return latitude, math.atan2(y, x), height
