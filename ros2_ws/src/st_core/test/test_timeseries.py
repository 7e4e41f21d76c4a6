"""Time-ordered samples: order of arrival, gaps, clock jumps, non-finite values, memory."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from st_core import timeseries
from st_core.timeseries import MAXIMUM_SAMPLES, SETBACK_SAMPLES, TimeSeries

MS = 1_000_000
T0 = 1_700_000_000_000_000_000


def series(**changes) -> TimeSeries:
    defaults = {"columns": ("value", "angle"), "span": 2.0, "maximum_gap": 0.1, "angles": ("angle",)}
    return TimeSeries(**(defaults | changes))


def filled(times_ms, **changes) -> TimeSeries:
    result = series(**changes)
    for t in times_ms:
        result.add(T0 + round(t * MS), (float(t), 0.001 * t))
    return result


@given(st.data(), st.lists(st.integers(0, 400), min_size=1, max_size=40, unique=True))
def test_order_of_arrival_does_not_matter(data, times):
    shuffled = data.draw(st.permutations(times))
    ordered, mixed = filled(sorted(times)), filled(shuffled)
    np.testing.assert_array_equal(mixed.times, ordered.times)
    np.testing.assert_array_equal(mixed.rows, ordered.rows)


@given(st.lists(st.tuples(st.integers(-(10**13), 10**13) | st.integers(0, 10**9),
                          st.floats(allow_nan=True, allow_infinity=True)), max_size=80))
def test_buffer_stays_ordered_finite_and_bounded_for_any_input(samples):
    result = series(columns=("value",), angles=())
    for time_ns, value in samples:
        result.add(T0 + time_ns, (value,))
        assert (np.diff(result.times) > 0).all()
        assert np.isfinite(result.rows).all()
        if len(result):
            assert result.newest - result.times[0] <= 2_000_000_000
    # Regular samples are accepted afterwards, whatever came before.
    start = T0 + 10**13 + 10**12 * (len(samples) % 2)
    for i in range(10):
        result.add(start + i * 10 * MS, (float(i),))
    assert result.row_at(start + 85 * MS) == pytest.approx((8.5,))


@given(st.lists(st.integers(0, 1500), min_size=1, max_size=60, unique=True),
       st.lists(st.floats(-50.0, 1600.0), max_size=30))
def test_interpolation_between_neighbours_but_not_across_a_gap(times, instants):
    times = sorted(times)
    samples = filled(times)
    at_ns = [T0 + round(w * MS) for w in (*instants, *times)]
    rows = samples.sample(np.array(at_ns))
    for time_ns, row in zip(at_ns, rows, strict=True):
        one = samples.row_at(time_ns)
        ms = (time_ns - T0) / MS
        before = max([t for t in times if t <= ms], default=None)
        after = min([t for t in times if t >= ms], default=None)
        known = before is not None and after is not None and after - before <= 100
        assert (one is not None) == known
        newest = time_ns if known else None if before is None else T0 + before * MS
        assert samples.newest_known_time(time_ns) == newest
        if known:
            assert one == pytest.approx((ms, 0.001 * ms), abs=1e-6)
            np.testing.assert_array_equal(row, one)
        else:
            assert np.isnan(row).all()
            assert samples.describe_unknown(time_ns)


def test_angles_are_interpolated_along_the_shorter_arc():
    samples = series()
    samples.add(T0, (0.0, math.pi - 0.1))
    samples.add(T0 + 10 * MS, (0.0, -math.pi + 0.1))
    assert samples.row_at(T0 + 5 * MS)[1] == pytest.approx(math.pi)
    assert samples.sample(np.array([T0 + 5 * MS]))[0, 1] == pytest.approx(math.pi)


def test_duplicate_and_non_finite_samples_are_rejected():
    samples = filled([0, 10, 20])
    assert samples.add(T0 + 10 * MS, (99.0, 0.0)) == (None, False)
    assert samples.add(T0 + 30 * MS, (math.nan, 0.0)) == (None, False)
    assert samples.add(T0 + 30 * MS, (0.0, math.inf)) == (None, False)
    assert len(samples) == 3
    assert samples.row_at(T0 + 10 * MS)[0] == 10.0


def test_single_outlier_time_stamps_are_ignored():
    samples = filled(range(0, 1000, 10))
    outliers = range(-9000, -2000, 1000)  # too far apart for a clock that stepped back
    for outlier in outliers:
        assert samples.add(T0 + outlier * MS, (0.0, 0.0)) == (None, False)
    assert len(outliers) > SETBACK_SAMPLES and len(samples) == 100


def test_buffer_restarts_after_a_few_samples_of_a_clock_that_stepped_back():
    samples = filled(range(0, 1000, 10))
    results = [samples.add(T0 - 3_600_000 * MS + i * 10 * MS, (float(i), 0.0)) for i in range(SETBACK_SAMPLES)]
    assert results == [(None, False)] * (SETBACK_SAMPLES - 1) + [(0, True)]
    assert samples.rows[:, 0].tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]


def test_single_sample_from_the_future_is_discarded():
    samples = filled(range(0, 1000, 10))
    samples.add(T0 + 10**9 * MS, (0.0, 0.0))
    for t in range(1000, 1100, 10):
        samples.add(T0 + t * MS, (float(t), 0.0))
    assert samples.newest == T0 + 1090 * MS
    assert samples.row_at(T0 + 1085 * MS)[0] == pytest.approx(1085.0)


def test_forward_jump_leaves_a_gap():
    samples = filled([*range(0, 100, 10), *range(1000, 1100, 10)])
    assert samples.row_at(T0 + 500 * MS) is None
    assert samples.describe_unknown(T0 + 500 * MS) == "gap of 0.910 s"
    assert samples.describe_unknown(T0 + 1190 * MS) == "ends 0.100 s earlier"
    assert samples.describe_unknown(T0 - 20 * MS) == "begins 0.020 s later"
    assert series().describe_unknown(T0) == "no samples"


def test_samples_older_than_the_span_are_discarded():
    samples = filled(range(0, 60_000, 4))
    assert len(samples) == 501
    assert len(samples._times) <= 2048
    assert samples.newest == T0 + 59_996 * MS and samples.times[0] == T0 + 57_996 * MS


def test_number_of_samples_is_bounded_at_any_rate(monkeypatch):
    assert MAXIMUM_SAMPLES >= 1000 * 60
    monkeypatch.setattr(timeseries, "MAXIMUM_SAMPLES", 100)
    samples = series(columns=("value",), angles=())
    for i in range(1000):
        samples.add(T0 + i, (0.0,))
    assert len(samples) == 100
