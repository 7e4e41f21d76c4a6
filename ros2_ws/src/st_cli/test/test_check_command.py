"""st check as a user starts it, and the same findings in the other verbs: real drives, unchanged and corrupted."""

import csv
import html
import json
import math
from pathlib import Path

import numpy as np
import pytest
import yaml
from st_cli.cli import app
from st_core.vehicle import VehicleParameters
from st_offline.discovery.drives import read_drives
from st_recordings.runs import ReadSettings, find_runs
from support import ROOT
from typer.testing import CliRunner

DRIVE = ROOT / "examples" / "data" / "rfs_turn_a.csv"
CAR = ROOT / "config" / "vehicle" / "hyundai_genesis.yaml"
DEGREES = 180.0 / math.pi
HOSTILE = "<b>drive</b>"


def st(*arguments):
    return CliRunner().invoke(app, [*map(str, arguments)], env={"COLUMNS": "300"})


def spoilt(file: Path, **factors: float) -> Path:
    """The real drive with columns multiplied."""
    with DRIVE.open(newline="") as stream:
        names, *rows = csv.reader(stream)
    values = np.array(rows, float)
    for name, factor in factors.items():
        values[:, names.index(name)] *= factor
    file.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(file, values, delimiter=",", header=",".join(names), comments="", fmt="%.9g")
    return file


@pytest.fixture(scope="module")
def wrong(tmp_path_factory):
    return spoilt(tmp_path_factory.mktemp("wrong") / f"{HOSTILE.replace('/', '-')}.csv", yaw_rate=DEGREES)


@pytest.fixture(scope="module")
def checked(wrong, tmp_path_factory):
    base = tmp_path_factory.mktemp("checked")
    result = st("check", wrong, DRIVE, base / "nothing.csv", "--vehicle", CAR, "--output", base / "out")
    return base / "out", result, json.loads((base / "out" / "check.json").read_text())


def names(findings, severity):
    return {one["name"] for one in findings if one["severity"] == severity}


def test_it_names_the_wrong_unit_and_exits_with_1(checked):
    folder, result, content = checked
    assert result.exit_code == 1
    run = content["runs"][HOSTILE.replace("/", "-")]
    assert names(run["findings"], "error") == {"yaw_rate_scale"}
    first = run["findings"][0]
    assert first["interval"][0] <= DEGREES <= first["interval"][1] and first["channels"] == ["yaw_rate"]
    assert first["text"] in result.output and first["advice"]["line"] in result.output
    assert run["verdict"] in result.output and "an evaluation would be meaningless" in run["verdict"]
    assert not names(content["runs"]["rfs_turn_a"]["findings"], "error")
    assert list(content["failed"]) == ["nothing.csv"] and "the file or folder does not exist" in result.output
    for name in ("report.html", "check.json"):
        assert str(folder / name) in result.output


def test_the_schema(checked):
    content = checked[2]
    assert set(content) == {"schema", "created", "versions", "vehicle", "runs", "together", "failed"}
    assert content["vehicle"] == {str(CAR): {"name": "Hyundai Genesis", "hash": content["vehicle"][str(CAR)]["hash"]}}
    for run in content["runs"].values():
        assert set(run) >= {"findings", "channels", "comparisons", "verdict", "vehicle", "duration", "warnings",
                            "files"}
        for one in run["findings"]:
            assert set(one) >= {"name", "severity", "channels", "value", "unit", "interval", "text", "where", "effect",
                                "advice", "tried"}
            assert one["severity"] in ("error", "warning", "note") and one["text"]
        for channel in run["channels"].values():
            assert set(channel) >= {"rate", "gaps", "noise", "resolution", "unit", "samples", "repeated", "missing"}
        assert 45.0 < run["channels"]["yaw_rate"]["rate"] < 55.0


def test_the_page_begins_with_the_finding(checked):
    text = (checked[0] / "report.html").read_text()
    assert "<b>drive" not in text and "&lt;b&gt;drive" in text
    assert text.index("Errors in 1 of 2 runs") < text.index("<table")
    for run in checked[2]["runs"].values():
        assert all(one["name"] in text for one in run["findings"])
    assert text.count("<figure>") >= 6


