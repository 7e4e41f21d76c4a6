"""Every rule of the decision with the evidence that triggers it, and every limit with a decision that it changes."""

import ast
import importlib
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from discovery_drives import COLUMNS, Rows, fit_problem, linear_problem
from st_core.discovery import OUTCOMES, Limits, decision
from st_core.discovery.decision import (
    ACCEPTED,
    ALTERNATIVE,
    BOUND,
    EXPLAINS_LESS,
    FILE,
    FORCES,
    GAIN_INSIGNIFICANT,
    IMPLAUSIBLE,
    IRRELEVANT,
    MINOR,
    NAMED,
    NEGLIGIBLE,
    NULL,
    PARTITION_NAMES,
    SENSORS,
    VARIES,
    Rival,
    decide,
    judge,
    judge_alternative,
    judge_necessity,
    judge_reporting,
    varies_relevantly,
    varying_partition,
)
from st_core.discovery.discover import (
    _Analysis,
    complete_delay,
    describe_common_cause,
    find_parameter_across_bound,
    replace_interval,
)
from st_core.discovery.evidence import Agreement, Evidence
from st_core.discovery.result import Combination, FittedParameter, FoundEffect, Reason, unseparated_combinations
from st_core.discovery.space import FileQuantity
from st_core.errors import ConfigurationError

discover_module = importlib.import_module("st_core.discovery.discover")  # not the function of this name
LIMITS = Limits()
GOOD = Evidence("mass", gain=0.2, p_value=1e-4, position_reduction=0.5, position_reduction_in_condition=0.5)
AGREEING = Agreement({}, p_equal=0.5, p_absent=1e-6)
DISAGREEING = Agreement({}, p_equal=1e-4, p_absent=0.2)
NEGLIGIBLE_GAIN, INSIGNIFICANT = replace(GOOD, gain=0.005), replace(GOOD, p_value=0.02)
SMALL_EFFECT = replace(GOOD, gain=0.02, position_reduction=0.01, position_reduction_in_condition=0.015)
NULL_POSSIBLE = replace(GOOD, null_p_value=0.2)
SENSORS_DISAGREE, AT_BOUND = replace(GOOD, sensors_p_value=0.01), replace(GOOD, bound_distance=0.0)
NO_POSITION_GAIN = replace(GOOD, position_reduction=0.01, position_reduction_in_condition=0.0)
MASS = FileQuantity("mass", "kg", 1600.0, 40.0, slope=1600.0, stated=True, without_effect=1600.0)
FILE_DISAGREES = replace(GOOD, file_comparison=(MASS, 0.25))
VARYING = replace(GOOD, agreement={"run": AGREEING, "place": DISAGREEING})
EQUAL_RIVAL = Rival("rear_stiffness", "mass", gain_ratio=0.9, p_no_worse=0.4, deficit=0.02,
              evidence=replace(GOOD, name="rear_stiffness"))
LOW_GAIN = replace(GOOD, gain=0.1)
SENSOR = Evidence("yaw_rate_scale", gain=0.0, p_value=1.0, sensors_p_value=0.6, sensors_null_p_value=0.001)
CONFIRMED = replace(GOOD, sensors_p_value=0.6, sensors_null_p_value=0.001)
SMALL_GAIN = replace(GOOD, gain=0.02, p_value=1e-4)
WORSE_RIVAL = replace(EQUAL_RIVAL, p_no_worse=0.01)
CLOSE_RIVAL = replace(WORSE_RIVAL, evidence=replace(WORSE_RIVAL.evidence, noise_ratio=5.0))
NOTHING = {"named": [], "rivals": {}, "rejected": [], "noise_ratio": 1.0, "detectable_share": 0.9}


