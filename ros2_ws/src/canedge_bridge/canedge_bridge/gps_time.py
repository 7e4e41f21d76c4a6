"""GPS time to UTC for the two time frames an OxTS unit can send on CAN (0x600 and 0x630)."""

from calendar import timegm
from collections.abc import Mapping
from datetime import UTC, datetime, timedelta

from st_core.leap_seconds import GPS_EPOCH_UNIX, at_gps, at_unix

DATE_TIME_PARTS = ("gps_year_of_century", "gps_century", "gps_month", "gps_day", "gps_hour", "gps_minute", "gps_second",
                   "gps_second_fraction")
MILLI_TIME_PARTS = ("gps_time", "gps_utc_offset")


def _to_utc(gps_as_unix: float) -> float:
    return gps_as_unix - at_gps(gps_as_unix - GPS_EPOCH_UNIX)


def from_date_time(parts: Mapping[str, float]) -> float:
    """UTC [s since 1970] of a date and time in GPS time; NaN where the parts make no date (unit not yet locked)."""
    try:
        moment = datetime(int(parts["gps_century"]) * 100 + int(parts["gps_year_of_century"]), int(parts["gps_month"]),
                          int(parts["gps_day"]), int(parts["gps_hour"]), int(parts["gps_minute"]), tzinfo=UTC)
    except (ValueError, OverflowError):
        return float("nan")
    return _to_utc(timegm(moment.timetuple()) + parts["gps_second"] + parts["gps_second_fraction"])


def to_date_time(unix_time: float) -> dict[str, float]:
    """The parts of `from_date_time`, to a hundredth of a second."""
    hundredths = round((unix_time + at_unix(unix_time)) * 100)
    moment = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(seconds=hundredths // 100)
    century, year = divmod(moment.year, 100)
    values = (year, century, moment.month, moment.day, moment.hour, moment.minute, moment.second,
              hundredths % 100 / 100)
    return dict(zip(DATE_TIME_PARTS, values, strict=True))


def from_milli_time(parts: Mapping[str, float]) -> float:
    """UTC [s since 1970] of GPS time [s since 1980-01-06]; NaN at 0 (not yet known).

    The unit's own offset wins over the table when it is sent. Only its size is used: GPS is ahead of UTC, and the sign
    on the wire was not seen.
    """
    if not parts["gps_time"] > 0:
        return float("nan")
    gps_as_unix = parts["gps_time"] + GPS_EPOCH_UNIX
    offset = abs(parts["gps_utc_offset"])
    return gps_as_unix - offset if offset else _to_utc(gps_as_unix)


def to_milli_time(unix_time: float) -> dict[str, float]:
    """The parts of `from_milli_time`; the offset as NCOM has it, UTC - GPS."""
    leap = at_unix(unix_time)
    return {"gps_time": unix_time + leap - GPS_EPOCH_UNIX, "gps_utc_offset": float(-leap)}
