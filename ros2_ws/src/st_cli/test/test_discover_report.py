"""Results of st discover in text, page and figures; the result cache; lists of references."""

import html
import json
import math
import re
from dataclasses import replace

import pytest
from drives import weave, write_drive
from example_discovery import discovery, fitted
from st_cli.verbs.discover import expand_references
from st_core.augmented import augment
from st_core.checks import Advice, Finding, Severity
from st_core.discovery import DiscoverySettings, decision
from st_core.discovery.error_regions import compute_window_errors
from st_core.discovery.result import (
    AssumedQuantity,
    CandidateEffect,
    Combination,
    FittedParameter,
    LocalEstimate,
    Power,
    Reason,
    Separability,
    UntestableEffect,
    VaryingEffect,
)
from st_core.identification.axle_forces import ForceCurve
from st_core.vehicle import VehicleParameters
from st_offline.discovery import drives, quantities, report_text
from st_offline.discovery.discover_command import build_document, print_result, write_page
from st_offline.discovery.drives import Request, read_drive, read_result, write_result
from st_offline.discovery.figures import draw_agreement, draw_axle_curves, draw_maps, draw_waterfall
from st_offline.discovery.relation_report import RelationReport
from st_offline.discovery.vehicle_update import VehicleUpdate, update_vehicle
from st_offline.evaluation.drawing import FigureOutput
from st_offline.pages import Table
from st_offline.terminal import console
from st_recordings.paths import json_text
from st_recordings.runs import ReadSettings, find_runs
from support import LEAF

CAR = VehicleParameters.from_yaml(LEAF.read_text())
STEPS = (("steering_ratio", {"factor": 0.894}, 0.72), ("heading_misalignment", {"angle": 0.0098}, 0.55),
         ("lateral_acceleration_bias", {"bias": -0.6}, 0.55))


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    file = write_drive(tmp_path_factory.mktemp("drive") / "<b>weave.csv", weave(20.0))
    return read_drive(find_runs([file])[0], CAR, ReadSettings(), force=True)


@pytest.fixture(scope="module")
def logs(drive):
    return [drive.log, replace(drive.log, name="other")]


def make_request(drive):
    return Request("nonlinear", CAR, "leaf.yaml", LEAF.read_text(), DiscoverySettings(), drives=[drive])


def make_varying_effect(logs, partition="run"):
    values = tuple(LocalEstimate(log.name if partition == "run" else partition + str(k), (-1.0) ** k, 0.2) for k,
                   log in enumerate(logs))
    return VaryingEffect("crosswind", partition, fitted("crosswind", {"wind_x": 9.0, "wind_y": 4.0}), values, 0.09)


def test_title_and_table_list_values_with_the_largest_effect_first(logs):
    found = discovery(logs, STEPS, 1.72)
    assert report_text.format_title(found) == (
        "5 s position error 1.72 m → 0.55 m (held-out): steering ratio × 0.8940 or a cause outside the library with "
        "the same effect; heading misalignment 0.561°; lateral acceleration bias -0.600 m/s²")
    effects = [replace(e, channel="yaw", share=0.25) for e in reversed(found.effects)]
    first, *_, last = report_text.list_effect_rows(replace(found, effects=tuple(effects)))
    assert first[0] == "steering ratio" and first[2:4] == ("+0.90 m", "heading error by 25 %")
    assert last[2] == "+0.000 m" and "2 of 2 runs, 2 of 2 sites" in last


def test_names_of_effects_keep_the_abbreviations_of_the_field():
    assert quantities.to_words("cg_position") == "CG position"


def test_effective_correction_is_described_by_the_error_without_it(logs):
    found = discovery(logs, STEPS, 1.72)
    text = report_text.describe_effective_corrections(replace(found, effective=found.effects[:1]))
    assert text.startswith("steering ratio × 0.8940 (5 s position error without it +0.90 m): each is marked effective")


def test_all_effects_of_the_model_file_are_listed(logs):
    found = discovery(logs, STEPS, 1.72)
    update = VehicleUpdate(CAR, "", found.model, (), {}, {"steering_ratio": {"steering_ratio": (15.87, 14.2)}})
    expected = "predict with model.yaml, which adds steering ratio, heading misalignment, lateral acceleration bias"
    assert expected in report_text.recommend(found, update)


