"""A fourth model from a model file: predicted and scored over DDS, in addition to the three, on an exact circle.

Its effects are chosen so that the circle is its steady state; the three other models have errors.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")
pytest.importorskip("st_msgs", reason="needs the built workspace")

from bags import nanoseconds, read_messages, stamps, trim_to_common_start
from circle_feeder import pose_at
from rclpy.node import Node
from ros_processes import Processes, wait_for
from scipy.optimize import fsolve
from st_core.augmented import augment
from st_core.model_file import ModelFile, ModelProvenance
from st_core.vehicle import VehicleParameters
from st_predictor.nodes.evaluator import EvaluatorNode
from st_predictor.nodes.predictor import PredictorNode
from support import LEAF, ROOT

pytestmark = [pytest.mark.ros, pytest.mark.timing("nodes run in real time; one that waits for its turn skips ticks")]
RADIUS, SPEED, ANGLE, DURATION = 30.0, 8.0, 0.09, 9.0  # m, m/s, rad of the road wheels, s
MODELS = ("kinematic", "linear", "nonlinear", "augmented")
MIN_TICKS = 20  # of an overloaded machine


def make_circle_model(car: VehicleParameters) -> ModelFile:
    """Rear stiffness and steering offset with which the linear model follows the feeder's circle, and a lag."""
    yaw_rate = SPEED / RADIUS
    state = (0.0, 0.0, SPEED, -car.cg_to_ins_x * yaw_rate, 0.0, yaw_rate)

    def model(unknown):
        factor, offset = map(float, unknown)
        return augment("linear", {"rear_stiffness": {"factor": factor}, "steering_offset": {"angle": offset},
                                  "steering_lag": {"time_constant": 0.1}})

    def residual(unknown):
        p = model(unknown).parameters(car)
        return np.array(model(unknown).rhs(state, model(unknown).inputs(ANGLE, 0.0, p), p))[[3, 5]]

    balanced = model(fsolve(residual, [0.5, 0.0], xtol=1e-12))
    return ModelFile.from_model(balanced, car, ModelProvenance(note="steady circle"))


@dataclass
class Run:
    zero_ns: int
    folder: Path
    file: ModelFile
    messages: dict[str, list[Any]] = field(default_factory=dict)
    errors: dict[str, list[Any]] = field(default_factory=dict)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    folder = tmp_path_factory.mktemp("augmented")
    file = make_circle_model(VehicleParameters.from_yaml(LEAF.read_text()))
    (folder / "model.yaml").write_text(file.to_yaml())
    processes = Processes(folder)
    try:
        chosen = f"vehicle_file:={LEAF}", f"model_file:={folder / 'model.yaml'}"
        nodes = [processes.node("st_predictor", "predictor", *chosen),
                 processes.node("st_predictor", "evaluator", *chosen, f"output_directory:={folder / 'errors'}"),
                 processes.node("st_predictor", "recorder", f"output_directory:={folder / 'bag'}")]
        received = [f"--wait-for=predictor/{m}/{kind}" for m in MODELS for kind in ("path:1", "prediction:2")]
        feeder = processes.start([
            sys.executable, str(ROOT / "tests" / "circle_feeder.py"), "--subscribers", "3", "--duration", str(DURATION),
            "--radius", str(RADIUS), "--speed", str(SPEED), "--angle", str(ANGLE), *received], "feeder")
        assert feeder.wait(60) == 0, processes.log("feeder")
        assert [processes.stop(node) for node in nodes] == [0, 0, 0]
    finally:
        processes.close()
    return Run(int(processes.log("feeder").split()[1]), folder, file, read_messages(folder / "bag"),
               read_messages(folder / "errors"))


def test_every_tick_has_four_predictions_and_paths(run: Run) -> None:
    ticks, *others = trim_to_common_start(
        *(stamps(run.messages[f"/predictor/{model}/{kind}"]) for model in MODELS for kind in ("prediction", "path")))
    assert len(ticks) > MIN_TICKS
    assert all(other == ticks for other in others)


def test_augmented_path_follows_the_circle(run: Run) -> None:
    paths = run.messages["/predictor/augmented/path"]
    for path in paths[5:]:
        t = (nanoseconds(path.header.stamp) - run.zero_ns) * 1e-9 + 0.05 * np.arange(101)
        truth = np.array([pose_at(k, RADIUS, SPEED)[:2] for k in t])
        points = [(p.pose.position.x, p.pose.position.y) for p in path.poses]
        np.testing.assert_allclose(points, truth, atol=2e-3)


