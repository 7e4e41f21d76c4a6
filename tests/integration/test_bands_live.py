"""Bands over real DDS: st demo and st replay with a bands file, what predictions state, what the evaluator counts."""

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")
pytest.importorskip("st_msgs", reason="needs the built workspace")

from bags import read_messages
from drives import write_drive
from st_core.bands import Bands, activity_instants, conditions_at
from st_core.log_evaluation import EvaluationSettings
from st_core.vehicle import VehicleParameters
from st_recordings.runs.bag import read_bag
from support import ROOT
from winding_road import Truth, winding_road

pytestmark = [
    pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(900),
    pytest.mark.timing("nodes run in real time; one that waits for its turn skips ticks"),
]
LEAF = ROOT / "config" / "vehicle" / "leaf.yaml"
MODELS = ("kinematic", "linear", "nonlinear")
WARN = 1
MOST_UNCOMPARED = 20  # predictions of a model: the recorder found the inputs two seconds after the predictor


def st(*arguments: object, status: tuple[int, ...] = (0,)) -> str:
    done = subprocess.run([str(ROOT / "st"), *map(str, arguments)], check=False, capture_output=True, text=True,
                          cwd=ROOT, timeout=240)
    assert done.returncode in status, done.stdout + done.stderr
    return done.stdout + done.stderr


def road(path: Path, seconds: float, seed: int, offset: float = 0.0) -> Path:
    """A drive of the Leaf on a winding road. offset: of the steering wheel, not in the vehicle file [rad]."""
    car = VehicleParameters.from_yaml(LEAF.read_text())
    truth = Truth(offset, car.steering_ratio, 0.95)
    time, x, y, yaw, forward, across, rate, _ = winding_road(car, truth, seconds, seed, 0.0).T
    steering_wheel = winding_road(car, truth, seconds, seed, 0.5)[:, 7]
    ahead, left = np.gradient(forward, time) - across * rate, np.gradient(across, time) + forward * rate
    return write_drive(path, np.stack([time, x, y, yaw, forward, across, rate, ahead, left,
                                       car.road_wheel_angle(steering_wheel)], axis=1))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Bands of ten drives, and two runs with them: the same car, and one with its steering off."""
    base = tmp_path_factory.mktemp("bands")
    for seed in range(10):
        road(base / "known" / f"road_{seed}.csv", 40.0, seed)
    st("calibrate", base / "known", "--vehicle", LEAF, "--output", base / "bands.yaml")
    for name, seconds, offset in (("same", 20.0, 0.0), ("off", 50.0, 0.5)):
        st("demo", "--drive", road(base / f"{name}.csv", seconds, 20, offset), "--bands", base / "bands.yaml",
           "--no-adaptive", "--output", base / name)
    return base


def stated(run: Path) -> dict[str, dict[int, dict[tuple[str, float], np.ndarray]]]:
    """Half-widths by model, start, and mode and level."""
    messages, found = read_messages(run / "bag", [f"/predictor/{m}/prediction" for m in MODELS]), {}
    for model in MODELS:
        found[model] = {
            m.header.stamp.sec * 10**9 + m.header.stamp.nanosec: {
                (b.mode, b.level): np.stack([b.along, b.across, b.yaw], axis=1) for b in m.bands}
            for m in messages[f"/predictor/{model}/prediction"]}
    return found


def compare(run: Path, file: Path) -> int:
    """Every band in a bag against the library on what was measured there; returns how many there are.

    Predictor and recorder find the inputs each in its own time. Where the recorder was later, a bag does not hold all
    of the steering that the first bands of the predictor were made of (nor, for less long, what its acceleration was).
    """
    bands, log = Bands.from_yaml(file.read_text()), read_bag(run / "bag").log
    signals, compared = EvaluationSettings().signals(log), 0
    recorded_ns = max(int(log.ins_time_ns[0]), int(log.steering_time_ns[0]))
    for model, by_start in stated(run).items():
        known = {start: bool(activity_instants(start)[0] >= recorded_ns) for start in by_start}
        assert sum(bool(by_start[start]) for start in by_start if not known[start]) <= MOST_UNCOMPARED
        starts = np.array(sorted(start for start in by_start if known[start]))
        here = conditions_at(signals, starts)
        wanted = {key: bands.half_widths(model, key[0], here, key[1])
                  for key in ((m, p) for m in ("forecast", "hindsight") for p in (0.5, 0.9))}
        for row, start in enumerate(starts.tolist()):
            for (mode, level), widths in by_start[start].items():
                expected = wanted[mode, level][row]
                assert widths.shape == expected.shape
                assert (np.abs(widths - expected) <= np.maximum(1e-4 * np.abs(expected), 1e-5)).all()
                compared += 1
    return compared


def test_predictions_carry_what_the_library_says_live_and_in_a_replay(folder: Path) -> None:
    file = folder / "bands.yaml"
    assert compare(folder / "same", file) > 4 * 3 * 100
    st("replay", folder / "same" / "bag", "--fast", "--bands", file, "--output", folder / "again")
    assert compare(folder / "again", file) > 4 * 3 * 100
    played, heard = (read_bag(folder / run / "bag").log for run in ("same", "again"))
    for name in ("ins_time_ns", "steering_time_ns"):  # to the last sample: the player waits until all have it
        assert np.array_equal(getattr(played, name), getattr(heard, name))


def test_the_evaluator_counts_what_lay_inside(folder: Path) -> None:
    summary = json.loads((folder / "same" / "summary.json").read_text())["models"]
    for model in MODELS:
        for mode in ("forecast", "hindsight"):
            one = summary[model][mode]
            assert 50 < one["bands"]["n"] <= one["n_starts"]
            assert one["bands"]["0.5"] <= one["bands"]["0.9"] and one["bands"]["0.9"] > 0.6
    assert not [text for text in messages(folder / "same") if "far less" in text]


def messages(run: Path) -> set[str]:
    """What the check on bands of predictor and evaluator warned of."""
    arrays = read_messages(run / "bag", ["/diagnostics"])["/diagnostics"]
    return {status.message for array in arrays for status in array.status
            if status.name.endswith("bands") and status.level == WARN}


def test_a_car_that_is_not_the_one_calibrated_with_is_warned_of(folder: Path) -> None:
    texts = messages(folder / "off")
    parts = ("coverage of bands is far below", "hindsight of linear (", "nominal level 90%")
    assert any(all(part in text for part in parts)
               for text in texts), texts
    summary = json.loads((folder / "off" / "summary.json").read_text())["models"]
    assert summary["linear"]["hindsight"]["bands"]["0.9"] < 0.3


def test_bands_of_another_car_are_refused_in_one_line_before_a_node_starts(folder: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.yaml"
    other.write_text(LEAF.read_text().replace("mass: {value: 1", "mass: {value: 2", 1))
    for arguments, words in ((("--vehicle", other), "the bands are for"), ((), "unknown key")):
        file = LEAF if not arguments else folder / "bands.yaml"
        text = st("demo", *arguments, "--bands", file, "--output", tmp_path / "run", status=(2,)).strip()
        assert words in text and len(text.splitlines()) == 1, text
