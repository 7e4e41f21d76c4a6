"""Waterfall, error budget, intervals, detection power and next manoeuvre, on problems of known truth."""

from dataclasses import replace

import numpy as np
import pytest
from discovery_drives import COLUMNS, fit_problem, linear_problem, recorded
from st_core.discovery import DiscoverySettings, Limits, power_analysis, waterfall
from st_core.discovery.evidence import screen
from st_core.discovery.fit import Problem
from st_core.discovery.loss import Errors, Loss
from st_core.discovery.next_manoeuvre import (
    MIN_SEPARATION,
    choose_manoeuvre,
    compute_separation,
    find_most_informative,
    list_separabilities,
    simulate_catalogue,
)
from st_core.discovery.result import FoundEffect
from st_core.discovery.space import Space
from st_core.discovery.windows import Windows
from st_core.manoeuvres import CATALOGUE

FEW = ("steering_offset", "mass", "yaw_rate_bias", "road_bank")
TRUTH = {"mass": 3.0, "yaw_rate_bias": 2.0}


@pytest.fixture(scope="module")
def explained():
    """(problem, fit of both true effects, errors at the horizon, waterfall steps, fit of the base)."""
    problem = linear_problem(FEW, TRUTH, 1, count=320)
    final = fit_problem(problem, *TRUTH)
    problem.loss.rescale(final.vector)
    final = fit_problem(problem, *TRUTH)
    ends = waterfall.HorizonErrors(problem, 0)
    steps, base = waterfall.build_steps(problem, final, list(TRUTH), ends, {})
    return problem, final, ends, steps, base


def test_horizon_errors_are_those_of_the_last_point(explained):
    problem, final, ends, *_ = explained
    rows = problem.held_out_residuals(final).reshape(320, 4, len(COLUMNS))[:, -1]
    squares = ends.by_channel(final)
    np.testing.assert_allclose(squares["yaw_rate"], np.square(rows[:, 1]))
    np.testing.assert_allclose(squares["position_5s"], np.hypot(rows[:, 4], rows[:, 5]))


def test_held_out_groups_are_whole_runs_if_there_are_more_than_three():
    four, two = (linear_problem(FEW, {}, 1, runs=n) for n in (4, 2))
    assert (four.held_out_groups[four.block] == four.errors.windows.run).all()
    assert (two.held_out_groups == two.fold).all()


def test_waterfall_steps_lead_from_the_base_error_to_the_final_error(explained):
    problem, final, ends, steps, base = explained
    error = waterfall.compare_channel_errors(ends, base, final, {"position": 0.01, "position_5s": 0.01})
    assert [s.effect for s in steps] == list(TRUTH) and [s.kind for s in steps] == ["vehicle parameters", "sensors"]
    assert steps[0].position_5s.base == pytest.approx(error["position_5s"].base)
    assert steps[-1].position_5s.augmented == pytest.approx(error["position_5s"].augmented)
    assert steps[0].position_5s.augmented == pytest.approx(steps[1].position_5s.base)
    decrease = sum(s.position_5s.base - s.position_5s.augmented for s in steps)
    assert decrease == pytest.approx(error["position_5s"].base - error["position_5s"].augmented)
    for channel in ("velocity_y", "yaw_rate", "acceleration_y", "yaw", "position"):
        assert steps[0].channels[channel].augmented == pytest.approx(steps[1].channels[channel].base)
        assert steps[-1].channels[channel].augmented == pytest.approx(error[channel].augmented)
    # Signatures and noise have equal variances: an effect of n typical sizes adds n^2 of them.
    for value, variances in ((steps[0].channels["yaw"].base, 14.0), (steps[1].channels["yaw"].base, 5.0),
                         (steps[1].channels["yaw"].augmented, 1.0)):
        assert value == pytest.approx(0.02 * np.sqrt(variances), rel=0.15)
    assert set(steps[0].runs) == {"run 1", "run 2", "run 3", "run 4"}
    assert np.mean([after for _, after in steps[-1].runs.values()]) == pytest.approx(
        steps[-1].position_5s.augmented, rel=1e-6)  # runs of equal length
    np.testing.assert_allclose(problem.loss.scale, problem.loss.scale_of(final.vector), rtol=0.05)  # unchanged


