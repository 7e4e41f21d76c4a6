"""The commands st course build, and st evaluate with a course, planned columns or adaptive bands."""

import json

import numpy as np
import pytest
from command_line import st
from drives import COLUMNS, weave, write_drive, write_vehicle
from support import LEAF


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two drives along the same road, of 40 s and 24 s; the course is built from the longer one."""
    base = tmp_path_factory.mktemp("course")
    write_drive(base / "old.csv", weave(40.0))
    write_drive(base / "new.csv", weave(24.0))
    (base / "short.csv").write_text("t,x\n0,1\n")
    car = write_vehicle(base / "car.yaml", LEAF)
    old, output = base / "old.csv", base / "course.yaml"
    return base, st("course", "build", old, base / "short.csv", "--vehicle", car, "-o", output)


def rmse(content, run, mode):
    return content["runs"][run]["kinematic"][mode]["lateral"]["rmse"]


@pytest.mark.slow
def test_course_is_built_and_reduces_the_forecast_error(folder, tmp_path):
    base, built = folder
    assert built.exit_code == 1 and "old: 0.32 km in 1 part" in built.output and "short: " in built.output
    assert st("course", "build", base / "old.csv", "-o", base / "course.yaml").exit_code == 2
    result = st("evaluate", base / "new.csv", base / "old.csv", "--vehicle", base / "car.yaml", "--model", "kinematic",
                "--course", base / "course.yaml", "--figures", "", "--output", tmp_path / "o")
    assert result.exit_code == 0, result.output
    content = json.loads((tmp_path / "o" / "evaluation.json").read_text())
    assert rmse(content, "new", "course") < 0.3 * rmse(content, "new", "forecast")
    # The course is not used for the run that it was built from.
    assert rmse(content, "old", "course") == pytest.approx(rmse(content, "old", "forecast"))
    assert "course" in (tmp_path / "o" / "report.html").read_text()


def write_geographic(path, rows, latitude=48.0):
    """Writes latitude and longitude [deg] in place of x and y; the first row becomes the origin of the map."""
    rows = rows.copy()
    rows[:, 1], rows[:, 2] = latitude + rows[:, 2] / 111_200.0, 9.0 + rows[:, 1] / 74_600.0
    np.savetxt(path, rows, delimiter=",", header=COLUMNS.replace("x,y", "latitude,longitude"), comments="", fmt="%.9f")


@pytest.mark.slow
def test_course_and_run_with_different_origins_share_one_map(folder, tmp_path):
    base, _ = folder
    write_geographic(tmp_path / "old.csv", weave(40.0))
    write_geographic(tmp_path / "later.csv", weave(40.0)[500:])
    write_geographic(tmp_path / "elsewhere.csv", weave(24.0), 48.5)
    assert st("course", "build", tmp_path / "old.csv", "--vehicle", base / "car.yaml", "-o",
              tmp_path / "course.yaml").exit_code == 0
    result = st("evaluate", tmp_path / "later.csv", tmp_path / "elsewhere.csv", "--vehicle", base / "car.yaml",
                "--model", "kinematic", "--course", tmp_path / "course.yaml", "--figures", "", "--output",
                tmp_path / "o")
    content = json.loads((tmp_path / "o" / "evaluation.json").read_text())
    assert rmse(content, "later", "course") < 0.3 * rmse(content, "later", "forecast")
    assert "elsewhere" not in content["runs"] and "map origins are 55.6 km apart" in " ".join(result.output.split())


def test_run_without_an_origin_among_others_is_named(folder, tmp_path):
    base, _ = folder
    write_geographic(tmp_path / "geographic.csv", weave(40.0))
    result = st("course", "build", base / "old.csv", tmp_path / "geographic.csv", "--vehicle", base / "car.yaml", "-o",
                tmp_path / "course.yaml")
    assert result.exit_code == 0 and "warning: old: without a map origin" in result.output


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["inputs", "path"])
def test_planned_columns_add_a_mode(folder, tmp_path, kind):
    base, _ = folder
    rows = weave(24.0)
    time, speed, yaw_rate, angle = rows[:, 0], rows[:, 4], rows[:, 6], rows[:, 9]
    extra = (angle, np.gradient(speed, time)) if kind == "inputs" else (speed, yaw_rate / speed)
    names = ("planned_road_wheel_angle,planned_velocity_x_dot" if kind == "inputs" else
             "planned_speed,planned_curvature")
    np.savetxt(tmp_path / "planned.csv", np.column_stack([rows, *extra]), delimiter=",", header=f"{COLUMNS},{names}",
               comments="", fmt="%.6f")
    result = st("evaluate", tmp_path / "planned.csv", "--vehicle", base / "car.yaml", "--model", "kinematic",
                "--figures", "", "--output", tmp_path / "o")
    assert result.exit_code == 0, result.output
    content = json.loads((tmp_path / "o" / "evaluation.json").read_text())
    assert content["about"]["planned"]["inputs_ahead"] == ["plan"]
    assert rmse(content, "planned", "plan") < 0.02 + rmse(content, "planned", "hindsight")
    assert rmse(content, "planned", "forecast") > 0.5


def test_invalid_course_file_is_rejected(folder, tmp_path):
    base, _ = folder
    (tmp_path / "course.yaml").write_text("schema: 1\n")
    result = st("evaluate", base / "new.csv", "--vehicle", base / "car.yaml", "--course", tmp_path / "course.yaml",
                "--output", tmp_path / "o")
    assert result.exit_code == 2 and "course.yaml" in result.output


def test_missing_recording_is_named_once(tmp_path):
    result = st("course", "build", "nosuch", "-o", tmp_path / "course.yaml")
    assert result.exit_code == 2 and result.output.count("nosuch:") == 1, result.output


@pytest.mark.slow
def test_adaptive_bands_need_no_calibration(folder, tmp_path):
    base, _ = folder
    result = st("evaluate", base / "old.csv", "--vehicle", base / "car.yaml", "--model", "linear", "--adaptive",
                "--figures", "", "--output", tmp_path / "o")
    assert result.exit_code == 0 and "Adaptive bands" in result.output, result.output
    content = json.loads((tmp_path / "o" / "evaluation.json").read_text())
    for one in (content["adaptive_bands"]["old"], content["adaptive_bands_all_runs"]):
        for mode in ("hindsight", "forecast"):
            scores = one["linear"][mode]
            assert scores["starts"] > 300 and 0.2 < scores["coverage"]["0.5"] < scores["coverage"]["0.9"] <= 1.0
            assert scores["late_coverage"]["0.9"] is None  # shorter than two minutes
    assert "Adaptive bands" in (tmp_path / "o" / "report.html").read_text()
