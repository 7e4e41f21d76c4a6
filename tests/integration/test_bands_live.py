"""Bands in st demo and st replay over DDS: bands of the predictions, coverage by the evaluator, warnings."""

import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")
pytest.importorskip("st_msgs", reason="needs the built workspace")

from bags import nanoseconds, read_messages
from command_line import st
from drives import write_drive
from st_core.bands import Bands, activity_instants, conditions_at
from st_core.log_evaluation import EvaluationSettings
from st_process import run_st
from st_recordings.runs.bag import read_bag
from st_sim.run import main
from support import LEAF, read_car
from winding_road import Truth, winding_road

pytestmark = [
    pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(900),
    pytest.mark.timing("nodes run in real time; one that waits for its turn skips ticks"),
]
MODELS = ("kinematic", "linear", "nonlinear")
WARN = 1
MAX_NOT_COMPARED = 20  # predictions per model: the recorder may receive the inputs 2 s later than the predictor


def road(path: Path, seconds: float, seed: int, offset: float = 0.0) -> Path:
    """A drive of the Leaf on a winding road. offset: of the steering wheel [rad], not in the vehicle file."""
    car = read_car("leaf")
    truth = Truth(offset, car.steering_ratio, 0.95)
    time, x, y, yaw, forward, across, rate, _ = winding_road(car, truth, seconds, seed, 0.0).T
    steering_wheel = winding_road(car, truth, seconds, seed, 0.5)[:, 7]
    ahead, left = np.gradient(forward, time) - across * rate, np.gradient(across, time) + forward * rate
    return write_drive(path, np.stack([time, x, y, yaw, forward, across, rate, ahead, left,
                                       car.road_wheel_angle(steering_wheel)], axis=1))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Bands of ten drives, and two runs with them: the same car live, and one with a steering offset in a replay, which
    is faster than real time."""
    base = tmp_path_factory.mktemp("bands")
    for seed in range(10):
        road(base / "calibration" / f"road_{seed}.csv", 40.0, seed)
    succeed("calibrate", base / "calibration", "--vehicle", LEAF, "--output", base / "bands.yaml")
    bands = "--bands", base / "bands.yaml", "--no-adaptive"
    run_st("demo", "--drive", road(base / "same.csv", 20.0, 20), "--vehicle", LEAF, *bands, "--output", base / "same")
    assert main(["--drive", str(road(base / "offset.csv", 44.0, 20, 0.5)), "--vehicle", str(LEAF), "--to-files",
                 str(base / "offset_files")]) == 0
    succeed("import", base / "offset_files", "--output", base / "offset_bag")
    run_st("replay", base / "offset_bag", "--fast", "--vehicle", LEAF, *bands, "--output", base / "offset")
    return base


def succeed(*arguments: object) -> None:
    result = st(*arguments)
    assert result.exit_code == 0, result.output


def recorded_half_widths(run: Path) -> dict[str, dict[int, dict[tuple[str, float], np.ndarray]]]:
    """By model, start [ns], and (mode, level)."""
    messages = read_messages(run / "bag", [f"/predictor/{m}/prediction" for m in MODELS])
    return {model: {nanoseconds(m.header.stamp): {(b.mode, b.level): np.stack([b.along, b.across, b.yaw], axis=1)
                                                  for b in m.bands}
                    for m in messages[f"/predictor/{model}/prediction"]} for model in MODELS}


def compare_with_library(run: Path, file: Path) -> int:
    """Compares the bands in a bag with those of the library for its measurements; returns the number of bands.

    If the recorder discovers the inputs later than the predictor, the bag lacks part of the steering and acceleration
    from which the predictor computed its first bands.
    """
    bands, log = Bands.from_yaml(file.read_text()), read_bag(run / "bag").log
    signals, compared = EvaluationSettings().signals(log), 0
    recorded_ns = max(int(log.ins_time_ns[0]), int(log.steering_time_ns[0]))
    for model, by_start in recorded_half_widths(run).items():
        complete = {start: bool(activity_instants(start)[0] >= recorded_ns) for start in by_start}
        assert sum(bool(by_start[start]) for start in by_start if not complete[start]) <= MAX_NOT_COMPARED
        starts = np.array(sorted(start for start in by_start if complete[start]))
        conditions = conditions_at(signals, starts)
        computed = {(mode, level): bands.half_widths(model, mode, conditions, level)
                    for mode in ("forecast", "hindsight") for level in (0.5, 0.9)}
        for row, start in enumerate(starts.tolist()):
            for (mode, level), widths in by_start[start].items():
                expected = computed[mode, level][row]
                assert widths.shape == expected.shape
                assert (np.abs(widths - expected) <= np.maximum(1e-4 * np.abs(expected), 1e-5)).all()
                compared += 1
    return compared


def test_bands_of_predictions_equal_the_library_live_and_in_a_replay(folder: Path) -> None:
    file = folder / "bands.yaml"
    assert compare_with_library(folder / "same", file) > 4 * 3 * 100
    run_st("replay", folder / "same" / "bag", "--fast", "--bands", file, "--output", folder / "replay")
    assert compare_with_library(folder / "replay", file) > 4 * 3 * 100
    played, recorded = (read_bag(folder / run / "bag").log for run in ("same", "replay"))
    for name in ("ins_time_ns", "steering_time_ns"):  # all samples: the player waits for its subscribers
        assert np.array_equal(getattr(played, name), getattr(recorded, name))


def test_coverage_of_the_calibrated_car_is_scored_and_not_warned_about(folder: Path) -> None:
    summary = json.loads((folder / "same" / "summary.json").read_text())["models"]
    for model in MODELS:
        for mode in ("forecast", "hindsight"):
            scores = summary[model][mode]
            assert 50 < scores["bands"]["n"] <= scores["n_starts"]
            assert scores["lateral"]["rmse"] < 5.0
            assert scores["bands"]["0.5"] <= scores["bands"]["0.9"] and scores["bands"]["0.9"] > 0.6
    assert not [text for text in band_warnings(folder / "same") if "significantly below" in text]


def band_warnings(run: Path) -> set[str]:
    """Warnings of the checks on bands in predictor and evaluator."""
    arrays = read_messages(run / "bag", ["/diagnostics"])["/diagnostics"]
    return {status.message for array in arrays for status in array.status
            if status.name.endswith("bands") and status.level == WARN}


def test_low_coverage_of_a_car_unlike_the_calibrated_one_is_warned_about(folder: Path) -> None:
    texts = band_warnings(folder / "offset")
    parts = ("coverage of bands is or was significantly below", "hindsight of linear (", "nominal level 90 %")
    assert any(all(part in text for part in parts) for text in texts), texts
    summary = json.loads((folder / "offset" / "summary.json").read_text())["models"]
    assert summary["linear"]["hindsight"]["bands"]["0.9"] < 0.3


def test_bands_of_another_car_are_rejected_in_one_line_before_a_node_starts(folder: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.yaml"
    other.write_text(LEAF.read_text().replace("mass: {value: 1", "mass: {value: 2", 1))
    for arguments, reason in ((("--vehicle", other), "the bands are for"), ((), "unknown key")):
        file = LEAF if not arguments else folder / "bands.yaml"
        result = st("demo", *arguments, "--bands", file, "--output", tmp_path / "run")
        text = result.output.strip()
        assert result.exit_code == 2 and reason in text and len(text.splitlines()) == 1, text
