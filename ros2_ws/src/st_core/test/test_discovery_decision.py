"""Every rule of the decision as a line: figures, the rule that answers. And every limit with a line it turns."""

import ast
from dataclasses import fields, replace
from pathlib import Path

import pytest
from st_core.discovery import OUTCOMES, Limits, decision
from st_core.discovery.decision import (
    ACCEPTED,
    BOUND,
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
    NamingChecks,
    Rival,
    SearchResult,
    decide,
    judge,
    judge_alternative,
    judge_naming,
    varies_relevantly,
    varying_partition,
)
from st_core.discovery.discover import complete_delay, replace_interval
from st_core.discovery.evidence import Agreement, Evidence, FileComparison
from st_core.discovery.result import Combination, FittedParameter, FoundEffect, unseparated_combinations
from st_core.errors import ConfigurationError

LIMITS = Limits()
GOOD = Evidence("mass", gain=0.2, p_value=1e-4, position=0.5, position_in_condition=0.5)
SAME = Agreement({}, p_equal=0.5, p_absent=1e-6)
DIFFERENT = Agreement({}, p_equal=1e-4, p_absent=0.2)
SMALL, LUCKY = replace(GOOD, gain=0.005), replace(GOOD, p_value=0.02)
CHEAP = replace(GOOD, gain=0.02, position=0.01, position_in_condition=0.015)
MAYBE_NULL = replace(GOOD, null_p_value=0.2)
DENIED, EDGE = replace(GOOD, sensors_p_value=0.01), replace(GOOD, bound_distance=0.0)
SLIGHT = replace(GOOD, position=0.01, position_in_condition=0.0)
HEAVY = replace(GOOD, file_comparison=FileComparison("mass", "kg", 2000.0, 1580.0, 47.4, 8.9))
LOCAL = replace(GOOD, agreement={"run": SAME, "place": DIFFERENT})
EQUAL = Rival("rear_stiffness", "mass", share=0.9, p_no_worse=0.4, deficit=0.02,
              evidence=replace(GOOD, name="rear_stiffness"))
WEAK = replace(GOOD, gain=0.1)
SENSED = Evidence("yaw_rate_scale", gain=0.0, p_value=1.0, sensors_p_value=0.6, sensors_null_p_value=0.001)
CONFIRMED = replace(GOOD, sensors_p_value=0.6, sensors_null_p_value=0.001)
SMALL_GAIN = replace(GOOD, gain=0.02, p_value=1e-4)
WORSE = replace(EQUAL, p_no_worse=0.01)
AMONG = replace(WORSE, evidence=replace(WORSE.evidence, noise_ratio=5.0))
NOTHING = SearchResult([], {}, [], noise_ratio=1.0, detectable_share=0.9)


@pytest.mark.parametrize(("evidence", "rule", "figures"), [
    (GOOD, ACCEPTED, {"gain": 0.2, "p_value": 1e-4, "position": 0.5}),
    (SMALL, NEGLIGIBLE, {"gain": 0.005, "negligible": 0.01}),
    (LUCKY, GAIN_INSIGNIFICANT, {"p_value": 0.02, "false_alarm": 0.01}),
    (replace(GOOD, healthy_gain=0.3), GAIN_INSIGNIFICANT, {"gain": 0.2, "healthy_gain": 0.3}),
    (replace(GOOD, healthy_gain=0.1), ACCEPTED, {}),
    (MAYBE_NULL, NULL, {"null_p_value": 0.2, "undecided_p": 0.05}),
    (CHEAP, IRRELEVANT, {"gain": 0.02, "position": 0.015}),
    (replace(CHEAP, gain=0.03), ACCEPTED, {}),
    (replace(CHEAP, position=0.03), ACCEPTED, {}),
    (replace(CHEAP, position_in_condition=0.03), ACCEPTED, {}),
    (replace(SENSED, gain=0.0, p_value=0.5, null_p_value=0.5, size=0.6), ACCEPTED,
     {}),  # a sensor's error, however little it costs
    (replace(SENSED, gain=0.0, p_value=0.5, size=0.4), IRRELEVANT, {"share": 0.0, "position": 0.0}),
    (replace(SENSED, gain=0.0, shares={"yaw_rate": (0.05, 3.0)}), ACCEPTED, {}),
    (replace(SENSED, gain=0.0, size=0.6, sensors_p_value=0.01), NEGLIGIBLE, {}),  # the sensors have another value
    (replace(SENSED, gain=0.0, size=0.6, sensors_null_p_value=0.02), NEGLIGIBLE,
     {}),  # the sensors may mean nothing by it
    (DENIED, SENSORS, {"sensors_p_value": 0.01, "undecided_p": 0.05}),
    (replace(GOOD, sensors_p_value=0.3), ACCEPTED, {}),
    (HEAVY, FILE, {"z_score": 8.9, "max_file_deviation": 3.0}),
    (replace(GOOD, file_comparison=replace(HEAVY.file_comparison, z_score=2.9)), ACCEPTED, {}),
    (EDGE, BOUND, {"bound_distance": 0.0, "at_bound": LIMITS.at_bound}),
    (LOCAL, VARIES, {"p_equal": 1e-4, "p_absent": 0.2}),
    (replace(GOOD, agreement={"run": Agreement({}, 1e-4, 0.01)}), ACCEPTED, {}),  # differs, yet is everywhere
    (replace(GOOD, agreement={"run": Agreement({}, 0.3, 0.4)}), ACCEPTED, {}),  # absent may be, differs not surely
])
def test_verdict_on_one_effect(evidence, rule, figures):
    verdict = judge(evidence, LIMITS)
    assert (verdict.rule, verdict.subject) == (rule, evidence.name)
    assert {k: verdict.figures[k] for k in figures} == figures
    assert verdict.text