def test_value_on_its_bound_is_marked_except_shape_factors():
    (ratio,) = quantities.format_parameters("steering_ratio", {"factor": FittedParameter(0.5, "1", (0.4, 0.6), 1.0)})
    assert ratio == "× 0.50 at a limit of its range (0.40 to 0.60)"
    (_, curvature) = quantities.format_parameters("front_tyre_curve", {
        "peak": FittedParameter(0.98, "1", (0.62, 1.30), 1.0),
        "curvature": FittedParameter(0.05, "1", (-0.17, 0.28), 1.0)})
    assert curvature == "curvature × 0.05 (-0.17 to 0.28)"


def test_indistinguishable_effects_are_listed_together(logs):
    found = discovery(logs, STEPS[:1], 1.72, alternatives={"steering_ratio": ("front_stiffness",)}, outcome="ambiguous")
    stiff = CandidateEffect("front_stiffness", "vehicle parameters", {"factor": 1.31}, 0.2, "alternative", "")
    found = replace(found, candidates=(*found.candidates, stiff))
    assert "steering ratio × 0.8940 or front stiffness × 1.31" in report_text.format_title(found)
    assert any("record the next drive" in text for text in report_text.recommend(found, None))


def test_undetectable_effects_are_listed_with_sizes_and_the_largest_change_of_position_first(logs):
    names = ("drag", "mass", "friction", "heading_misalignment", "steering_ratio")
    sizes = (("steering_ratio", "1", ((0.05, 0.1), (0.08, 0.8))), ("friction", "1", ((0.2, 0.0),)),
             ("heading_misalignment", "rad", ((math.radians(0.5), 0.7),)))
    powers = tuple(Power(name, "", unit, size, probability, 0, 2.0 * size) for name, unit, rows in sizes
                   for size, probability in rows)
    found = discovery(logs, (), 1.0)
    found = replace(found, not_testable=tuple(UntestableEffect(name, "") for name in names),
                    power_analysis=replace(found.power_analysis, powers=powers))
    assert report_text.describe_undetectable(found) == (
        "not detectable in these drives: friction of 20 % (0.40 m after 5 s), steering ratio of 5 % (0.10 m after 5 s, "
        "detectable from about 8 %), mass, heading misalignment of 0.5° (0.017 m after 5 s), drag")
    assert report_text.describe_detectable(found) == ""
    assert "steering ratio of 3 %" in report_text.describe_detectable(discovery(logs, (), 1.0))


def test_minor_effects_on_the_vehicle_file_are_possible_causes_with_interval_reason_and_change_of_position(logs):
    steps = (*STEPS, ("sensor_lever_arm", {"x": 0.58, "y": 0.0}, 0.45))
    found = discovery(logs, steps, 1.72)
    reasons = tuple(Reason(decision.MINOR, e.name, {}, f"reason {k}") for k, e in enumerate(found.effects))
    minor = (found.effects[0], *found.effects[2:])
    uncertain = replace(found, effects=found.effects[1:2], minor=minor, reasons=reasons)
    causes = [text for heading, text in report_text.summarise(uncertain, None, {}) if heading == "possible cause"]
    assert causes == [
        "steering ratio × 0.8940 (0.8919 to 0.8961): without it or another in its place the 5 s position error "
        "changes by +0.90 m; reason 0",
        "sensor lever arm x 0.580 m (0.568 to 0.592); y 0 m (0 to 0): without it or another in its place the 5 s "
        "position error changes by +0.090 m; reason 3"]
    largest = ("; the largest reduction is by steering ratio × 0.8940, which is not certain enough to be reported as a "
               "cause")
    assert report_text.format_title(uncertain).endswith(largest)
    assert largest not in report_text.format_title(replace(uncertain, minor=uncertain.minor[1:]))


@pytest.mark.parametrize(("strength", "why"),
                         [(2.0, "these drives do not"), (12.0, "the model is not accurate enough to")])
def test_file_with_one_of_two_alternatives_mentions_the_other(logs, strength, why):
    found = discovery(logs, (("yaw_inertia", {"factor": 0.86}, 0.5),), 1.7, alternatives={"yaw_inertia": ("mass",)})
    found = replace(found, separability=(Separability("yaw_inertia", "mass", 0.9, strength),))
    corrected = VehicleUpdate(CAR, "", found.model, ("yaw_inertia",), {"yaw_inertia": (1.0, 0.86, 0.8, 0.9)}, {})
    reported = report_text.recommend(found, corrected)
    assert any(f"the first of yaw inertia × 0.8600 or mass × 1.020; {why} separate" in t for t in reported)
    more = replace(found, minor=found.effects)
    reported = report_text.recommend(more, replace(corrected, text="name: x", error=(0.33, 0.31)))
    alone = "vehicle.yaml alone reduces the position error at the end of the horizon by 6 %"
    assert any(alone in t for t in reported)