def test_interval_of_an_error_reduction_contains_it_and_that_of_no_reduction_contains_zero(explained):
    *_, ends, steps, _ = explained
    for step in steps:
        low, high = step.position_5s.interval
        assert 0.0 < low < step.position_5s.base - step.position_5s.augmented < high
    values = np.abs(np.random.default_rng(0).standard_normal(320))
    low, high = ends.compare("position_5s", values, values[::-1]).interval
    assert low < 0.0 < high
    assert np.isnan(ends.compare("position_5s", np.full(320, np.nan), values).base)


def test_error_comparison_names_the_worst_run_and_the_runs_with_a_larger_error(explained):
    _, final, ends, _, base = explained
    error = waterfall.compare_channel_errors(ends, base, final, {})["position_5s"]
    after = ends.error_by_run("position_5s", ends.by_channel(final)["position_5s"])
    assert (error.worst_run, error.worst) == (max(after, key=after.get), max(after.values())) and error.worse_runs == ()
    reverse = waterfall.compare_channel_errors(ends, final, base, {})["position_5s"]
    assert set(reverse.worse_runs) == set(after)
    assert waterfall.compare_channel_errors(ends, final, base, {"position_5s": 10.0})["position_5s"].worse_runs == ()


def test_budget_divides_the_error_reduction_by_kind_of_effect(explained):
    problem, final, ends, _, base = explained
    lines = {line.part: line for line in waterfall.build_budget(problem, base, final, final, None, ends)}
    assert list(lines) == ["sensors", "vehicle parameters", "unexplained"]
    error = waterfall.compare_channel_errors(ends, base, final, {})["position_5s"]
    assert lines["unexplained"].added_last == lines["unexplained"].added_first
    assert lines["unexplained"].added_last == pytest.approx(error.augmented, rel=0.01)
    assert lines["unexplained"].share_added_last == pytest.approx(error.augmented / error.base, rel=0.01)
    # Mean position error proportional to sqrt(3^2 + 2^2 + 1): without the mass 2^2 + 1, without the bias 3^2 + 1.
    unit = error.augmented
    assert lines["vehicle parameters"].added_last == pytest.approx(unit * (np.sqrt(10.0) - 1.0), rel=0.15)
    assert lines["vehicle parameters"].added_first == pytest.approx(unit * (np.sqrt(14.0) - np.sqrt(5.0)), rel=0.15)
    assert lines["sensors"].added_last == pytest.approx(unit * (np.sqrt(5.0) - 1.0), rel=0.15)
    assert lines["vehicle parameters"].loss_added_last > lines["sensors"].loss_added_last > 0.0


def test_budget_of_a_single_part_does_not_depend_on_the_order():
    problem = linear_problem(FEW, {"mass": 3.0}, 2)
    final = fit_problem(problem, "mass")
    ends = waterfall.HorizonErrors(problem, 0)
    _, base = waterfall.build_steps(problem, final, ["mass"], ends, {})
    part, unexplained = waterfall.build_budget(problem, base, final, final, None, ends)
    assert (part.part, part.added_last) == ("vehicle parameters", part.added_first)
    assert part.loss_added_last == part.loss_added_first
    assert part.share_added_last + unexplained.share_added_last == pytest.approx(1.0)
    assert part.loss_added_last + unexplained.loss_added_last == pytest.approx(1.0)


# Intervals


@pytest.mark.slow
@pytest.mark.parametrize("common", [0.0, 0.8])
def test_intervals_cover_the_truth(common):
    """95 of 100, also with errors common to a block; fewer than 88 of 100 occur with probability 0.002."""
    covered, widths = [], []
    for seed in range(100):
        problem = linear_problem(FEW, {"mass": 1.0}, seed, common=common)
        partitions = {"run": (problem.errors.windows.run, list("abcd"))}
        result = waterfall.estimate_parameters(problem, fit_problem(problem, "mass"), "mass", partitions)["factor"]
        covered.append(result.interval[0] <= 1.1 <= result.interval[1])
        widths.append(result.interval[1] - result.interval[0])
    assert sum(covered) >= 88
    assert np.median(widths) < 0.1


