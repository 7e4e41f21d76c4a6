"""Inputs of st discover: drives, model files, and rejections in one line."""

import json
from dataclasses import replace

import numpy as np
import pytest
from command_line import st
from drives import circle, weave, write_drive, write_vehicle
from st_core.augmented import augment
from st_core.errors import ConfigurationError
from st_core.log import DriveLog
from st_core.model_file import ModelFile, ModelProvenance
from st_core.vehicle import VehicleParameters
from st_live.configuration import make_model_parameters
from st_live.suite import SuiteError
from st_offline.discovery.discover_command import _check_reference
from st_offline.discovery.drives import collect_clock_deviations, pool_sensor_estimates, read_drive, read_drives
from st_recordings.runs import ReadSettings, find_runs
from support import LEAF, ROOT

GENESIS = ROOT / "config" / "vehicle" / "hyundai_genesis.yaml"
NOISE = np.array([0.01, 0.01, 0.0005, 0.02, 0.02, 0.002, 0.05, 0.05, 0.0005])
"""Standard deviations of x, y, yaw, vx, vy, yaw_rate, ax, ay, delta, SI."""


def load_vehicle(path) -> VehicleParameters:
    return VehicleParameters.from_yaml(path.read_text(), str(path))


def discover(*arguments):
    return st("discover", *arguments, columns=80)