def test_causes_outside_the_library_are_listed_for_a_named_effect(logs):
    found = discovery(logs, (("steering_ratio", {"factor": 0.94}, 0.5),), 1.7)
    assert any(text.startswith("measure steering ratio on the car, and check causes that have the same effect but "
                               "are not in the library: a wrong wheelbase in the vehicle file")
               for text in report_text.recommend(found, None))
    assert "or a cause outside the library with the same effect" in report_text.format_title(found)
    mass = discovery(logs, (("mass", {"factor": 0.94}, 0.5),), 1.7)
    assert "outside the library" not in report_text.format_title(mass)
    assert not any("outside the library" in text for text in report_text.recommend(mass, None))


def test_correction_of_recordings_is_advised_only_if_one_exists(logs):
    lag = Finding("yaw_rate_lag", Severity.WARNING, ("yaw_rate",), "yaw_rate lags yaw by 0.30 s", 0.3, "s", effect=0.4,
                   advice=Advice.correct("yaw_rate", earlier=0.3))
    frozen = Finding("channel_frozen", Severity.WARNING, ("velocity_y",), "velocity_y is 0 throughout",
                    advice=Advice("text", "record velocity_y"))
    found = discovery(logs, STEPS[:1], 1.72)
    correct, look, unknown = (dict(report_text.summarise(found, None, {"a": [one]}))["recordings"]
                              for one in (lag, frozen, replace(lag, advice=None)))
    assert correct.endswith("correct them as st check proposes, and run st discover again")
    assert unknown.endswith("correct them, and run st discover again")
    assert look == "velocity_y is 0 throughout (a). Advice: record velocity_y"


def test_changes_of_the_vehicle_file_have_units():
    assert report_text.format_changes({"steering_wheel_offset": (0.0, 0.0208), "steering_ratio": (16.3, 15.05)}) == \
        "steering_wheel_offset 0 → 0.0208 rad, steering_ratio 16.3 → 15.05"


def test_minor_effects_are_listed_with_all_alternatives(logs):
    found = discovery(logs, (("tyre_stiffness", {"factor": 1.2}, 0.5),), 1.7,
                      alternatives={"tyre_stiffness": ("mass",)})
    found = replace(discovery(logs, STEPS, 1.72), minor=found.effects)
    advice = report_text.recommend(found, None)
    assert any("contains tyre stiffness × 1.2000 or mass × 1.020" in text for text in advice)


@pytest.mark.parametrize(("outcome", "message"), [
    ("none", "no significant model error"), ("not_testable", "too little excitation"),
    ("ambiguous", "no effect is certain enough to be reported as a cause"),
    ("unknown", "a significant error that no effect of the library explains")])
def test_title_states_the_outcome_if_no_effect_is_named(logs, outcome, message):
    assert message in report_text.format_title(discovery(logs, (), 1.72, outcome=outcome))


def test_unexplained_residual_is_reported_with_the_named_effects(logs):
    named = discovery(logs, STEPS, 1.72)
    much = replace(named, signature=("errors are 3.1 times the noise",))
    message = "; a residual remains that no effect of the library explains: errors are 3.1 times the noise"
    assert report_text.format_title(much) == report_text.format_title(named) + message
    assert "an effect that is not in the library; errors are 3.1 times the noise" in report_text.explain_effects(much)
    assert any("residual may have biased their values" in text for text in report_text.recommend(much, None))
    assert not any("biased their values" in text for text in report_text.recommend(named, None))


def test_varying_effect_is_reported_but_not_named(logs):
    found = discovery(logs, (), 1.72, varying=(make_varying_effect(logs),), outcome="varying")
    title = report_text.format_title(found)
    assert title.endswith("an effect that resembles crosswind (0.090 m) but varies between runs; "
                          "no effect is reported as a cause")
    (text,) = dict(report_text.list_details(found, None))["varying effects"]
    assert "not a property of the car" in text and "other: -1.00 ± 0.39" in text