@pytest.mark.parametrize(("evidence", "rule", "figures"), [
    (GOOD, ACCEPTED, {"gain": 0.2, "p_value": 1e-4, "position": 0.5}),
    (NEGLIGIBLE_GAIN, NEGLIGIBLE, {"gain": 0.005, "negligible": 0.01}),
    (INSIGNIFICANT, GAIN_INSIGNIFICANT, {"p_value": 0.02, "false_alarm": 0.01}),
    (replace(GOOD, gain_between_runs=0.3), GAIN_INSIGNIFICANT, {"gain": 0.2, "gain_between_runs": 0.3}),
    (replace(GOOD, gain_between_runs=0.1), ACCEPTED, {}),
    (NULL_POSSIBLE, NULL, {"null_p_value": 0.2, "undecided_p": 0.05}),
    (SMALL_EFFECT, IRRELEVANT, {"gain": 0.02, "position": 0.015}),
    (replace(SMALL_EFFECT, gain=0.03), ACCEPTED, {}),
    (replace(SMALL_EFFECT, position_reduction=0.03), ACCEPTED, {}),
    (replace(SMALL_EFFECT, position_reduction_in_condition=0.03), ACCEPTED, {}),
    (replace(SENSOR, gain=0.0, p_value=0.5, null_p_value=0.5, size=0.6), ACCEPTED,
     {}),  # a sensor error, however small its effect on the prediction
    (replace(SENSOR, gain=0.0, p_value=0.5, size=0.4), IRRELEVANT, {"share": 0.0, "position": 0.0}),
    (replace(SENSOR, gain=0.0, reductions={"yaw_rate": (0.05, 3.0)}), ACCEPTED, {}),
    (replace(SENSOR, gain=0.0, size=0.6, sensors_p_value=0.01), NEGLIGIBLE, {}),  # the sensors disagree
    (replace(SENSOR, gain=0.0, size=0.6, sensors_null_p_value=0.02), NEGLIGIBLE,
     {}),  # zero agrees with the sensors too
    (SENSORS_DISAGREE, SENSORS, {"sensors_p_value": 0.01, "undecided_p": 0.05}),
    (replace(GOOD, sensors_p_value=0.3), ACCEPTED, {}),
    (FILE_DISAGREES, FILE, {"z_score": 10.0, "max_file_deviation": 3.0}),
    (replace(GOOD, file_comparison=(MASS, 0.0725)), ACCEPTED, {}),
    (AT_BOUND, BOUND, {"bound_distance": 0.0, "at_bound": LIMITS.at_bound}),
    (VARYING, VARIES, {"p_equal": 1e-4, "p_absent": 0.2}),
    (replace(GOOD, agreement={"run": Agreement({}, 1e-4, 0.01)}), ACCEPTED, {}),  # differs, but present everywhere
    (replace(GOOD, agreement={"run": Agreement({}, 0.3, 0.4)}), ACCEPTED, {}),  # no significant difference
])
def test_verdict_of_one_effect(evidence, rule, figures):
    verdict = judge(evidence, LIMITS)
    assert (verdict.rule, verdict.subject) == (rule, evidence.name)
    assert {k: verdict.figures[k] for k in figures} == figures
    assert verdict.text


def test_combination_that_differs_from_the_file_makes_the_outcome_ambiguous():
    outcome, why = decide(LIMITS, **(NOTHING | dict(combinations=["front cornering stiffness over axle load"])))
    assert outcome == "ambiguous"
    assert "front cornering stiffness over axle load: different from the vehicle file" in why.text


@pytest.mark.parametrize(("file", "differs"), [(44.0, True), (38.0, False), (39.0, True), (33.0, False)])
def test_combination_differs_if_the_file_is_outside_its_99_percent_interval(file, differs):
    assert Combination("C/m", "1/rad", 35.0, (32.0, 38.0), file, ("mass",)).differs is differs


def test_total_delay_is_reported_unless_one_of_its_effects_is_named():
    stiffness = Combination("front cornering stiffness over axle load", "1/rad", 35.0, (34.0, 36.0), 40.0, ("mass",))
    gain = Combination("steady-state yaw gain at 20 m/s", "1/s", 0.3, (0.29, 0.31), 0.35, ("mass",))
    delay = Combination("total delay of the steering", "s", -0.06, (-0.07, -0.05), 0.0, ("steering_lag",))
    named = FoundEffect("steering_lag", "physics", {}, (), 0.0, {})
    assert unseparated_combinations((stiffness, gain, delay), ()) == (stiffness, delay)
    assert unseparated_combinations((gain, replace(delay, interval=(-0.15, 0.03))), ()) == (gain,)
    assert unseparated_combinations((delay,), (named,)) == ()
    stiffness = replace(stiffness, effects=("front_stiffness", "load"))
    assert unseparated_combinations((stiffness,), (replace(named, name="tyre_stiffness"),)) == ()  # by its member


def test_total_delay_of_one_effect_has_the_interval_and_alternatives_of_that_effect():
    delay = Combination("total delay of the steering", "s", 0.02, (0.01, 0.06), 0.0, ("steering_delay", "steering_lag"))
    wide = {"time": FittedParameter(0.02, "s", (-0.07, 0.05), 0.0)}
    one = FoundEffect("steering_delay", "physics", wide, ("steering_lag", "tyre_relaxation"), 0.0, {})
    found = complete_delay(delay, (one,))
    assert found.interval == (-0.07, 0.06) and not found.differs
    assert found.effects == ("steering_delay", "steering_lag", "tyre_relaxation")
    other = replace(one, name="steering_lag", alternatives=())  # their errors cancel in the sum
    assert complete_delay(delay, (one, other)).interval == delay.interval
    stiffness = Combination("front cornering stiffness over axle load", "1/rad", 35.0, (34.0, 36.0), 40.0, ("mass",))
    assert complete_delay(stiffness, (replace(one, name="mass"),)) == stiffness  # yaw inertia does not change it


