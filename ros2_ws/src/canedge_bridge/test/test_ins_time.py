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


def test_the_packet_of_the_ncom_notes():
    """GPS 1440936034.560 s is 2025-09-03T12:00:16.560 UTC."""
    unix_time = replace_gps_time({"gps_time": 1_440_936_034.560, "gps_utc_offset": 0})["ins_unix_time"]
    assert unix_time == pytest.approx(1_756_900_816.560, abs=1e-6)


@pytest.mark.parametrize("around", [1_483_228_800, 1_435_708_800])
@pytest.mark.parametrize("difference", [-2.5, -0.5, 0.0, 0.5, 2.5])
def test_there_and_back_across_a_leap_second(around, difference):
    unix_time = around + difference
    for names, error in ((DATE_TIME_PARTS, 0.005), (("gps_time",), 1e-6)):
        again = replace_gps_time(split_unix_time(unix_time, frozenset(names)))["ins_unix_time"]
        assert again == pytest.approx(unix_time, abs=error)


@pytest.mark.parametrize("wrong", [{"gps_month": 0}, {"gps_month": 13}, {"gps_day": 31, "gps_month": 2},
                                   {"gps_hour": 24}, {"gps_minute": 60}])
def test_no_date_is_no_time(wrong):
    assert math.isnan(replace_gps_time(split_unix_time(1.7e9, frozenset(DATE_TIME_PARTS)) | wrong)["ins_unix_time"])
