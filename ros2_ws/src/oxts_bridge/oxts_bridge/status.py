"""The slowly cycling status, put together: newest value of every field, counters unwrapped, derived values added."""

from math import isfinite, radians, sqrt

from .channels import FIELDS, TRIGGER_CHANNELS, decode_channel, trigger_nanoseconds
from .fields import Value
from .geodesy import origin_from_channel_25, wrap_degrees

# Fields that only make sense together with others; the derived value stands for them.
PARTS = frozenset(
    {"GpsMinutes", "UpTimeCode", "WSpeedMilliseconds", "OldRefX", "OldRefY", "OldRefHeading"}
    | {name for channel in TRIGGER_CHANNELS for name in FIELDS[channel]}
)
LOCAL_FRAME = ("RefLat", "RefLon", "RefAlt", "RefHeading")
# A filtered lag forgets with this share per message (vendor's choice).
_LAG_SHARE = 0.01
# Channels whose derived values change although their bytes do not, or that share a field with another channel (12 and
# 57).
_NEVER_SKIPPED = frozenset({12, 23, 45, 57})

_CYCLIC = {
    channel: tuple((name, 1 << field.cyclic) for name, field in fields.items() if field.cyclic)
    for channel, fields in FIELDS.items()
}


class StatusTracker:
    """Newest value of every field of every channel; None = the unit says invalid; absent = never sent.

    values: by field name, units as in the channel table; parts of derived values are left out. seen: channels so far.
    """

    def __init__(self) -> None:
        self.values: dict[str, Value] = {}
        self.seen: set[int] = set()
        self._raw: dict[int, bytes] = {}
        self._local_frame: dict[str, Value] = {}
        self._wheel: tuple[float, int] | None = None

    def update(
        self,
        channel: int,
        data: bytes,
        gps_seconds: float | None = None,
        position: tuple[float, float, float] | None = None,
    ) -> dict[str, Value]:
        """Take the 8 bytes of a channel; returns the fields it sets (empty if the same bytes came last time).

        gps_seconds: time of the packet, for wheel speed. position: its latitude, longitude [rad], altitude [m], for
        channel 25.
        """
        if self._raw.get(channel) == data and channel not in _NEVER_SKIPPED:
            return {}
        self._raw[channel] = data
        self.seen.add(channel)
        fields = decode_channel(channel, data)
        for name, modulus in _CYCLIC.get(channel, ()):
            before = self.values.get(name)
            if before is not None:
                fields[name] = before + (fields[name] - before) % modulus
        derive = _DERIVE.get(channel)
        if derive is not None:
            derive(self, fields, data, gps_seconds, position)
        self.values.update(fields)
        return fields

    def get(self, name: str) -> Value:
        """Newest value, None when invalid or never sent."""
        return self.values.get(name)

    def number(self, name: str) -> float:
        """As get(), NaN for None."""
        value = self.values.get(name)
        return float("nan") if value is None else float(value)

    @property
    def local_frame(self) -> tuple[float, float, float, float] | None:
        """Origin latitude, longitude [deg], altitude [m], heading [deg] of the last complete local frame of the
        unit."""
        latitude, longitude, altitude, heading = (self.values.get(name) for name in LOCAL_FRAME)
        if latitude is None or longitude is None or altitude is None or heading is None:
            return None
        return latitude, longitude, altitude, heading

    def _system(self, fields: dict, data: bytes, gps_seconds: float | None, position: object) -> None:
        lag, code = fields["BnsLag"], fields.pop("UpTimeCode")
        if lag is not None:
            before = self.values.get("BnsLagFilt")
            fields["BnsLagFilt"] = lag if before is None else before * (1 - _LAG_SHARE) + lag * _LAG_SHARE
        fields["UpTime"] = None if code is None else up_time(code)

    def _dilution(self, fields: dict, data: bytes, gps_seconds: float | None, position: object) -> None:
        horizontal, total = fields["HDOP"], fields["PDOP"]
        known = horizontal is not None and total is not None and total > horizontal
        fields["VDOP"] = sqrt(total**2 - horizontal**2) if known else None

    def _trigger(self, fields: dict, data: bytes, gps_seconds: float | None, position: object) -> None:
        time = trigger_nanoseconds(data)
        name = next(iter(fields)).removesuffix("Minutes") + "Time"
        fields.clear()
        fields[name] = self.values.get(name) if time is None else time / 1e9

    def _wheel_speed(self, fields: dict, data: bytes, gps_seconds: float | None, position: object) -> None:
        """Minute of the count: the one that puts it nearest to the packet. Frequency between two counts [pulse/s]."""
        milliseconds = fields.pop("WSpeedMilliseconds")
        fields["WSpeedTime"] = None
        if milliseconds is None or gps_seconds is None:
            return  # no new time, so no new frequency: the last one stands
        time = 60.0 * round((gps_seconds - milliseconds * 1e-3) / 60.0) + milliseconds * 1e-3
        count, before = fields["WSpeedCount"], self._wheel
        forward = before is not None and time > before[0]
        fields["WSpeedFreq"] = (count - before[1]) % (1 << 32) / (time - before[0]) if before and forward else None
        self._wheel = time, count
        fields["WSpeedTime"] = time

    def _origin(self, fields: dict, data: bytes, gps_seconds: float | None, position: object) -> None:
        self._local_frame.update(fields)
        complete = all(self._local_frame.get(name) is not None for name in LOCAL_FRAME)
        fields.clear()
        if complete:
            fields.update(self._local_frame)
            fields["RefHeading"] = wrap_degrees(fields["RefHeading"])

    def _old_origin(
        self, fields: dict, data: bytes, gps_seconds: float | None, position: tuple[float, float, float] | None
    ) -> None:
        x, y, heading = (fields.pop(name) for name in ("OldRefX", "OldRefY", "OldRefHeading"))
        newer = all(self._local_frame.get(name) is not None for name in LOCAL_FRAME)
        marked = None in (x, y, heading) or data == b"\x80\0\0\0\x80\0\0\0"
        if newer or marked or position is None or not all(map(isfinite, position)):
            return
        latitude, longitude, altitude, heading = origin_from_channel_25(x, y, heading, *position)
        fields.update(
            RefLat=latitude * _DEGREES, RefLon=longitude * _DEGREES, RefAlt=altitude, RefHeading=wrap_degrees(heading)
        )


_DEGREES = 1 / radians(1)
_DERIVE = {
    23: StatusTracker._system,
    25: StatusTracker._old_origin,
    45: StatusTracker._wheel_speed,
    48: StatusTracker._dilution,
    66: StatusTracker._origin,
    67: StatusTracker._origin,
    **dict.fromkeys(TRIGGER_CHANNELS, StatusTracker._trigger),
}


def up_time(code: int) -> int:
    """Seconds since power-on from the compressed code of channel 23: seconds, then minutes, then hours."""
    if code <= 10_800:
        return code
    return (code - 10_620) * 60 if code <= 20_700 else (code - 20_532) * 3600