@pytest.mark.parametrize(("interval", "crossed"), [((0.28, 0.72), "factor"), ((0.55, 0.9), ""), ((1.7, 6.0), "")])
def test_load_sensitivity_is_not_named_across_its_physical_bound(interval, crossed):
    """As of a saloon without lateral velocity; at the upper bound, stiffness is proportional to load."""
    fitted = {"factor": FittedParameter(sum(interval) / 2.0, "1", interval, 1.0)}
    effect = FoundEffect("tyre_load_sensitivity", "vehicle parameters", fitted, (), 0.1, {})
    assert find_parameter_across_bound(effect) == crossed


def test_first_failed_rule_is_the_verdict():
    """An effect that fails every rule is corrected rule by rule."""
    worst = Evidence("mass", gain=0.005, p_value=0.5, null_p_value=0.5, sensors_p_value=0.001, bound_distance=0.0,
                     agreement={"run": DISAGREEING})
    corrections = ({"gain": 0.02}, {"p_value": 1e-4}, {"null_p_value": 0.0}, {"position_reduction": 1.0},
                   {"sensors_p_value": None}, {"bound_distance": 1.0}, {"agreement": {}})
    rules = []
    for correction in corrections:
        rules.append(judge(worst, LIMITS).rule)
        worst = replace(worst, **correction)
    assert rules == [NEGLIGIBLE, GAIN_INSIGNIFICANT, NULL, IRRELEVANT, SENSORS, BOUND, VARIES]
    assert judge(worst, LIMITS).rule == ACCEPTED


@pytest.mark.parametrize(("evidence", "rule", "figures"), [
    (replace(NO_POSITION_GAIN, reductions={"yaw": (0.1, 5.0)}), NAMED, {"share": 0.1}),
    (replace(NO_POSITION_GAIN, reductions={"yaw": (0.01, 5.0), "yaw_rate": (0.2, 9.0)}), NAMED, {"share": 0.2}),
    (replace(NO_POSITION_GAIN, reductions={"yaw": (0.1, 1.5)}), MINOR, {"share": 0.0}),  # the channel is mostly noise
    (replace(NO_POSITION_GAIN, reductions={"yaw": (0.01, 5.0)}), MINOR, {"share": 0.01, "position": 0.01}),
    (replace(NO_POSITION_GAIN, position_reduction=0.03), NAMED, {"position": 0.03}),
    (replace(NO_POSITION_GAIN, position_reduction_in_condition=0.03), NAMED, {"position": 0.03}),
    (NO_POSITION_GAIN, MINOR, {"share": 0.0}),
    (LOW_GAIN, NAMED, {"position": 0.5}),
    (replace(LOW_GAIN, noise_ratio=5.0), MINOR, {"gain": 0.1, "noise_ratio": 5.0}),  # more remains unexplained
    (replace(GOOD, gain=0.3, noise_ratio=5.0), NAMED, {}),
    (replace(LOW_GAIN, noise_ratio=5.0, sensors_p_value=0.6, sensors_null_p_value=0.3), MINOR, {}),
    (replace(LOW_GAIN, noise_ratio=5.0, sensors_p_value=0.6, sensors_null_p_value=0.001), NAMED,
     {}),  # confirmed by the sensors
])
def test_accepted_effect_is_named_or_minor(evidence, rule, figures):
    verdict = judge_reporting(evidence, LIMITS)
    assert verdict.rule == rule and verdict.subject == "mass" and verdict.text
    assert {k: verdict.figures[k] for k in figures} == figures


@pytest.mark.parametrize(("evidence", "checks", "rule"), [
    (GOOD, {}, NAMED), (GOOD, dict(excludes_null=False), MINOR),
    (CONFIRMED, dict(excludes_null=False), NAMED),
    (GOOD, dict(parameter_at_bound="factor"), MINOR), (GOOD, dict(peak_force_ratio=0.5), MINOR),
    (GOOD, dict(worse_axle="rear"), FORCES), (GOOD, dict(summands=("steering_lag",)), MINOR),
    (GOOD, dict(depends_on=("front_stiffness",)), MINOR),
    (CONFIRMED, dict(violation="yaw_inertia: dynamic index k^2 / (l_f l_r) 0.5 is outside 0.6 to 1.4"), IMPLAUSIBLE),
    (replace(GOOD, position_reduction=-0.03), {}, MINOR),  # adding it raises the held-out position error
    (replace(CONFIRMED, position_reduction=-0.03), {}, NAMED)])  # but the sensors confirm it
def test_intervals_and_axle_forces_decide_the_naming(evidence, checks, rule):
    verdict = judge_reporting(evidence, LIMITS, **checks)
    assert verdict.rule == rule and verdict.text


@pytest.mark.parametrize(("agreement", "partition"), [
    ({}, ""),
    ({"run": AGREEING, "site": AGREEING}, ""),
    ({"run": AGREEING, "site": DISAGREEING}, "site"),
    ({"run": DISAGREEING, "time": Agreement({}, 1e-4, 0.4), "site": AGREEING}, "time"),  # the largest p_absent
    ({"run": Agreement({}, 0.02, 0.4)}, ""),
    ({"run": Agreement({}, 1e-4, 0.04)}, ""),
])
def test_partition_across_which_an_effect_varies(agreement, partition):
    assert varying_partition(replace(GOOD, agreement=agreement), LIMITS) == partition