def test_augmented_model_has_no_error_in_both_modes(run: Run) -> None:
    summary = run.messages["/evaluator/summary"][-1]
    rows = {(s.model, s.mode): s for s in summary.statistics}
    assert rows.keys() == set(product(MODELS, ("forecast", "hindsight")))
    for mode in ("forecast", "hindsight"):
        # Topics are matched independently, so the first predictions of a model may be lost.
        assert min(rows["augmented", mode].n_starts, rows["linear", mode].n_starts) > 10
        assert rows["augmented", mode].lateral_max < 2e-3
        assert abs(rows["linear", mode].lateral_mean) > 0.2


def test_configuration_hash_distinguishes_the_augmented_model(run: Run) -> None:
    hashes = {m: {p.configuration_hash for p in run.messages[f"/predictor/{m}/prediction"]} for m in MODELS}
    assert hashes["kinematic"] == hashes["linear"] == hashes["nonlinear"]
    assert all(len(h) == 1 for h in hashes.values()) and hashes["augmented"] != hashes["linear"]
    scored = {m: {e.configuration_hash for e in run.errors["/evaluator/errors"] if e.model == m} for m in MODELS}
    assert scored == hashes


def test_errors_are_recorded_with_their_model_file(run: Run) -> None:
    from mcap.reader import make_reader

    with (run.folder / "errors" / "errors_0.mcap").open("rb") as stream:
        records = {record.name: record.metadata for record in make_reader(stream).iter_metadata()}
    assert ModelFile.from_yaml(records["configuration"]["model"]) == run.file
    assert records["configuration"]["model_hash"] == run.file.hash


OWN_EFFECT = '''
"""Yaw damping by a tow hook, for a test."""

from st_core.effects import Effect, Parameter, register


@register
class TowHook(Effect):
    name = "tow_hook"
    physics = "r_dot = r_dot - gain r"
    excited_by = "turning"
    kind, slot = "physics", "body"
    parameters = (
        Parameter("gain", "1/s", null=0.0, initial=0.5, bounds=(0.0, 5.0), meaning="damping", source="test"),
    )

    @staticmethod
    def acceleration(instant, prepared, theta):
        zero = 0.0 * instant.yaw_rate
        return zero, zero, -theta.gain * instant.yaw_rate
'''
MODEL = """
base: linear
effects:
  {effect}:
    {entry}
"""
MASS = MODEL.format(effect="mass", entry='factor: {value: 1.1, unit: "1"}')
TOW_HOOK = MODEL.format(effect="tow_hook", entry='gain: {value: 0.5, unit: "1/s"}')
ANOTHER_CAR = MASS + 'vehicle: {name: "Truck", hash: "abcdef"}\n'


@pytest.mark.parametrize(("node", "text", "message"), [
    (PredictorNode, None, "model.yaml: No such file"),
    (PredictorNode, MASS.replace("1.1", "9.0"), "effects.mass.factor: 9.0 is outside 0.6 to 2"),
    (PredictorNode, TOW_HOOK, "unknown effect 'tow_hook'"),
    (PredictorNode, ANOTHER_CAR, "the values are valid for 'Truck' abcdef"),
    (EvaluatorNode, ANOTHER_CAR, "the values are valid for 'Truck' abcdef"),
])
def test_invalid_model_file_is_rejected_in_one_line(
        refuse: Callable[..., str], tmp_path: Path, node: type[Node], text: str | None, message: str):
    path = tmp_path / "model.yaml"
    if text:
        path.write_text(text)
    line = refuse(node, f"vehicle_file:={LEAF}", f"model_file:={path}")
    assert "model_file: " in line and message in line


def test_own_effects_are_loaded_from_their_folder(processes: Processes) -> None:
    (processes.folder / "effects").mkdir()
    (processes.folder / "effects" / "tow_hook.py").write_text(OWN_EFFECT)
    (processes.folder / "model.yaml").write_text(TOW_HOOK)
    node = processes.node("st_predictor", "predictor", f"vehicle_file:={LEAF}",
                          f"model_file:={processes.folder / 'model.yaml'}",
                          f"effects_directory:={processes.folder / 'effects'}")
    wait_for(lambda: "linear, nonlinear, augmented of" in processes.log("predictor"), 60, "predictor up")
    assert processes.stop(node) == 0


def test_missing_folder_of_effects_is_rejected(refuse: Callable[..., str]) -> None:
    line = refuse(PredictorNode, f"vehicle_file:={LEAF}", "effects_directory:=/nowhere")
    assert "effects_directory: /nowhere: not a folder of effects" in line
