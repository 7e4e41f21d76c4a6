"""Evidence for one effect, compared with results calculated by hand and with problems of known truth."""

from dataclasses import replace

import numpy as np
import pytest
from discovery_drives import COLUMNS, NOISE, fit_problem, linear_problem, recorded
from scipy import stats
from st_core.channels import SMOOTHING_NS
from st_core.discovery import DiscoverySettings
from st_core.discovery.evidence import (
    SIGN_DRAWS,
    Scores,
    collect_evidence,
    column_reductions,
    compare_parts,
    covariance,
    describe_position_reduction,
    distance_to_bound,
    library_p_value,
    null_p_value,
    pool_ratios,
    score_statistic,
    screen,
    sensor_p_values,
    standard_deviations,
)
from st_core.discovery.fit import Problem
from st_core.discovery.partitions import (
    CONDITIONS,
    THIRDS,
    divide_by_condition,
    divide_by_place,
    divide_by_run,
    find_sites,
    make_partitions,
)
from st_core.discovery.windows import Windows
from st_core.timeseries import moving_average

FEW = ("steering_offset", "mass", "yaw_inertia", "road_bank", "yaw_rate_bias")


def screen_base(problem):
    """(fit without effects, scores of all effects)."""
    base = fit_problem(problem)
    return base, screen(problem, base, np.random.default_rng(0))


def p_values(problem) -> dict[str, float]:
    _, scores = screen_base(problem)
    return {e: library_p_value(scores.by_effect[e], gain, scores, len(FEW)) for e, (gain, _) in scores.gains.items()}


# Significance


@pytest.mark.slow
@pytest.mark.parametrize("common", [0.0, 0.7])
def test_pure_noise_has_false_alarms_at_the_stated_rate(common):
    """The p-value of 0.01 is for the whole library, also if windows of a block have common errors."""
    alarms = [min(p_values(linear_problem(FEW, {}, seed, common=common)).values()) <= 0.01 for seed in range(100)]
    assert sum(alarms) <= 3  # more than 3 occur with probability 0.02


def test_true_effect_is_significant_and_first():
    found = [p_values(linear_problem(FEW, {"mass": 0.5}, seed)) for seed in range(20)]
    assert sum(p["mass"] <= 0.01 and min(p, key=p.get) == "mass" for p in found) >= 19


def test_effect_in_few_blocks_is_significant_by_the_gain_ratio():
    """The sign test cannot detect it: three blocks have equal signs in one of four cases."""
    problem = linear_problem(FEW, {}, 1, count=320, block=16, common=0.2)
    mass, affected = problem.space.indices("mass")[0], np.isin(problem.block, (3, 9, 14))
    problem.errors.noise[affected] += 3.0 * problem.errors.signatures[mass][affected]
    _, scores = screen_base(problem)
    gain, _ = scores.gains["mass"]
    assert (scores.largest >= score_statistic(scores.by_effect["mass"])).mean() > 0.01
    assert library_p_value(scores.by_effect["mass"], gain, scores, len(FEW)) <= 0.01


def test_score_statistic_is_the_squared_sum_divided_by_the_sum_of_squares():
    assert score_statistic(np.array([[1.0], [2.0], [-1.0]])) == pytest.approx(4.0 / 6.0)
    assert score_statistic(np.ones((7, 1))) == pytest.approx(7.0)


def test_p_value_is_twice_the_smaller_of_two_tests():
    scores_of_effect, gain = np.ones((10, 1)), np.linspace(0.5, 1.5, 10)
    exceeded, unequalled = (Scores({}, np.full(SIGN_DRAWS, size), 1.0, {}) for size in (11.0, 9.0))
    by_ratio, by_score = 2 * 5 * stats.f.sf(2.0 * 10.0, 1, 9), 2.0 / (1 + SIGN_DRAWS)
    assert library_p_value(scores_of_effect, gain, exceeded, 5) == pytest.approx(by_ratio)
    assert library_p_value(scores_of_effect, gain, unequalled, 5) == pytest.approx(by_score)
    ratio_insignificant = replace(unequalled, design_effect=1e9)
    assert library_p_value(scores_of_effect, gain, ratio_insignificant, 5) == pytest.approx(by_score)
    assert library_p_value(scores_of_effect, -gain, ratio_insignificant, 5) > 0.5  # raises the held-out loss
    assert library_p_value(scores_of_effect, gain, replace(exceeded, design_effect=1e9), 5) == 1.0


