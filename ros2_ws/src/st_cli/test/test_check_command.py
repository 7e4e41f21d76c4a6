"""The command st check, and its findings in the other commands: a real drive, unchanged and in a wrong unit."""

import csv
import html
import json
import math
from pathlib import Path

import numpy as np
import pytest
import yaml
from command_line import st
from st_core.vehicle import VehicleParameters
from st_offline.checking.check_report import findings_as_json
from st_offline.discovery.drives import read_drives
from st_recordings.runs import ReadSettings, find_runs
from support import ROOT

DRIVE = ROOT / "examples" / "data" / "rfs_turn_a.csv"
CAR = ROOT / "config" / "vehicle" / "hyundai_genesis.yaml"
DEGREES_PER_RADIAN = 180.0 / math.pi
HOSTILE = "<b>drive</b>"
FILE_NAME = HOSTILE.replace("/", "-")
QUICK = ("--vehicle", CAR, "--model", "kinematic", "--figures", "")


def write_scaled_drive(file: Path, **factors: float) -> Path:
    """Writes the real drive with some columns multiplied by a factor."""
    with DRIVE.open(newline="") as stream:
        names, *rows = csv.reader(stream)
    values = np.array(rows, float)
    for name, factor in factors.items():
        values[:, names.index(name)] *= factor
    file.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(file, values, delimiter=",", header=",".join(names), comments="", fmt="%.9g")
    return file


@pytest.fixture(scope="module")
def faulty_drive(tmp_path_factory):
    return write_scaled_drive(tmp_path_factory.mktemp("faulty") / f"{FILE_NAME}.csv", yaw_rate=DEGREES_PER_RADIAN)


@pytest.fixture(scope="module")
def evaluated(faulty_drive, tmp_path_factory):
    """Evaluation of the faulty and the unchanged drive without --force: folder, result, document."""
    base = tmp_path_factory.mktemp("evaluated")
    result = st("evaluate", faulty_drive, DRIVE, *QUICK[:-1], "png", "--output", base / "out")
    return base / "out", result, json.loads((base / "out" / "evaluation.json").read_text())


@pytest.fixture(scope="module")
def checked(faulty_drive, tmp_path_factory):
    base = tmp_path_factory.mktemp("checked")
    result = st("check", faulty_drive, DRIVE, base / "nothing.csv", "--vehicle", CAR, "--output", base / "out")
    return base / "out", result, json.loads((base / "out" / "check.json").read_text())


def select_names(findings, severity):
    return {finding["name"] for finding in findings if finding["severity"] == severity}


def test_wrong_unit_is_reported_with_exit_status_1(checked):
    folder, result, content = checked
    assert result.exit_code == 1
    run = content["runs"][FILE_NAME]
    assert select_names(run["findings"], "error") == {"yaw_rate_scale"}
    first = run["findings"][0]
    assert first["interval"][0] <= DEGREES_PER_RADIAN <= first["interval"][1] and first["channels"] == ["yaw_rate"]
    assert first["text"] in result.output and first["advice"]["line"] in result.output
    assert run["verdict"] in result.output and "an evaluation would be meaningless" in run["verdict"]
    assert not select_names(content["runs"]["rfs_turn_a"]["findings"], "error")
    assert list(content["failed"]) == ["nothing.csv"] and "the file or folder does not exist" in result.output
    for name in ("report.html", "check.json"):
        assert str(folder / name) in result.output


def test_check_json_schema(checked):
    content = checked[2]
    assert set(content) == {"schema", "created", "versions", "vehicle", "runs", "combined_estimates", "failed"}
    assert content["vehicle"] == {str(CAR): {"name": "Hyundai Genesis", "hash": content["vehicle"][str(CAR)]["hash"]}}
    for run in content["runs"].values():
        assert set(run) >= {"findings", "channels", "comparisons", "verdict", "vehicle", "duration", "warnings",
                            "files"}
        for one in run["findings"]:
            assert set(one) >= {"name", "severity", "channels", "value", "unit", "interval", "text", "times", "effect",
                                "advice", "tried"}
            assert one["severity"] in ("error", "warning", "note") and one["text"]
        for channel in run["channels"].values():
            assert set(channel) >= {"rate", "gaps", "noise", "resolution", "unit", "samples", "repeated", "missing"}
        assert 45.0 < run["channels"]["yaw_rate"]["rate"] < 55.0


