"""Tracks the state of the unit from its status channels: newest, unwrapped and derived values."""

from math import cos, degrees, isfinite, radians, sin, sqrt

from .channels import FIELDS, TRIGGER_CHANNELS, Value, decode_channel, decode_event_time
from .geometry import compute_radii
from .stream import ReceivedPacket

# Fields of the channel table from which other values are computed; `st ncom` writes only the computed values.
RAW_FIELDS = frozenset(
    {"GpsMinutes", "UpTimeCode", "WSpeedMilliseconds", "OldRefX", "OldRefY", "OldRefHeading"}
    | {name for channel in TRIGGER_CHANNELS for name in FIELDS[channel]}
)
LOCAL_FRAME = ("RefLat", "RefLon", "RefAlt", "RefHeading")
_LAG_WEIGHT = 0.01  # weight of a new value in the filtered lag, as in the vendor's tools
# Channels processed even if their bytes repeat: values derived from 23 and 45 change; 12 and 57 set the same fields.
_NEVER_SKIPPED = frozenset({12, 23, 45, 57})

_COUNTER_MODULI = {
    channel: tuple((name, 1 << field.counter_bits) for name, field in fields.items() if field.counter_bits)
    for channel, fields in FIELDS.items()
}


class StatusTracker:
    """Newest value of every field of every channel.

    values: by field name, in the units of the channel table; None: invalid, absent: never sent. raw: bytes by channel.
    """

    def __init__(self) -> None:
        self.values: dict[str, Value] = {}
        self.raw: dict[int, bytes] = {}
        self._raw_counts: dict[str, int] = {}  # newest count of every counter, as sent
        self._local_frame: dict[str, Value] = {}
        self._last_pulses: tuple[float, int] | None = None  # time [s] and count of the newest wheel pulses

    def restart(self) -> None:
        """Prepare for a new stream: counters begin with its first counts; other values are kept."""
        self._raw_counts.clear()
        self._last_pulses = None

    def update(self, channel: int, data: bytes, gps_seconds: float | None = None,
               position: tuple[float, float, float] | None = None) -> dict[str, Value]:
        """Set and return the values in the 8 bytes of a channel; empty if they repeat (except _NEVER_SKIPPED).

        Empty also for an incomplete local frame (channels 66 and 67). gps_seconds: time of the packet, for the wheel
        speed. position: latitude, longitude [rad], altitude [m] of the packet, for channel 25.
        """
        if self.raw.get(channel) == data and channel not in _NEVER_SKIPPED:
            return {}
        self.raw[channel] = data
        fields = decode_channel(channel, data)
        for name, modulus in _COUNTER_MODULI.get(channel, ()):
            count, previous = fields[name], self._raw_counts.get(name)
            self._raw_counts[name] = count
            if previous is not None:
                fields[name] = self.values[name] + (count - previous) % modulus
        if channel in TRIGGER_CHANNELS:
            time, name = decode_event_time(channel, data), TRIGGER_CHANNELS[channel]
            fields = {name: self.values.get(name) if time is None else time / 1e9}
        elif "BnsLag" in fields:
            lag, code = fields["BnsLag"], fields.pop("UpTimeCode")
            if lag is not None:
                previous = self.values.get("BnsLagFilt")
                fields["BnsLagFilt"] = lag if previous is None else previous * (1 - _LAG_WEIGHT) + lag * _LAG_WEIGHT
            fields["UpTime"] = None if code is None else decode_up_time(code)
        elif "OldRefX" in fields:
            x, y, heading = (fields.pop(name) for name in ("OldRefX", "OldRefY", "OldRefHeading"))
            is_valid = None not in (x, y, heading) and data != b"\x80\0\0\0\x80\0\0\0"
            if is_valid and not self._has_local_frame() and position is not None and all(map(isfinite, position)):
                fields.update(zip(LOCAL_FRAME, compute_legacy_origin(x, y, heading, *position), strict=True))
        elif "WSpeedCount" in fields:
            self._set_wheel_speed(fields, gps_seconds)
        elif "HDOP" in fields:
            horizontal, total = fields["HDOP"], fields["PDOP"]
            is_valid = horizontal is not None and total is not None and total > horizontal
            fields["VDOP"] = sqrt(total**2 - horizontal**2) if is_valid else None
        elif "RefLat" in fields or "RefAlt" in fields:
            self._local_frame.update(fields)
            fields = {}
            if self._has_local_frame():
                fields = self._local_frame | {"RefHeading": wrap_degrees(self._local_frame["RefHeading"])}
        self.values.update(fields)
        return fields

    def update_from(self, received: ReceivedPacket) -> dict[str, Value]:
        """Set and return the values in a packet; empty if it has no status channel, else as from `update`."""
        if not received.rule.has_status:
            return {}
        packet = received.packet
        seconds = None if received.gps_ns is None else received.gps_ns * 1e-9
        position = (packet.latitude, packet.longitude, packet.altitude)
        return self.update(packet.channel, packet.batch_s, seconds, position)

    def get(self, name: str) -> Value:
        """Newest value; None if invalid or never sent."""
        return self.values.get(name)

    def get_number(self, name: str) -> float:
        """Newest value; NaN if invalid or never sent."""
        value = self.values.get(name)
        return float("nan") if value is None else float(value)

    @property
    def local_origin(self) -> tuple[float, float, float] | None:
        """Latitude, longitude [deg], altitude [m] of the origin of the unit's newest local frame; None if unknown."""
        # All three are set together.
        return None if self.get("RefLat") is None else (self.get("RefLat"), self.get("RefLon"), self.get("RefAlt"))

    def _has_local_frame(self) -> bool:
        return all(self._local_frame.get(name) is not None for name in LOCAL_FRAME)

    def _set_wheel_speed(self, fields: dict, gps_seconds: float | None) -> None:
        """Set the time of the pulse count [s], in the minute nearest to the packet, and the pulse frequency [1/s]."""
        milliseconds = fields.pop("WSpeedMilliseconds")
        fields["WSpeedTime"] = None
        if milliseconds is None or gps_seconds is None:
            return  # without a new time, the last frequency stays valid
        time = 60.0 * round((gps_seconds - milliseconds * 1e-3) / 60.0) + milliseconds * 1e-3
        count, previous = fields["WSpeedCount"], self._last_pulses
        fields["WSpeedFreq"] = (
            (count - previous[1]) % (1 << 32) / (time - previous[0]) if previous and time > previous[0] else None)
        self._last_pulses = time, count
        fields["WSpeedTime"] = time