def test_interval_includes_the_variation_between_runs_but_not_between_places():
    """Ratios 0.5, 1, 1, 1.5 to the estimate: standard deviation 0.41, of the mean of four 0.2; t of 3 degrees of
    freedom 3.18."""
    problem = linear_problem(FEW, {"mass": 2.0}, 3, count=640, common=0.0)
    run, index = problem.errors.windows.run, problem.space.indices("mass")[0]
    problem.errors.noise = 0.2 * problem.errors.noise
    for k, change in ((0, -1.0), (3, 1.0)):
        problem.errors.noise[run == k] += change * problem.errors.signatures[index][run == k]
    problem.loss.rescale(problem.errors.truth)
    fit = fit_problem(problem, "mass")
    by_run, by_place = {"run": (run, list("abcd"))}, {"place": (run, list("abcd"))}
    single, places, runs = (waterfall.estimate_parameters(problem, fit, "mass", partitions)["factor"].interval
                           for partitions in ({}, by_place, by_run))
    assert runs[0] < 1.2 < runs[1] and places == single
    assert 0.65 * 2 * 3.18 * 0.2 * 0.2 < runs[1] - runs[0] < 0.8
    assert runs[1] - runs[0] > 1.3 * (single[1] - single[0])


def test_interval_includes_the_values_of_equally_good_sets_of_effects(explained):
    problem, final, *_ = explained
    index = problem.space.indices("mass")
    other = final.vector.copy()
    other[index] += 0.5 * problem.space.scale[index]
    single = waterfall.estimate_parameters(problem, final, "mass", {})["factor"]
    wide = waterfall.estimate_parameters(problem, final, "mass", {}, [(("mass", "road_bank"), other)])["factor"]
    assert (wide.value, wide.interval[0]) == (single.value, single.interval[0])
    assert wide.interval[1] - single.interval[1] == pytest.approx(0.5 * problem.space.scale[index][0])
    assert waterfall.estimate_parameters(problem, final, "mass", {}, [(("road_bank",), other)])["factor"] == single


def test_value_with_a_reference_is_the_change_since_the_reference():
    problem = linear_problem(FEW, {"mass": 3.0}, 4)
    start = problem.start.copy()
    start[problem.space.indices("mass")] += 0.1
    problem = Problem(problem.loss, start, problem.block, np.eye(len(problem.space)))
    result = waterfall.estimate_parameters(problem, fit_problem(problem, "mass"), "mass", {})["factor"]
    assert result.value == pytest.approx(1.2, abs=0.02) and result.null == 1.0


# Detection power


@pytest.mark.slow
def test_predicted_power_agrees_with_the_power_measured_on_simulated_drives():
    problem = linear_problem(FEW, {}, 5, common=0.3)
    problem.errors.signatures *= 0.8  # a quarter of a typical size is then irrelevant, half of it relevant
    problem.noise = np.full(len(COLUMNS), 0.02)  # the noise explains all of the residual
    base = fit_problem(problem)
    scores = screen(problem, base, np.random.default_rng(0))
    predicted = power_analysis.predict_power(problem, base, scores, Limits())
    ticks = []
    measured = power_analysis.measure_power(problem, base, Limits(), 0, lambda: ticks.append(1))
    assert (predicted.measured, predicted.simulated_drives, measured.measured, len(ticks)) == (False, 0, True, len(FEW))
    assert measured.alarms <= 0.05 * measured.simulated_drives
    by_size = {(p.effect, p.size): p.probability for p in predicted.powers}
    difference = [by_size[m.effect, m.size] - m.probability for m in measured.powers]
    assert np.mean(np.abs(difference)) < 0.12
    assert {round(m.probability) for m in measured.powers} == {0, 1}
    for effect in FEW:
        powers = [p.probability for p in predicted.powers if p.effect == effect]
        assert powers == sorted(powers)


def test_effect_without_a_signature_has_no_detection_power():
    problem = linear_problem(FEW, {}, 6)
    problem.errors.signatures[problem.space.indices("road_bank")] = 0.0
    base = fit_problem(problem)
    scores = screen(problem, base, np.random.default_rng(0))
    predicted = power_analysis.predict_power(problem, base, scores, Limits())
    found = {e: max(p.probability for p in predicted.powers if p.effect == e) for e in FEW}
    assert found["road_bank"] < 0.01 and min(found[e] for e in FEW if e != "road_bank") > 0.8
    assert sum(p.effect == "road_bank" for p in predicted.powers) == 3


