"""The commands st calibrate and st evaluate --bands on drives with known errors."""

import json
import shutil

import pytest
from command_line import st
from drives import weave, write_drive, write_vehicle
from support import LEAF


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Ten drives of one car for calibration, two more for the test; bands of the linear model."""
    base = tmp_path_factory.mktemp("bands")
    for k in range(12):
        file = "known/second_day/weave_1.csv" if k == 9 else f"{'known' if k < 9 else 'new'}/weave_{k}.csv"
        write_drive(base / file, weave(16.0, 7.0 + 0.15 * k, 0.02))
    write_vehicle(base / "car.yaml", LEAF)
    shutil.copy(base / "known" / "weave_0.csv", base / "known" / "copy.csv")
    write_drive(base / "known" / "short.csv", weave(3.0))
    result = st("calibrate", base / "known", "--vehicle", base / "car.yaml", "--model", "linear", "--output",
                base / "bands.yaml")
    return base, result


@pytest.mark.slow
def test_calibrate_reports_excluded_runs_and_supported_levels(folder):
    base, result = folder
    assert result.exit_code == 1, result.output
    text = " ".join(result.output.split())
    assert "less than the horizon of 5 s" in text and "has the same content as" in text
    assert "bands of linear from 10 runs" in text and "10 runs support levels up to 90.9 %" in text
    assert (base / "bands.yaml").read_text().count("weave_1.csv") == 2  # files with the same name in two folders


@pytest.mark.slow
def test_recordings_of_one_folder_count_as_one_run_with_together(folder, tmp_path):
    base, _ = folder
    recordings = [base / "known" / f"weave_{k}.csv" for k in range(3)]
    arguments = (*recordings, base / "new", "--vehicle", base / "car.yaml", "--model", "linear", "--together",
                 "--output", tmp_path / "bands.yaml")
    result = st("calibrate", *arguments)
    assert result.exit_code == 2 and "4 runs support levels up to 80.0 %" in result.output
    done = st("calibrate", *arguments, "--level", 0.8)
    assert done.exit_code == 0 and "from 4 runs" in done.output
    assert "weave_10" in (tmp_path / "bands.yaml").read_text()


def test_level_in_percent_is_rejected_before_a_run_is_read(tmp_path):
    result = st("calibrate", tmp_path, "--level", 90, "--output", tmp_path / "bands.yaml")
    assert result.exit_code == 2 and result.output == "st calibrate: level 90: must be between 0 and 1; 90 % is 0.9\n"


@pytest.mark.slow
def test_evaluate_scores_bands_on_unseen_drives(folder, tmp_path):
    base, _ = folder
    result = st("evaluate", base / "new", "--vehicle", base / "car.yaml", "--model", "linear", "--bands",
                base / "bands.yaml", "--figures", "png", "--output", tmp_path / "o")
    assert result.exit_code == 0, result.output
    content = json.loads((tmp_path / "o" / "evaluation.json").read_text())
    whole = content["bands_all_runs"]
    assert whole["known_recordings"] == [] and set(content["bands"]) == {"weave_10", "weave_11"}
    for scores in whole["models"]["linear"].values():
        assert scores["starts"] > 50 and 0.0 <= scores["coverage"]["0.5"] <= scores["coverage"]["0.9"] <= 1.0
        assert scores["coverage"]["0.9"] > 0.5  # the same car on the same road, a little faster
        assert 0.0 < scores["crps"]["lateral"] < scores["interval_score"]["0.9"]["lateral"]
        assert scores["half_width"]["0.5"]["5"]["lateral"] < scores["half_width"]["0.9"]["5"]["lateral"]
    assert (tmp_path / "o" / "bands_reliability.png").stat().st_size > 5000
    shares = whole["shares"]["linear"]
    assert shares["starts"] > 50 and set(shares["share"]) == {"parameters", "sensors and start", "residual"}
    assert sum(part["5"]["lateral"] for part in shares["share"].values()) == pytest.approx(1.0)
    assert shares["share"]["sensors and start"]["5"]["lateral"] > 0.0
    assert "Decomposition of the error" in result.output
    page = (tmp_path / "o" / "report.html").read_text()
    assert "<h2>Bands</h2>" in page and "Reliability of the bands" in page


@pytest.mark.slow
def test_calibration_recordings_are_reported_as_no_test(folder, tmp_path):
    base, _ = folder
    result = st("evaluate", base / "known" / "weave_1.csv", "--vehicle", base / "car.yaml", "--model", "linear",
                "--bands", base / "bands.yaml", "--figures", "", "--output", tmp_path / "o")
    assert "this is not an independent test of the bands" in " ".join(result.output.split())


def test_bands_of_another_car_or_model_are_rejected_in_one_line(folder, tmp_path):
    base, _ = folder
    for arguments, fragment in ((("--vehicle", LEAF, "--model", "linear"), "the bands are for"),
                                (("--vehicle", base / "car.yaml", "--model", "kinematic"), "bands.kinematic: missing")):
        result = st("evaluate", base / "new", *arguments, "--bands", base / "bands.yaml", "--output", tmp_path / "o")
        assert result.exit_code == 2 and fragment in result.output, result.output
        assert len(result.output.strip().splitlines()) == 1 and not (tmp_path / "o").exists()


def test_bands_that_are_not_text_are_rejected_with_the_name_of_the_file(tmp_path):
    (tmp_path / "bands.yaml").write_bytes(b"schema: \xff")
    result = st("evaluate", tmp_path, "--bands", tmp_path / "bands.yaml")
    assert result.exit_code == 2 and f"st evaluate: {tmp_path / 'bands.yaml'}: cannot be read" in result.output


def test_too_few_runs_write_no_file_and_existing_file_is_kept(folder, tmp_path):
    base, _ = folder
    few = st("calibrate", base / "new", "--vehicle", base / "car.yaml", "--model", "linear", "--output",
             tmp_path / "b.yaml")
    assert few.exit_code == 2 and "2 runs support levels up to 66.7 %" in few.output
    assert not (tmp_path / "b.yaml").exists()
    second = st("calibrate", base / "new", "--vehicle", base / "car.yaml", "--output", base / "bands.yaml")
    assert second.exit_code == 2 and "bands.yaml exists: " in second.output