@pytest.fixture
def drive(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return write_drive(tmp_path / "drive.csv", weave(8.0))


def are_equal(a: DriveLog, b: DriveLog) -> bool:
    return a.name == b.name and all(np.array_equal(getattr(a, n), getattr(b, n)) for n in (
        "ins_time_ns", "x", "y", "yaw", "velocity_x", "velocity_y", "yaw_rate", "steering_time_ns", "road_wheel_angle",
        "acceleration_y"))


def test_parallel_and_serial_reading_give_equal_drives(drive, tmp_path):
    other = write_drive(tmp_path / "other.csv", weave(7.0))
    sources, ticks = find_runs([drive, other, tmp_path / "none.csv"]), []
    alone, parallel = (read_drives(sources, load_vehicle(LEAF), ReadSettings(), jobs, lambda: ticks.append(1))
                       for jobs in (1, 2))
    assert [d.problem != "" for d in parallel] == [d.problem != "" for d in alone] and len(ticks) == 6
    for a, b in zip(alone, parallel, strict=True):
        assert (a.log is None and b.log is None) or are_equal(a.log, b.log)


@pytest.mark.parametrize(("arguments", "message"), [
    (["--base", "wrong"], "--base wrong: unknown model; use kinematic, linear, nonlinear or a model file"),
    (["--base", "none.yaml"], "--base none.yaml: cannot be read: No such file"),
    (["--channels", "speed"], "channels: 'speed' is not one of velocity_y, yaw_rate"),
    (["--channels", ""], "at least one of velocity_y, yaw_rate"),
    (["--figures", "gif"], "--figures: gif is not one of"),
    (["--reference", "nowhere"], "no --reference run can be used: "),
])
def test_wrong_options_are_rejected_in_one_line(drive, tmp_path, arguments, message):
    result = discover(drive, "--output", tmp_path / "o", *arguments)
    assert result.exit_code == 2 and message in result.output and "Traceback" not in result.output


def test_missing_and_damaged_recordings_are_rejected(drive, tmp_path):
    broken = tmp_path / "broken.csv"
    broken.write_text(drive.read_text().partition("\n")[2])  # without its header
    for path, message in ((tmp_path / "none.csv", "the file or folder does not exist"), (broken, "broken.csv")):
        result = discover(path, "--output", tmp_path / "o")
        assert result.exit_code == 2 and "no run can be used: " in result.output and message in result.output


def test_rows_without_a_number_are_excluded_and_reported(drive, tmp_path):
    first, *rows = drive.read_text().splitlines()

    def with_nan(column: str, some: slice) -> None:
        cells = [row.split(",") for row in rows]
        for row in cells[some]:
            row[first.split(",").index(column)] = "nan"
        drive.write_text("\n".join([first, *(",".join(row) for row in cells)]) + "\n")
    with_nan("yaw_rate", slice(100, 150))
    read = read_drive(find_runs([drive])[0], load_vehicle(LEAF), ReadSettings())
    assert "yaw_rate (column yaw_rate): 50 of 400 rows (12 %) have no number" in read.metadata["warnings"][0]
    with_nan("vx", slice(None))
    result = discover(drive, "--output", tmp_path / "o")
    assert result.exit_code == 2 and "fewer than two usable rows" in result.output


def test_deviations_of_aligned_clocks_are_collected(drive):
    read = read_drive(find_runs([drive])[0], load_vehicle(LEAF), ReadSettings())
    assert collect_clock_deviations([read]) == {}  # one clock
    poor = replace(read, metadata={**read.metadata, "clock_deviation_s": 0.039})
    assert collect_clock_deviations([replace(read, name="other"), poor]) == {read.name: 0.039}
    unknown = replace(poor, metadata={"clock_deviation_s": None})
    assert collect_clock_deviations([replace(poor, log=None), unknown]) == {}


def test_drive_is_rejected_as_its_own_reference(drive, tmp_path):
    copy = tmp_path / "healthy" / "copy.csv"
    copy.parent.mkdir()
    copy.write_bytes(drive.read_bytes())
    result = discover(drive, "--reference", copy, "--output", tmp_path / "o")
    assert result.exit_code == 2 and "is given as a run and as --reference" in result.output


def test_reference_of_another_car_is_rejected(drive, tmp_path):
    """Recordings of the suite contain their vehicle file, whose name identifies the car."""
    def read_with_car(car_name, file):
        read = read_drive(find_runs([write_drive(tmp_path / file, weave(9.0))])[0], load_vehicle(LEAF), ReadSettings())
        digest = {"files": {file: file}, "vehicle": car_name}
        return replace(read, name=file, metadata={**read.metadata, **digest})
    leaf, genesis, unknown = (read_with_car(name, file) for name, file in (
        ("Leaf", "a.csv"), ("Genesis", "b.csv"), ("", "c.csv")))
    with pytest.raises(ConfigurationError, match=r"--reference b\.csv was recorded with 'Genesis', a\.csv"):
        _check_reference([leaf], [unknown, genesis])
    _check_reference([leaf, unknown], [read_with_car("Leaf", "d.csv"), read_with_car("", "e.csv")])


def test_reference_option_takes_all_paths_and_needs_remaining_runs(drive, tmp_path):
    healthy = [write_drive(tmp_path / "healthy" / f"{name}.csv", weave(seconds)) for name, seconds in
               (("a", 9.0), ("b", 10.0))]
    for arguments in (["--figures", "gif", drive, "--reference", *healthy],
                      ["--figures", "gif", "--reference", *healthy, "--", drive]):
        assert "--figures: gif is not one of" in discover(*arguments).output
    result = discover("--reference", drive, *healthy)
    assert result.exit_code == 2 and "no runs are left: --reference takes every path" in " ".join(
        result.output.replace("│", " ").split())


def test_sensor_estimates_of_the_checks_are_pooled_over_runs(tmp_path):
    files = [write_drive(tmp_path / f"{seconds:.0f}.csv", weave(seconds)) for seconds in (30.0, 40.0)]
    one, two = read_drives(find_runs(files), load_vehicle(LEAF), ReadSettings(), 1, lambda: None)
    alone, both = pool_sensor_estimates([one]), pool_sensor_estimates([one, two])
    assert alone["yaw_rate_bias"] == tuple(one.metadata["estimates"]["yaw_rate_bias"])
    value, low, high = both["yaw_rate_bias"]
    assert low <= value <= high and set(both) >= set(alone)


def test_effect_file_that_fails_to_load_is_reported_in_one_line(drive, tmp_path):
    (tmp_path / "effects").mkdir()
    (tmp_path / "effects" / "broken.py").write_text("import nothing_of_this_name\n")
    result = discover(drive, "--effects", tmp_path / "effects", "--output", tmp_path / "o")
    assert result.exit_code == 2 and "broken.py: cannot be loaded: ModuleNotFoundError" in result.output


def test_model_file_of_another_car_is_rejected(drive, tmp_path):
    model = tmp_path / "model.yaml"
    lag = augment("nonlinear", {"steering_lag": {"time_constant": 0.1}})
    model.write_text(ModelFile.from_model(lag, load_vehicle(GENESIS), ModelProvenance()).to_yaml())
    result = discover(drive, "--base", model, "--output", tmp_path / "o")
    assert result.exit_code == 2 and "the values are valid for 'Hyundai Genesis'" in result.output
    with pytest.raises(ConfigurationError, match="the values are valid for 'Hyundai Genesis'"):
        make_model_parameters(model, None, LEAF)
    assert make_model_parameters(model, None, GENESIS) == {"model_file": str(model), "effects_directory": ""}


def test_invalid_model_file_of_the_fourth_model_is_rejected(tmp_path):
    (tmp_path / "model.yaml").write_text("base: nonlinear\neffects: {no_such: {}}\n")
    with pytest.raises(ConfigurationError, match="no_such"):
        make_model_parameters(tmp_path / "model.yaml", None, LEAF)
    with pytest.raises(SuiteError, match="requires a model file"):
        make_model_parameters(None, tmp_path, LEAF)
    assert make_model_parameters(None, None, LEAF) == {}


def test_output_folder_is_not_overwritten(drive, tmp_path):
    (tmp_path / "o").mkdir()
    (tmp_path / "o" / "precious.txt").write_text("x")
    result = discover(drive, "--output", tmp_path / "o")
    assert result.exit_code == 2 and "is not empty" in result.output


def test_too_short_run_is_rejected_with_the_required_length(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    result = discover(write_drive(tmp_path / "short.csv", weave(3.0)), "--output", tmp_path / "o")
    assert result.exit_code == 2 and "no run is long enough: a run needs 7 s" in result.output


def discover_in_noisy_drives(tmp_path, *rows, change=str):
    """Result (discovery.json) and output of st discover for drives of the given rows plus noise; no report."""
    rng, files = np.random.default_rng(5), []
    for number, given in enumerate(rows):
        noisy = given.copy()
        noisy[:, 1:] += rng.normal(size=noisy[:, 1:].shape) * NOISE
        files.append(write_drive(tmp_path / "in" / f"{number}.csv", noisy))
    files[0].write_text(change(files[0].read_text()))
    car = write_vehicle(tmp_path / "car.yaml", LEAF)
    result = st("discover", *files, "--vehicle", car, "--no-report", "--output", tmp_path / "o", columns=300,
                XDG_CACHE_HOME=str(tmp_path / "cache"))
    assert result.exit_code == 0 and "Traceback" not in result.output, result.output
    return json.loads((tmp_path / "o" / "discovery.json").read_text()), result.output


@pytest.mark.slow
def test_straight_driving_is_reported_as_insufficient(tmp_path):
    content, message = discover_in_noisy_drives(tmp_path, weave(15.0, curvature=1e-9), weave(15.0, 10.0, 1e-9))
    assert content["outcome"] in ("not_testable", "none") and not content["effects"]
    assert {"friction", "mass", "front_stiffness"} <= {n["name"] for n in content["not_testable"]}
    assert "driving is straight" in message and "2 runs only" in message


@pytest.mark.slow
def test_turns_to_one_side_and_a_single_run_are_reported(tmp_path):
    _, message = discover_in_noisy_drives(tmp_path, circle(40.0))
    assert "nearly all turns are to one side" in message and "one run only" in message
    assert "suspect: 1 run, 40 s: 0 40 s" in message and "reference: none" in message


@pytest.mark.slow
def test_channel_missing_in_one_run_is_excluded_and_reported(tmp_path):
    def without_acceleration(text):
        rows = [line.split(",") for line in text.splitlines()]
        return "\n".join(",".join(row[:8] + row[9:]) for row in rows) + "\n"
    content, message = discover_in_noisy_drives(tmp_path, weave(20.0), weave(20.0, 10.0), change=without_acceleration)
    assert "acceleration_y" not in content["errors"] and "velocity_y" in content["errors"]
    assert "acceleration_y" in message and "0" in message