@pytest.mark.parametrize(("gain", "p_value", "between", "relevant"), [
    (0.2, 1e-4, 0.0, True), (0.2, 0.02, 0.0, False), (0.02, 1e-4, 0.0, False), (0.2, 1e-4, 0.3, False)])
def test_varying_effect_is_relevant_by_its_gain(gain, p_value, between, relevant):
    assert varies_relevantly(replace(GOOD, gain=gain, p_value=p_value, gain_between_runs=between), LIMITS) == relevant


def test_varying_effect_without_effect_on_the_position_is_not_relevant():
    assert not varies_relevantly(replace(GOOD, position_reduction=0.01, position_reduction_in_condition=0.01), LIMITS)
    small = replace(AT_BOUND, position_reduction=0.01, position_reduction_in_condition=0.01)
    assert decide(LIMITS, **(NOTHING | dict(rejected=[small])))[0] == "none"


@pytest.mark.parametrize(("interval", "known", "expected"), [
    ((-1.0, 9.0), (3.5, 3.0, 5.0), (3.0, 5.0)),  # the sensors exclude the null
    ((-1.0, 9.0), (2.5, 2.0, 3.5), (2.0, 6.0)),  # also if the fitted value is outside their interval
    ((-1.0, 4.5), (3.5, 3.0, 5.0), (3.0, 5.0)),  # also if their interval exceeds the fitted one
    ((1.0, 7.0), (3.5, 3.0, 5.0), (1.0, 7.0)),  # already excluded
    ((-1.0, 9.0), (1.0, -1.0, 5.0), (-1.0, 9.0)),  # not excluded by the sensors
    ((-1.0, 9.0), (9.0, 8.0, 10.0), (-1.0, 9.0)),  # the sensors disagree
    ((-1.0, 9.0), None, (-1.0, 9.0)),
])
def test_interval_is_that_of_the_sensors_if_only_they_exclude_the_null(interval, known, expected):
    assert replace_interval(FittedParameter(4.0, "rad/s", interval, 0.0), known).interval == expected


def test_verdict_of_a_varying_effect_names_the_partition():
    for partition, name in PARTITION_NAMES.items():
        assert name in judge(replace(GOOD, agreement={partition: DISAGREEING}), LIMITS).text


@pytest.mark.parametrize(("rival", "rule"), [
    (EQUAL_RIVAL, ALTERNATIVE),
    (replace(EQUAL_RIVAL, gain_ratio=0.4), EXPLAINS_LESS),
    (replace(EQUAL_RIVAL, added=0.3), ALTERNATIVE),
    (replace(EQUAL_RIVAL, added=0.5), EXPLAINS_LESS),  # explains other errors: most of its gain is in addition
    (WORSE_RIVAL, EXPLAINS_LESS),
    (CLOSE_RIVAL, ALTERNATIVE),  # worse by less than what no effect explains
    (replace(CLOSE_RIVAL, deficit=0.3), EXPLAINS_LESS),
    (replace(EQUAL_RIVAL, evidence=SMALL_EFFECT), ALTERNATIVE),  # relevance is required of the named effect only
    (replace(EQUAL_RIVAL, evidence=NEGLIGIBLE_GAIN), NEGLIGIBLE),
    (replace(EQUAL_RIVAL, evidence=INSIGNIFICANT), GAIN_INSIGNIFICANT),
    (replace(EQUAL_RIVAL, evidence=NULL_POSSIBLE), NULL),
    (replace(EQUAL_RIVAL, evidence=NULL_POSSIBLE, with_effect=True), ALTERNATIVE),  # the drives do not exclude it
    (replace(WORSE_RIVAL, evidence=NULL_POSSIBLE, with_effect=True), EXPLAINS_LESS),
    (replace(EQUAL_RIVAL, evidence=SENSORS_DISAGREE), SENSORS),
    (replace(EQUAL_RIVAL, evidence=AT_BOUND), BOUND),
    (replace(EQUAL_RIVAL, evidence=VARYING), VARIES),
    (replace(EQUAL_RIVAL, gain_ratio=0.4, evidence=AT_BOUND), EXPLAINS_LESS),  # the first rule
])
def test_rival_is_an_alternative_or_rejected_by_a_rule(rival, rule):
    assert judge_alternative(rival, LIMITS).rule == rule


@pytest.mark.parametrize(("rival", "established"), [
    (EQUAL_RIVAL, False), (WORSE_RIVAL, True), (CLOSE_RIVAL, False), (replace(CLOSE_RIVAL, deficit=0.3), True)])
