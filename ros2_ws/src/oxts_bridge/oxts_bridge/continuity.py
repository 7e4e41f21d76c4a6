"""Whether a packet goes on where the stream in use has been: what tells two units behind one address apart."""

from math import cos, isfinite

from st_core.position_jumps import excess

from .gps_time import MINUTE_MS
from .ncom import PACKET_SIZE, NcomError, Packet, decode

# A stream that was silent for longer has to be found anew [ms].
LONGEST_MS = 1_000
EARTH_RADIUS = 6_371_000.0  # m; the half per cent that it is off by is nothing beside what a jump may be


class Continuity:
    """Time and place of the newest packet in use; `continues` asks whether bytes of another sender follow it."""

    def __init__(self) -> None:
        self._newest: Packet | None = None

    def note(self, packet: Packet) -> None:
        """A packet of the stream in use, the newest of its series."""
        self._newest = packet

    def continues(self, data: bytes) -> bool:
        """Whether the first packet of a datagram is later than the newest, and no further away than that was driving.

        False without a position on either side.
        """
        try:
            packet = decode(data[:PACKET_SIZE])
        except NcomError:
            return False
        before = self._newest
        if before is None:
            return False
        later = (packet.milliseconds - before.milliseconds) % MINUTE_MS
        north = (packet.latitude - before.latitude) * EARTH_RADIUS
        east = (packet.longitude - before.longitude) * EARTH_RADIUS * cos(before.latitude)
        rows = (0.0, 0.0, *_velocity(before)), (east, north, *_velocity(packet))
        if not 0 < later <= LONGEST_MS or not all(map(isfinite, (*rows[0], *rows[1]))):
            return False
        return not excess(later * 1.0e-3, *rows)


def _velocity(packet: Packet) -> tuple[float, float, float]:
    """(yaw, v_x, v_y) of axes that point east and north."""
    north, east, _ = packet.velocity_ned
    return 0.0, east, north