def test_design_effect_is_larger_for_dependent_windows():
    independent, dependent = (np.median([screen_base(linear_problem(FEW, {}, seed, common=c))[1].design_effect
                                  for seed in range(10)]) for c in (0.0, 1.0))
    assert 1.0 <= independent < dependent


def test_screen_excludes_effects_of_the_model_and_is_reproducible():
    problem = linear_problem(FEW, {"mass": 1.0}, 2)
    fit = fit_problem(problem, "mass")
    first, second = (screen(problem, fit, np.random.default_rng(0)) for _ in range(2))
    assert "mass" not in first.by_effect and set(first.by_effect) == set(FEW) - {"mass"}
    np.testing.assert_array_equal(first.largest, second.largest)


# Parameter values


def test_null_p_value_is_that_of_hotellings_test():
    problem = linear_problem(FEW, {"mass": 1.0}, 3)
    fit = fit_problem(problem, "mass", "yaw_inertia")
    assert null_p_value(problem, fit, "mass") < 1e-3 and null_p_value(problem, fit, "yaw_inertia") > 0.01
    index = problem.space.indices("mass")
    z = (fit.vector - problem.start)[index] / standard_deviations(problem, fit, "mass")
    expected = 2.0 * stats.t.sf(abs(z[0]), problem.blocks - 1)
    assert null_p_value(problem, fit, "mass") == pytest.approx(expected, rel=1e-6)


def test_standard_deviation_agrees_with_the_scatter_over_repeated_drives():
    """Drives of the same car, with noise common to the windows of a block."""
    values, deviations = [], []
    for seed in range(60):
        problem = linear_problem(FEW, {"mass": 1.0}, seed, common=0.8)
        fit = fit_problem(problem, "mass")
        values.append(fit.vector[problem.space.indices("mass")[0]])
        deviations.append(standard_deviations(problem, fit, "mass")[0])
        assert (np.linalg.eigvalsh(covariance(problem, fit)) > -1e-12).all()
    assert np.median(deviations) == pytest.approx(np.std(values), rel=0.25)


def test_distance_to_a_bound_is_in_typical_sizes():
    """Yaw inertia: factor up to 2.5, typical size 0.15."""
    inside, beyond = (fit_problem(linear_problem(FEW, {"yaw_inertia": deviation}, 4, size=0.2), "yaw_inertia")
                      for deviation in (6.0, 14.0))
    problem = linear_problem(FEW, {}, 4)
    assert distance_to_bound(problem, inside, "yaw_inertia") == pytest.approx(4.0, abs=0.1)
    assert distance_to_bound(problem, beyond, "yaw_inertia") == 0.0


@pytest.mark.parametrize(("effect", "deviation"), [("steering_lag", -1.0), ("combined_slip", 1.5)])
def test_bound_at_the_null_or_at_the_theoretical_value_is_not_counted(effect, deviation):
    problem = linear_problem((effect,), {effect: deviation}, 5)
    fit = fit_problem(problem, effect)
    assert fit.vector[problem.space.indices(effect)[0]] == (0.0 if deviation < 0.0 else 1.0)
    assert distance_to_bound(problem, fit, effect) > 1.0


