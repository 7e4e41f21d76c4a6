"""Columns, units and corrections in a run.yaml: a drive with falsified columns is read as the original."""

import math
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
from drives import COLUMNS, weave, write_drive
from st_core.log import INS_SIGNALS, DriveLog
from st_core.types import body_to_map
from st_recordings.runs import LoadedRun, RunError, find_runs, read

NAMES = COLUMNS.split(",")


def load(folder: Path, text: str, **distortions) -> LoadedRun:
    """Reads the weave with a run.yaml, columns replaced by functions of (values, all original columns)."""
    rows = weave(10.0)
    original = dict(zip(NAMES, rows.T.copy(), strict=True))
    columns = {name: distortions[name](values, original) if name in distortions else values
               for name, values in original.items()}
    write_drive(folder / "drive.csv", np.stack(list(columns.values()), axis=1))
    (folder / "run.yaml").write_text("name: weave\ncsv: drive.csv\n" + text)
    (source,) = find_runs([folder / "run.yaml"])
    return read(source)


@pytest.fixture(scope="module")
def true_log(tmp_path_factory: pytest.TempPathFactory) -> DriveLog:
    return load(tmp_path_factory.mktemp("true"), "").log


def assert_same(log: DriveLog, true_log: DriveLog, tolerance: float = 1e-4) -> None:
    rows = np.minimum(np.searchsorted(true_log.ins_time_ns, log.ins_time_ns), len(true_log.x) - 1)
    np.testing.assert_array_equal(true_log.ins_time_ns[rows], log.ins_time_ns)
    for name in (*INS_SIGNALS, "acceleration_y"):
        np.testing.assert_allclose(getattr(log, name), getattr(true_log, name)[rows], atol=tolerance, err_msg=name)
    np.testing.assert_allclose(log.road_wheel_angle, true_log.road_wheel_angle, atol=tolerance)


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
    "reference point": ("correct: {position: {ahead: -1.5}}", {
        "x": lambda v, c: v + 1.5 * np.cos(c["yaw"]), "y": lambda v, c: v + 1.5 * np.sin(c["yaw"])}),
    "misalignment": ("correct: {heading: {add: -0.0098}}", {
        "yaw": lambda v, _: v + 0.0098, "vx": lambda v, c: body_to_map(c["vx"], c["vy"], -0.0098)[0],
        "vy": lambda v, c: body_to_map(c["vx"], c["vy"], -0.0098)[1],
        "ax": lambda v, c: body_to_map(c["ax"], c["ay"], -0.0098)[0],
        "ay": lambda v, c: body_to_map(c["ax"], c["ay"], -0.0098)[1]}),
}


@pytest.mark.parametrize("case", CASES)
def test_run_yaml_restores_the_original_drive(tmp_path: Path, true_log: DriveLog, case: str) -> None:
    text, distortions = CASES[case]
    if case == "late":  # the first 0.3 s were not recorded, the last 0.3 s are unknown
        text += "\nleave_out: [[0, 0.3]]"
    run = load(tmp_path, text, **distortions)
    assert case != "late" or len(run.log.x) == len(true_log.x) - 16 - 15
    assert_same(run.log, true_log)
    with pytest.raises(AssertionError) if case != "wrapped degrees for radians" else nullcontext():
        assert_same(load(tmp_path, "", **distortions).log, true_log)


def test_corrections_are_reported_in_checks_provenance_and_warnings(tmp_path: Path) -> None:
    run = load(tmp_path, "correct: {yaw_rate: {scale: 0.01745}}\nleave_out: [[2, 3.5]]")
    phrases = ("yaw_rate x 0.01745", "INS samples left out from 2 to 3.5 s")
    assert run.auxiliary.corrections == phrases and run.provenance["corrected"] == list(phrases)
    assert any(w.endswith("corrected by its run.yaml: " + "; ".join(phrases)) for w in run.warnings)
    plain = load(tmp_path, "")
    assert plain.auxiliary.corrections == () and not plain.warnings and "corrected" not in plain.provenance
    assert plain.provenance["columns"]["velocity_x"] == "vx [m/s, assumed]"


def test_labels_keep_their_absolute_times(tmp_path: Path) -> None:
    run = load(tmp_path, "labels: [{name: bend, start: 4, end: 6}]\nleave_out: [[0, 0.99]]")
    (label,) = run.labels
    start = run.log.ins_time_ns[0] * 1e-9 + label.start
    assert start == pytest.approx(4.0) and label.end - label.start == pytest.approx(2.0)


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
def test_invalid_columns_units_or_corrections_are_rejected(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(RunError, match=rf"run\.yaml: {message}"):
        load(tmp_path, text)


def test_names_of_columns_and_units_of_a_bag_are_rejected(tmp_path: Path) -> None:
    (tmp_path / "bag").mkdir()
    for text in ("columns: {yaw: heading_deg}", "units: {yaw: deg}"):
        (tmp_path / "run.yaml").write_text(f"bag: bag\n{text}\n")
        with pytest.raises(RunError, match=r"run\.yaml: only csv and vbo files have columns and units; .* `correct:`"):
            read(find_runs([tmp_path / "run.yaml"])[0])


def test_corrections_that_leave_no_samples_are_rejected(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"drive\.csv: .*leave no INS sample"):
        load(tmp_path, "correct: {yaw: {earlier: 60}}")
    with pytest.raises(RunError, match="fewer than two measurements of INS or steering"):
        load(tmp_path, "leave_out: [[0, 60]]")