def test_first_lines_list_runs_and_references_with_durations(logs):
    lines = report_text.list_details(discovery(logs, STEPS, 1.72, reference=[replace(logs[0], name="healthy")]), None)
    assert [question for question, _ in lines[:2]] == ["suspect", "reference"]
    assert lines[0][1] == ["2 runs, 40 s at 2 sites (overlapping tracks are one site): <b>weave 20 s, other 20 s"]
    assert lines[1][1] == ["1 run, 20 s: healthy 20 s"]
    answers_by_question = dict(report_text.list_details(discovery(logs, STEPS, 1.72), None))
    assert "starts from the vehicle file" in answers_by_question["reference"][0]


def test_angles_are_in_degrees_with_digits_according_to_the_interval(logs):
    (p,) = fitted("heading_misalignment", {"angle": math.radians(0.5)}).values()
    assert quantities.format_parameter(p) == "0.500° (0.490 to 0.510)"
    assert quantities.format_parameter(p, interval=False) == "0.500°"
    assert quantities.format_deviation(0.03, "1") == "3 %"
    assert quantities.format_deviation(math.radians(-1.0), "rad") == "1°"


def test_figures_are_drawn_only_if_they_have_content(logs, tmp_path):
    full = discovery(logs, STEPS, 1.72, varying=(make_varying_effect(logs),))
    nothing = replace(full.power_analysis, powers=())
    empty = replace(discovery(logs, (), 1.72), budget=(), power_analysis=nothing, candidates=(), errors={})
    slip = tuple(0.01 * k for k in range(11))
    curve = ForceCurve("front", slip, *(tuple(9e4 * factor * s for s in slip) for factor in (0.8, 0.75, 0.85, 1.0)),
                       (0.1,) * 10)
    full = replace(full, axle_curves=(curve,))
    for make in (draw_waterfall, draw_agreement, draw_axle_curves):
        drawn = make(full, FigureOutput(tmp_path, ("png",)))
        assert drawn.svg.startswith("<svg") and (tmp_path / f"{drawn.key}.png").stat().st_size > 5000
        assert make(empty, FigureOutput(None, ())) is None


@pytest.mark.parametrize(("after", "is_shown"), [(0.722, False), (0.75, True)])
def test_legend_lists_an_increase_only_if_it_is_visible(logs, after, is_shown):
    found = discovery(logs, (STEPS[0], ("lateral_acceleration_bias", {"bias": -0.6}, after)), 1.72)
    assert (">increase<" in draw_waterfall(found, FigureOutput(None, ())).svg) is is_shown


def test_maps_are_drawn_from_window_errors(tmp_path):
    files = [write_drive(tmp_path / f"{speed}.csv", weave(90.0, speed)) for speed in (7.0, 9.0)]
    long = [read_drive(source, CAR, ReadSettings(), force=True).log for source in find_runs(files)]
    found, settings = discovery(long, STEPS[:1], 1.72), DiscoverySettings(channels=("yaw_rate", "position"))
    before, after = (compute_window_errors(long, model, CAR, settings) for model in (found.base, found.model))
    drawn = draw_maps(found, long, before, after, FigureOutput(tmp_path, ("png",)))
    assert drawn.key == "map" and "complete model" in drawn.svg


def test_negative_delay_is_the_first_recommendation(logs):
    found = discovery(logs, (("steering_delay", {"time": -0.06}, 0.5),), 1.7)
    assert "steering delay is negative (-0.0600 s), which is not causal" in report_text.recommend(found, None)[0]
    later = discovery(logs, (("steering_delay", {"time": 0.06}, 0.5),), 1.7)
    assert not any("causal" in text for text in report_text.recommend(later, None))


@pytest.mark.parametrize(("number", "decimals", "shown"), [
    (-0.0004, 1, "-0.0004"), (0.04, 0, "0.04"), (-0.0, 1, "0"), (0.0, 2, "0"), (1.26, 1, "1.3"), (-0.26, 1, "-0.3")])
def test_small_numbers_are_not_rounded_to_zero_and_zero_has_no_sign(number, decimals, shown):
    assert quantities.format_decimal(number, decimals) == shown