def test_sensor_estimates_confirm_or_contradict_the_fit():
    problem = linear_problem(FEW, {"yaw_rate_bias": 1.0}, 6)
    fit = fit_problem(problem, "yaw_rate_bias")
    value = fit.vector[problem.space.indices("yaw_rate_bias")[0]]
    deviation = standard_deviations(problem, fit, "yaw_rate_bias")[0]
    half_width = 0.001 * stats.norm.ppf(0.975)
    estimate = {"yaw_rate_bias.bias": (0.003, 0.003 - half_width, 0.003 + half_width)}
    assert sensor_p_values(problem, fit, "yaw_rate_bias", estimate)[0] == pytest.approx(
        2.0 * stats.norm.sf(abs(value - 0.003) / np.hypot(0.001, deviation)), rel=1e-6)
    near = {"yaw_rate_bias.bias": (value, value - 1e-4, value + 1e-4)}
    far = {"yaw_rate_bias.bias": (0.0, -1e-4, 1e-4)}
    assert sensor_p_values(problem, fit, "yaw_rate_bias", near)[0] == pytest.approx(1.0)
    assert sensor_p_values(problem, fit, "yaw_rate_bias", far)[0] < 1e-6
    assert sensor_p_values(problem, fit, "yaw_rate_bias", near)[1] < 1e-6  # and exclude zero
    assert sensor_p_values(problem, fit, "yaw_rate_bias", far)[1] == pytest.approx(1.0)
    assert sensor_p_values(problem, fit, "mass", far) == (None, None)


def test_column_reductions_are_those_of_the_columns_that_the_effect_changes():
    problem = linear_problem(FEW, {"mass": 1.0}, 7)
    problem.noise = np.full(len(COLUMNS), 0.01)
    before = np.full(problem.errors.noise.shape, 0.02)
    after = before.copy()
    after[:, 1::len(COLUMNS)] = 0.005  # yaw rate
    problem.errors.noise = before
    problem.errors.truth = problem.start
    result = column_reductions(problem, before, after)
    assert result["yaw_rate"] == pytest.approx((0.75, 2.0))
    assert result["velocity_y"] == pytest.approx((0.0, 2.0))


@pytest.mark.parametrize(("reduction", "text"), [
    (0.032, "reduces the position error at the end of the horizon by 3.2 cm"),
    (-0.0002, "reduces the position error at the end of the horizon by less than 0.1 cm"),
    (0.0, "reduces no measured position error"),
    (-0.032, "increases the position error at the end of the horizon by 3.2 cm")])
def test_text_of_a_position_reduction(reduction, text):
    assert describe_position_reduction(reduction) == text


def test_evidence_compares_the_fits_with_and_without_the_effect():
    problem = linear_problem(FEW, {"mass": 1.0}, 8)
    base, scores = screen_base(problem)
    fit = fit_problem(problem, "mass")
    e = collect_evidence(problem, base, fit, "mass", scores, {}, {})
    by_run = problem.held_out_loss(base, problem.held_out_groups) - problem.held_out_loss(fit, problem.held_out_groups)
    assert e.gain == pytest.approx(min((base.held_out - fit.held_out).sum(), by_run.sum()) / problem.residual_count)
    decrease = (problem.position_error(problem.held_out_residuals(base))
                - problem.position_error(problem.held_out_residuals(fit)))
    assert e.position_reduction == e.position_reduction_in_condition == pytest.approx(decrease.mean())
    assert e.position_reduction > 0.0
    halves = (np.arange(160) % 2, ["even", "odd"])
    by_condition = collect_evidence(problem, base, fit, "mass", scores, {"condition": halves}, {})
    lower_bounds = [d.mean() - 1.645 * d.std(ddof=1) / np.sqrt(80) for d in (decrease[::2], decrease[1::2])]
    assert by_condition.position_reduction_in_condition == pytest.approx(max(lower_bounds))


# Agreement between parts


def test_random_effects_with_equal_variances():
    """Ratios 0, 1 and 2, variances 1/4: Q = 8, between = (8 - 2) / (12 - 48 / 12) = 3/4, mean 1 +- sqrt(1 / 3)."""
    result = pool_ratios(np.array([0.0, 1.0, 2.0]), np.full(3, 0.25), ["a", "b", "c"])
    assert result.ratios == {"a": (0.0, 0.5), "b": (1.0, 0.5), "c": (2.0, 0.5)}
    assert result.p_equal == pytest.approx(np.exp(-4.0))  # chi-square of two degrees of freedom
    assert result.p_absent == pytest.approx(stats.norm.sf(1.0 / np.sqrt(0.75 + 1.0 / 3.0)))