def test_smallest_detectable_size_is_listed_for_an_effect_that_is_undetectable_at_its_typical_size():
    problem = linear_problem(FEW, {}, 5, common=0.3)
    problem.noise = np.full(len(COLUMNS), 1e-4)  # far below the residual, a fifth of which must then be explained
    problem.errors.signatures *= 0.5
    base = fit_problem(problem)
    predicted = power_analysis.predict_power(problem, base, screen(problem, base, np.random.default_rng(0)), Limits())
    rows = [[p for p in predicted.powers if p.effect == e] for e in FEW]
    assert all(larger == [] for _, _, typical, *larger in rows if typical.probability >= 0.8)
    undetectable = [(typical, larger) for _, _, typical, *larger in rows if typical.probability < 0.8 and larger]
    assert undetectable
    for typical, (detectable,) in undetectable:
        assert detectable.probability >= 0.8 and detectable.size > typical.size
        assert detectable.position_5s > typical.position_5s


# Next manoeuvre


def found_effect(name: str, *alternatives: str) -> FoundEffect:
    return FoundEffect(name, "vehicle parameters", {}, alternatives, 0.1, {})


@pytest.mark.parametrize(("cosine", "remaining", "healthy"), [(0.0, 1.0, 0.0), (0.8, 0.36, 0.0), (1.0, 0.0, 0.0),
                                                              (0.8, 0.36, 1.5)])
def test_separation_is_the_part_of_an_effect_orthogonal_to_the_other(cosine, remaining, healthy):
    """healthy: value of the healthy car, from which a search with reference drives starts."""
    problem = linear_problem(FEW, {}, 7)
    one, other = (problem.space.indices(n)[0] for n in ("mass", "road_bank"))
    h = np.zeros((len(problem.space), len(problem.space)))
    h[one, one], h[other, other], h[one, other], h[other, one] = 9.0, 4.0, 6.0 * cosine, 6.0 * cosine
    problem.start = problem.space.null.copy()
    problem.start[one] += healthy * problem.space.scale[one]
    vector = problem.start.copy()
    vector[one] += 2.0 * problem.space.scale[one]
    fit = replace(fit_problem(problem, "mass"), vector=vector)
    result = compute_separation(problem, fit, h, "mass", "road_bank", 8.0)
    assert result[0] == pytest.approx(cosine, abs=1e-6)
    assert result[1] == pytest.approx(np.sqrt(2.0 * 4.0 * 9.0 * remaining / 8.0), abs=1e-3)


def fit_drives(leaf, manoeuvres, effects, names):
    settings = DiscoverySettings(windows=100)
    space = Space("nonlinear", settings)
    windows = Windows(recorded(leaf, effects, 1, manoeuvres), leaf, settings)
    loss = Loss(Errors(windows, space), space.null)
    problem = Problem(loss, space.null, windows.block)
    fit = problem.fit(names, problem.all_sensitivities(space.null))
    loss.rescale(fit.vector)
    return problem, problem.refit(fit)


@pytest.mark.slow
def test_suggested_manoeuvre_separates_two_effects_as_predicted(leaf):
    """A small error of the yaw inertia and a steering lag are not separable in gentle driving."""
    true, answer = {"yaw_inertia": {"factor": 1.05}}, [found_effect("yaw_inertia", "steering_lag")]
    problem, fit = fit_drives(leaf, ("weave",), true, ("yaw_inertia",))
    design = screen(problem, fit, np.random.default_rng(0)).design_effect
    before, = list_separabilities(problem, fit, answer, design)
    options = simulate_catalogue(problem, fit)
    result = choose_manoeuvre(problem, fit, [before], options, design)
    assert result.separates == ("yaw_inertia", "steering_lag") and result.name in {m.name for m in CATALOGUE}
    assert result.strength == max(result.options.values()) >= MIN_SEPARATION and result.strength > before.strength
    more, refitted = fit_drives(leaf, ("weave", *[result.name] * result.repetitions), true, ("yaw_inertia",))
    more.loss.scale = problem.loss.scale
    after, = list_separabilities(more, refitted, answer, design)
    assert after.strength == pytest.approx(result.strength, rel=0.5)
    assert choose_manoeuvre(problem, fit, [], options, design) is None  # no alternative
    assert find_most_informative(problem, "friction", options) == "ramp_to_limit"
    strong = fit_drives(leaf, ("weave",), {"yaw_inertia": {"factor": 1.2}}, ("yaw_inertia",))
    separated = list_separabilities(*strong, answer, design)
    assert separated[0].strength > MIN_SEPARATION
    assert choose_manoeuvre(*strong, separated, options, design) is None  # already separated