def test_every_possible_finding_is_in_the_manual(checked):
    manual = (ROOT / "docs" / "manual" / "checks.md").read_text()
    for run in checked[2]["runs"].values():
        for one in run["findings"]:
            assert f"`{one['name']}`" in manual, one["name"]


def test_the_cure_it_proposes_cures(wrong, tmp_path):
    cure = tmp_path / "cured" / "run.yaml"
    result = st("check", wrong, "--vehicle", CAR, "--output", tmp_path / "a", "--propose-cure", cure)
    assert result.exit_code == 1 and "# error: yaw_rate_scale: " in cure.read_text()
    assert math.isclose(yaml.safe_load(cure.read_text())["correct"]["yaw_rate"]["scale"], 1 / DEGREES, rel_tol=0.02)
    again = st("check", cure, "--vehicle", CAR, "--output", tmp_path / "b", "--json", tmp_path / "numbers.json")
    assert again.exit_code == 0, again.output
    (run,) = json.loads((tmp_path / "numbers.json").read_text())["runs"].values()
    assert "yaw_rate_scale" not in {one["name"] for one in run["findings"]}
    assert any("yaw_rate" in warning for warning in run["warnings"])  # what was corrected is said
    evaluated = st("evaluate", cure, "--vehicle", CAR, "--model", "kinematic", "--figures", "", "--output",
                   tmp_path / "c")
    assert evaluated.exit_code == 0, evaluated.output
    # A second proposal corrects further what the first one corrected.
    third = tmp_path / "cured" / "more.run.yaml"
    assert st("check", cure, "--vehicle", CAR, "--output", tmp_path / "d", "--propose-cure", third).exit_code == 0
    scale = yaml.safe_load(third.read_text())["correct"]["yaw_rate"]["scale"]
    assert math.isclose(scale, 1 / DEGREES, rel_tol=0.02)


def test_a_cure_is_proposed_for_one_run_only(wrong, tmp_path):
    result = st("check", wrong, DRIVE, "--output", tmp_path / "o", "--propose-cure", tmp_path / "run.yaml")
    assert result.exit_code == 2 and "2 runs were given" in result.output
    assert not (tmp_path / "o").exists() and not (tmp_path / "run.yaml").exists()


def test_nothing_to_read_is_2_and_leaves_nothing(tmp_path):
    result = st("check", tmp_path / "none.csv", "--output", tmp_path / "o")
    assert result.exit_code == 2 and "no run can be read" in result.output and not (tmp_path / "o").exists()


def test_evaluate_leaves_a_meaningless_run_out(wrong, tmp_path, checked):
    quick = ("--vehicle", CAR, "--model", "kinematic", "--figures", "")
    result = st("evaluate", wrong, DRIVE, *quick, "--output", tmp_path / "o")
    assert result.exit_code == 1 and "yaw_rate_scale" in result.output and "--force" in result.output
    content = json.loads((tmp_path / "o" / "evaluation.json").read_text())
    name = HOSTILE.replace("/", "-")
    assert list(content["runs"]) == ["rfs_turn_a"] and list(content["failed"]) == [name]
    assert names(content["refused"][name], "error") == {"yaw_rate_scale"}
    # The same words everywhere.
    other = checked[2]["runs"]["rfs_turn_a"]["findings"]
    assert content["about"]["rfs_turn_a"]["findings"] == other
    page = (tmp_path / "o" / "report.html").read_text()
    for one in (*other, *content["refused"][name]):
        assert f">{one['name']}</code>" in page
        assert one["severity"] == "note" or one["text"] in result.output
    only = st("evaluate", wrong, *quick, "--output", tmp_path / "p")
    assert only.exit_code == 2 and "yaw_rate_scale" in only.output


