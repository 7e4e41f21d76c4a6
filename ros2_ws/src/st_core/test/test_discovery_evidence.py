"""What drives say of one effect: against numbers worked out by hand, and against problems whose truth is known."""

from dataclasses import replace

import numpy as np
import pytest
from discovery_drives import COLUMNS, NOISE, linear_problem, recorded
from scipy import stats
from st_core.channels import SMOOTHING_NS
from st_core.discovery import DiscoverySettings
from st_core.discovery.evidence import (
    SIGN_DRAWS,
    Scores,
    collect_evidence,
    column_shares,
    compare_parts,
    covariance,
    distance_to_bound,
    library_p_value,
    null_p_value,
    pool_ratios,
    score_statistic,
    screen,
    sensor_p_values,
    standard_deviations,
)
from st_core.discovery.partitions import (
    CONDITIONS,
    TIMES,
    divide_by_condition,
    divide_by_place,
    divide_by_run,
    find_sites,
    make_partitions,
)
from st_core.discovery.windows import Windows, noise_floor
from st_core.timeseries import moving_average

FEW = ("steering_offset", "mass", "yaw_inertia", "road_bank", "yaw_rate_bias")


def fitted(problem, *names):
    return problem.fit(names, problem.all_sensitivities(problem.start), iterations=30)


def screened(problem, seed: int = 0):
    base = fitted(problem)
    return base, screen(problem, base, np.random.default_rng(seed))


def chances(problem) -> dict[str, float]:
    _, scores = screened(problem)
    return {e: library_p_value(scores.by_effect[e], gain, scores, len(FEW)) for e, (gain, _) in scores.gains.items()}


# Chance


@pytest.mark.parametrize("common", [0.0, 0.7])
def test_pure_noise_says_nothing(common):
    """At most a limit of one in a hundred over the whole library, whatever windows of a block share."""
    alarms = [min(chances(linear_problem(FEW, {}, seed, common=common)).values()) <= 0.01 for seed in range(100)]
    assert sum(alarms) <= 3  # more than that come with probability 0.02


def test_effect_that_is_there_is_sure():
    found = [chances(linear_problem(FEW, {"mass": 0.5}, seed)) for seed in range(20)]
    assert sum(c["mass"] <= 0.01 and min(c, key=c.get) == "mass" for c in found) >= 19


def test_effect_of_few_blocks_is_found_by_the_ratio():
    """The signs of blocks cannot show it: three are alike in one of four cases."""
    problem = linear_problem(FEW, {}, 1, count=320, block=16, common=0.2)
    mass, few = problem.space.indices("mass")[0], np.isin(problem.block, (3, 9, 14))
    problem.errors.noise[few] += 3.0 * problem.errors.signatures[mass][few]
    _, scores = screened(problem)
    gain, _ = scores.gains["mass"]
    assert (scores.largest >= score_statistic(scores.by_effect["mass"])).mean() > 0.01
    assert library_p_value(scores.by_effect["mass"], gain, scores, len(FEW)) <= 0.01


def test_statistic_is_the_square_of_the_sum_over_the_sum_of_squares():
    assert score_statistic(np.array([[1.0], [2.0], [-1.0]])) == pytest.approx(4.0 / 6.0)
    assert score_statistic(np.ones((7, 1))) == pytest.approx(7.0)


def test_chance_is_the_smaller_of_two_tests():
    own, gain = np.ones((10, 1)), np.linspace(0.5, 1.5, 10)
    beaten, unbeaten = (Scores({}, np.full(SIGN_DRAWS, size), 1.0, {}) for size in (11.0, 9.0))
    by_ratio = 5 * stats.f.sf(2.0 * 10.0, 1, 9)
    assert library_p_value(own, gain, beaten, 5) == pytest.approx(by_ratio)
    assert library_p_value(own, gain, unbeaten, 5) == pytest.approx(1.0 / (1 + SIGN_DRAWS))
    wide = replace(unbeaten, design_effect=1e9)
    assert library_p_value(own, gain, wide, 5) == pytest.approx(1.0 / (1 + SIGN_DRAWS))
    assert library_p_value(own, -gain, wide, 5) > 0.5  # held out it is worse
    assert library_p_value(own, gain, replace(beaten, design_effect=1e9), 5) == 1.0
    assert library_p_value(own[:1], gain[:1], unbeaten, 5) == 1.0  # one block says nothing


def test_design_effect_is_what_dependent_windows_make_of_the_variance():
    alone, together = (np.median([screened(linear_problem(FEW, {}, seed, common=c))[1].design_effect
                                  for seed in range(10)]) for c in (0.0, 1.0))
    assert 1.0 <= alone < together


