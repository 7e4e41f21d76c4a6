"""The command st effects, and a proposed effect file in the commands that accept a model file."""

import json
from pathlib import Path

import numpy as np
import pytest
import typer
from command_line import st
from drives import weave, write_drive
from effect_registry import restored
from st_cli.verbs._options import report_errors
from st_core.augmented import augment
from st_core.effects import EFFECTS, find_source_file, load_folder
from st_core.model_file import ModelFile
from st_core.relations import Candidate, Relation, RelationSearch
from st_core.vehicle import VehicleParameters
from st_offline.discovery.relation_report import write_files
from support import LEAF

CAR = VehicleParameters.from_yaml(LEAF.read_text())


registry = pytest.fixture(autouse=True)(restored)


@pytest.fixture
def proposal(tmp_path):
    """A folder with a proposed effect: a rear axle that steers with the lateral acceleration."""
    c = Candidate("rear_steer", "acceleration_y", -1.0, -6.0, 6.0)
    at = np.linspace(-6.0, 6.0, 41)
    heights = np.linalg.lstsq(c.compute_splines(at).T, 0.001 * at, rcond=1e-6)[0]
    one = Relation(c, heights, at, heights @ c.compute_splines(at), 0.0 * at, 0.0 * at + 1 / 41, 0.1, 0.001,
                   (0.8, 0.5), {}, augment("nonlinear", {"mass": {"factor": 1.1}}))
    write_files(RelationSearch(one, "", {}), CAR, ["lap"], "2026-01-01", {}, tmp_path)
    assert not any(name.startswith("proposed_") for name in EFFECTS)  # the registry of later tests is unchanged
    return tmp_path


def test_library_is_listed():
    shown = st("effects").output
    assert all(name in shown for name in EFFECTS)
    roll_steer = shown.partition("\nroll_steer ")[2].partition("hard to separate")[0]
    assert "acts on: slip angles, additional states" in roll_steer


def test_own_effects_are_listed_if_their_folder_is_given(proposal):
    assert "proposed_rear_steer" in st("effects", "list", "--effects", proposal / "effects").output


@pytest.mark.slow
def test_proposed_file_meets_all_requirements(proposal):
    result = st("effects", "check", proposal / "effects" / "proposed_rear_steer.py")
    assert result.exit_code == 0 and "proposed_rear_steer: all requirements met" in result.output, result.output
    assert result.output.count("  ok   ") == 8


def test_library_file_can_be_checked():
    result = st("effects", "check", find_source_file(EFFECTS["yaw_rate_bias"]))
    assert result.exit_code == 0 and "yaw_rate_bias: all requirements met" in result.output, result.output


@pytest.mark.slow
def test_violated_requirement_is_reported_with_exit_status_1(proposal):
    file = proposal / "effects" / "proposed_rear_steer.py"
    hook = "RelationEffect.slip_angles"
    shifted = f"lambda front, rear, *more: {hook}(front + 0.001, rear, *more)"
    file.write_text(file.read_text().replace(f"staticmethod({hook})", f"staticmethod({shifted})"))
    result = st("effects", "check", file)
    assert result.exit_code == 1
    assert "FAIL null values leave predictions bit-identical: null values change a state" in result.output


@pytest.mark.parametrize(("arguments", "fragment"), [
    (("check", "nothing.py"), "nothing.py: does not exist"),
    (("check", __file__.replace(".py", ".csv")), "the name of an effect file must end in .py"),
    (("describe",), "'describe' is not one of")])
def test_wrong_arguments_are_rejected_in_one_line(arguments, fragment):
    result = st("effects", *arguments)
    assert result.exit_code == 2 and fragment in result.output


@pytest.mark.slow
def test_model_file_with_a_proposed_effect_is_evaluated_and_exported(proposal, tmp_path):
    drive = write_drive(tmp_path / "weave.csv", weave(20.0))
    options = ("--model", "nonlinear", "--model", proposal / "proposed.yaml", "--vehicle", LEAF, "--figures", "",
               "--output")
    result = st("evaluate", drive, *options, tmp_path / "no")
    assert result.exit_code == 2 and "proposed_rear_steer" in result.output
    result = st("evaluate", drive, *options, tmp_path / "out", "--effects", proposal / "effects")
    assert result.exit_code == 0, result.output
    models = json.loads((tmp_path / "out" / "evaluation.json").read_text())["runs"]["weave"]
    errors = {m: models[m]["hindsight"]["lateral"]["rmse"] for m in ("nonlinear", "augmented")}
    assert errors["nonlinear"] != errors["augmented"]
    result = st("export", proposal / "proposed.yaml", "--effects", proposal / "effects", "--output",
                tmp_path / "exported")
    assert result.exit_code == 0, result.output
    description = json.loads((tmp_path / "exported" / "model.json").read_text())
    assert "proposed_rear_steer" in description["effects"]


@pytest.mark.slow
def test_drives_are_identified_with_a_proposed_effect(proposal, tmp_path):
    drive = write_drive(tmp_path / "weave.csv", weave(60.0))
    arguments = ("identify", "stiffness", drive, "--model", proposal / "proposed.yaml", "--vehicle", LEAF, "--output")
    result = st(*arguments, tmp_path / "out", "--effects", proposal / "effects")
    assert result.exit_code == 0, result.output
    assert "proposed_rear_steer" in (tmp_path / "out" / "identification.json").read_text()
    result = st("identify", "steering-offset", drive, "--model", proposal / "proposed.yaml", "--effects",
                 proposal / "effects", "--output", tmp_path / "no")
    assert result.exit_code == 2 and "steering-offset uses no model" in result.output


def test_model_file_reads_back_as_written(proposal):
    load_folder(str(proposal / "effects"))
    model = ModelFile.from_yaml((proposal / "proposed.yaml").read_text()).model()
    assert model.values["proposed_rear_steer"]["share"] == 1.0 and model.values["mass"] == {"factor": 1.1}


def test_error_of_the_operating_system_names_the_file(capsys):
    with pytest.raises(typer.Exit), report_errors("effects", OSError):
        Path("/nowhere/a.py").read_text()
    assert capsys.readouterr().err == "st effects: /nowhere/a.py: No such file or directory\n"
