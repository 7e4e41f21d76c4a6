"""GPS to UTC at the leap seconds."""

import math

import pytest
from canedge_bridge.ins_time import DATE_TIME_PARTS, replace_gps_time, split_unix_time
from st_core.leap_seconds import leap_seconds_at_utc


@pytest.mark.parametrize(("unix_time", "leap"), [
    (1_136_073_600, 14), (1_230_767_999, 14), (1_230_768_000, 15), (1_341_100_800, 16), (1_435_708_800, 17),
    (1_483_228_799, 17), (1_483_228_800, 18), (1_900_000_000, 18), (1_000_000_000, 13), (0, 0)])
def test_leap_seconds(unix_time, leap):
    assert leap_seconds_at_utc(unix_time) == leap


def test_gps_time_of_the_ncom_example():
    """GPS 1440936034.560 s is 2025-09-03T12:00:16.560 UTC."""
    unix_time = replace_gps_time({"gps_time": 1_440_936_034.560, "gps_utc_offset": 0})["ins_unix_time"]
    assert unix_time == pytest.approx(1_756_900_816.560, abs=1e-6)


@pytest.mark.parametrize("around", [1_483_228_800, 1_435_708_800])
@pytest.mark.parametrize("difference", [-2.5, -0.5, 0.0, 0.5, 2.5])
def test_time_near_a_leap_second_is_unchanged_by_conversion_to_gps_and_back(around, difference):
    unix_time = around + difference
    for names, error in ((DATE_TIME_PARTS, 0.005), (("gps_time",), 1e-6)):
        converted = replace_gps_time(split_unix_time(unix_time, frozenset(names)))["ins_unix_time"]
        assert converted == pytest.approx(unix_time, abs=error)


@pytest.mark.parametrize("invalid", [{"gps_month": 0}, {"gps_month": 13}, {"gps_day": 31, "gps_month": 2},
                                     {"gps_hour": 24}, {"gps_minute": 60}, {"gps_hour": math.nan},
                                     {"gps_minute": math.nan}, {"gps_century": math.nan}])
def test_invalid_date_gives_nan(invalid):
    assert math.isnan(replace_gps_time(split_unix_time(1.7e9, frozenset(DATE_TIME_PARTS)) | invalid)["ins_unix_time"])