def test_screen_leaves_out_what_is_there_and_is_the_same_twice():
    problem = linear_problem(FEW, {"mass": 1.0}, 2)
    fit = fitted(problem, "mass")
    first, second = (screen(problem, fit, np.random.default_rng(0)) for _ in range(2))
    assert "mass" not in first.by_effect and set(first.by_effect) == set(FEW) - {"mass"}
    np.testing.assert_array_equal(first.largest, second.largest)


# Values


def test_null_is_hotellings_test():
    problem = linear_problem(FEW, {"mass": 1.0}, 3)
    fit = fitted(problem, "mass", "yaw_inertia")
    assert null_p_value(problem, fit, "mass") < 1e-3 and null_p_value(problem, fit, "yaw_inertia") > 0.01
    own = problem.space.indices("mass")
    z = (fit.vector - problem.start)[own] / standard_deviations(problem, fit, "mass")
    expected = 2.0 * stats.t.sf(abs(z[0]), problem.blocks - 1)
    assert null_p_value(problem, fit, "mass") == pytest.approx(expected, rel=1e-6)


def test_deviation_is_that_of_repeated_drives():
    """Over drives of the same car, with noise that windows of a block share."""
    values, result = [], []
    for seed in range(60):
        problem = linear_problem(FEW, {"mass": 1.0}, seed, common=0.8)
        fit = fitted(problem, "mass")
        values.append(fit.vector[problem.space.indices("mass")[0]])
        result.append(standard_deviations(problem, fit, "mass")[0])
        assert (np.linalg.eigvalsh(covariance(problem, fit)) > -1e-12).all()
    assert np.median(result) == pytest.approx(np.std(values), rel=0.25)


def test_distance_to_a_bound_counts_in_typical_sizes():
    """Of the inertia: factor up to 2.5, typical size 0.15."""
    inside, beyond = (fitted(linear_problem(FEW, {"yaw_inertia": by}, 4, size=0.2), "yaw_inertia")
                      for by in (6.0, 14.0))
    problem = linear_problem(FEW, {}, 4)
    assert distance_to_bound(problem, inside, "yaw_inertia") == pytest.approx(4.0, abs=0.1)
    assert distance_to_bound(problem, beyond, "yaw_inertia") == 0.0


@pytest.mark.parametrize(("effect", "by"), [("steering_lag", -1.0), ("combined_slip", 1.5)])
def test_bound_at_the_null_or_at_theory_is_none(effect, by):
    problem = linear_problem((effect,), {effect: by}, 5)
    fit = fitted(problem, effect)
    assert fit.vector[problem.space.indices(effect)[0]] == (0.0 if by < 0.0 else 1.0)
    assert distance_to_bound(problem, fit, effect) > 1.0


def test_sensors_confirm_or_contradict():
    problem = linear_problem(FEW, {"yaw_rate_bias": 1.0}, 6)
    fit = fitted(problem, "yaw_rate_bias")
    value = fit.vector[problem.space.indices("yaw_rate_bias")[0]]
    own = standard_deviations(problem, fit, "yaw_rate_bias")[0]
    off = value - 0.003
    reach = 0.001 * stats.norm.ppf(0.975)
    said = {"yaw_rate_bias.bias": (0.003, 0.003 - reach, 0.003 + reach)}
    assert sensor_p_values(problem, fit, "yaw_rate_bias", said)[0] == pytest.approx(
        2.0 * stats.norm.sf(abs(off) / np.hypot(0.001, own)), rel=1e-6)
    near = {"yaw_rate_bias.bias": (value, value - 1e-4, value + 1e-4)}
    far = {"yaw_rate_bias.bias": (0.0, -1e-4, 1e-4)}
    assert sensor_p_values(problem, fit, "yaw_rate_bias", near)[0] == pytest.approx(1.0)
    assert sensor_p_values(problem, fit, "yaw_rate_bias", far)[0] < 1e-6
    assert sensor_p_values(problem, fit, "yaw_rate_bias", near)[1] < 1e-6  # and say that it is there
    assert sensor_p_values(problem, fit, "yaw_rate_bias", far)[1] == pytest.approx(1.0)
    assert sensor_p_values(problem, fit, "mass", far) == (None, None)