def test_findings_of_the_recordings_are_in_the_summary(logs):
    wrong = Finding("x_scale", Severity.WARNING, ("x",), "x is 0.97 times the integrated velocity", effect=1.1)
    lines = dict(report_text.summarise(discovery(logs, STEPS, 1.72), None, {"a": [wrong], "b": [wrong]}))
    assert "velocity (a, b; shifts the position after 5 s by about 1.1 m). The recordings" in lines["recordings"]
    assert "recordings" not in dict(report_text.summarise(discovery(logs, STEPS, 1.72), None, {"a": []}))


def test_deviating_combination_is_reported_if_none_of_its_effects_is_named(logs):
    stiffness = Combination("front cornering stiffness over axle load", "1/rad", 36.0, (30.0, 40.0), 45.0,
                            ("front_stiffness", "steering_compliance"))
    understeer = Combination("stability factor K", "s^2/m^2", 0.003, (0.0025, 0.004), 0.002, ("front_stiffness",))
    found = replace(discovery(logs, STEPS, 1.72), combinations=(stiffness, understeer))
    text = "front cornering stiffness over axle load 0.80 (0.67 to 0.89) times the vehicle file value"
    assert f"{text} or a cause outside the library with the same effect" in report_text.format_title(found)
    assert dict(report_text.summarise(found, None, {}))["only the combination is identifiable"] == (
        f"{text}: front stiffness or steering compliance, which these drives do not separate")
    separate = replace(discovery(logs, STEPS[1:], 1.72), combinations=(stiffness,))  # no cause outside acts like these
    assert report_text.format_title(separate).endswith(text)
    delay = Combination("total delay of the steering", "s", -0.0619, (-0.07, -0.05), 0.0, ("steering_delay",))
    late = replace(found, combinations=(delay,))
    assert "total delay of the steering -0.062 s (-0.070 to -0.050)" in report_text.format_title(late)
    either = replace(delay, effects=("steering_delay", "tyre_relaxation"))
    assert "(-0.070 to -0.050) or tyre relaxation" in report_text.format_title(replace(found, combinations=(either,)))
    small = replace(understeer, file=-0.0001)
    assert "stability factor K 0.003 s²/m² (0.0025 to 0.004; vehicle file -0.0001)" in report_text.format_title(
        replace(found, combinations=(small,)))
    assert not any("weigh the car" in line for line in report_text.recommend(late, None))
    same = replace(found, combinations=(replace(stiffness, interval=(30.0, 44.0)),))
    named = replace(found, combinations=(replace(stiffness, effects=(found.effects[0].name,)),))
    for one in (same, named):
        assert "over axle load" not in report_text.format_title(one)


def test_meaning_of_a_stiffness_names_the_known_quantities_that_it_depends_on(logs):
    """Another mass or position of the CG, which scales show, changes the stiffness that the drives determine."""
    known = (AssumedQuantity("mass", "kg", 1420.0, 42.6, False),
             AssumedQuantity("cg_to_front_axle", "m", 1.07, 0.03, True))
    found = replace(discovery(logs, [("rear_stiffness", {"factor": 1.25}, 0.5)], 1.72), assumed=known)
    (text,) = report_text.explain_effects(found)
    assert text.endswith("with the mass 1420 kg (standard deviation 43) and cg_to_front_axle 1.07 m (standard "
                         "deviation 0.03) of the vehicle file")


@pytest.mark.parametrize(("effect", "is_limited"), [("rear_tyre_curve", True), ("mass", False)])
def test_model_with_an_undetermined_peak_is_recommended_for_the_driven_range_only(logs, effect, is_limited):
    """A peak that the drives do not reach is extrapolated: harder driving may be predicted worse than by the file."""
    found = discovery(logs, STEPS, 1.72)
    lines = report_text.recommend(replace(found, minor=(replace(found.effects[0], name=effect),)), None)
    (line,) = [line for line in lines if line.startswith("model.yaml also contains")]
    limit = "; use it only up to the slip angles of these drives, which do not determine the peak tyre force"
    assert line.endswith(limit) is is_limited  # other reasons than the range of the drives are possible