def test_page_begins_with_the_findings(checked):
    text = (checked[0] / "report.html").read_text()
    assert "<b>drive" not in text and "&lt;b&gt;drive" in text
    assert text.index("Errors in 1 of 2 runs") < text.index("<table")
    for run in checked[2]["runs"].values():
        assert all(one["name"] in text for one in run["findings"])
    assert text.count("<figure>") >= 6


def test_reported_findings_are_described_in_the_manual(checked):
    manual = (ROOT / "docs" / "manual" / "checks.md").read_text()
    for run in checked[2]["runs"].values():
        for one in run["findings"]:
            assert f"`{one['name']}`" in manual, one["name"]


@pytest.mark.slow
def test_proposed_correction_removes_the_finding(faulty_drive, tmp_path):
    car = tmp_path / "car"  # of table recordings: without DBC and signal table
    car.mkdir()
    (car / "vehicle.yaml").write_text(CAR.read_text())
    corrected = tmp_path / "corrected" / "run.yaml"
    result = st("check", faulty_drive, "--car", car, "--output", tmp_path / "a", "--propose-correction", corrected)
    assert result.exit_code == 1 and "# error: yaw_rate_scale: " in corrected.read_text()
    scale = yaml.safe_load(corrected.read_text())["correct"]["yaw_rate"]["scale"]
    assert math.isclose(scale, 1 / DEGREES_PER_RADIAN, rel_tol=0.02)
    second = tmp_path / "corrected" / "more.run.yaml"
    checked = st("check", corrected, "--vehicle", CAR, "--output", tmp_path / "b", "--json", tmp_path / "numbers.json",
                 "--propose-correction", second)
    assert checked.exit_code == 0, checked.output
    (run,) = json.loads((tmp_path / "numbers.json").read_text())["runs"].values()
    assert "yaw_rate_scale" not in {one["name"] for one in run["findings"]}
    assert any("yaw_rate" in warning for warning in run["warnings"])  # applied corrections are reported
    evaluated = st("evaluate", corrected, *QUICK, "--output", tmp_path / "c")
    assert evaluated.exit_code == 0, evaluated.output
    # The second proposal contains the first correction as well.
    scale = yaml.safe_load(second.read_text())["correct"]["yaw_rate"]["scale"]
    assert math.isclose(scale, 1 / DEGREES_PER_RADIAN, rel_tol=0.02)


def test_correction_is_proposed_for_a_single_run_only(faulty_drive, tmp_path):
    result = st("check", faulty_drive, DRIVE, "--output", tmp_path / "o", "--propose-cure", tmp_path / "run.yaml")
    assert result.exit_code == 2 and "2 runs were given" in result.output
    assert not (tmp_path / "o").exists() and not (tmp_path / "run.yaml").exists()


def test_unreadable_input_exits_with_2_and_writes_nothing(tmp_path):
    result = st("check", tmp_path / "none.csv", "--output", tmp_path / "o")
    assert result.exit_code == 2 and "no run can be read" in result.output and not (tmp_path / "o").exists()


def test_recording_of_two_rows_is_checked(tmp_path):
    file = tmp_path / "short.csv"
    file.write_text("".join(DRIVE.read_text().splitlines(keepends=True)[:3]))
    result = st("check", file, "--vehicle", CAR, "--output", tmp_path / "out")
    assert result.exit_code == 0 and (tmp_path / "out" / "report.html").exists(), result.output


@pytest.mark.slow
def test_evaluate_excludes_a_run_with_an_error(faulty_drive, tmp_path, evaluated, checked):
    folder, result, content = evaluated
    assert result.exit_code == 1 and "yaw_rate_scale" in result.output and "--force" in result.output
    assert list(content["runs"]) == ["rfs_turn_a"] and list(content["failed"]) == [FILE_NAME]
    assert select_names(content["refused"][FILE_NAME], "error") == {"yaw_rate_scale"}
    # Figures are drawn before the result of the checks; those of a rejected run are not kept.
    assert [entry.name for entry in (folder / "runs").iterdir()] == ["rfs_turn_a"]
    assert {entry.name for entry in folder.iterdir() if entry.is_dir()} == {"runs"}
    # Every output contains the same findings.
    other = checked[2]["runs"]["rfs_turn_a"]["findings"]
    assert content["about"]["rfs_turn_a"]["findings"] == other
    page = (folder / "report.html").read_text()
    for one in (*other, *content["refused"][FILE_NAME]):
        assert f">{one['name']}</code>" in page
        assert one["severity"] == "note" or one["text"] in result.output
    alone = st("evaluate", faulty_drive, *QUICK, "--output", tmp_path / "p")
    assert alone.exit_code == 2 and "yaw_rate_scale" in alone.output