def test_effect_is_established_only_if_the_best_model_without_it_explains_less(rival, established):
    for name, instead in (("rear_stiffness and mass", ", with rear stiffness and mass instead,"), ("", "")):
        verdict = judge_necessity(replace(rival, name=name, replaces="roll_steer"), LIMITS)
        assert (verdict is None) == established
        if verdict:
            assert (verdict.rule, verdict.subject) == (MINOR, "roll_steer")
            assert f"the best model without it{instead} changes the errors by only +" in verdict.text


def test_text_of_an_alternative_names_the_effect_it_replaces():
    for rival in (replace(EQUAL_RIVAL, replaces="tyre_stiffness"), replace(WORSE_RIVAL, replaces="tyre_stiffness")):
        text = judge_alternative(rival, LIMITS).text
        assert "in place of tyre stiffness it achieves 90 % of that effect's error reduction" in text


@pytest.mark.parametrize(("answer", "outcome", "figures"), [
    (NOTHING | dict(named=[GOOD, replace(GOOD, name="friction")], rivals={"mass": [EQUAL_RIVAL]}), "several",
     {"effects": 2}),
    (NOTHING | dict(named=[GOOD]), "named", {}),
    (NOTHING | dict(named=[GOOD], rivals={"mass": [replace(EQUAL_RIVAL, gain_ratio=0.1)]}), "named", {}),
    (NOTHING | dict(named=[GOOD], rivals={"friction": [EQUAL_RIVAL]}), "named", {}),  # a rival of another effect
    (NOTHING | dict(named=[GOOD], rivals={"mass": [EQUAL_RIVAL]}), "ambiguous", {"names": 2}),
    (NOTHING | dict(named=[GOOD], rejected=[VARYING], noise_ratio=9.0, detectable_share=0.1), "named", {}),
    (NOTHING | dict(rejected=[AT_BOUND, VARYING], noise_ratio=9.0, detectable_share=0.1), "varying", {}),
    (NOTHING | dict(rejected=[AT_BOUND], n_varying=1, noise_ratio=9.0, detectable_share=0.1), "varying", {}),
    (NOTHING | dict(named=[GOOD], n_varying=1), "named", {}),
    (NOTHING | dict(rejected=[AT_BOUND], detectable_share=0.1), "unknown", {}),
    (NOTHING | dict(rejected=[SENSORS_DISAGREE], detectable_share=0.1), "unknown", {}),
    (NOTHING | dict(rejected=[NEGLIGIBLE_GAIN, INSIGNIFICANT, SMALL_EFFECT]), "none", {"noise_ratio": 1.0}),
    (NOTHING | dict(detectable_share=0.7), "not_testable", {"detectable_share": 0.7, "detection_power": 0.8}),
    (NOTHING | dict(detectable_share=0.7, noise_ratio=9.0), "unknown",
     {"noise_ratio": 9.0}),  # an unexplained residual takes precedence
    (NOTHING | dict(noise_ratio=2.5), "unknown", {"noise_ratio": 2.5, "max_noise_ratio": 2.0}),
    (NOTHING, "none", {"noise_ratio": 1.0, "max_noise_ratio": 2.0}),
    (NOTHING | dict(n_effects=3, base_noise_ratio=15.0, detectable_share=0.7), "ambiguous",
     {"effects": 3, "base_noise_ratio": 15.0, "max_noise_ratio": 2.0}),
    (NOTHING | dict(n_effects=3, base_noise_ratio=15.0, noise_ratio=2.5), "unknown", {"noise_ratio": 2.5}),
    (NOTHING | dict(n_effects=3, base_noise_ratio=1.9), "none", {}),
    (NOTHING | dict(base_noise_ratio=15.0), "none", {}),  # nothing reduces it significantly
])
def test_outcome_of_a_search_result(answer, outcome, figures):
    decided, why = decide(LIMITS, **answer)
    assert decided == outcome and decided in OUTCOMES
    assert (why.rule, why.subject) == (outcome, "outcome")
    assert {k: why.figures[k] for k in figures} == figures


def judge_low_peak_force(evidence, limits):
    return judge_reporting(evidence, limits, peak_force_ratio=0.5)


def decide_outcome(result, limits):
    return decide(limits, **result)[1]


