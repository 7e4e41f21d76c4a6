"""`st export`: exported functions can be loaded or compiled and agree with the equations."""

import ctypes
import json
import shutil
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from command_line import st
from st_core.augmented import augment
from st_core.bands import Bands, CalibrationDomain, ErrorSamples, calibrate, compute_conditions
from st_core.bands.file import hash_configuration
from st_core.integrate import rk4_step
from st_core.log_evaluation import EvaluationSettings
from st_core.model_file import ModelFile, ModelProvenance
from st_core.models import MODELS
from st_core.prediction import PredictionSettings
from st_core.vehicle import VehicleParameters
from support import LEAF, ROOT

casadi = pytest.importorskip("casadi", reason="casadi is not installed")

STATE, INPUTS, H = (1.0, 2.0, 12.0, 0.2, 0.3, 0.25), (0.06, -0.8), 0.05
EFFECTS = {"tyre_relaxation": {"length": 0.4}, "road_bank": {"angle": 0.05}, "steering_delay": {"time": 0.05},
           "sensor_lever_arm": {"x": 0.2, "y": 0.05}}


def vehicle(name="leaf"):
    path = ROOT / "config" / "vehicle" / f"{name}.yaml"
    return VehicleParameters.from_yaml(path.read_text(), str(path))


@pytest.fixture
def augmented(tmp_path):
    path = tmp_path / "model.yaml"
    path.write_text(ModelFile.from_model(augment("nonlinear", EFFECTS), vehicle(), ModelProvenance()).to_yaml())
    return path


def export(*arguments):
    return st("export", *arguments, columns=80)


def expected_step(model, car):
    """Start state and the state after one step H with constant inputs, integrated by RK4."""
    p = model.parameters(car)
    w = model.inputs(*INPUTS, p)
    state = model.start_state(STATE, w, p)
    return state, rk4_step(model.rhs, state, w, w, w, p, H)


@pytest.mark.parametrize("name", MODELS)
def test_exported_casadi_step_loads_without_the_suite_and_agrees(tmp_path, name):
    out = tmp_path / "out"
    assert export(name, "--vehicle", LEAF, "--output", out).exit_code == 0
    state, expected = expected_step(MODELS[name], vehicle())
    code = (f"import casadi, json; f = casadi.Function.load({str(out / f'{name}_step.casadi')!r}); "
            f"print(json.dumps(f({list(state)}, {list(INPUTS)}, {H}).full().ravel().tolist()))")
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=tmp_path)
    np.testing.assert_allclose(json.loads(process.stdout), expected, rtol=1e-12, atol=1e-12)
    jacobian = casadi.Function.load(str(out / f"{name}_step_jacobian.casadi"))
    assert [m.shape for m in jacobian(state, INPUTS, H)] == [(6, 6), (6, 2)]


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("gcc") is None, reason="no gcc")
def test_exported_c_code_compiles_and_agrees(tmp_path, augmented):
    out = tmp_path / "out"
    result = export(augmented, "--format", "c", "--output", out, "--substeps", 2)
    assert result.exit_code == 0, result.output
    user = tmp_path / "user.c"
    user.write_text('#include "augmented.h"\nint main(void) { return augmented_step_n_in() == 3 ? 0 : 1; }\n')
    flags = ["gcc", "-std=c99", "-O1", "-Wall", "-Werror", f"-I{out}"]
    subprocess.run([*flags, user, out / "augmented.c", "-lm", "-o", tmp_path / "user"], check=True)
    subprocess.run([tmp_path / "user"], check=True)
    library = tmp_path / "augmented.so"
    subprocess.run([*flags, "-fPIC", "-shared", out / "augmented.c", "-lm", "-o", library], check=True)
    compiled = casadi.external("augmented_step", str(library))

    model = augment("nonlinear", EFFECTS)
    p = model.parameters(vehicle())
    w = model.inputs(*INPUTS, p)
    state = expected = model.start_state(STATE, w, p)
    for _ in range(2):
        expected = rk4_step(model.rhs, expected, w, w, w, p, H / 2)
    np.testing.assert_allclose(compiled(state, INPUTS, H).full().ravel(), expected, rtol=1e-12, atol=1e-12)
    assert hasattr(ctypes.CDLL(str(library)), "augmented_dynamics_jacobian")


