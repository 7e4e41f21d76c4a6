"""GPS time of packets: minutes, leap seconds, late packets and steps of the clock."""

from datetime import UTC, datetime

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oxts_bridge.file_decoder import compute_packet_times
from oxts_bridge.ncom import LATE, MAX_LATE_RUN, NEW, SAME, GpsClock, compute_host_minute, to_unix_nanoseconds
from st_core.leap_seconds import leap_seconds_at_gps

SECOND = 1_000_000_000
MINUTE = 24_015_600


def gps_seconds(*date):
    return int(datetime(*date, tzinfo=UTC).timestamp()) - 315_964_800


@pytest.mark.parametrize(("date", "leap"), [
    ((1980, 1, 6), 0), ((1981, 6, 30), 0), ((1981, 7, 2), 1), ((1999, 6, 1), 13), ((2005, 12, 31), 13),
    ((2006, 1, 2), 14), ((2009, 6, 1), 15), ((2012, 7, 2), 16), ((2016, 12, 31), 17), ((2017, 1, 2), 18),
    ((2030, 1, 1), 18),
])
def test_leap_seconds_by_date(date, leap):
    assert leap_seconds_at_gps(gps_seconds(*date)) == leap


def test_leap_second_changes_at_utc_midnight():
    midnight = gps_seconds(2017, 1, 1) + 18
    assert (leap_seconds_at_gps(midnight - 1), leap_seconds_at_gps(midnight)) == (17, 18)


def test_unix_time_with_and_without_the_utc_offset_of_the_unit():
    gps = (MINUTE * 60_000 + 34_560) * 1_000_000
    assert to_unix_nanoseconds(gps) == 1_756_900_816_560_000_000
    assert to_unix_nanoseconds(gps, -18) == to_unix_nanoseconds(gps)
    assert to_unix_nanoseconds(gps, -19) == to_unix_nanoseconds(gps) - SECOND


def test_unix_times_keep_differences_of_four_microseconds():
    gps = 1_440_936_034_560_004_000
    assert to_unix_nanoseconds(gps) - to_unix_nanoseconds(gps - 4_000) == 4_000


def feed(clock, *packets):
    """(ms, minute or None[, received_ns]) -> list of (time - MINUTE * 60000 or None, order)."""
    results = [clock.step(*packet) for packet in packets]
    return [(None if time is None else time - MINUTE * 60_000, order) for time, order in results]


def test_first_time_is_that_of_the_packet_with_channel_0():
    assert feed(GpsClock(), (1000, None), (1010, None), (1020, MINUTE), (1030, None)) == [
        (None, NEW), (None, NEW), (1020, NEW), (1030, NEW)]


def test_milliseconds_wrap_without_channel_0():
    assert feed(GpsClock(), (59_990, MINUTE), (0, None), (10, None)) == [(59_990, NEW), (60_000, NEW), (60_010, NEW)]


def test_late_packet_does_not_count_a_wrap_twice():
    clock = GpsClock()
    times = feed(clock, (59_980, MINUTE), (0, None), (59_990, None), (10, None), (20, None))
    assert times == [(59_980, NEW), (60_000, NEW), (59_990, LATE), (60_010, NEW), (60_020, NEW)]
    assert clock.jumps == 0


def test_week_change_is_not_a_jump():
    minute = 10_080 * 2383 - 1
    clock = GpsClock()
    times = [clock.step(ms, m)[0] for ms, m in ((59_990, minute), (0, None), (10, minute + 1))]
    assert times == [(minute + 1) * 60_000 + delta for delta in (-10, 0, 10)]
    assert clock.jumps == 0


def test_duplicate_and_reordered_packets():
    times = feed(GpsClock(), (100, MINUTE), (110, None), (110, None), (105, None), (120, None))
    assert [order for _, order in times] == [NEW, NEW, SAME, LATE, NEW]


