"""INS readings to NCOM bytes, with the status channels a real unit cycles through."""

import math

from oxts_bridge.ncom import Packet, encode

from .geodesy import Origin
from .ncom_status import UNDULATION, StatusChannels
from .sensors import InsReading

UNIX_OF_GPS_EPOCH_NS = 315_964_800_000_000_000
LEAP_SECONDS_NS = 18_000_000_000
"""GPS is ahead of UTC by 18 s since 2017."""

NOTHING, RAW, INITIALISING, LOCKING, LOCKED = 0, 1, 2, 3, 4
_NOWHERE = (math.nan, math.nan, math.nan)


class NcomWire:
    """One unit.

    start_ns: UTC of the start of the drive, whole milliseconds [ns since 1970], because the wire has no finer time.
    """

    def __init__(self, origin: Origin, start_ns: int, rate: int):
        self._origin = origin
        self._start_gps_ns = start_ns - UNIX_OF_GPS_EPOCH_NS + LEAP_SECONDS_NS
        self._status = StatusChannels(origin, rate)

    def packet(self, reading: InsReading, status: int = LOCKED) -> bytes:
        """The 72 bytes of one epoch. status: navigation status; what 0 and 1 declare invalid is marked so."""
        total_ms = round((self._start_gps_ns + round(reading.stamp * 1e9)) / 1_000_000)
        minutes, milliseconds = divmod(total_ms, 60_000)
        channel, batch_s = self._status.next(minutes if status >= INITIALISING else None, reading)
        roll_rate, pitch_rate, yaw_rate = reading.rates
        force_x, force_y, force_z = reading.specific_force
        packet = Packet(
            milliseconds=milliseconds if status >= INITIALISING else 0,
            navigation_status=status,
            # Body axes FLU -> FRD.
            acceleration=(force_x, -force_y, -force_z) if status >= RAW else _NOWHERE,
            angular_rate=(roll_rate, -pitch_rate, -yaw_rate) if status >= RAW else _NOWHERE,
            latitude=0.0,
            longitude=0.0,
            altitude=0.0,
            channel=channel,
            batch_s=batch_s,
        )
        if status >= INITIALISING:
            packet.latitude, packet.longitude, height = self._origin.to_geodetic(reading.x, reading.y, reading.z)
            packet.altitude = height - UNDULATION
            c, s = math.cos(reading.yaw), math.sin(reading.yaw)
            packet.velocity_ned = (
                s * reading.velocity_x + c * reading.velocity_y,
                c * reading.velocity_x - s * reading.velocity_y,
                -reading.velocity_z,
            )
            packet.heading = math.remainder(math.pi / 2 - reading.yaw, 2 * math.pi)
            packet.pitch, packet.roll = reading.pitch, reading.roll
        return encode(packet)
