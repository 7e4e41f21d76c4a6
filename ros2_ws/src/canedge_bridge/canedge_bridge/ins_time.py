"""Converts between UTC and the GPS time that an OxTS unit sends in CAN frames 0x600 and 0x630."""

from collections.abc import Mapping
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
from st_core.leap_seconds import GPS_EPOCH_UNIX, leap_seconds_at_gps_times, leap_seconds_at_utc

DATE_TIME_PARTS = ("gps_year_of_century", "gps_century", "gps_month", "gps_day", "gps_hour", "gps_minute", "gps_second",
                   "gps_second_fraction")
GPS_SECONDS_PARTS = ("gps_time", "gps_utc_offset")


def replace_gps_time(values: Mapping[str, Any]) -> dict[str, Any]:
    """The signals of a frame, with any parts of GPS time replaced with `ins_unix_time`, UTC [s since 1970].

    values: numbers or arrays by canonical name. The time is NaN where the unit has no valid time yet.
    """
    if "gps_time" in values:
        unix = _from_gps_seconds(np.asarray(values["gps_time"]), np.abs(np.asarray(values["gps_utc_offset"])))
    elif "gps_century" in values:
        unix = _from_date_time({name: np.asarray(values[name]) for name in DATE_TIME_PARTS})
    else:
        return dict(values)
    others = {name: value for name, value in values.items() if not name.startswith("gps_")}
    return {**others, "ins_unix_time": unix if unix.ndim else float(unix)}


def _from_gps_seconds(gps: np.ndarray, leap_seconds: np.ndarray) -> np.ndarray:
    """UTC [s since 1970] of GPS time [s since 1980-01-06]; NaN unless `gps` is positive, as 0 means unknown.

    leap_seconds: magnitude of the unit's offset, because its sign in real frames is not known; 0: use the table.
    """
    as_unix = np.where(gps > 0, gps + GPS_EPOCH_UNIX, np.nan)
    return np.where(leap_seconds > 0, as_unix - leap_seconds, _to_utc(as_unix))


def _from_date_time(parts: Mapping[str, np.ndarray]) -> np.ndarray:
    """UTC [s since 1970] of a date and time in GPS time; NaN if the date, hour or minute is invalid."""
    n = {name: np.nan_to_num(part, nan=-1).astype(np.int64) for name, part in parts.items()}
    day = _day_number(n["gps_century"] * 100 + n["gps_year_of_century"], n["gps_month"], n["gps_day"])
    is_time = (n["gps_hour"] < 24) & (n["gps_minute"] < 60)
    seconds = day * 86400.0 + n["gps_hour"] * 3600 + n["gps_minute"] * 60
    return _to_utc(np.where(is_time, seconds + (parts["gps_second"] + parts["gps_second_fraction"]), np.nan))


def _to_utc(gps_as_unix: np.ndarray) -> np.ndarray:
    """UTC [s since 1970] of GPS time given in seconds since 1970."""
    return gps_as_unix - leap_seconds_at_gps_times(gps_as_unix - GPS_EPOCH_UNIX)


def _day_number(year: np.ndarray, month: np.ndarray, day: np.ndarray) -> np.ndarray:
    """Days since 1970-01-01, NaN for a date that does not exist."""
    is_valid = (year >= 1) & (year <= 9999) & (month >= 1) & (month <= 12) & (day >= 1)
    months = (np.where(is_valid, year, 1970) - 1970) * 12 + np.where(is_valid, month, 1) - 1
    month_start = months.astype("datetime64[M]").astype("datetime64[D]").astype(np.int64)
    next_month_start = (months + 1).astype("datetime64[M]").astype("datetime64[D]").astype(np.int64)
    return np.where(is_valid & (day <= next_month_start - month_start), month_start + day - 1.0, np.nan)


def split_unix_time(unix_time: float, names: frozenset[str]) -> dict[str, float]:
    """GPS time of UTC [s since 1970]: GPS_SECONDS_PARTS if `names` has gps_time, else DATE_TIME_PARTS to 0.01 s."""
    leap = leap_seconds_at_utc(unix_time)
    if "gps_time" in names:
        # Sign as in NCOM: UTC - GPS time, which is negative.
        return {"gps_time": unix_time + leap - GPS_EPOCH_UNIX, "gps_utc_offset": float(-leap)}
    hundredths = round((unix_time + leap) * 100)
    moment = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(seconds=hundredths // 100)
    century, year = divmod(moment.year, 100)
    values = (year, century, moment.month, moment.day, moment.hour, moment.minute, moment.second,
              hundredths % 100 / 100)
    return dict(zip(DATE_TIME_PARTS, values, strict=True))