def test_content_of_the_model_description(tmp_path, augmented):
    out = tmp_path / "out"
    assert export(augmented, "--output", out, "--free", "road_bank.angle").exit_code == 0
    description = json.loads((out / "model.json").read_text())
    assert (description["model"], description["base"], description["substeps"]) == ("augmented", "nonlinear", 1)
    assert description["vehicle"]["hash"] == vehicle().hash
    assert description["vehicle"]["cg_to_ins_x"] == pytest.approx(vehicle().cg_to_ins_x + 0.2)
    assert [(s["name"], s["unit"]) for s in description["states"]][-2:] == [
        ("tyre_relaxation.slip_front", "rad"), ("tyre_relaxation.slip_rear", "rad")]
    assert [i["name"] for i in description["inputs"]] == ["road_wheel_angle", "velocity_x_dot"]
    assert description["parameters"] == [{"name": "road_bank.angle", "unit": "rad", "lower": -0.3, "upper": 0.3,
                                      "value": 0.05}]
    assert description["omitted_effects"] == ["steering_delay"]
    arguments = description["functions"]["augmented_step"]["arguments"]
    assert arguments == {"x": [8, 1], "u": [2, 1], "h": [1, 1], "p": [1, 1]}
    assert sorted(description["files"]) == sorted(f.name for f in out.iterdir() if f.suffix == ".casadi")
    readme = (out / "README.md").read_text()
    assert "INS -0.198 m ahead, 0.05 m left of the CG." in readme
    assert "road-wheel angle is positive to the left. velocity_x_dot is the derivative of velocity_x" in readme
    assert "augmented_step.casadi" in readme and "Not in the equations: steering_delay" in readme


@pytest.mark.parametrize(("run_count", "levels"), [
    (10, {0.5: "50", 0.9: "90"}), (5, {0.5: "50", 0.8: "80"}), (10, {0.5: "50", 0.904: "90_4"})])
def test_bands_are_exported_as_functions_of_state_and_inputs(tmp_path, run_count, levels):
    rng = np.random.default_rng(1)
    time = 0.5 * np.arange(1, 11)
    runs = [ErrorSamples(f"run {k}", rng.uniform(0.0, (26.0, 8.0, 6.0, 1.0), (2000, 4)),
                         {("linear", "hindsight"): 0.1 * rng.standard_normal((2000, 1, 3)) * time[:, None]})
            for k in range(run_count)]
    settings, key = EvaluationSettings(PredictionSettings(step=0.5)), ("linear", "hindsight")
    bands = Bands(vehicle().name, vehicle().hash, settings.as_dict(), {"drawn": "0" * 64}, len(runs),
                  CalibrationDomain.from_runs([one.conditions for one in runs]),
                  {key: calibrate(runs, key, time, tuple(levels))},
                  {"linear": hash_configuration(vehicle(), settings.as_dict(), "")})
    file, out = tmp_path / "bands.yaml", tmp_path / "out"
    file.write_text(bands.to_yaml())
    assert export("linear", "--bands", file, "--output", out).exit_code == 0
    ins_v_x = STATE[2] - STATE[5] * vehicle().cg_to_ins_y
    start = compute_conditions(np.array([ins_v_x]), np.array([STATE[5]]), np.array([INPUTS[1]]), np.array([0.02]))
    for level, name in levels.items():
        exported = casadi.Function.load(str(out / f"linear_band_hindsight_{name}.casadi"))
        np.testing.assert_allclose(np.array(exported(STATE, INPUTS, 0.02)),
                                   bands.half_widths("linear", "hindsight", start, level)[0, 1:], rtol=1e-9)
    description = json.loads((out / "model.json").read_text())
    assert sorted(description["files"]) == sorted(f.name for f in out.iterdir() if f.suffix == ".casadi")
    assert "linear_band_" in (out / "README.md").read_text()
    result = export("kinematic", "--bands", file, "--output", tmp_path / "other")
    assert result.exit_code == 2 and "bands.kinematic: missing; the file has linear" in result.output
    result = export("linear", "--car", "hyundai_genesis", "--bands", file, "--output", tmp_path / "other")
    assert result.exit_code == 2 and "calibrate with drives of this car" in result.output


@pytest.mark.parametrize(("arguments", "message"), [
    (["bicycle"], "bicycle: unknown model; use kinematic, linear, nonlinear or a model file (.yaml)"),
    (["linear", "--free", "road_bank.angle"], "'road_bank.angle' is not a parameter"),
    (["none.yaml"], "No such file"),
])
def test_wrong_arguments_are_rejected_in_one_line(tmp_path, arguments, message):
    result = export(*arguments, "--output", tmp_path / "out")
    assert result.exit_code == 2 and message in result.output and len(result.output.splitlines()) == 1


@pytest.mark.parametrize("embed", [False, True])
def test_model_file_requires_its_car(tmp_path, embed):
    path = tmp_path / "model.yaml"
    file = ModelFile.from_model(augment("linear", ["mass"]), vehicle(), ModelProvenance())
    path.write_text((file if embed else replace(file, vehicle=None)).to_yaml())
    wrong = export(path, "--vehicle", ROOT / "config/vehicle/hyundai_genesis.yaml", "--output", tmp_path / "out")
    assert wrong.exit_code == 2 and "the values are valid for" in wrong.output
    assert export(path, "--output", tmp_path / "out").exit_code == 0