def test_a_combination_that_differs_is_no_single_effect():
    outcome, why = decide(replace(NOTHING, combinations=["front cornering stiffness over mass"]), LIMITS)
    assert outcome == "ambiguous" and "front cornering stiffness over mass: different from the vehicle file" in why.text


@pytest.mark.parametrize(("file", "differs"), [(44.0, True), (38.0, False), (39.0, True), (33.0, False)])
def test_a_combination_differs_outside_its_99_percent_interval(file, differs):
    assert Combination("C/m", "N/(rad kg)", 35.0, (32.0, 38.0), file, ("mass",)).differs is differs


def test_a_total_delay_is_reported_with_the_stiffness_unless_a_part_of_it_is_named():
    stiffness = Combination("front cornering stiffness over mass", "N/(rad kg)", 35.0, (34.0, 36.0), 40.0, ("mass",))
    gain = Combination("steady-state yaw gain at 20 m/s", "1/s", 0.3, (0.29, 0.31), 0.35, ("mass",))
    delay = Combination("total delay of the steering", "s", -0.06, (-0.07, -0.05), 0.0, ("steering_lag",))
    named = FoundEffect("steering_lag", "physics", {}, (), 0.0, {})
    assert unseparated_combinations((stiffness, gain, delay), ()) == (stiffness, delay)
    assert unseparated_combinations((gain, replace(delay, interval=(-0.15, 0.03))), ()) == (gain,)
    assert unseparated_combinations((delay,), (named,)) == ()


def test_a_delay_from_one_effect_is_as_uncertain_as_this_effect_and_has_its_alternatives():
    delay = Combination("total delay of the steering", "s", 0.02, (0.01, 0.06), 0.0, ("steering_delay", "steering_lag"))
    wide = {"time": FittedParameter(0.02, "s", (-0.07, 0.05), 0.0)}
    one = FoundEffect("steering_delay", "physics", wide, ("steering_lag", "tyre_relaxation"), 0.0, {})
    found = complete_delay(delay, (one,))
    assert found.interval == (-0.07, 0.06) and not found.differs
    assert found.effects == ("steering_delay", "steering_lag", "tyre_relaxation")
    other = replace(one, name="steering_lag", alternatives=())  # what one loses, the other gains: the sum is certain
    assert complete_delay(delay, (one, other)).interval == delay.interval
    stiffness = Combination("front cornering stiffness over mass", "N/(rad kg)", 35.0, (34.0, 36.0), 40.0, ("mass",))
    assert complete_delay(stiffness, (replace(one, name="mass"),)) == stiffness  # yaw inertia does not change it


