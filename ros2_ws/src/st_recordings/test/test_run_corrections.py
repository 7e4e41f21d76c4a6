"""What a run.yaml says of columns, units and faults: a drive spoilt on the way into its file is read as it was."""

import math
from pathlib import Path

import numpy as np
import pytest
from drives import COLUMNS, weave, write_drive
from st_core.log import INS_SIGNALS, DriveLog
from st_core.types import body_to_map
from st_recordings.runs import LoadedRun, RunError, find_runs, read

NAMES = COLUMNS.split(",")


def loaded(folder: Path, text: str, **spoil) -> LoadedRun:
    """The weave, columns spoilt by functions of (value, all columns), read with a run.yaml."""
    rows = weave(10.0)
    columns = dict(zip(NAMES, rows.T.copy(), strict=True))
    given = dict(columns)
    for name, function in spoil.items():
        columns[name] = function(given[name], given)
    write_drive(folder / "drive.csv", np.stack(list(columns.values()), axis=1))
    (folder / "run.yaml").write_text("name: weave\ncsv: drive.csv\n" + text)
    (source,) = find_runs([folder / "run.yaml"])
    return read(source)


@pytest.fixture(scope="module")
def true(tmp_path_factory: pytest.TempPathFactory) -> DriveLog:
    return loaded(tmp_path_factory.mktemp("true"), "").log


def assert_same(log: DriveLog, true: DriveLog, within: float = 1e-4) -> None:
    rows = np.minimum(np.searchsorted(true.ins_time_ns, log.ins_time_ns), len(true.x) - 1)
    np.testing.assert_array_equal(true.ins_time_ns[rows], log.ins_time_ns)
    for name in (*INS_SIGNALS, "acceleration_y"):
        np.testing.assert_allclose(getattr(log, name), getattr(true, name)[rows], atol=within, err_msg=name)
    np.testing.assert_allclose(log.road_wheel_angle, true.road_wheel_angle, atol=within)


CASES = {
    "units": ("units: {yaw: deg, yaw_rate: deg/s, velocity_x: km/h, t: ms, acceleration_y: g}", {
        "yaw": lambda v, _: np.degrees(v), "yaw_rate": lambda v, _: np.degrees(v), "vx": lambda v, _: 3.6 * v,
        "t": lambda v, _: 1e3 * v, "ay": lambda v, _: v / 9.80665}),
    "columns": ("columns: {x: y, y: x}", {"x": lambda v, c: c["y"], "y": lambda v, c: c["x"]}),
    "compass": ("columns: {compass_heading: yaw}\nunits: {compass_heading: deg}", {
        "yaw": lambda v, _: (90.0 - np.degrees(v)) % 360.0}),
    "wrapped degrees for radians": (f"correct: {{yaw: {{scale: {math.pi / 180}}}}}", {
        "yaw": lambda v, _: np.degrees(v + 3.1) % 360.0 - np.degrees(3.1)}),
    "scale and bias": ("correct: {yaw_rate: {scale: 2.0, add: -0.004}, x: {scale: 0.5}}", {
        "yaw_rate": lambda v, _: (v + 0.004) / 2, "x": lambda v, _: 2 * v}),
    "sign": ("correct: {steering: {scale: -1}}", {"delta": lambda v, _: -v}),
    "late": ("correct: {yaw_rate: {earlier: 0.3}}", {
        "yaw_rate": lambda v, c: np.interp(c["t"] - 0.3, c["t"], v)}),
    "another point": ("correct: {position: {ahead: -1.5}}", {
        "x": lambda v, c: v + 1.5 * np.cos(c["yaw"]), "y": lambda v, c: v + 1.5 * np.sin(c["yaw"])}),
    "askew": ("correct: {heading: {add: -0.0098}}", {
        "yaw": lambda v, _: v + 0.0098, "vx": lambda v, c: body_to_map(c["vx"], c["vy"], -0.0098)[0],
        "vy": lambda v, c: body_to_map(c["vx"], c["vy"], -0.0098)[1],
        "ax": lambda v, c: body_to_map(c["ax"], c["ay"], -0.0098)[0],
        "ay": lambda v, c: body_to_map(c["ax"], c["ay"], -0.0098)[1]}),
}


@pytest.mark.parametrize("case", CASES)
def test_spoilt_and_corrected_is_as_it_was(tmp_path: Path, true: DriveLog, case: str) -> None:
    text, spoil = CASES[case]
    run = loaded(tmp_path, text, **spoil)
    if case == "late":  # the first 0.3 s were never recorded, the last 0.3 s are not known
        run = loaded(tmp_path, text + "\nleave_out: [[0, 0.3]]", **spoil)
        assert len(run.log.x) == len(true.x) - 16 - 15
    assert_same(run.log, true)
    with pytest.raises(AssertionError):
        assert_same(loaded(tmp_path, "", **spoil).log, true)