def test_shares_of_the_columns():
    """An effect of one column only takes nothing away from the others; the noise is what is told."""
    problem = linear_problem(FEW, {"mass": 1.0}, 7)
    problem.noise = np.full(len(COLUMNS), 0.01)
    rows = np.full(problem.errors.noise.shape, 0.02)
    half = rows.copy()
    half[:, 1::len(COLUMNS)] = 0.005
    problem.errors.noise = rows
    problem.errors.truth = problem.start
    result = column_shares(problem, rows, half)
    assert result["yaw_rate"] == pytest.approx((0.75, 2.0))
    assert result["velocity_y"] == pytest.approx((0.0, 2.0))


def test_evidence_of_a_fit_against_that_without():
    problem = linear_problem(FEW, {"mass": 1.0}, 8)
    base, scores = screened(problem)
    fit = fitted(problem, "mass")
    e = collect_evidence(problem, base, fit, "mass", scores, {}, {})
    by_run = problem.held_out_loss(base, problem.held_out_groups) - problem.held_out_loss(fit, problem.held_out_groups)
    assert e.gain == pytest.approx(min((base.held_out - fit.held_out).sum(), by_run.sum()) / problem.residual_count)
    fall = (problem.position_error(problem.held_out_rows(base))
            - problem.position_error(problem.held_out_rows(fit)))
    assert e.position == e.position_in_condition == pytest.approx(fall.mean()) and e.position > 0.0
    halves = (np.arange(160) % 2, ["even", "odd"])
    bent = collect_evidence(problem, base, fit, "mass", scores, {"condition": halves}, {})
    surely = [f.mean() - 1.645 * f.std(ddof=1) / np.sqrt(80) for f in (fall[::2], fall[1::2])]
    assert bent.position_in_condition == pytest.approx(max(surely))


# The same everywhere


def test_random_effects_by_hand():
    """Shares 0, 1 and 2, variances 1/4: Q = 8, between = (8 - 2) / (12 - 48 / 12) = 3/4, mean 1 +- sqrt(1 / 3)."""
    result = pool_ratios(np.array([0.0, 1.0, 2.0]), np.full(3, 0.25), ["a", "b", "c"])
    assert result.ratios == {"a": (0.0, 0.5), "b": (1.0, 0.5), "c": (2.0, 0.5)}
    assert result.p_equal == pytest.approx(np.exp(-4.0))  # chi-square of two degrees of freedom
    assert result.p_absent == pytest.approx(stats.norm.sf(1.0 / np.sqrt(0.75 + 1.0 / 3.0)))


def test_random_effects_with_unequal_variances():
    """Weights 100, 25 and 4, written out."""
    y, v = np.array([1.0, 0.6, 3.0]), np.array([0.01, 0.04, 0.25])
    w = [100.0, 25.0, 4.0]
    mean = (100.0 * 1.0 + 25.0 * 0.6 + 4.0 * 3.0) / 129.0
    q = 100.0 * (1.0 - mean)**2 + 25.0 * (0.6 - mean)**2 + 4.0 * (3.0 - mean)**2
    between = (q - 2.0) / (129.0 - (100.0**2 + 25.0**2 + 4.0**2) / 129.0)
    w = [1.0 / (s + between) for s in v]
    mean = sum(a * b for a, b in zip(w, y, strict=True)) / sum(w)
    result = pool_ratios(y, v, ["a", "b", "c"])
    assert result.p_equal == pytest.approx(stats.chi2.sf(q, 2))
    assert result.p_absent == pytest.approx(stats.norm.sf(mean / np.sqrt(between + 1.0 / sum(w))))


def test_parts_that_agree_have_no_variance_between_them():
    result = pool_ratios(np.array([1.0, 1.0, 1.0]), np.full(3, 0.01), ["a", "b", "c"])
    assert result.p_equal == 1.0 and result.p_absent < 1e-12


def test_one_part_cannot_disagree():
    assert pool_ratios(np.array([1.0]), np.array([1.0]), ["a"]).p_equal == 1.0
    assert pool_ratios(np.zeros(0), np.zeros(0), []).p_equal == 1.0


def test_shares_of_parts_are_those_put_in():
    """A mass that is twice itself in the first run, and not there in the last."""
    problem = linear_problem(FEW, {"mass": 2.0}, 9, count=320, common=0.0)
    run, own = problem.errors.windows.run, problem.space.indices("mass")[0]
    signature = problem.errors.signatures[own]
    problem.errors.noise = 0.5 * problem.errors.noise
    problem.errors.noise[run == 0] += 1.0 * signature[run == 0]
    problem.errors.noise[run == 3] -= 1.0 * signature[run == 3]
    problem.loss.rescale(problem.errors.truth)
    fit = fitted(problem, "mass")
    result = compare_parts(problem, fit, "mass", run, ["a", "b", "c", "d"])
    stated = (fit.vector - problem.start)[own] / problem.space.scale[own]
    assert stated == pytest.approx(2.0, abs=0.2)
    assert [share * stated for share, _ in result.ratios.values()] == pytest.approx([3.0, 2.0, 2.0, 1.0], abs=0.25)
    assert result.p_equal < 1e-6 and result.p_absent < 0.05