def test_rules_are_asked_in_their_order():
    """Of an effect that fails them all the first is the verdict; corrected one by one, the next."""
    worst = Evidence("mass", gain=0.005, p_value=0.5, null_p_value=0.5, sensors_p_value=0.001, bound_distance=0.0,
                     agreement={"run": DIFFERENT})
    corrections = ({"gain": 0.02}, {"p_value": 1e-4}, {"null_p_value": 0.0}, {"position": 1.0},
                   {"sensors_p_value": None}, {"bound_distance": 1.0}, {"agreement": {}})
    asked = []
    for correction in corrections:
        asked.append(judge(worst, LIMITS).rule)
        worst = replace(worst, **correction)
    assert asked == [NEGLIGIBLE, GAIN_INSIGNIFICANT, NULL, IRRELEVANT, SENSORS, BOUND, VARIES]
    assert judge(worst, LIMITS).rule == ACCEPTED


@pytest.mark.parametrize(("evidence", "rule", "figures"), [
    (replace(SLIGHT, shares={"yaw": (0.1, 5.0)}), NAMED, {"share": 0.1}),
    (replace(SLIGHT, shares={"yaw": (0.01, 5.0), "yaw_rate": (0.2, 9.0)}), NAMED, {"share": 0.2}),  # most
    (replace(SLIGHT, shares={"yaw": (0.1, 1.5)}), MINOR, {"share": 0.0}),  # a channel that is noise
    (replace(SLIGHT, shares={"yaw": (0.01, 5.0)}), MINOR, {"share": 0.01, "position": 0.01}),
    (replace(SLIGHT, position=0.03), NAMED, {"position": 0.03}),
    (replace(SLIGHT, position_in_condition=0.03), NAMED, {"position": 0.03}),
    (SLIGHT, MINOR, {"share": 0.0}),
    (WEAK, NAMED, {"position": 0.5}),
    (replace(WEAK, noise_ratio=5.0), MINOR, {"gain": 0.1, "noise_ratio": 5.0}),  # beside more than it takes away itself
    (replace(GOOD, gain=0.3, noise_ratio=5.0), NAMED, {}),
    (replace(WEAK, noise_ratio=5.0, sensors_p_value=0.6, sensors_null_p_value=0.3), MINOR, {}),
    (replace(WEAK, noise_ratio=5.0, sensors_p_value=0.6, sensors_null_p_value=0.001), NAMED,
     {}),  # the sensors say so among themselves
])
def test_effect_that_holds_is_named_or_kept(evidence, rule, figures):
    verdict = judge_naming(evidence, LIMITS)
    assert verdict.rule == rule and verdict.subject == "mass" and verdict.text
    assert {k: verdict.figures[k] for k in figures} == figures


@pytest.mark.parametrize(("evidence", "checks", "rule"), [
    (GOOD, NamingChecks(), NAMED), (GOOD, NamingChecks(excludes_null=False), MINOR),
    (CONFIRMED, NamingChecks(excludes_null=False), NAMED),
    (GOOD, NamingChecks(crossing="factor"), MINOR), (GOOD, NamingChecks(peak_force_share=0.5), MINOR),
    (GOOD, NamingChecks(worse_axle="rear"), FORCES), (GOOD, NamingChecks(summed=("steering_lag",)), MINOR),
    (CONFIRMED, NamingChecks(objection="yaw_inertia: k^2 / (l_f l_r) 0.5 is outside 0.6 to 1.4"), IMPLAUSIBLE),
    (replace(GOOD, position=-0.03), NamingChecks(), MINOR),  # its own step makes the held-out error larger
    (replace(CONFIRMED, position=-0.03), NamingChecks(), NAMED)])  # but the sensors show it among themselves
def test_what_intervals_and_axles_say_of_an_effect(evidence, checks, rule):
    verdict = judge_naming(evidence, LIMITS, checks)
    assert verdict.rule == rule and verdict.text


@pytest.mark.parametrize(("agreement", "partition"), [
    ({}, ""),
    ({"run": SAME, "site": SAME}, ""),
    ({"run": SAME, "site": DIFFERENT}, "site"),
    ({"run": DIFFERENT, "time": Agreement({}, 1e-4, 0.4), "site": SAME}, "time"),  # the one that denies it most
    ({"run": Agreement({}, 0.02, 0.4)}, ""),
    ({"run": Agreement({}, 1e-4, 0.04)}, ""),
])
def test_partition_over_which_an_effect_varies(agreement, partition):
    assert varying_partition(replace(GOOD, agreement=agreement), LIMITS) == partition


