"""Leap seconds between GPS time and UTC.

GPS time counts from 1980-01-06T00:00:00 without leap seconds: UTC = GPS - leap seconds. Used by the bridges and checks.
Source: IERS Bulletin C. Checked by: test_packet_time.py and test_ins_time.py of the bridges.
"""

from bisect import bisect_right
from calendar import timegm

import numpy as np

GPS_EPOCH_UNIX = 315_964_800

# ((year, month), GPS - UTC [s] from the first day of the month on).
_DATES = (((1980, 1), 0), ((1981, 7), 1), ((1982, 7), 2), ((1983, 7), 3), ((1985, 7), 4), ((1988, 1), 5),
          ((1990, 1), 6), ((1991, 1), 7), ((1992, 7), 8), ((1993, 7), 9), ((1994, 7), 10), ((1996, 1), 11),
          ((1997, 7), 12), ((1999, 1), 13), ((2006, 1), 14), ((2009, 1), 15), ((2012, 7), 16), ((2015, 7), 17),
          ((2017, 1), 18))
LEAP_SECONDS = tuple(leap for _, leap in _DATES)
UNIX_STARTS = tuple(timegm((*date, 1, 0, 0, 0)) for date, _ in _DATES)  # UTC [s since 1970]
GPS_STARTS = tuple(start - GPS_EPOCH_UNIX + leap for start, leap in zip(UNIX_STARTS, LEAP_SECONDS, strict=True))


def leap_seconds_at_utc(unix_time: float) -> int:
    """GPS - UTC [s] at a UTC time [s since 1970]; the last entry of the table applies from its date on."""
    return LEAP_SECONDS[max(bisect_right(UNIX_STARTS, unix_time) - 1, 0)]


def leap_seconds_at_gps(gps_seconds: float) -> int:
    """GPS - UTC [s] at a GPS time [s since 1980-01-06]."""
    return LEAP_SECONDS[max(bisect_right(GPS_STARTS, gps_seconds) - 1, 0)]


def leap_seconds_at_gps_times(gps_seconds: np.ndarray) -> np.ndarray:
    """`leap_seconds_at_gps` for each element; for NaN the newest value."""
    return np.array(LEAP_SECONDS)[np.maximum(np.searchsorted(GPS_STARTS, gps_seconds, side="right") - 1, 0)]