LIMIT_CASES = [
    ("false_alarm", 1.0, judge, INSIGNIFICANT, GAIN_INSIGNIFICANT, ACCEPTED),
    ("false_alarm", 1e-9, judge, replace(VARYING, p_value=0.0), VARIES, ACCEPTED),
    ("false_alarm", 1.0, varies_relevantly, INSIGNIFICANT, False, True),
    ("undecided_p", 1e-9, judge, SENSORS_DISAGREE, SENSORS, ACCEPTED),
    ("undecided_p", 0.9, judge, VARYING, VARIES, ACCEPTED),
    ("undecided_p", 0.9, judge, NULL_POSSIBLE, NULL, ACCEPTED),
    ("undecided_p", 1e-9, judge_alternative, WORSE_RIVAL, EXPLAINS_LESS, ALTERNATIVE),
    ("undecided_p", 1e-9, judge_reporting, replace(CONFIRMED, gain=0.1, noise_ratio=5.0, sensors_p_value=0.01), MINOR,
     NAMED),
    ("relevant", 1e-9, judge, SMALL_EFFECT, IRRELEVANT, ACCEPTED),
    ("relevant", 1e-9, judge_reporting, replace(NO_POSITION_GAIN, reductions={"yaw": (0.01, 5.0)}), MINOR, NAMED),
    ("relevant", 1e-9, varies_relevantly, SMALL_GAIN, False, True),
    ("relevant_position", 1e-9, judge, SMALL_EFFECT, IRRELEVANT, ACCEPTED),
    ("relevant_position", 1e-9, judge_reporting, NO_POSITION_GAIN, MINOR, NAMED),
    ("min_relative_size", 1e-9, judge, replace(SENSOR, size=0.4), IRRELEVANT, ACCEPTED),
    ("negligible", 1e-9, judge, NEGLIGIBLE_GAIN, NEGLIGIBLE, ACCEPTED),
    ("min_rival_gain", 1e-9, judge_alternative, replace(EQUAL_RIVAL, gain_ratio=0.4), EXPLAINS_LESS, ALTERNATIVE),
    ("min_peak_force", 1e-9, judge_low_peak_force, GOOD, MINOR, NAMED),
    ("max_file_deviation", 1e9, judge, FILE_DISAGREES, FILE, ACCEPTED),
    ("at_bound", 1e-9, judge, replace(AT_BOUND, bound_distance=0.001), BOUND, ACCEPTED),
    ("unexplained_share", 1e-9, judge_alternative, CLOSE_RIVAL, ALTERNATIVE, EXPLAINS_LESS),
    ("unexplained_share", 1e-9, judge_reporting, replace(LOW_GAIN, noise_ratio=5.0), MINOR, NAMED),
    ("max_noise_ratio", 1e9, decide_outcome, NOTHING | dict(noise_ratio=9.0), "unknown", "none"),
    ("max_noise_ratio", 1e9, judge_reporting, replace(LOW_GAIN, noise_ratio=5.0), MINOR, NAMED),
    ("max_noise_ratio", 1e9, judge_reporting, replace(NO_POSITION_GAIN, reductions={"yaw": (0.1, 5.0)}), NAMED, MINOR),
    ("max_noise_ratio", 1e9, judge_alternative, CLOSE_RIVAL, ALTERNATIVE, EXPLAINS_LESS),
    ("detection_power", 1e-9, decide_outcome, NOTHING | dict(detectable_share=0.1), "not_testable", "none"),
]
"""(limit, its inactive value, decision, subject, answer with the default limits, answer with the inactive limit)."""
TESTED_ELSEWHERE = {"max_effects"}
"""Limits of the search itself: test_discovery.py."""


def test_every_limit_has_a_case():
    assert {field.name for field in fields(Limits)} == {case[0] for case in LIMIT_CASES} | TESTED_ELSEWHERE


@pytest.mark.parametrize(("limit", "inactive", "decision_on", "subject", "default", "without"), LIMIT_CASES)
def test_limit_changes_the_decision(limit, inactive, decision_on, subject, default, without):
    for limits, expected in ((LIMITS, default), (replace(LIMITS, **{limit: inactive}), without)):
        decided = decision_on(subject, limits)
        assert getattr(decided, "rule", decided) == expected


def test_limits_are_few_and_positive():
    assert len(fields(Limits)) <= 15
    for field in fields(Limits):
        with pytest.raises(ConfigurationError, match=f"limit {field.name}"):
            Limits(**{field.name: 0.0})


def test_decision_imports_neither_numerical_libraries_nor_the_search():
    imported = set()
    for node in ast.walk(ast.parse(Path(decision.__file__).read_text())):
        if isinstance(node, ast.Import):
            imported |= {name.name for name in node.names}
        elif isinstance(node, ast.ImportFrom):
            imported.add("." * node.level + (node.module or ""))
    assert imported == {"collections.abc", "dataclasses", "..channels", ".evidence", ".settings", ".result"}


def test_limits_are_used_in_few_modules():
    """`decision` decides on every report; the search orders and skips candidates by limits, the power analysis applies
    them to simulated drives, and `discover` to the detectability."""
    folder = Path(decision.__file__).parent
    names = {f.name for f in fields(Limits)}
    using = set()
    for file in folder.glob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Attribute) and node.attr in names and ast.unparse(node.value).endswith("limits"):
                using.add(file.name)
    assert using == {"decision.py", "search.py", "power_analysis.py", "discover.py"}


@pytest.mark.parametrize("reference", [[], ["healthy"]])
@pytest.mark.parametrize(("interval", "rule"), [((1.02, 1.10), NAMED), ((0.98, 1.14), MINOR)])
def test_only_an_effect_with_an_interval_that_excludes_its_null_is_named(reference, interval, rule):
    assert decide_without_axle_forces("mass", reference, interval).rule == rule