def test_what_was_corrected_is_said_everywhere(tmp_path: Path) -> None:
    run = loaded(tmp_path, "correct: {yaw_rate: {scale: 0.01745}}\nleave_out: [[2, 3.5]]")
    phrases = ("yaw_rate x 0.01745", "INS left out from 2 to 3.5 s")
    assert run.auxiliary.corrected == phrases and run.provenance["corrected"] == list(phrases)
    assert any(w.endswith("corrected by its run.yaml: " + "; ".join(phrases)) for w in run.warnings)
    plain = loaded(tmp_path, "")
    assert plain.auxiliary.corrected == () and not plain.warnings and "corrected" not in plain.provenance
    assert plain.provenance["columns"]["velocity_x"] == "vx [m/s, assumed]"


def test_labels_stay_with_what_they_name(tmp_path: Path) -> None:
    run = loaded(tmp_path, "labels: [{name: bend, start: 4, end: 6}]\nleave_out: [[0, 0.99]]")
    (label,) = run.labels
    at = run.log.ins_time_ns[0] * 1e-9 + label.start
    assert at == pytest.approx(4.0) and label.end - label.start == pytest.approx(2.0)


@pytest.mark.parametrize(("text", "message"), [
    ("columns: [yaw]", "columns: expected a mapping; known keys are t, x, y, latitude"),
    ("columns: {speed: v}", "columns: unknown key speed; known keys are t, x, y, latitude"),
    ("columns: {yaw: 3}", "columns: yaw: 3 is not the name of a column"),
    ("columns: {yaw: course}", r"columns: yaw: drive\.csv has no column 'course'; its columns are t, x, y"),
    ("units: {speed: km/h}", "units: unknown key speed"),
    ("units: {yaw: m}", "units: yaw: 'm' is not a unit of angle; known units are rad, deg, mrad"),
    ("units: {yaw: 57.3}", "units: yaw: '57.3' is not a unit of angle"),
    ("correct: {speed: {scale: 2}}", "correct: unknown key speed; known keys are x, y, position"),
    ("correct: {yaw: 2}", "correct: yaw: expected a mapping; known keys are scale, add, earlier"),
    ("correct: {yaw: {factor: 2}}", "correct: yaw: unknown key factor; known keys are scale, add, earlier"),
    ("correct: {yaw: {scale: much}}", "correct: yaw: scale: 'much' is not a number"),
    ("correct: {yaw: {scale: true}}", "correct: yaw: scale: 'True' is not a number"),
    ("correct: {yaw: {scale: .inf}}", "correct: yaw: scale: 'inf' is not a number"),
    ("correct: {yaw: {earlier: 1.0e+20}}", r"correct: yaw: earlier: 1e\+20 is not within .-60"),
    ("correct: {yaw: {scale: 0}}", "correct: yaw: scale: must not be 0"),
    ("correct: {heading: {scale: 2}}", "correct: heading: unknown key scale; known keys are add"),
    ("correct: {steering: {add: 1}, road_wheel_angle: {add: 1}}", "correct: .* are the same channel"),
    ("leave_out: [3, 4]", r"leave_out: expected a list of \[start, end\]"),
    ("leave_out: [[4, 3]]", r"leave_out: expected a list of \[start, end\]"),
    ("leave_out: 4", r"leave_out: expected a list of \[start, end\]"),
])
def test_a_run_yaml_that_is_wrong(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(RunError, match=rf"run\.yaml: {message}"):
        loaded(tmp_path, text)


def test_columns_and_units_are_of_csv_only(tmp_path: Path) -> None:
    (tmp_path / "bag").mkdir()
    for key in ("columns", "units"):
        (tmp_path / "run.yaml").write_text(f"bag: bag\n{key}: {{yaw: deg}}\n")
        with pytest.raises(RunError, match=rf"{key}: only csv and vbo files have columns, .* with `correct:`"):
            read(find_runs([tmp_path / "run.yaml"])[0])


def test_a_correction_that_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"drive\.csv: .*leave no INS sample"):
        loaded(tmp_path, "correct: {yaw: {earlier: 60}}")
    with pytest.raises(RunError, match="fewer than two measurements of INS or steering"):
        loaded(tmp_path, "leave_out: [[0, 60]]")