def test_random_effects_with_unequal_variances():
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


def test_equal_parts_have_no_variance_between_them():
    result = pool_ratios(np.array([1.0, 1.0, 1.0]), np.full(3, 0.01), ["a", "b", "c"])
    assert result.p_equal == 1.0 and result.p_absent < 1e-12


def test_fewer_than_two_parts_have_no_evidence_of_disagreement():
    assert pool_ratios(np.array([1.0]), np.array([1.0]), ["a"]).p_equal == 1.0
    assert pool_ratios(np.zeros(0), np.zeros(0), []).p_equal == 1.0


def test_ratios_of_parts_are_recovered():
    """The effect has 3, 2, 2 and 1 typical sizes in the four runs."""
    problem = linear_problem(FEW, {"mass": 2.0}, 9, count=320, common=0.0)
    run, index = problem.errors.windows.run, problem.space.indices("mass")[0]
    signature = problem.errors.signatures[index]
    problem.errors.noise = 0.5 * problem.errors.noise
    problem.errors.noise[run == 0] += 1.0 * signature[run == 0]
    problem.errors.noise[run == 3] -= 1.0 * signature[run == 3]
    problem.loss.rescale(problem.errors.truth)
    fit = fit_problem(problem, "mass")
    result = compare_parts(problem, fit, "mass", run, ["a", "b", "c", "d"])
    estimate = (fit.vector - problem.start)[index] / problem.space.scale[index]
    assert estimate == pytest.approx(2.0, abs=0.2)
    assert [ratio * estimate for ratio, _ in result.ratios.values()] == pytest.approx([3.0, 2.0, 2.0, 1.0], abs=0.25)
    assert result.p_equal < 1e-6 and result.p_absent < 0.05


@pytest.mark.parametrize("common", [0.0, 0.8])
def test_runs_of_one_car_agree(common):
    agreements = []
    for seed in range(60):
        problem = linear_problem(FEW, {"mass": 1.0}, seed, common=common)
        agreements.append(compare_parts(problem, fit_problem(problem, "mass"), "mass", problem.errors.windows.run,
                                        list("abcd")))
    assert np.mean([a.p_equal < 0.05 for a in agreements]) <= 0.15
    assert max(a.p_absent for a in agreements) < 0.05


# Partitions and noise


@pytest.fixture(scope="module")
def logs(leaf):
    return recorded(leaf, {}, 1, ("lane_change", "lane_change", "circle"))


def make_windows(logs, leaf) -> Windows:
    return Windows(logs, leaf, DiscoverySettings(windows=60))


def test_runs_at_common_places_belong_to_one_site(logs, leaf):
    elsewhere = replace(logs[1], x=logs[1].x + 5000.0)
    together, apart = (make_windows([logs[0], other], leaf) for other in (logs[1], elsewhere))
    assert set(find_sites(together)) == {0}
    assert [set(find_sites(apart)[apart.run == k]) for k in (0, 1)] == [{0}, {1}]
    assert "site" not in make_partitions(apart)  # equal to the runs
    both = make_windows([*logs[:2], replace(logs[2], x=logs[2].x + 5000.0)], leaf)
    assert make_partitions(both)["site"][1] == ["site 1", "site 2"]


def test_fewer_than_five_runs_are_divided_into_sections(logs, leaf):
    part, labels = divide_by_run(make_windows(logs[:1], leaf))
    assert len(np.unique(part)) == len(labels) == 6 and labels[0] == "lane_change 1, part 1"
    assert (np.diff(part) >= 0).all()
    five = make_windows([replace(logs[0], name=f"run {k}") for k in range(5)], leaf)
    assert divide_by_run(five)[1] == [f"run {k}" for k in range(5)]