def decide_without_axle_forces(name: str, reference: list[str], interval: tuple[float, float]) -> Reason:
    e = Evidence(name, 0.3, 0.001, position_reduction=0.1)
    found = FoundEffect(name, "vehicle parameters", {"factor": FittedParameter(1.06, "1", interval, 1.0)}, (), 0.1, {})
    analysis = SimpleNamespace(reference=reference, limits=LIMITS)
    return _Analysis._decide_reporting(analysis, SimpleNamespace(evidence={name: e}), [found], None, {})[name]


@pytest.mark.parametrize("name", ["friction", "rear_tyre_curve"])
def test_peak_is_not_named_if_the_axle_forces_are_unknown(name):
    """Without a reference; with one, the value is a change of a peak that the healthy car had as well."""
    verdict = decide_without_axle_forces(name, [], (1.02, 1.10))
    assert verdict.rule == MINOR and verdict.text.startswith("the axle forces, and so their peaks, are unknown")
    assert decide_without_axle_forces(name, ["healthy"], (1.02, 1.10)).rule == NAMED


@pytest.mark.parametrize(("answer", "outcome"), [
    ({}, "none"), ({"n_effects": 2}, "ambiguous"), ({"detectable_share": 0.7}, "not_testable"),
    ({"rejected": [AT_BOUND]}, "unknown")])
def test_outcome_without_positions_does_not_state_a_position_error(answer, outcome):
    decided, why = decide(LIMITS, **(NOTHING | answer | dict(noise_ratio=np.nan, base_noise_ratio=np.nan)))
    assert decided == outcome and "position error" not in why.text and "nan" not in why.text


@pytest.mark.parametrize(("name", "rule"), [
    ("front_tyre_curve", MINOR), ("rear_tyre_curve", NAMED), ("friction", NAMED), ("mass", NAMED)])
def test_peak_of_an_axle_that_did_not_reach_it_is_not_named(monkeypatch, name, rule):
    """The front axle was driven to 70 % of its peak force, the rear axle to 99 %."""
    monkeypatch.setattr(discover_module, "find_implausible_values", lambda *_: ())
    car = SimpleNamespace(with_values=lambda _: car, effective_vehicle=lambda _: None)
    space = SimpleNamespace(at=lambda _: car, null=None, values=lambda *_: {})
    axles = SimpleNamespace(compute_force_ratios=lambda: {"front": 0.7, "rear": 0.99}, find_worse_axles=lambda *_: (),
                            car=None)
    analysis = SimpleNamespace(reference=[], limits=LIMITS, space=space, vehicle=None,
                               problem=SimpleNamespace(start=None))
    found = FoundEffect(name, "vehicle parameters", {"peak": FittedParameter(0.7, "1", (0.6, 0.8), 1.0)}, (), 0.1, {})
    state = SimpleNamespace(evidence={name: GOOD}, fit=SimpleNamespace(vector=None))
    assert _Analysis._decide_reporting(analysis, state, [found], axles, {})[name].rule == rule


@pytest.mark.parametrize(("similarity", "rule"), [(0.0, NAMED), (0.9, MINOR)])
def test_effect_that_compensates_for_a_refuted_one_is_not_named(monkeypatch, similarity, rule):
    """As of a car with downforce, where stiffer tyres, refuted by the axle forces, changed the INS position."""
    monkeypatch.setattr(discover_module, "find_implausible_values", lambda *_: ())
    problem = linear_problem(("mass", "front_stiffness"), {"mass": 2.0, "front_stiffness": -2.0}, 3)
    mass, stiffness = problem.space.indices("mass", "front_stiffness")[::-1]
    problem.errors.signatures[mass] += similarity * problem.errors.signatures[stiffness]
    fit = fit_problem(problem, "mass", "front_stiffness")
    names = [problem.space.effect_names[i] for i in (mass, stiffness)]
    found = [FoundEffect(n, "vehicle parameters", {"factor": FittedParameter(
        value := float(fit.vector[i]), "1", (value - 0.05, value + 0.05), 1.0)}, (), 0.1, {})
        for n, i in zip(names, (mass, stiffness), strict=True)]
    axles = SimpleNamespace(compute_force_ratios=lambda: {}, find_worse_axles=lambda *_: ("front",),
                            find_effects_on_axle=lambda *_: ["front_stiffness"], car=None)
    analysis = SimpleNamespace(reference=[], limits=LIMITS, space=SimpleNamespace(
        at=lambda _: SimpleNamespace(with_values=lambda _: SimpleNamespace(effective_vehicle=lambda _: None)),
        null=None, values=problem.space.values), vehicle=None, problem=problem)
    analysis._find_dependent = lambda *inputs: _Analysis._find_dependent(analysis, *inputs)
    state = SimpleNamespace(evidence={n: replace(GOOD, name=n) for n in names}, fit=fit)
    verdicts = _Analysis._decide_reporting(analysis, state, found, axles, {})
    assert verdicts["front_stiffness"].rule == FORCES and verdicts["mass"].rule == rule
    assert ("in a model without front stiffness" in verdicts["mass"].text) == (rule == MINOR)


