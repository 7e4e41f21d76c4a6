"""What an INS says of itself, and what several runs say together."""

from dataclasses import replace

import numpy as np
import pytest
from exact_drive import T0, exact_drive
from exact_faults import plus
from st_core.checks import AuxiliaryData, DriveCheck, Finding, InsQuality, Severity, check, compare_runs, pool_estimates

RTK_INTEGER, RTK_FLOAT, DIFFERENTIAL, LOCKED, LOCKING = 6.0, 5.0, 4.0, 4.0, 3.0


@pytest.fixture(scope="module")
def log(leaf):
    return exact_drive(leaf, 30.0)


def said(log, **fields):
    """Findings of a unit that says all is well but for `fields`, at 10 Hz."""
    time = np.arange(0, 300)
    good = InsQuality(T0 + time * 10**8, np.full(300, LOCKED), np.full(300, RTK_INTEGER), np.full(300, 0.01),
                      np.full(300, 0.002))
    return check(log, None, AuxiliaryData(quality=replace(good, **fields))).findings


def part(usual, other, rows):
    values = np.full(300, usual)
    values[rows] = other
    return values


def test_a_unit_that_is_well_says_nothing(log):
    assert said(log) == ()
    assert said(log, position_mode=part(RTK_INTEGER, RTK_FLOAT, slice(50, 90))) == ()
    unknown = np.full(300, np.nan)
    assert said(log, navigation_status=unknown, position_mode=unknown, position_accuracy=unknown) == ()
    assert said(log, position_mode=np.full(300, -1.0)) == ()


@pytest.mark.parametrize(("field", "usual", "bad", "words"), [
    ("position_mode", RTK_INTEGER, DIFFERENTIAL, "without RTK"), ("navigation_status", LOCKED, LOCKING, "not locked")])
def test_modes_by_their_share_and_place(log, field, usual, bad, words):
    one, = said(log, **{field: part(usual, bad, slice(50, 95))})
    assert (one.name, one.severity, one.value) == ("ins_mode", Severity.WARNING, pytest.approx(0.15))
    assert words in one.text and one.where == (pytest.approx((5.0, 9.4)),)
    few, = said(log, **{field: part(usual, bad, slice(50, 52))})
    assert few.severity is Severity.NOTE


@pytest.mark.parametrize(("metres", "severity"), [(0.3, Severity.WARNING), (8.0, Severity.ERROR)])
def test_poor_accuracy(log, metres, severity):
    one, = said(log, position_accuracy=part(0.01, metres, slice(100, 300)))
    assert (one.name, one.severity, one.value) == ("ins_accuracy", severity, metres)
    assert one.where == (pytest.approx((10.0, 29.9)),)
    assert said(log, position_accuracy=part(0.01, metres, slice(0, 100))) == ()


def measured(value, half, name="yaw_rate_bias", reported=True, unit="rad/s"):
    """A run of which nothing but this is known."""
    interval = (value - half, value + half)
    one = Finding(name, Severity.NOTE, ("yaw_rate",), "", value, unit, interval)
    return DriveCheck((one,) if reported else (), {}, (), {name: (value, *interval)})


def test_runs_that_agree_are_alike_and_know_the_mean_better():
    draw = np.random.default_rng(0).standard_normal(8)
    one, = compare_runs([measured(0.004 + 0.0005 * d, 1.96 * 0.0005) for d in draw])
    assert one.consistent and (one.runs, one.reported) == (8, 8)
    assert one.mean == pytest.approx(0.004, abs=0.0005) and one.interval[0] < 0.004 < one.interval[1]
    assert one.interval[1] - one.interval[0] < 0.002
    assert "consistent across all 8 runs" in one.text and "rad/s" in one.text


def test_runs_that_differ_say_so_and_by_how_much():
    values = (-0.01, 0.0, 0.01, 0.02)
    one, = compare_runs([measured(value, 0.0002) for value in values])
    assert not one.consistent and (one.lowest, one.highest) == (-0.01, 0.02)
    assert one.between == pytest.approx(np.std(values, ddof=1), rel=0.02)
    assert one.interval[0] < 0.0 < one.interval[1] and "differs" in one.text


