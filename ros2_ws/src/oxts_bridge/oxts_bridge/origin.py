"""Where the map frame starts: the first fix, a given point, or the unit's own local frame."""

from math import degrees, radians

from .geodesy import LocalFrame
from .motion import Motion
from .status import StatusTracker

FIRST_FIX, GIVEN, UNIT = "first_fix", "given", "unit"
# A unit repeats its local frame about every 200 packets; after this long it has none [ns].
UNIT_PATIENCE_NS = 10_000_000_000


class Origin:
    """Decides once and keeps it: a map frame that moves would tear every path apart.

    frame: None until decided. degrees: latitude, longitude [deg], altitude [m] of it, which give the same frame again
    to the last bit. With source "unit" the first fix stands in when the unit sends no local frame within 10 s.
    """

    def __init__(self, source: str, given: tuple[float, float, float] | None = None) -> None:
        """given: latitude, longitude [deg], altitude [m] of the same kind as the unit sends; for source "given"."""
        self.source = source
        self.used = ""
        self.frame: LocalFrame | None = None
        self.degrees: tuple[float, float, float] | None = None
        self._since_ns: int | None = None
        if source == GIVEN:
            if given is None:
                raise ValueError("origin_source given needs an origin")
            self._set(GIVEN, *given)

    def look(self, motion: Motion, status: StatusTracker, now_ns: int) -> LocalFrame | None:
        """The frame for this fix; now_ns: any steady clock of the stream."""
        if self.frame is not None:
            return self.frame
        if self.source == UNIT:
            sent = status.local_frame
            if sent is not None:
                return self._set(UNIT, *sent[:3])
            self._since_ns = now_ns if self._since_ns is None else self._since_ns
            if 0 <= now_ns - self._since_ns < UNIT_PATIENCE_NS:
                return None
        return self._set(FIRST_FIX, degrees(motion.latitude), degrees(motion.longitude), motion.altitude)

    def _set(self, used: str, latitude: float, longitude: float, altitude: float) -> LocalFrame:
        self.used = used
        self.degrees = latitude, longitude, altitude
        self.frame = LocalFrame(radians(latitude), radians(longitude), altitude)
        return self.frame