@pytest.mark.parametrize(("rule", "count"), [(FORCES, 1), (IMPLAUSIBLE, 1), (MINOR, 2)])
def test_combination_changed_by_a_refuted_effect_is_not_stated(monkeypatch, rule, count):
    """As of a bus whose tyre stiffness, correct in its file, was refuted as implausible, but stated over the mass."""
    delay = Combination("total delay of the steering", "s", 0.06, (0.05, 0.07), 0.0, ("steering_delay",))
    stiffness = replace(delay, name="front cornering stiffness over axle load", effects=("front_stiffness", "mass"))
    judged = judge_tyre_stiffness(monkeypatch, Reason(rule, "tyre_stiffness", {}, ""), (delay, stiffness))
    assert judged.combinations == (delay, stiffness)[:count]


@pytest.mark.parametrize(("rival", "evidence", "named"), [
    (WORSE_RIVAL, GOOD, True), (EQUAL_RIVAL, GOOD, False), (EQUAL_RIVAL, CONFIRMED, True)])
def test_effect_that_the_best_other_model_does_not_need_is_named_only_if_sensors_confirm_it(
        monkeypatch, rival, evidence, named):
    judged = judge_tyre_stiffness(monkeypatch, Reason(NAMED, "tyre_stiffness", {}, ""), (), rival, evidence)
    assert (len(judged.named), len(judged.minor)) == (named, not named)


def judge_tyre_stiffness(monkeypatch, verdict, combinations, rival=WORSE_RIVAL, evidence=GOOD):
    """Result for a fit with only tyre_stiffness, with this verdict before the search without it finds `rival`."""
    monkeypatch.setattr(discover_module.waterfall, "estimate_parameters", lambda *_: {})
    monkeypatch.setattr(discover_module.waterfall, "leave_one_out", lambda *_: {})
    problem = SimpleNamespace(prior=(), held_out_residuals=lambda _: None, position_error=lambda _: np.array([np.nan]))
    analysis = SimpleNamespace(
        problem=problem, vehicle=SimpleNamespace(wheelbase=2.7), reference=[], sensors={}, limits=LIMITS,
        _analyse_axles=lambda *_: (None, (), combinations), _decide_reporting=lambda *_: {"tyre_stiffness": verdict})
    state = SimpleNamespace(order=["tyre_stiffness"], evidence={"tyre_stiffness": evidence}, rivals={}, fit=None,
                            near_optimal=[])
    search = SimpleNamespace(find_cancelling_effects=lambda *_: (), find_best_rival=lambda *_: rival)
    return _Analysis._judge_effects(analysis, search, state, {}, {"position_5s": 0.1})


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_correction_of_drives_without_positions_has_no_position_error():
    """The increase was NaN, which JSON does not know."""
    problem = linear_problem(("mass", "yaw_inertia"), {"mass": 1.0}, 3)
    problem.loss.known = problem.loss.known & ~np.tile([c.startswith("position") for c in COLUMNS], len(Rows.time))
    without, fit = (fit_problem(problem, *names) for names in ((), ("mass",)))
    correction, = _Analysis._list_corrections(None, problem, fit, SimpleNamespace(fit=without))
    assert correction.name == "mass" and correction.position_5s_increase == 0.0


@pytest.mark.parametrize(("factor", "x", "names", "found"), [
    (0.95, -0.13, ("steering_ratio", "sensor_lever_arm"), True),  # rear wheels steered by -0.053: x = 2.7 m (f - 1)
    (1.05, 0.15, ("steering_ratio", "sensor_lever_arm"), True),
    (0.95, 0.13, ("steering_ratio", "sensor_lever_arm"), False),  # of opposite sign
    (0.95, -0.45, ("steering_ratio", "sensor_lever_arm"), False),  # too far for this ratio
    (0.99, -0.03, ("steering_ratio", "sensor_lever_arm"), False),  # both intervals include the file's values
    (0.95, -0.13, ("steering_ratio",), False),
])
def test_ratio_and_ins_position_of_one_cause(factor, x, names, found):
    parameters = {"steering_ratio": {"factor": FittedParameter(factor, "1", (factor - 0.02, factor + 0.02), 1.0)},
                  "sensor_lever_arm": {"x": FittedParameter(x, "m", (x - 0.05, x + 0.05), 0.0),
                                       "y": FittedParameter(0.0, "m", (-0.1, 0.1), 0.0)}}
    effects = [FoundEffect(name, "sensors", parameters[name], (), 0.0, {}) for name in names]
    text = describe_common_cause(effects, 2.7)
    assert bool(text) == found
    if found:
        assert (f"steer by {1.0 - 1.0 / factor:+.3f} times the front angle, or a wheelbase of {2.7 * factor:.2f} m"
                in text)
