"""Status and accuracy reported by the INS, and findings compared and pooled over several runs."""

from dataclasses import replace

import numpy as np
import pytest
from exact_drive import T0, exact_drive
from exact_faults import biased
from st_core.checks import AuxiliaryData, DriveCheck, Finding, InsQuality, Severity, check, compare_runs, pool_estimates

RTK_INTEGER, RTK_FLOAT, DIFFERENTIAL, LOCKED, LOCKING = 6.0, 5.0, 4.0, 4.0, 3.0


@pytest.fixture(scope="module")
def log(leaf):
    return exact_drive(leaf, 30.0)


def quality_findings(log, **fields):
    """Findings for an INS that reports good quality at 10 Hz except in `fields`."""
    time = np.arange(0, 300)
    good = InsQuality(T0 + time * 10**8, np.full(300, LOCKED), np.full(300, RTK_INTEGER), np.full(300, 0.01))
    return check(log, None, AuxiliaryData(quality=replace(good, **fields))).findings


def with_section(good, bad, rows):
    values = np.full(300, good)
    values[rows] = bad
    return values


def test_healthy_or_unknown_ins_status_gives_no_findings(log):
    assert quality_findings(log) == ()
    assert quality_findings(log, position_mode=with_section(RTK_INTEGER, RTK_FLOAT, slice(50, 90))) == ()
    for mode in (15, 16, 23, 24, 28, 29):  # float and integer of post-processed, gx and ix solutions
        assert quality_findings(log, position_mode=np.full(300, float(mode))) == ()
    unknown = np.full(300, np.nan)
    assert quality_findings(log, navigation_status=unknown, position_mode=unknown, position_accuracy=unknown) == ()
    assert quality_findings(log, position_mode=np.full(300, -1.0)) == ()


@pytest.mark.parametrize(("field", "good", "bad", "text"), [
    ("position_mode", RTK_INTEGER, DIFFERENTIAL, "without RTK"), ("navigation_status", LOCKED, LOCKING, "not locked")])
def test_bad_ins_mode_is_reported_with_its_percentage_and_time(log, field, good, bad, text):
    finding, = quality_findings(log, **{field: with_section(good, bad, slice(50, 95))})
    assert (finding.name, finding.severity, finding.value) == ("ins_mode", Severity.WARNING, pytest.approx(0.15))
    assert text in finding.text and finding.times == (pytest.approx((5.0, 9.4)),)
    short, = quality_findings(log, **{field: with_section(good, bad, slice(50, 52))})
    assert short.severity is Severity.NOTE


@pytest.mark.parametrize(("metres", "severity"), [(0.3, Severity.WARNING), (8.0, Severity.ERROR)])
def test_poor_position_accuracy_is_reported_with_its_value_and_time(log, metres, severity):
    finding, = quality_findings(log, position_accuracy=with_section(0.01, metres, slice(100, 300)))
    assert (finding.name, finding.severity, finding.value) == ("ins_accuracy", severity, metres)
    assert finding.times == (pytest.approx((10.0, 29.9)),)
    assert quality_findings(log, position_accuracy=with_section(0.01, metres, slice(0, 100))) == ()


def run_with_estimate(value, half_width, name="yaw_rate_bias", reported=True, unit="rad/s"):
    """A checked run with this estimate only."""
    interval = (value - half_width, value + half_width)
    finding = Finding(name, Severity.NOTE, ("yaw_rate",), "", value, unit, interval)
    return DriveCheck((finding,) if reported else (), {}, (), {name: (value, *interval)})


def test_consistent_runs_have_a_mean_with_a_narrower_interval():
    draw = np.random.default_rng(0).standard_normal(8)
    comparison, = compare_runs([run_with_estimate(0.004 + 0.0005 * d, 1.96 * 0.0005) for d in draw])
    assert comparison.consistent and (comparison.runs, comparison.reported) == (8, 8)
    assert comparison.mean == pytest.approx(0.004,
                                            abs=0.0005) and comparison.interval[0] < 0.004 < comparison.interval[1]
    assert comparison.interval[1] - comparison.interval[0] < 0.002
    assert "consistent across all 8 runs" in comparison.text and "rad/s" in comparison.text


def test_differing_runs_are_reported_with_their_range_and_scatter():
    values = (-0.01, 0.0, 0.01, 0.02)
    comparison, = compare_runs([run_with_estimate(value, 0.0002) for value in values])
    assert not comparison.consistent and (comparison.lowest, comparison.highest) == (-0.01, 0.02)
    assert comparison.between == pytest.approx(np.std(values, ddof=1), rel=0.02)
    assert comparison.interval[0] < 0.0 < comparison.interval[1] and "differs" in comparison.text


@pytest.mark.parametrize(("half_width", "consistent"), [(0.005, True), (1e-5, False)])
def test_runs_are_consistent_if_their_intervals_contain_the_mean(half_width, consistent):
    comparison, = compare_runs([run_with_estimate(v, half_width, "x_scale", unit="1") for v in (0.960, 0.964, 0.968)])
    assert comparison.consistent is consistent and comparison.mean == pytest.approx(0.964, abs=1e-4)