def test_evaluate_continues_when_forced_and_changes_no_number(wrong, tmp_path):
    quick = ("--vehicle", CAR, "--model", "kinematic", "--figures", "")
    result = st("evaluate", wrong, *quick, "--output", tmp_path / "o", "--force")
    assert result.exit_code == 0 and "error: yaw_rate" in result.output
    (about,) = json.loads((tmp_path / "o" / "evaluation.json").read_text())["about"].values()
    assert names(about["findings"], "error") == {"yaw_rate_scale"}
    numbers = []
    for more in ((), ("--force",)):
        folder = tmp_path / f"good{len(more)}"
        assert st("evaluate", DRIVE, *quick, "--output", folder, *more).exit_code == 0
        numbers.append(json.loads((folder / "evaluation.json").read_text())["runs"])
    assert numbers[0] == numbers[1]


def test_evaluate_reports_a_step_that_is_too_long_and_the_remedy(tmp_path):
    stiff = tmp_path / "stiff.yaml"
    lines = [line if not line.startswith("yaw_inertia:") else
             'yaw_inertia: {value: 1900.0, unit: kg m^2, source: "a test"}' for line in CAR.read_text().splitlines()]
    stiff.write_text("\n".join(lines) + "\n")
    quick = ("--model", "linear", "--model", "nonlinear", "--figures", "")

    def found(vehicle, folder):
        assert st("evaluate", DRIVE, *quick, "--vehicle", vehicle, "--output", folder).exit_code == 0
        (about,) = json.loads((folder / "evaluation.json").read_text())["about"].values()
        return [one for one in about["findings"] if one["name"] == "step_too_long"]

    (one,) = found(stiff, tmp_path / "a")
    assert one["advice"]["kind"] == "vehicle"
    assert one["advice"]["line"] in html.unescape((tmp_path / "a" / "report.html").read_text())
    corrected = tmp_path / "corrected.yaml"
    corrected.write_text("\n".join(line if not line.startswith("minimum_slip_speed:") else one["advice"]["line"]
                                   for line in lines) + "\n")
    assert found(corrected, tmp_path / "b") == []


def test_identify_leaves_a_meaningless_drive_out(wrong, tmp_path):
    result = st("identify", "steering-offset", wrong, DRIVE, "--vehicle", CAR, "--output", tmp_path / "o")
    assert result.exit_code == 0, result.output
    assert "left out: " in result.output and "yaw_rate_scale" in result.output and "--force" in result.output
    (one,) = json.loads((tmp_path / "o" / "details.json").read_text())["experiments"]
    assert one["used"] == ["rfs_turn_a"]
    assert names(one["findings"][HOSTILE.replace("/", "-")], "error") == {"yaw_rate_scale"}
    assert "Findings in the recordings" in (tmp_path / "o" / "report.html").read_text()
    alone = st("identify", "steering-offset", wrong, "--vehicle", CAR, "--output", tmp_path / "p")
    assert alone.exit_code == 2 and "yaw_rate_scale" in alone.output
    forced = st("identify", "steering-offset", wrong, DRIVE, "--vehicle", CAR, "--output", tmp_path / "q", "--force")
    assert forced.exit_code in (0, 1) and "left out: " not in forced.output


def test_discover_leaves_a_meaningless_run_out(wrong, tmp_path):
    result = st("discover", wrong, "--vehicle", CAR, "--output", tmp_path / "o", "--fresh")
    assert result.exit_code == 2 and "no run can be used" in result.output and "yaw_rate_scale" in result.output
    car = VehicleParameters.from_yaml(CAR.read_text())
    sources = find_runs([wrong, DRIVE])
    for _ in range(2):  # the second time from what is kept
        bad, good = read_drives(sources, car, ReadSettings(), 1, lambda: None)
        assert bad.log is None and "yaw_rate_scale" in bad.problem and good.log is not None and not good.problem
        assert names(bad.about["findings"], "error") == {"yaw_rate_scale"} and good.about["findings"]
    (forced,) = read_drives(sources[:1], car, ReadSettings(), 1, lambda: None, force=True)
    assert forced.log is not None and names(forced.about["findings"], "error") == {"yaw_rate_scale"}