def compute_legacy_origin(x: float, y: float, heading: float, latitude: float, longitude: float,
                          altitude: float) -> tuple[float, float, float, float]:
    """Local frame of old firmware: latitude, longitude [deg], altitude [m] of its origin, heading [deg] of its x axis.

    x, y: current position in the local frame [m], y to the left of x. heading: of the x axis, clockwise from north
    [deg]. latitude, longitude [rad], altitude [m]: current position. Iterates because the radii depend on the origin.
    """
    s, c = sin(radians(heading)), cos(radians(heading))
    north, east = x * c + y * s, x * s - y * c
    origin = latitude
    for _ in range(4):
        meridian, normal = compute_radii(origin)
        origin = latitude - north / (meridian + altitude)
    longitude -= east / ((normal + altitude) * cos(origin))
    return degrees(origin), degrees(longitude), altitude, wrap_degrees(heading)


def wrap_degrees(angle: float) -> float:
    """The angle [deg] in (-180, 180]."""
    return 180.0 - (180.0 - angle) % 360.0


def decode_up_time(code: int) -> int:
    """Seconds since power-on from the compressed code of channel 23, which counts seconds, then minutes, then hours."""
    if code <= 10_800:
        return code
    return (code - 10_620) * 60 if code <= 20_700 else (code - 20_532) * 3600
