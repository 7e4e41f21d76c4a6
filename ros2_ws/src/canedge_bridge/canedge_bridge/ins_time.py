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
    """The values, with any parts of GPS time replaced by `ins_unix_time`: UTC [s since 1970], NaN while the unit has no
    valid time. values: number or array of each signal of a message, by canonical name."""
    if "gps_time" in values:  # [s since 1980-01-06], 0 if unknown
        gps = np.asarray(values["gps_time"])
        as_unix = np.where(gps > 0, gps + GPS_EPOCH_UNIX, np.nan)
        leap_seconds = np.abs(np.asarray(values["gps_utc_offset"]))  # 0: unknown; the sign that units send is uncertain
        unix = np.where(leap_seconds > 0, as_unix - leap_seconds, _to_utc(as_unix))
    elif "gps_century" in values:
        unix = _from_date_time({name: np.asarray(values[name]) for name in DATE_TIME_PARTS})
    else:
        return dict(values)
    others = {name: value for name, value in values.items() if not name.startswith("gps_")}
    return {**others, "ins_unix_time": unix if unix.ndim else float(unix)}


def _from_date_time(parts: Mapping[str, np.ndarray]) -> np.ndarray:
    """UTC [s since 1970] of a date and time in GPS time; NaN if the date, hour or minute is missing or invalid."""
    n = {name: np.nan_to_num(part, nan=9999).astype(np.int64) for name, part in parts.items()}
    year, month, day = n["gps_century"] * 100 + n["gps_year_of_century"], n["gps_month"], n["gps_day"]
    is_month = (year >= 1) & (year <= 9999) & (month >= 1) & (month <= 12)
    months = np.where(is_month, (year - 1970) * 12 + month - 1, 0)  # since 1970-01
    month_start, month_end = ((months + k).astype("datetime64[M]").astype("datetime64[D]").astype(np.int64)
                              for k in (0, 1))  # days since 1970-01-01
    is_valid = is_month & (day >= 1) & (day <= month_end - month_start) & (n["gps_hour"] < 24) & (n["gps_minute"] < 60)
    seconds = (month_start + day - 1.0) * 86400.0 + n["gps_hour"] * 3600 + n["gps_minute"] * 60
    return _to_utc(np.where(is_valid, seconds + (parts["gps_second"] + parts["gps_second_fraction"]), np.nan))


def _to_utc(gps_as_unix: np.ndarray) -> np.ndarray:
    """UTC [s since 1970] of GPS time given in seconds since 1970."""
    return gps_as_unix - leap_seconds_at_gps_times(gps_as_unix - GPS_EPOCH_UNIX)


def split_unix_time(unix_time: float, names: frozenset[str]) -> dict[str, float]:
    """GPS time at UTC [s since 1970]: GPS_SECONDS_PARTS if `names` has gps_time, else DATE_TIME_PARTS to 0.01 s."""
    leap = leap_seconds_at_utc(unix_time)
    if "gps_time" in names:
        # Sign as in NCOM: UTC - GPS time, which is negative.
        return {"gps_time": unix_time + leap - GPS_EPOCH_UNIX, "gps_utc_offset": float(-leap)}
    hundredths = round((unix_time + leap) * 100)
    gps = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(seconds=hundredths // 100)  # GPS time, represented as UTC
    century, year = divmod(gps.year, 100)
    values = (year, century, gps.month, gps.day, gps.hour, gps.minute, gps.second, hundredths % 100 / 100)
    return dict(zip(DATE_TIME_PARTS, values, strict=True))