@pytest.mark.parametrize(("gain", "p_value", "healthy_gain", "relevant"), [
    (0.2, 1e-4, 0.0, True), (0.2, 0.02, 0.0, False), (0.02, 1e-4, 0.0, False), (0.2, 1e-4, 0.3, False)])
def test_effect_with_a_value_of_its_own_in_each_part(gain, p_value, healthy_gain, relevant):
    assert varies_relevantly(replace(GOOD, gain=gain, p_value=p_value, healthy_gain=healthy_gain), LIMITS) == relevant


def test_what_varies_must_be_relevant():
    assert not varies_relevantly(replace(GOOD, position=0.01, position_in_condition=0.01), LIMITS)
    cheap = replace(EDGE, position=0.01, position_in_condition=0.01)
    assert decide(replace(NOTHING, refused=[cheap]), LIMITS)[0] == "none"


@pytest.mark.parametrize(("interval", "known", "expected"), [
    ((-1.0, 9.0), (3.5, 3.0, 5.0), (3.0, 5.0)),  # the sensors deny the null
    ((1.0, 7.0), (3.5, 3.0, 5.0), (1.0, 7.0)),  # it was denied already
    ((-1.0, 9.0), (1.0, -1.0, 5.0), (-1.0, 9.0)),  # they do not
    ((-1.0, 9.0), (7.0, 6.0, 8.0), (-1.0, 9.0)),  # they say something else
    ((-1.0, 9.0), None, (-1.0, 9.0)),
])
def test_interval_is_as_sure_as_the_sensors_where_they_deny_the_null(interval, known, expected):
    assert replace_interval(FittedParameter(4.0, "rad/s", interval, 0.0), known).interval == expected


def test_every_partition_has_a_name():
    for partition, words in PARTITION_NAMES.items():
        assert words in judge(replace(GOOD, agreement={partition: DIFFERENT}), LIMITS).text


@pytest.mark.parametrize(("rival", "rule"), [
    (EQUAL, "alternative"),
    (replace(EQUAL, share=0.4), "explains less"),
    (replace(EQUAL, added=0.3), "alternative"),
    (replace(EQUAL, added=0.5), "explains less"),  # it explains other errors: most of its gain remains beside the first
    (WORSE, "explains less"),
    (AMONG, "alternative"),  # worse by less than nothing describes
    (replace(AMONG, deficit=0.3), "explains less"),
    (replace(EQUAL, evidence=CHEAP), "alternative"),  # worth is a matter of the stated one
    (replace(EQUAL, evidence=SMALL), NEGLIGIBLE),
    (replace(EQUAL, evidence=LUCKY), GAIN_INSIGNIFICANT),
    (replace(EQUAL, evidence=MAYBE_NULL), NULL),
    (replace(EQUAL, evidence=MAYBE_NULL, shared=True), "alternative"),  # the drives do not exclude it
    (replace(WORSE, evidence=MAYBE_NULL, shared=True), "explains less"),
    (replace(EQUAL, evidence=DENIED), SENSORS),
    (replace(EQUAL, evidence=EDGE), BOUND),
    (replace(EQUAL, evidence=LOCAL), VARIES),
    (replace(EQUAL, share=0.4, evidence=EDGE), "explains less"),  # asked first
])
def test_another_name(rival, rule):
    assert judge_alternative(rival, LIMITS).rule == rule


def test_another_name_is_told_with_the_one_whose_place_it_takes():
    for rival in (replace(EQUAL, replaces="tyre_stiffness"), replace(WORSE, replaces="tyre_stiffness")):
        text = judge_alternative(rival, LIMITS).text
        assert "in place of tyre stiffness it achieves 90% of its error reduction" in text