def test_minute_is_unknown_after_a_long_interruption_of_reception():
    clock = GpsClock()
    times = feed(clock, (1000, MINUTE, 0), (1010, None, SECOND // 100), (5000, None, 64 * SECOND),
                 (5010, MINUTE + 1, 65 * SECOND))
    assert times == [(1000, NEW), (1010, NEW), (None, NEW), (65_010, NEW)]
    assert clock.jumps == 0


def test_minute_is_known_after_a_short_interruption_over_a_wrap():
    clock = GpsClock()
    assert feed(clock, (55_000, MINUTE, 0), (5_000, None, 10 * SECOND)) == [(55_000, NEW), (65_000, NEW)]
    assert clock.jumps == 0


def test_step_longer_than_the_pause_of_reception_is_a_jump():
    clock = GpsClock()
    feed(clock, (1000, MINUTE, 0), (6000, None, SECOND // 100))
    assert clock.jumps == 1


def test_missing_58_s_are_detected_by_the_minute():
    """From its milliseconds alone, the packet would be 1.8 s late."""
    clock = GpsClock()
    assert feed(clock, (1200, MINUTE), (59_400, MINUTE), (59_410, None)) == [(1200, NEW), (59_400, NEW), (59_410, NEW)]
    assert clock.jumps == 1


def test_clock_set_back_is_accepted_after_consecutive_late_packets():
    clock = GpsClock()
    feed(clock, (50_000, MINUTE))
    back = [(30_000 + 10 * i, MINUTE - 5 if i % 10 == 0 else None) for i in range(MAX_LATE_RUN + 5)]
    times = feed(clock, *back)
    assert [order for _, order in times] == [LATE] * MAX_LATE_RUN + [NEW] * 5
    assert times[-1] == (30_000 - 5 * 60_000 + 10 * (MAX_LATE_RUN + 4), NEW)
    assert clock.jumps == 1


def test_separate_late_packets_are_not_a_clock_set_back():
    clock = GpsClock()
    clock.step(10_000, MINUTE)
    orders = [clock.step(ms, None)[1] for i in range(1, 40) for ms in (10_000 + 10 * i, 9_500 + 10 * i)]
    assert orders == [NEW, LATE] * 39


def test_minute_that_differs_by_one_near_its_end_is_accepted_when_repeated():
    clock = GpsClock()
    assert feed(clock, (59_900, MINUTE), (0, MINUTE), (100, MINUTE)) == [(59_900, NEW), (60_000, NEW), (100, NEW)]
    clock = GpsClock()
    assert feed(clock, (59_900, MINUTE), (0, MINUTE), (100, MINUTE + 1))[-1] == (60_100, NEW)
    assert clock.jumps == 0


def test_other_minute_of_channel_0_is_accepted_at_once():
    clock = GpsClock()
    assert feed(clock, (10_000, MINUTE), (10_010, MINUTE + 7))[-1] == (7 * 60_000 + 10_010, NEW)
    assert clock.jumps == 1


def test_minute_of_a_status_only_packet_is_used_only_without_another():
    clock = GpsClock()
    clock.initialise_minute(MINUTE)
    clock.initialise_minute(MINUTE + 3)
    assert feed(clock, (1000, None)) == [(1000, NEW)]
    clock.initialise_minute(MINUTE + 9)
    assert feed(clock, (1010, None)) == [(1010, NEW)]


def test_columns_agree_with_steps_for_a_clock_set_back_before_a_wrong_minute():
    ms = np.array([*range(59_888, 59_968, 4), *range(29_968, 29_984, 4)])
    minutes = np.full(len(ms), -1)
    minutes[0], minutes[-2] = 1_000_000, 999_281
    clock = GpsClock()
    one_by_one = [clock.step(int(a), None if b < 0 else int(b)) for a, b in zip(ms, minutes, strict=True)]
    times, order = compute_packet_times(ms, minutes, [])
    assert list(zip(times.tolist(), order.tolist(), strict=True)) == one_by_one
    assert order[-4:].tolist() == [LATE] * 4


@given(offset=st.integers(-29_000, 29_000), ms=st.integers(0, 59_999))
def test_minute_from_a_host_clock_with_an_error_below_half_a_minute(offset, ms):
    utc_ns = to_unix_nanoseconds((MINUTE * 60_000 + ms) * 1_000_000)
    assert compute_host_minute(utc_ns + offset * 1_000_000, ms) == MINUTE


@given(st.lists(st.tuples(st.integers(0, 65_535), st.none() | st.integers(1_000, 30_525_000),
                          st.none() | st.integers(0, 10**12)), max_size=80))
def test_clock_accepts_any_packets(packets):
    clock = GpsClock()
    for packet in packets:
        time, order = clock.step(*packet)
        assert order in (NEW, SAME, LATE)
        assert time is None or isinstance(time, int)
