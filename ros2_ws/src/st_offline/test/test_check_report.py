"""Constructed findings of a check in text, on the page and in a proposed run.yaml."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
import yaml
from st_core.checks import Advice, Comparison, DriveCheck, Finding, Sampling, Severity
from st_core.checks.finding import Alternative
from st_core.clock_types import Alignment, Verdict
from st_core.vehicle import VehicleParameters
from st_offline.checking import check_command, check_report
from st_offline.checking.check_command import (
    append_corrections,
    check_file_name,
    draw_comparison,
    make_run_yaml,
    make_summary,
    make_title,
    write_page,
)
from st_offline.checking.check_report import (
    CheckedRun,
    build_document,
    describe_effect,
    describe_intervals,
    group_findings,
    print_findings,
    print_run,
    print_runs,
)
from st_offline.checking.gate import RejectedRunError
from st_offline.terminal import console
from st_recordings.paths import OutputError, json_text
from st_recordings.runs import ReadSettings, RunSource
from st_recordings.runs.columns import Layout
from st_recordings.runs.run_types import SteeringField, summarise_alignment
from support import LEAF

HOSTILE = "<script>alert(1)</script> & [bold]x"


def correct_by(**entry):
    return Advice("run.yaml", f"correct: {json.dumps(entry['correct'])}" if "correct" in entry else str(entry), entry)


DEGREES = Finding("yaw_rate_scale", Severity.ERROR, ("yaw_rate",), "yaw rate is 57.3 times too large: deg/s?", 57.3,
                  "1", (57.2, 57.4), (), 130.4, correct_by(correct={"yaw_rate": {"scale": 0.01745}}))
JUMPS = Finding("position_jumps", Severity.WARNING, ("x", "y"), f"positions jump {HOSTILE}", 2, "1", None,
                ((1.0, 1.5), (3.0, 3.25)), 0.31, correct_by(leave_out=[[1.0, 1.5], [3.0, 3.25]]))
MOVED = Finding("measuring_point", Severity.WARNING, (), "the INS point lies 1.50 m behind", -1.5, "m",
                (-1.53, -1.47), (), 0.2,
                Advice("vehicle", "cg_to_ins_x: {value: -1.9, unit: m}", {"cg_to_ins_x": -1.9}))
COARSE = Finding("resolution_coarse", Severity.NOTE, ("yaw",), "yaw comes in steps", np.nan, "rad",
                 advice=Advice("text", "log more digits"))
OPPOSITE_SIGN = Finding("steering_sign", Severity.ERROR, ("road_wheel_angle",), "is -1 times the angle", -1.0, "1")
ALL_FINDINGS = (DEGREES, JUMPS, MOVED, COARSE)


def make_check(findings=ALL_FINDINGS):
    time = np.arange(0.0, 10.0, 0.01)
    rate = np.sin(time)
    comparison = Comparison("yaw_rate", "Yaw rate against the change of yaw", "rad/s", "yaw rate", "change of yaw",
                            time, 57.3 * rate, np.where(time < 5.0, rate, np.nan), ("yaw_rate_scale", "position_jumps"))
    channel = Sampling("rad/s", 1000, 100.0, 0, 0.01, 0.001, 0.0, 0.02, 3)
    return DriveCheck(tuple(findings), {"yaw_rate": channel}, (comparison,))


def make_source(folder):
    return RunSource("drive", "csv", (folder / "drive.csv",))


def make_run(name="drive", findings=ALL_FINDINGS):
    car = VehicleParameters.from_yaml(LEAF.read_text())
    return CheckedRun(name, make_check(findings), car, "leaf.yaml", 10.0, (), {"drive.csv": "0" * 64},
                      summarise_alignment(Alignment()), "RUN")


@pytest.fixture(autouse=True)
def narrow_terminal(monkeypatch):
    monkeypatch.setattr(console, "_width", 60)


@pytest.mark.parametrize(("value", "interval", "unit", "text"), [
    (57.31, (57.20, 57.42), "1", "57.31 ± 0.11"), (-1.5, (-1.53, -1.47), "m", "-1.500 ± 0.030 m"),
    (0.31, (0.29, 0.35), "s", "0.310 (0.290 to 0.350) s"), (0.0035, None, "rad/s", "0.0035 rad/s"),
    (1234.5, (1230.0, 1239.0), "m/s^2", "1234.5 ± 4.5 m/s²"), (None, None, "m", ""), (6, (6.0, 6.0), "1", "6"),
    (np.nan, None, "m", ""), (-0.0001, (-0.0201, 0.0199), "m/s", "0.000 ± 0.020 m/s"),
])
def test_estimates_are_rounded_to_the_digits_of_their_interval(value, interval, unit, text):
    assert check_report.format_estimate(value, interval, unit) == text


def test_time_ranges_and_effect_of_a_finding():
    assert describe_intervals(DEGREES) == "whole run" and describe_intervals(JUMPS) == "1.0 to 1.5 s, 3.0 to 3.2 s"
    short = Finding("a", Severity.NOTE, (), "t", times=((0.71, 0.72), (3.0, 3.2)))
    assert describe_intervals(short) == "0.7 s, 3.0 to 3.2 s"
    many = tuple((float(k), k + 0.5) for k in range(9))
    assert describe_intervals(Finding("a", Severity.NOTE, (), "t", times=many)).endswith("3.0 to 3.5 s and 5 more")
    assert describe_effect(DEGREES) == "shifts the position after 5 s by about 130 m" and describe_effect(COARSE) == ""


def test_verdict_counts_findings_and_states_their_consequence():
    expected = "1 error, 2 warnings, 1 note: an evaluation would be meaningless"
    assert check_report.format_verdict(make_check()) == expected
    assert check_report.format_verdict(make_check([MOVED])) == "1 warning: an evaluation would be biased"
    biased = Finding("acceleration_y_bias", Severity.WARNING, ("acceleration_y",), "too low")
    expected = "1 warning: results of identify and discover would be biased"
    assert check_report.format_verdict(make_check([biased])) == expected
    assert check_report.format_verdict(make_check([MOVED, biased])) == "2 warnings: an evaluation would be biased"
    assert check_report.format_verdict(make_check([])) == "no findings in 1 comparison"
    assert "nothing could be compared" in check_report.format_verdict(DriveCheck((), {}, ()))
    assert check_report.format_headline(make_check([DEGREES])) == "1 error: yaw rate is 57.3 times too large: deg/s?"
    asking = replace(DEGREES, statement="yaw: 57.3 times too large: deg?: gon?")
    two = check_report.format_headline(make_check([DEGREES, asking]))
    assert two == "2 errors: yaw rate is 57.3 times too large; yaw: 57.3 times too large"


def test_findings_are_sorted_by_severity():
    assert sorted((COARSE, MOVED, JUMPS, DEGREES), key=check_report.rank_severity) == [DEGREES, MOVED, JUMPS, COARSE]


def test_terminal_prints_all_findings_and_no_markup_of_names(capsys):
    print_run(make_run(HOSTILE))
    text = capsys.readouterr().out
    for one in ALL_FINDINGS:
        assert one.text in text and one.name in text and one.advice.line in text
    assert HOSTILE in text and "in the vehicle file: cg_to_ins_x" in text and "3.0 to 3.2 s" in text


def test_other_commands_print_each_finding_once_with_its_runs(capsys):
    print_findings({HOSTILE: ALL_FINDINGS, "second": (replace(JUMPS, effect=2.0), COARSE)})
    text = capsys.readouterr().out
    assert text.count(JUMPS.text) == 1 and f"{HOSTILE}, second: warning: {JUMPS.text} (largest of 2) | shifts" in text
    assert "about 2 m" in text and text.count(DEGREES.text) == 1 and DEGREES.advice.line in text
    assert COARSE.text not in text and "2 notes of the checks" in text


def test_opposite_steering_sign_comes_first_with_its_correction(capsys):
    print_run(replace(make_run("drive", (DEGREES, OPPOSITE_SIGN)), arguments="logs/drive.csv"))
    first = capsys.readouterr().out.splitlines()[0]
    assert "opposite sign" in first and "--steering-sign -1" in first and "CAN" not in first
    assert "`st check logs/drive.csv --propose-correction run.yaml`" in first
    assert "opposite sign" in str(RejectedRunError("a.csv", [OPPOSITE_SIGN]))
    assert "opposite" not in str(RejectedRunError("a.csv", [DEGREES]))
    assert make_summary([make_run("drive", (OPPOSITE_SIGN,))])[1].startswith("The steering angle has the opposite sign")


def test_opposite_steering_sign_of_a_can_log_is_corrected_in_car_yaml(capsys):
    alignment = summarise_alignment(Alignment(0, 0, 0.0, 0.001, 0.1, "shared signals", Verdict.GOOD))
    print_run(replace(make_run("drive", (OPPOSITE_SIGN,)), alignment=alignment))
    first = capsys.readouterr().out.splitlines()[0]
    assert "steering_sign in car.yaml" in first and "--steering-field" not in first and "run.yaml" not in first


def test_clock_offsets_of_many_runs_are_summarised_in_one_sentence():
    found = {str(n): summarise_alignment(Alignment(0, -n * 100_000_000, 0.0, 0.001 * n, 0.1, "shared signals", verdict))
             for n, verdict in enumerate((Verdict.GOOD, Verdict.GOOD, Verdict.DOUBTFUL), 1)}
    assert check_report.describe_clocks({**found, "csv": {"method": "none"}}) == (
        "INS minus steering clock of 3 runs: -0.300 to -0.100 s, estimated from the data, standard deviation up to 3.0 "
        "ms, 1 of them doubtful")
    assert check_report.describe_clocks({**found, "set": {**found["1"], "method": "by hand"}}).endswith(
        "; set: INS minus steering clock: -0.100 s, set by hand")
    found["2"] = found["2"] | {"offset_deviation_s": None}
    assert "standard deviation up to 3.0 ms (unknown in 1 of them)" in check_report.describe_clocks(found)
    unknown = {name: alignment | {"offset_deviation_s": None} for name, alignment in found.items()}
    assert "standard deviation unknown, 1 of them doubtful" in check_report.describe_clocks(unknown)
    del found["3"]
    assert check_report.describe_clocks(found).count("steering clock:") == 2


@pytest.mark.parametrize(("method", "text"), [
    ("none", ""), ("by hand", "INS minus steering clock: -0.430 s, set by hand"),
    ("shared signals", "INS minus steering clock: -0.430 s, estimated from the data (by shared signals, "
     "standard deviation 1.2 ms, good)")])
def test_clock_offset_of_the_steering_is_printed(method, text, capsys):
    alignment = summarise_alignment(Alignment(0, -430_000_000, 0.0, 0.0012, 0.1, method, Verdict.GOOD))
    assert check_report.describe_clock(alignment) == text
    unknown = check_report.describe_clock(alignment | {"offset_deviation_s": None})
    assert unknown == text.replace("1.2 ms", "unknown")
    print_run(replace(make_run(), alignment=alignment))
    message = capsys.readouterr().out
    assert text in message and ("steering clock" in message) is bool(text)


def test_document_contains_only_finite_numbers():
    content = json.loads(json_text(build_document([make_run()], {})))
    entry = content["runs"]["drive"]
    assert content["schema"] == 3 and entry["vehicle"] == "leaf.yaml" and "leaf.yaml" in content["vehicle"]
    assert set(entry["findings"][0]) == {"name", "severity", "channels", "value", "unit", "interval", "text", "times",
                                         "effect", "advice", "tried", "alternatives"}
    lag = Finding("velocity_lag", Severity.NOTE, ("velocity_x",), "late",
                  alternatives=(Alternative("only one is", ("velocity_x_lag",)), Alternative("a", ())))
    (ambiguous,) = check_report.findings_as_json([lag])
    assert ambiguous["text"] == "late, or only one is, or a: all fit this drive"
    assert ambiguous["alternatives"][0] == {"text": "only one is", "findings": ["velocity_x_lag"]}
    assert entry["channels"]["yaw_rate"]["missing"] == 3 and entry["comparisons"][0]["residual_rms"] > 10.0


def test_page_contains_every_finding_escaped_and_loads_nothing(tmp_path):
    runs, failed = [make_run(HOSTILE), make_run("second", [])], {"third": "it is <b>broken</b>: `st <x>`"}
    write_page(tmp_path / "p.html", runs, failed, build_document(runs, failed))
    text = (tmp_path / "p.html").read_text()
    assert "<script" not in text and "&lt;script&gt;alert(1)" in text and "it is &lt;b&gt;broken" in text
    assert "/b&gt;: <code>st &lt;x&gt;</code>" in text
    assert not re.findall(r'(?:src|href)="(?!#|data:)[^"]+"|url\((?!#)|@import', text)
    for one in (DEGREES, MOVED, COARSE):
        assert one.text in text and one.name in text
    assert "57.30 ± 0.10" in text and "1.0 to 1.5 s, 3.0 to 3.2 s" in text and "after 5 s by about 130 m" in text
    assert text.count("<figure>") == 2 and "var(--bad)" in text and "prefers-color-scheme: dark" in text
    assert "correct: {&#34;yaw_rate&#34;: {&#34;scale&#34;: 0.01745}}" in text
    assert make_title(runs).startswith("Errors in 1 of 2 runs (<script>")


@pytest.mark.slow
def test_page_of_many_runs_is_small(tmp_path):
    runs = [make_run(f"drive {number}") for number in range(60)]
    write_page(tmp_path / "p.html", runs, {}, build_document(runs, {}))
    assert (tmp_path / "p.html").stat().st_size < 6_000_000


def test_proposed_run_yaml_contains_all_corrections_with_their_findings(tmp_path):
    file = tmp_path / "corrected" / "run.yaml"
    settings = ReadSettings(steering_sign=-1, offset=1695000123.456)
    text = make_run_yaml(make_source(tmp_path), ALL_FINDINGS, file, settings)
    content = yaml.safe_load(text)
    assert content == {"name": "drive", "csv": "../drive.csv", "offset": 1695000123.456,
                       "correct": {"yaw_rate": {"scale": 0.01745}}, "leave_out": [[1.0, 1.5], [3.0, 3.25]]}
    comments = [line for line in text.splitlines() if line.startswith("#")]
    for one in ALL_FINDINGS:
        assert any(f"{one.severity.value}: {one.name}: " in line for line in comments)
    assert "#   in the vehicle file: cg_to_ins_x: {value: -1.9, unit: m}" in comments
    assert "# read with --steering-sign -1 --steering-latency 0" in comments


@pytest.mark.parametrize(("sign", "content"), [
    (1, {"columns": {"yaw": "psi", "steering_wheel_angle": "swa"}, "units": {"steering_wheel_angle": "deg"}}),
    (-1, {"columns": {"yaw": "psi"}})])
def test_proposed_run_yaml_contains_the_steering_column_of_the_option(tmp_path, sign, content):
    """A run.yaml has no sign of the steering; a wrong one would be read without an error."""
    source = replace(make_source(tmp_path), settings={"layout": Layout({"yaw": "psi"})})
    read = ReadSettings(steering_sign=sign, steering=SteeringField("", "swa", "wheel", "deg", sign))
    text = make_run_yaml(source, [], tmp_path / "run.yaml", read)
    assert yaml.safe_load(text) == {"name": "drive", "csv": "drive.csv", **content}
    assert "# read with --steering-field 'swa' --steering-is wheel" in text
    assert ("--steering-sign -1" in text) is (sign == -1)


def test_multiline_finding_remains_a_comment(tmp_path):
    multiline = Finding("yaw_lag", Severity.NOTE, (), "late\nname: other", advice=Advice("text", "x\ny: 1"))
    assert yaml.safe_load(make_run_yaml(make_source(tmp_path), [multiline], tmp_path / "run.yaml", ReadSettings())) == {
        "name": "drive", "csv": "drive.csv"}


def test_more_severe_of_two_contradicting_corrections_is_applied(tmp_path):
    scaled = correct_by(correct={"yaw_rate": {"scale": 2.0}})
    other = Finding("yaw_rate_bias", Severity.WARNING, (), "too high", advice=scaled)
    text = make_run_yaml(make_source(tmp_path), [DEGREES, other], tmp_path / "run.yaml", ReadSettings())
    assert yaml.safe_load(text)["correct"] == {"yaw_rate": {"scale": 0.01745}}
    assert "#   not applied, an earlier finding proposes a different value: correct:" in text


def test_corrections_of_units_are_proposed_for_csv_and_vbo_only(tmp_path):
    exchanged = Finding("position_axes", Severity.ERROR, ("x", "y"), "exchanged",
                        advice=correct_by(columns={"x": "y", "y": "x"}))
    unit = Finding("time_unit", Severity.ERROR, ("time",), "ms", advice=correct_by(units={"t": "ms"}))
    for kind, is_table in (("csv", True), ("vbo", True), ("bag", False)):
        source = replace(make_source(tmp_path), kind=kind)
        text = make_run_yaml(source, [exchanged, unit], tmp_path / "run.yaml", ReadSettings())
        assert "columns" in yaml.safe_load(text) and ("units" in yaml.safe_load(text)) is is_table
        assert ("#   not applied, only csv and vbo files have units: " in text) is not is_table


def test_time_range_excluded_by_several_findings_is_listed_once(tmp_path):
    text = make_run_yaml(make_source(tmp_path), [JUMPS, replace(JUMPS, name="channel_frozen")], tmp_path / "run.yaml",
                    ReadSettings())
    assert yaml.safe_load(text)["leave_out"] == [[1.0, 1.5], [3.0, 3.25]]


def test_new_corrections_are_combined_with_previous_ones():
    """A sample is first corrected by the previous, then by the new scale, offset and time shift."""
    before = {"correct": {"yaw_rate": {"scale": 2.0, "add": 0.5, "earlier": 0.1}, "y": {"scale": -1.0}},
              "leave_out": [[0.0, 1.0]], "units": {"t": "ms"}}
    new = {"correct": {"yaw_rate": {"scale": 3.0, "add": 0.25, "earlier": 0.02}, "position": {"ahead": 1.0}},
           "leave_out": [[5.0, 6.0]], "units": {"yaw": "deg"}}
    after = append_corrections(before, new)
    assert after["correct"] == {"yaw_rate": {"scale": 6.0, "add": 3.0 * 0.5 + 0.25, "earlier": pytest.approx(0.12)},
                                "y": {"scale": -1.0}, "position": {"ahead": 1.0}}
    assert after["leave_out"] == [[0.0, 1.0], [5.0, 6.0]] and after["units"] == {"t": "ms", "yaw": "deg"}
    only_scaled = append_corrections(before, {"correct": {"yaw_rate": {"scale": 3.0}}})["correct"]["yaw_rate"]
    assert only_scaled == {"scale": 6.0, "add": 1.5, "earlier": 0.1}


@pytest.mark.parametrize(("name", "message"), [("correction.yaml", "name it run.yaml"), ("run.yaml", "exists; choose")])
def test_invalid_or_existing_file_name_of_a_proposal_is_rejected(tmp_path, name, message):
    (tmp_path / name).write_text("name: mine\n")
    with pytest.raises(OutputError, match=message):
        check_file_name(tmp_path / name)


def test_quantity_has_the_unit_of_its_finding():
    assert check_report.format_quantity("yaw_rate_lag", (0.31, 0.29, 0.33)) == "0.310 ± 0.020 s"
    assert check_report.format_quantity("yaw_rate_bias", (0.004, 0.003, 0.005)) == "0.0040 ± 0.0010 rad/s"
    assert check_report.format_quantity("acceleration_y_bias", (-0.6, -0.8, -0.4)) == "-0.60 ± 0.20 m/s²"
    assert check_report.format_quantity("velocity_x_bias", (-0.6, -0.8, -0.4)) == "-0.60 ± 0.20 m/s"
    assert check_report.format_quantity("yaw_drift", (0.0004, 0.0003, 0.0005)) == "0.00040 ± 0.00010 rad/s"
    assert check_report.format_quantity("x_scale", (0.97, 0.96, 0.98)) == "0.970 ± 0.010"


def test_many_runs_print_each_finding_once_and_runs_without_findings_in_one_line(capsys):
    runs = [make_run(f"{name}{k}", found) for name, found in (("bad", (DEGREES,)), ("good", ())) for k in range(5)]
    print_runs(runs)
    text = capsys.readouterr().out
    assert text.count(DEGREES.text) == 1 and "bad0, bad1" in text and "report.html" in text
    assert "no findings in 5 of 10 runs: good0, good1" in text


def test_clock_offset_of_a_time_zone_is_explained():
    zone = summarise_alignment(Alignment(0, 7198_588_000_000, 0.0, 0.001, 0.1, "shared signals", Verdict.GOOD))
    text = "+7198.588 s (about +2 h: one of the two clocks shows local time), estimated"
    assert text in check_report.describe_clock(zone)
    other = summarise_alignment(Alignment(0, 900_000_000_000, 0.0, 0.001, 0.1, "shared signals", Verdict.GOOD))
    assert "local time" not in check_report.describe_clock(other)


def test_correction_is_offered_only_if_one_exists():
    without_correction = replace(COARSE, severity=Severity.WARNING)
    assert len(make_summary([make_run("drive", (without_correction,))])) == 1
    (_, correct) = make_summary([replace(make_run("drive", (JUMPS,)), arguments="a/run.yaml")])
    assert correct.startswith("To correct the recording, run `st check a/run.yaml --propose-correction run.yaml` with")


def test_equal_findings_in_two_channels_are_not_merged():
    steering = Finding("sentinel_values", Severity.WARNING, ("road_wheel_angle",), "road_wheel_angle is -9999", -9999.0)
    speed = replace(steering, channels=("velocity_x",), statement="velocity_x is -9999")
    assert [names for _, names in group_findings({"a": [steering, speed], "b": [speed]})] == [["a"], ["a", "b"]]


def test_lag_and_lead_are_not_merged():
    late = Finding("yaw_rate_lag", Severity.WARNING, ("yaw_rate",), "yaw_rate lags yaw", 0.08, "s", effect=0.1)
    early = replace(late, statement="yaw_rate leads yaw", value=-0.05, effect=0.2)
    grouped = group_findings({"a": [late], "b": [early], "c": [late]})
    assert [(one.text, names) for one, names in grouped] == [("yaw_rate leads yaw", ["b"]),
                                                             ("yaw_rate lags yaw", ["a", "c"])]


@pytest.mark.parametrize("quantity", ["distance per second", "forward acceleration", "yaw rate"])
def test_labels_of_both_axes_stay_apart_below_a_long_title(monkeypatch, quantity):
    figures = []
    monkeypatch.setattr(check_command.drawing, "save_figure", lambda figure, *others: figures.append(figure))
    result = make_check()
    title = f"{quantity}: sensor versus another one"
    run = CheckedRun("run", result, None, "", 10.0, (), {}, {}, "RUN")
    draw_comparison(replace(result.comparisons[0], title=title), run, "")
    figures[0].suptitle("a title\nof\nthree lines", fontsize=10)
    figures[0].draw_without_rendering()
    upper, lower = (axes.yaxis.label.get_window_extent() for axes in figures[0].axes)
    assert upper.y0 - lower.y1 > 0.15 * figures[0].dpi  # inch
    check_command.plt.close(figures[0])