def test_runs_are_inconsistent_if_two_of_four_intervals_miss_the_mean():
    values = ((-1.0, 0.1), (-1.4, 0.1), (-1.2, 0.3), (-1.2, 0.3))
    found = compare_runs([run_with_estimate(value, half_width, "measuring_point", unit="m") for value,
                          half_width in values])
    assert [comparison.consistent for comparison in found] == [False]


def test_mean_with_an_interval_that_contains_zero_is_not_listed():
    assert compare_runs([run_with_estimate(v, 0.6, "measuring_point", unit="m") for v in (-0.9, 0.0, -0.4)]) == []


def test_runs_are_weighted_by_their_precision():
    comparison, = compare_runs([run_with_estimate(0.004, 0.0001), run_with_estimate(0.004, 0.0001),
                         run_with_estimate(0.02, 0.05)])
    assert comparison.mean == pytest.approx(0.004, abs=1e-5)


def test_estimates_of_runs_without_the_finding_count_too():
    others = [run_with_estimate(value, 0.002, reported=False) for value in (0.003, 0.005)]
    comparison, = compare_runs([run_with_estimate(0.004, 0.002), *others])
    assert (comparison.runs, comparison.reported) == (3, 1)
    assert compare_runs([run_with_estimate(0.004, 0.002, reported=False)] * 3) == []
    assert compare_runs([run_with_estimate(0.004, 0.002)] * 2) == []


def test_infinite_interval_does_not_count_as_consistent():
    """Such an estimate contains no information: it is left out, here of three runs that must be compared."""
    runs = [run_with_estimate(value, half_width) for value, half_width in ((0.004, 0.001), (0.005, 0.001),
                                                                           (0.0, np.inf))]
    assert compare_runs(runs) == []
    assert compare_runs([*runs, run_with_estimate(0.006, 0.001)])[0].runs == 3


def test_infinite_interval_does_not_change_a_pooled_estimate():
    known = [{"a": (1.0, 0.9, 1.1)}, {"a": (1.2, 1.1, 1.3)}]
    unknown = {"a": (5.0, -np.inf, np.inf)}
    assert pool_estimates([*known, unknown]) == pool_estimates(known)
    assert pool_estimates([unknown, known[0]]) == {}  # one of several runs is no confirmation
    assert pool_estimates([unknown, unknown]) == {}


def test_findings_are_sorted_by_frequency():
    findings = (*run_with_estimate(1.0, 0.1, "a", unit="m").findings,
                *run_with_estimate(1.0, 0.1, "b", unit="m").findings)
    both = DriveCheck(findings, {}, (), {"a": (1.0, 0.9, 1.1), "b": (1.0, 0.9, 1.1)})
    only_b = replace(both, findings=both.findings[1:])
    comparisons = compare_runs([both, only_b, only_b])
    assert [(comparison.name, comparison.reported) for comparison in comparisons] == [("b", 3), ("a", 1)]


def test_bias_of_one_sensor_is_consistent_over_its_drives(leaf):
    with_bias = biased(0.005, "yaw_rate")
    runs = [check(with_bias(exact_drive(leaf, 30.0, seed=seed)), leaf) for seed in range(3)]
    comparison, = compare_runs(runs)
    assert comparison.name == "yaw_rate_bias" and comparison.consistent
    assert comparison.interval[0] < 0.005 < comparison.interval[1] and comparison.as_dict()["text"] == comparison.text


def estimate(value: float, deviation: float) -> tuple[float, float, float]:
    return value, value - 1.96 * deviation, value + 1.96 * deviation


def test_pooling_one_run_returns_its_estimates():
    assert pool_estimates([{"yaw_rate_bias": (0.1, 0.0, 0.3)}]) == {"yaw_rate_bias": (0.1, 0.0, 0.3)}
    assert pool_estimates([]) == {}


def test_pooled_estimate_of_consistent_runs_is_weighted_by_precision():
    runs = [{"a": estimate(1.0, 0.1)}, {"a": estimate(1.3, 0.3)}, {"b": estimate(5.0, 1.0)}]
    value, low, high = pool_estimates(runs)["a"]
    assert value == pytest.approx((1.0 / 0.01 + 1.3 / 0.09) / (1 / 0.01 + 1 / 0.09))
    assert low < value < high


def test_pooled_interval_covers_the_mean_of_differing_runs():
    """The true values scatter between runs by far more than their intervals."""
    rng = np.random.default_rng(3)
    covered = 0
    for _ in range(200):
        values = rng.normal(2.0, 0.5, 8) + rng.normal(0.0, 0.05, 8)
        _, low, high = pool_estimates([{"a": estimate(value, 0.05)} for value in values])["a"]
        covered += low <= 2.0 <= high
    assert 180 <= covered <= 199