def test_time_partition_divides_each_run_into_thirds(logs, leaf):
    windows = make_windows(logs, leaf)
    part, labels = make_partitions(windows)["time"]
    assert labels == list(THIRDS)
    for run in range(3):
        third, seconds = part[windows.run == run], windows.seconds[windows.run == run]
        assert set(third) == {0, 1, 2} and (np.diff(third) >= 0).all()
        assert seconds[third == 0].max() < seconds.max() / 3.0 <= seconds[third == 1].min() + 1e-9


def test_places_are_squares_of_the_map():
    number, labels = divide_by_place(np.array([0.0, 49.0, 51.0, -1.0]), np.array([0.0, 49.0, 0.0, 0.0]))
    assert number[0] == number[1] and len(set(number)) == 3
    assert labels[number[2]] == "east 75 m, north 25 m" and labels[number[3]] == "east -25 m, north 25 m"


def test_conditions_are_halves_by_speed_and_by_lateral_acceleration():
    speed, lateral = np.array([5.0, 5.0, 20.0, 20.0]), np.array([0.5, 3.0, 0.1, 1.0])
    part, labels = divide_by_condition(speed, lateral)
    assert [labels[k] for k in part] == ["slow and gentle", "slow and hard", "fast and gentle", "fast and hard"]
    assert labels == list(CONDITIONS)


def test_noise_floor_does_not_depend_on_vehicle_model_errors(leaf):
    logs = recorded(leaf, {"steering_offset": {"angle": 0.02}}, 2, ("weave", "slalom", "circle"))
    floor = Windows(logs, leaf, DiscoverySettings()).noise_floor()
    assert floor["velocity_y"] == pytest.approx(NOISE["velocity_y"], rel=0.1)
    white = np.random.default_rng(0).standard_normal((100, len(logs[0].x)))
    averaged = np.std([moving_average(logs[0].ins_time_ns, each, SMOOTHING_NS) for each in white])
    for name in ("yaw_rate", "acceleration_y"):
        assert floor[name] == pytest.approx(NOISE[name] * averaged, rel=0.1)
    ends = np.sqrt(2.0) * NOISE["x"]  # position difference between start and end of a window
    for column in ("position_lateral", "position_longitudinal"):
        assert ends * 0.8 < floor[column] < ends * 1.8


def test_covariance_with_reference_drives_adds_the_shift_by_an_error_of_their_fit():
    """An error of the start moves the value and the start; the interval contains only what differs between them."""
    size = len(linear_problem(FEW, {}, 21).space)
    root = np.random.default_rng(3).standard_normal((size, size))
    problem = linear_problem(FEW, {"mass": 2.0}, 21, prior=root @ root.T + 5.0 * np.eye(size))
    problem.start_covariance = np.diag(np.linspace(0.5, 1.0, size)) @ np.linalg.inv(problem.prior)
    problem.start_covariance = problem.start_covariance @ np.diag(np.linspace(0.5, 1.0, size))
    fit = fit_problem(problem, "mass", iterations=100)
    index, scale, step = int(problem.space.indices("mass")[0]), problem.space.scale, 0.02

    def distance(shift: np.ndarray) -> float:
        shifted = Problem(problem.loss, problem.start + shift * scale, problem.block, problem.prior)
        return float(shifted.distance(fit_problem(shifted, "mass", iterations=100).vector)[index])

    slope = np.array([distance(step * row) - distance(-step * row) for row in np.eye(size)]) / (2.0 * step)
    curvature = problem.loss.curvature(problem.errors.at(fit.vector), fit.sensitivities.values)
    inverse = np.linalg.inv(curvature + problem.prior_curvature(fit.names, fit.indices) + 1e-9 * np.eye(size))
    scatter = problem.blocks * np.cov(fit.quadratic.sum_groups(problem.block).gradient.T)
    expected = (inverse @ scatter @ inverse)[index, index] + slope @ problem.start_covariance @ slope
    assert covariance(problem, fit)[index, index] == pytest.approx(expected, rel=0.02)
    assert abs(slope[index]) > 0.5