@pytest.mark.slow
def test_evaluate_force_includes_the_run_and_changes_no_number(faulty_drive, tmp_path, evaluated):
    result = st("evaluate", faulty_drive, DRIVE, *QUICK, "--output", tmp_path / "o", "--force")
    assert result.exit_code == 0 and "error: yaw_rate" in result.output
    content = json.loads((tmp_path / "o" / "evaluation.json").read_text())
    assert select_names(content["about"][FILE_NAME]["findings"], "error") == {"yaw_rate_scale"}
    assert content["runs"]["rfs_turn_a"] == evaluated[2]["runs"]["rfs_turn_a"]


@pytest.mark.slow
def test_evaluate_reports_a_too_long_step_and_its_correction(tmp_path):
    stiff = tmp_path / "stiff.yaml"
    lines = [line if not line.startswith("yaw_inertia:") else
             'yaw_inertia: {value: 1900.0, unit: kg m^2, source: "test"}' for line in CAR.read_text().splitlines()]
    stiff.write_text("\n".join(lines) + "\n")
    models = ("--model", "linear", "--model", "nonlinear", "--figures", "")

    def find_too_long_steps(vehicle, folder):
        assert st("evaluate", DRIVE, *models, "--vehicle", vehicle, "--output", folder).exit_code == 0
        (about,) = json.loads((folder / "evaluation.json").read_text())["about"].values()
        return [one for one in about["findings"] if one["name"] == "step_too_long"]

    (finding,) = find_too_long_steps(stiff, tmp_path / "a")
    assert finding["advice"]["kind"] == "vehicle"
    assert finding["advice"]["line"] in html.unescape((tmp_path / "a" / "report.html").read_text())
    corrected = tmp_path / "corrected.yaml"
    corrected.write_text("\n".join(line if not line.startswith("minimum_slip_speed:") else finding["advice"]["line"]
                                   for line in lines) + "\n")
    assert find_too_long_steps(corrected, tmp_path / "b") == []


@pytest.mark.slow
def test_identify_excludes_a_run_with_an_error(faulty_drive, tmp_path):
    result = st("identify", "steering-offset", faulty_drive, DRIVE, "--vehicle", CAR, "--output", tmp_path / "o")
    assert result.exit_code == 0, result.output
    assert "left out: " in result.output and "yaw_rate_scale" in result.output and "--force" in result.output
    (one,) = json.loads((tmp_path / "o" / "details.json").read_text())["experiments"]
    assert one["used"] == ["rfs_turn_a"]
    assert select_names(one["findings"][FILE_NAME], "error") == {"yaw_rate_scale"}
    assert "Findings in the recordings" in (tmp_path / "o" / "report.html").read_text()
    alone = st("identify", "steering-offset", faulty_drive, "--vehicle", CAR, "--output", tmp_path / "p")
    assert alone.exit_code == 2 and "yaw_rate_scale" in alone.output
    forced = st("identify", "steering-offset", faulty_drive, DRIVE, "--vehicle", CAR, "--output", tmp_path / "q",
                "--force")
    assert forced.exit_code in (0, 1) and "left out: " not in forced.output


@pytest.mark.slow
def test_discover_excludes_a_run_with_an_error(faulty_drive, tmp_path):
    result = st("discover", faulty_drive, "--vehicle", CAR, "--output", tmp_path / "o", "--fresh")
    assert result.exit_code == 2 and "no run can be used" in result.output and "yaw_rate_scale" in result.output
    car = VehicleParameters.from_yaml(CAR.read_text())
    sources = find_runs([faulty_drive, DRIVE])
    for _ in range(2):  # the second time from the cache
        faulty, correct = read_drives(sources, car, ReadSettings(), 1, lambda: None)
        assert faulty.log is None and "yaw_rate_scale" in faulty.problem
        assert select_names(findings_as_json(faulty.findings), "error") == {"yaw_rate_scale"}
        assert correct.log is not None and not correct.problem and correct.findings
    (forced,) = read_drives(sources[:1], car, ReadSettings(), 1, lambda: None, force=True)
    assert forced.log is not None and select_names(findings_as_json(forced.findings), "error") == {"yaw_rate_scale"}