@pytest.mark.parametrize(("answer", "outcome", "figures"), [
    (replace(NOTHING, named=[GOOD, replace(GOOD, name="friction")], rivals={"mass": [EQUAL]}), "several",
     {"effects": 2}),
    (replace(NOTHING, named=[GOOD]), "named", {}),
    (replace(NOTHING, named=[GOOD], rivals={"mass": [replace(EQUAL, share=0.1)]}), "named", {}),
    (replace(NOTHING, named=[GOOD], rivals={"friction": [EQUAL]}), "named", {}),  # of something else
    (replace(NOTHING, named=[GOOD], rivals={"mass": [EQUAL]}), "ambiguous", {"names": 2}),
    (replace(NOTHING, named=[GOOD], refused=[LOCAL], noise_ratio=9.0, detectable_share=0.1), "named", {}),
    (replace(NOTHING, refused=[EDGE, LOCAL], noise_ratio=9.0, detectable_share=0.1), "varying", {}),
    (replace(NOTHING, refused=[EDGE], varying_effects=1, noise_ratio=9.0, detectable_share=0.1), "varying", {}),
    (replace(NOTHING, named=[GOOD], varying_effects=1), "named", {}),
    (replace(NOTHING, refused=[EDGE], detectable_share=0.1), "unknown", {}),
    (replace(NOTHING, refused=[DENIED], detectable_share=0.1), "unknown", {}),
    (replace(NOTHING, refused=[SMALL, LUCKY, CHEAP]), "none", {"noise_ratio": 1.0}),
    (replace(NOTHING, detectable_share=0.7), "not_testable", {"detectable_share": 0.7, "detection_power": 0.8}),
    (replace(NOTHING, detectable_share=0.7, noise_ratio=9.0), "unknown",
     {"noise_ratio": 9.0}),  # a gap is there, whatever else is not seen
    (replace(NOTHING, noise_ratio=2.5), "unknown", {"noise_ratio": 2.5, "max_noise_ratio": 2.0}),
    (NOTHING, "none", {"noise_ratio": 1.0, "max_noise_ratio": 2.0}),
    (replace(NOTHING, effects=3, base_noise_ratio=15.0, detectable_share=0.7), "ambiguous",
     {"effects": 3, "base_noise_ratio": 15.0, "max_noise_ratio": 2.0}),
    (replace(NOTHING, effects=3, base_noise_ratio=15.0, noise_ratio=2.5), "unknown", {"noise_ratio": 2.5}),
    (replace(NOTHING, effects=3, base_noise_ratio=1.9), "none", {}),
    (replace(NOTHING, base_noise_ratio=15.0), "none", {}),  # nothing reduces it significantly
])
def test_outcome(answer, outcome, figures):
    said, why = decide(answer, LIMITS)
    assert said == outcome and said in OUTCOMES
    assert (why.rule, why.subject) == (outcome, "outcome")
    assert {k: why.figures[k] for k in figures} == figures


TURNED = {
    "false_alarm": (lambda limits: judge(LUCKY, limits).rule, 1.0, GAIN_INSIGNIFICANT, ACCEPTED),
    "undecided_p": (lambda limits: judge(DENIED, limits).rule, 1e-9, SENSORS, ACCEPTED),
    "relevant": (lambda limits: judge(CHEAP, limits).rule, 1e-9, IRRELEVANT, ACCEPTED),
    "relevant_position": (lambda limits: judge(CHEAP, limits).rule, 1e-9, IRRELEVANT, ACCEPTED),
    "min_relative_size": (lambda limits: judge(replace(SENSED, size=0.4), limits).rule, 1e-9, IRRELEVANT, ACCEPTED),
    "negligible": (lambda limits: judge(SMALL, limits).rule, 1e-9, NEGLIGIBLE, ACCEPTED),
    "min_rival_gain": (lambda limits: judge_alternative(replace(EQUAL, share=0.4), limits).rule, 1e-9, "explains less",
                       "alternative"),
    "min_peak_force": (lambda limits: judge_naming(GOOD, limits, NamingChecks(peak_force_share=0.5)).rule, 1e-9, MINOR,
                       NAMED),
    "max_file_deviation": (lambda limits: judge(HEAVY, limits).rule, 1e9, FILE, ACCEPTED),
    "at_bound": (lambda limits: judge(replace(EDGE, bound_distance=0.001), limits).rule, 1e-9, BOUND, ACCEPTED),
    "unexplained_share": (lambda limits: judge_alternative(AMONG, limits).rule, 1e-9, "alternative", "explains less"),
    "max_noise_ratio": (lambda limits: decide(replace(NOTHING, noise_ratio=9.0), limits)[0], 1e9, "unknown", "none"),
    "detection_power": (lambda limits: decide(replace(NOTHING, detectable_share=0.1), limits)[0], 1e-9, "not_testable",
                        "none"),
}
"""By limit: what is asked, the value at which the limit is off, and the answer with the limit and without."""
ELSEWHERE = {"max_effects": "test_discovery.py"}
"""Limits that the search itself needs, and where they are tested."""