@pytest.mark.parametrize(("half", "consistent"), [(0.005, True), (1e-5, False)])
def test_runs_are_consistent_only_while_their_intervals_hold_the_mean(half, consistent):
    one, = compare_runs([measured(v, half, "x_scale", unit="1") for v in (0.960, 0.964, 0.968)])
    assert one.consistent is consistent and one.mean == pytest.approx(0.964, abs=1e-4)


def test_two_of_four_intervals_that_miss_are_not_consistent():
    values = ((-1.0, 0.1), (-1.4, 0.1), (-1.2, 0.3), (-1.2, 0.3))
    found = compare_runs([measured(value, half, "measuring_point", unit="m") for value, half in values])
    assert [one.consistent for one in found] == [False]


def test_a_mean_whose_interval_holds_zero_is_not_listed():
    assert compare_runs([measured(v, 0.6, "measuring_point", unit="m") for v in (-0.9, 0.0, -0.4)]) == []


def test_a_run_counts_by_how_well_it_knows():
    one, = compare_runs([measured(0.004, 0.0001), measured(0.004, 0.0001), measured(0.02, 0.05)])
    assert one.mean == pytest.approx(0.004, abs=1e-5)


def test_what_was_measured_counts_also_where_it_was_not_told():
    one, = compare_runs([measured(0.004, 0.002),
                         measured(0.003, 0.002, reported=False), measured(0.005, 0.002, reported=False)])
    assert (one.runs, one.reported) == (3, 1)
    assert compare_runs([measured(0.004, 0.002, reported=False)] * 3) == []
    assert compare_runs([measured(0.004, 0.002)] * 2) == []


def test_the_most_frequent_first():
    findings = (*measured(1.0, 0.1, "a", unit="m").findings, *measured(1.0, 0.1, "b", unit="m").findings)
    both = DriveCheck(findings, {}, (), {"a": (1.0, 0.9, 1.1), "b": (1.0, 0.9, 1.1)})
    only_b = replace(both, findings=both.findings[1:])
    assert [(one.name, one.reported) for one in compare_runs([both, only_b, only_b])] == [("b", 3), ("a", 1)]


def test_drives_of_one_unit_together(leaf):
    biased = plus(0.005, "yaw_rate")
    runs = [check(biased(exact_drive(leaf, 30.0, seed=seed)), leaf) for seed in range(3)]
    one, = compare_runs(runs)
    assert one.name == "yaw_rate_bias" and one.consistent
    assert one.interval[0] < 0.005 < one.interval[1] and one.as_dict()["text"] == one.text


def estimate(value: float, deviation: float) -> tuple[float, float, float]:
    return value, value - 1.96 * deviation, value + 1.96 * deviation


def test_one_run_is_taken_as_it_is():
    assert pool_estimates([{"yaw_rate_bias": (0.1, 0.0, 0.3)}]) == {"yaw_rate_bias": (0.1, 0.0, 0.3)}
    assert pool_estimates([]) == {}


def test_alike_runs_are_weighed_by_their_precision():
    runs = [{"a": estimate(1.0, 0.1)}, {"a": estimate(1.3, 0.3)}, {"b": estimate(5.0, 1.0)}]
    value, low, high = pool_estimates(runs)["a"]
    assert value == pytest.approx((1.0 / 0.01 + 1.3 / 0.09) / (1 / 0.01 + 1 / 0.09))
    assert low < value < high


def test_the_interval_covers_the_mean_of_runs_that_differ():
    """Runs whose true values are drawn with a spread far beyond their own intervals."""
    rng = np.random.default_rng(3)
    hits = 0
    for _ in range(200):
        values = rng.normal(2.0, 0.5, 8) + rng.normal(0.0, 0.05, 8)
        _, low, high = pool_estimates([{"a": estimate(value, 0.05)} for value in values])["a"]
        hits += low <= 2.0 <= high
    assert 180 <= hits <= 199