@pytest.mark.parametrize("common", [0.0, 0.8])
def test_runs_of_one_car_agree(common):
    result = []
    for seed in range(60):
        problem = linear_problem(FEW, {"mass": 1.0}, seed, common=common)
        result.append(compare_parts(problem, fitted(problem, "mass"), "mass", problem.errors.windows.run, list("abcd")))
    assert np.mean([a.p_equal < 0.05 for a in result]) <= 0.15
    assert max(a.p_absent for a in result) < 0.05


# Partitions and the noise


@pytest.fixture(scope="module")
def logs(leaf):
    return recorded(leaf, {}, 1, ("lane_change", "lane_change", "circle"))


def windows_of(logs, leaf) -> Windows:
    return Windows(logs, leaf, DiscoverySettings(windows=60))


def test_runs_that_share_places_are_of_one_site(logs, leaf):
    elsewhere = replace(logs[1], x=logs[1].x + 5000.0)
    together, apart = (windows_of([logs[0], other], leaf) for other in (logs[1], elsewhere))
    assert set(find_sites(together)) == {0}
    assert [set(find_sites(apart)[apart.run == k]) for k in (0, 1)] == [{0}, {1}]
    assert "site" not in make_partitions(apart)  # nothing beyond the runs
    both = windows_of([*logs[:2], replace(logs[2], x=logs[2].x + 5000.0)], leaf)
    assert make_partitions(both)["site"][1] == ["site 1", "site 2"]


def test_few_runs_are_divided_into_stretches(logs, leaf):
    part, called = divide_by_run(windows_of(logs[:1], leaf))
    assert len(np.unique(part)) == len(called) == 6 and called[0] == "lane_change 1, part 1"
    assert (np.diff(part) >= 0).all()
    five = windows_of([replace(logs[0], name=f"run {k}") for k in range(5)], leaf)
    assert divide_by_run(five)[1] == [f"run {k}" for k in range(5)]


def test_thirds_are_of_each_run(logs, leaf):
    windows = windows_of(logs, leaf)
    part, called = make_partitions(windows)["time"]
    assert called == list(TIMES)
    for run in range(3):
        mine, seconds = part[windows.run == run], windows.seconds[windows.run == run]
        assert set(mine) == {0, 1, 2} and (np.diff(mine) >= 0).all()
        assert seconds[mine == 0].max() < seconds.max() / 3.0 <= seconds[mine == 1].min() + 1e-9


def test_places_are_squares_of_the_map():
    number, called = divide_by_place(np.array([0.0, 49.0, 51.0, -1.0]), np.array([0.0, 49.0, 0.0, 0.0]))
    assert number[0] == number[1] and len(set(number)) == 3
    assert called[number[2]] == "east 75 m, north 25 m" and called[number[3]] == "east -25 m, north 25 m"


def test_conditions_are_halves_by_speed_and_by_how_hard_it_corners():
    speed, lateral = np.array([5.0, 5.0, 20.0, 20.0]), np.array([0.5, 3.0, 0.1, 1.0])
    part, called = divide_by_condition(speed, lateral)
    assert [called[k] for k in part] == ["slow and gentle", "slow and hard", "fast and gentle", "fast and hard"]
    assert called == list(CONDITIONS)


def test_noise_is_found_without_a_car(leaf):
    logs = recorded(leaf, {"steering_offset": {"angle": 0.02}}, 2, ("weave", "slalom", "circle"))
    floor = noise_floor(Windows(logs, leaf, DiscoverySettings()))
    assert floor["velocity_y"] == pytest.approx(NOISE["velocity_y"], rel=0.1)
    white = np.random.default_rng(0).standard_normal((100, len(logs[0].x)))
    averaged = np.std([moving_average(logs[0].ins_time_ns, each, SMOOTHING_NS) for each in white])
    for name in ("yaw_rate", "acceleration_y"):
        assert floor[name] == pytest.approx(NOISE[name] * averaged, rel=0.1)
    ends = np.sqrt(2.0) * NOISE["x"]  # of the way: start and end
    for column in ("position_lateral", "position_longitudinal"):
        assert ends * 0.8 < floor[column] < ends * 1.8