def test_every_limit_has_an_answer_that_it_turns():
    without = {field.name for field in fields(Limits)} - {*TURNED, *ELSEWHERE}
    assert not without, f"limits without a line in TURNED of {Path(__file__).name}: {', '.join(sorted(without))}"


@pytest.mark.parametrize("limit", TURNED)
def test_limit_turns_an_answer(limit):
    asked, off, on, without = TURNED[limit]
    assert asked(LIMITS) == on
    assert asked(replace(LIMITS, **{limit: off})) == without


@pytest.mark.parametrize(("limit", "off", "asked", "on", "without"), [
    ("false_alarm", 1e-9, lambda limits: judge(replace(LOCAL, p_value=0.0), limits).rule, VARIES, ACCEPTED),
    ("undecided_p", 0.9, lambda limits: judge(LOCAL, limits).rule, VARIES, ACCEPTED),
    ("undecided_p", 1e-9, lambda limits: judge_alternative(WORSE, limits).rule, "explains less", "alternative"),
    ("undecided_p", 0.9, lambda limits: judge(MAYBE_NULL, limits).rule, NULL, ACCEPTED),
    ("relevant", 1e-9, lambda limits: judge_naming(replace(SLIGHT, shares={"yaw": (0.01, 5.0)}), limits).rule, MINOR,
     NAMED),
    ("relevant", 1e-9, lambda limits: varies_relevantly(SMALL_GAIN, limits), False, True),
    ("false_alarm", 1.0, lambda limits: varies_relevantly(LUCKY, limits), False, True),
    ("relevant_position", 1e-9, lambda limits: judge_naming(SLIGHT, limits).rule, MINOR, NAMED),
    ("unexplained_share", 1e-9, lambda limits: judge_naming(replace(WEAK, noise_ratio=5.0), limits).rule, MINOR,
     NAMED),
    ("max_noise_ratio", 1e9, lambda limits: judge_naming(replace(WEAK, noise_ratio=5.0), limits).rule, MINOR, NAMED),
    ("undecided_p", 1e-9, lambda limits: judge_naming(
        replace(CONFIRMED, gain=0.1, noise_ratio=5.0, sensors_p_value=0.01), limits).rule, MINOR, NAMED),
    ("max_noise_ratio", 1e9, lambda limits: judge_alternative(AMONG, limits).rule, "alternative", "explains less"),
    ("max_noise_ratio", 1e9, lambda limits: judge_naming(replace(SLIGHT, shares={"yaw": (0.1, 5.0)}), limits).rule,
     NAMED,
     MINOR),
])
def test_limit_that_is_asked_again_turns_that_too(limit, off, asked, on, without):
    assert asked(LIMITS) == on
    assert asked(replace(LIMITS, **{limit: off})) == without


def test_limits_elsewhere_are_tested_there():
    for limit, file in ELSEWHERE.items():
        assert f"Limits({limit}=" in (Path(__file__).parent / file).read_text()


def test_limits_are_few_and_positive():
    assert len(fields(Limits)) <= 15
    for field in fields(Limits):
        with pytest.raises(ConfigurationError, match=f"limit {field.name}"):
            Limits(**{field.name: 0.0})


def test_decision_is_pure():
    """No numbers are made there: neither numpy nor scipy, nor anything of the search."""
    imported = set()
    for node in ast.walk(ast.parse(Path(decision.__file__).read_text())):
        if isinstance(node, ast.Import):
            imported |= {name.name for name in node.names}
        elif isinstance(node, ast.ImportFrom):
            imported.add("." * node.level + (node.module or ""))
    assert imported == {"collections.abc", "dataclasses", "..channels", ".evidence", ".settings", ".result"}


def test_limits_are_compared_in_few_places():
    """What is stated is decided in `decision`; the search orders and saves work by them, the certificate repeats them
    on imitated drives, and `discover` asks what could be seen."""
    folder = Path(decision.__file__).parent
    names = {f.name for f in fields(Limits)}
    using = set()
    for file in folder.glob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Attribute) and node.attr in names and ast.unparse(node.value).endswith("limits"):
                using.add(file.name)
    assert using == {"decision.py", "search.py", "certificate.py", "discover.py"}
