"""`st export`: exported functions can be loaded or compiled and agree with the equations."""

import ctypes
import json
import shutil
import subprocess
import sys

import numpy as np
import pytest
from st_cli.cli import app
from st_core.augmented import augment
from st_core.bands import Bands, CalibrationDomain, ErrorSamples, calibrate, conditions
from st_core.bands.file import hash_configuration
from st_core.integrate import rk4_step
from st_core.log_evaluation import EvaluationSettings
from st_core.model_file import ModelFile, ModelProvenance
from st_core.models import MODELS
from st_core.prediction import PredictionSettings
from st_core.vehicle import VehicleParameters
from support import ROOT
from typer.testing import CliRunner

casadi = pytest.importorskip("casadi", reason="casadi is not installed")

STATE, INPUTS, H = (1.0, 2.0, 12.0, 0.2, 0.3, 0.25), (0.06, -0.8), 0.05
EFFECTS = {"tyre_relaxation": {"length": 0.4}, "road_bank": {"angle": 0.05}, "steering_delay": {"time": 0.05}}


def vehicle(name="leaf"):
    path = ROOT / "config" / "vehicle" / f"{name}.yaml"
    return VehicleParameters.from_yaml(path.read_text(), str(path))


@pytest.fixture
def augmented(tmp_path):
    path = tmp_path / "model.yaml"
    path.write_text(ModelFile.of(augment("nonlinear", EFFECTS), vehicle(), ModelProvenance()).to_yaml())
    return path


def run(*arguments):
    return CliRunner().invoke(app, ["export", *map(str, arguments)])


def expected_step(model, car):
    p = model.parameters(car)
    w = model.inputs(*INPUTS, p)
    state = model.start_state(STATE, w, p)
    return state, rk4_step(model.rhs, state, w, w, w, p, H)


@pytest.mark.parametrize("name", MODELS)
def test_casadi_files_load_without_the_suite(tmp_path, name):
    out = tmp_path / "out"
    assert run(name, "--vehicle", ROOT / "config/vehicle/leaf.yaml", "--output", out).exit_code == 0
    state, expected = expected_step(MODELS[name], vehicle())
    code = (f"import casadi, json; f = casadi.Function.load({str(out / f'{name}_step.casadi')!r}); "
            f"print(json.dumps(f({list(state)}, {list(INPUTS)}, {H}).full().ravel().tolist()))")
    there = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=tmp_path)
    np.testing.assert_allclose(json.loads(there.stdout), expected, rtol=1e-12, atol=1e-12)
    jacobian = casadi.Function.load(str(out / f"{name}_step_jacobian.casadi"))
    assert [m.shape for m in jacobian(state, INPUTS, H)] == [(6, 6), (6, 2)]


@pytest.mark.skipif(shutil.which("gcc") is None, reason="no gcc")
def test_c_compiles_and_agrees(tmp_path, augmented):
    out = tmp_path / "out"
    result = run(augmented, "--format", "c", "--output", out, "--substeps", 2)
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


def test_content_of_the_description(tmp_path, augmented):
    out = tmp_path / "out"
    assert run(augmented, "--output", out, "--free", "road_bank.angle").exit_code == 0
    printed = json.loads((out / "model.json").read_text())
    assert (printed["model"], printed["base"], printed["substeps"]) == ("augmented", "nonlinear", 1)
    assert printed["vehicle"]["hash"] == vehicle().hash
    assert [(s["name"], s["unit"]) for s in printed["states"]][-2:] == [
        ("tyre_relaxation.slip_front", "rad"), ("tyre_relaxation.slip_rear", "rad")]
    assert [i["name"] for i in printed["inputs"]] == ["road_wheel_angle", "velocity_x_dot"]
    assert printed["parameters"] == [{"name": "road_bank.angle", "unit": "rad", "lower": -0.3, "upper": 0.3,
                                      "value": 0.05}]
    assert printed["effects_not_in_the_equations"] == ["steering_delay"]
    assert printed["functions"]["augmented_step"]["arguments"] == {"x": [8, 1], "u": [2, 1], "h": [1, 1], "p": [1, 1]}
    assert sorted(printed["files"]) == sorted(f.name for f in out.iterdir() if f.suffix == ".casadi")
    readme = (out / "README.md").read_text()
    assert "augmented_step.casadi" in readme and "Not in the equations: steering_delay" in readme


def test_bands_are_written_as_functions_of_state_and_inputs(tmp_path):
    draw = np.random.default_rng(1)
    time = 0.5 * np.arange(1, 11)
    runs = [ErrorSamples(f"run {k}", draw.uniform(0.0, (26.0, 8.0, 6.0, 1.0), (400, 4)),
                         {("linear", "hindsight"): 0.1 * draw.standard_normal((400, 1, 3)) * time[:, None]})
            for k in range(10)]
    settings, question = EvaluationSettings(PredictionSettings(step=0.5)), ("linear", "hindsight")
    bands = Bands(vehicle().name, vehicle().hash, settings.as_dict(), {"drawn": "0" * 64}, len(runs),
                  CalibrationDomain.of([one.conditions for one in runs]), {question: calibrate(runs, question, time)},
                  {"linear": hash_configuration(vehicle(), settings.as_dict(), "")})
    file, out = tmp_path / "bands.yaml", tmp_path / "out"
    file.write_text(bands.to_yaml())
    assert run("linear", "--bands", file, "--output", out).exit_code == 0
    ins_v_x = STATE[2] - STATE[5] * vehicle().cg_to_ins_y
    here = conditions(np.array([ins_v_x]), np.array([STATE[5]]), np.array([INPUTS[1]]), np.array([0.02]))
    for level, name in ((0.5, "50"), (0.9, "90")):
        written = casadi.Function.load(str(out / f"linear_band_hindsight_{name}.casadi"))
        np.testing.assert_allclose(np.array(written(STATE, INPUTS, 0.02)),
                                   bands.half_widths("linear", "hindsight", here, level)[0, 1:], rtol=1e-9)
    refused = run("kinematic", "--bands", file, "--output", tmp_path / "other")
    assert refused.exit_code == 2 and "the bands have no entry for model kinematic, only for linear" in refused.output


@pytest.mark.parametrize(("arguments", "message"), [
    (["bicycle"], "bicycle: unknown model; use kinematic, linear, nonlinear or a model file (.yaml)"),
    (["linear", "--free", "road_bank.angle"], "'road_bank.angle' is not a parameter"),
    (["none.yaml"], "No such file"),
])
def test_what_is_refused(tmp_path, arguments, message):
    result = run(*arguments, "--output", tmp_path / "out")
    assert result.exit_code == 2 and message in result.output and len(result.output.splitlines()) == 1


@pytest.mark.parametrize("embed", [False, True])
def test_a_model_file_requires_its_car(tmp_path, embed):
    path = tmp_path / "model.yaml"
    path.write_text(ModelFile.of(augment("linear", ["mass"]), vehicle(), ModelProvenance(), embed=embed).to_yaml())
    wrong = run(path, "--vehicle", ROOT / "config/vehicle/hyundai_genesis.yaml", "--output", tmp_path / "out")
    assert wrong.exit_code == 2 and "the values are valid for" in wrong.output
    assert run(path, "--output", tmp_path / "out").exit_code == 0