def test_page_and_terminal_contain_the_result_and_escape_names(logs, drive, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(console, "_width", 300)
    found = discovery(logs, STEPS, 1.72, varying=(make_varying_effect(logs),))
    request = make_request(drive)
    corrected = update_vehicle(found, request)
    content = build_document(found, request, corrected, {})
    assert content["schema"] == 4 and content["files"]["vehicle.yaml"]["not_folded"]["steering_ratio"]
    assert json.loads(json_text(content))["outcome"] == found.outcome
    page = tmp_path / "report.html"
    write_page(page, found, corrected, [], content, [draw_waterfall(found, FigureOutput(None, ()))])
    text = page.read_text()
    assert report_text.format_title(found) in text and "&lt;b&gt;weave" in text and "<b>weave 20" not in text
    assert "2.5 % is required" in text and not re.findall(r'(?:src|href)="(?!#|data:)[^"]+"', text)
    print_result(found, corrected, [], {"report.html": page}, True)
    message = capsys.readouterr().out
    order = [message.index(text) for text in ("suspect: 2 runs", "5 s position error 1.72 m", "effect", "to do")]
    assert order == sorted(order)
    assert len(message.splitlines()) <= 25 and "--fresh repeats the search" in message
    for effect in found.effects:
        assert all(quantities.format_parameter(p) in message for p in effect.parameters.values())


def test_page_and_terminal_contain_the_proposal(logs, drive, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(console, "_width", 60)
    found = discovery(logs, STEPS, 1.72)
    table = Table("By run", "Note.", ("run", "m"), [("[weave]", "0.1")])
    reported = RelationReport([("proposal", ["a relation, <b>bold"])], [table], "PROPOSAL: a relation")
    page = tmp_path / "report.html"
    content = build_document(found, make_request(drive), None, {})
    write_page(page, found, None, [], content, [draw_waterfall(found, FigureOutput(None, ()))], reported)
    text = html.unescape(page.read_text())
    print_result(found, None, [], {"report.html": page}, False, reported)
    message = capsys.readouterr().out
    for shown, parts in ((text, ("PROPOSAL: a relation", "a relation, <b>bold", "By run", "[weave]")),
                         (message, ("PROPOSAL: a relation",))):
        order = [shown.index(part) for part in parts]
        assert order == sorted(order)
    assert "<b>bold" not in page.read_text()


def test_stored_result_is_read_back_completely(logs, tmp_path):
    start = augment("nonlinear", {"mass": {"factor": 1.1}})
    found = discovery(logs, STEPS, 1.72, varying=(make_varying_effect(logs),), start=start)
    for one in (found, discovery(logs, (), 1.72)):
        write_result(tmp_path / "a.json", one)
        back = read_result(tmp_path / "a.json")
        assert back.document() == one.document() and back.steps == one.steps and back.varying == one.varying
        assert back.base.values == one.base.values
        assert (back.model and back.model.values) == (one.model and one.model.values)
    for damaged in ("", "{}", (tmp_path / "a.json").read_text()[:200], '{"base": 1}'):
        (tmp_path / "a.json").write_text(damaged)
        assert read_result(tmp_path / "a.json") is None
    assert read_result(tmp_path / "none.json") is None


def test_every_input_changes_the_key_of_the_result_cache(logs):
    base, settings = augment("nonlinear", {}), DiscoverySettings()
    inputs = [logs, [], CAR, base, settings, {}, {}, {}]
    changes = [(0, logs[:1]), (0, [replace(logs[0], yaw=logs[0].yaw + 1e-6), logs[1]]), (1, logs[:1]),
              (2, replace(CAR, mass=1600.0)), (3, augment("nonlinear", {"mass": {"factor": 1.1}})),
              (3, augment("linear", {})), (4, DiscoverySettings(seed=1)), (5, {"mine.py": "ab"}),
              (6, {"yaw_rate_bias": (0.1, 0.0, 0.2)}), (7, {"a": 0.02})]
    keys = {drives.make_result_key(*inputs)}
    for place, value in changes:
        keys.add(drives.make_result_key(*inputs[:place], value, *inputs[place + 1:]))
    assert len(keys) == 1 + len(changes) and drives.make_result_key(*inputs) in keys


@pytest.mark.parametrize(("given", "expected"), [
    (["a", "--reference", "b", "c", "--seed", "1"], ["a", "--reference", "b", "--reference", "c", "--seed", "1"]),
    (["a", "--reference", "b", "--reference", "c", "d"], ["a", *["--reference", "b"], *["--reference", "c"],
                                                          *["--reference", "d"]]),
    (["--reference", "b", "--", "a"], ["--reference", "b", "--", "a"]),
    (["--reference=b", "a"], ["--reference=b", "a"]),
    (["a", "--seed", "1", "b"], ["a", "--seed", "1", "b"])])
def test_reference_takes_all_paths_up_to_the_next_option(given, expected):
    assert expand_references(given) == expected
