"""st effects as a user starts it, and a proposed effect file in every verb that accepts a model file."""

import json

import numpy as np
import pytest
from drives import weave, write_drive
from effect_registry import restored
from st_cli.cli import app
from st_core.augmented import augment
from st_core.effects import EFFECTS, load_folder, source_file
from st_core.model_file import ModelFile
from st_core.relations import Candidate, Relation, RelationSearch
from st_core.vehicle import VehicleParameters
from st_offline.discovery.relation_files import write_files
from support import ROOT
from typer.testing import CliRunner

LEAF = ROOT / "config" / "vehicle" / "leaf.yaml"
CAR = VehicleParameters.from_yaml(LEAF.read_text())


def st(*arguments):
    return CliRunner().invoke(app, [*map(str, arguments)], env={"COLUMNS": "200"})


registry = pytest.fixture(autouse=True)(restored)


@pytest.fixture
def law(tmp_path):
    """A folder with a proposed effect: a rear axle that steers with the lateral acceleration."""
    c = Candidate("rear_steer", "acceleration_y", -1.0, -6.0, 6.0)
    at = np.linspace(-6.0, 6.0, 41)
    heights = np.linalg.lstsq(c.compute_splines(at).T, 0.001 * at, rcond=1e-6)[0]
    one = Relation(c, heights, at, heights @ c.compute_splines(at), 0.0 * at, 0.0 * at + 1 / 41, 0.1, 0.001,
                   (0.8, 0.5), {},
                   augment("nonlinear", {"mass": {"factor": 1.1}}))
    write_files(RelationSearch(one, "", {}), CAR, ["lap"], "2026-01-01", {}, tmp_path)
    assert not any(name.startswith("proposed_") for name in EFFECTS)  # later searches do not include it
    return tmp_path


def test_the_library_is_listed():
    shown = st("effects").output
    assert all(name in shown for name in EFFECTS)
    roll_steer = shown.partition("\nroll_steer ")[2].partition("hard to separate")[0]
    assert "acts on: slip angles, additional states" in roll_steer


def test_own_effects_are_listed_with_their_folder(law):
    assert "proposed_rear_steer" in st("effects", "list", "--effects", law / "effects").output


def test_a_proposed_file_meets_all_requirements(law):
    result = st("effects", "check", law / "effects" / "proposed_rear_steer.py")
    assert result.exit_code == 0 and "proposed_rear_steer: all requirements met" in result.output, result.output
    assert result.output.count("  ok   ") == 8


def test_a_file_of_the_library_is_checked_as_one_of_your_own():
    result = st("effects", "check", source_file(EFFECTS["yaw_rate_bias"]))
    assert result.exit_code == 0 and "yaw_rate_bias: all requirements met" in result.output, result.output


def test_a_violated_requirement_is_reported_with_an_exit_status(law):
    file = law / "effects" / "proposed_rear_steer.py"
    file.write_text(file.read_text().replace("theta.share * relation(", "theta.share + relation("))
    result = st("effects", "check", file)
    assert result.exit_code == 1 and "FAIL at null it changes nothing, to the last bit: at null" in result.output


@pytest.mark.parametrize(("arguments", "words"), [
    (("check", "nothing.py"), "nothing.py: is not an effect file"), (("describe",), "'describe' is not one of")])
def test_what_is_no_effect_file_is_one_line(arguments, words):
    result = st("effects", *arguments)
    assert result.exit_code == 2 and words in result.output


def test_model_file_with_a_proposed_effect_is_evaluated_and_exported(law, tmp_path):
    drive = write_drive(tmp_path / "weave.csv", weave(20.0))
    words = ("--model", "nonlinear", "--model", law / "proposed.yaml", "--vehicle", LEAF, "--figures", "", "--output")
    refused = st("evaluate", drive, *words, tmp_path / "no")
    assert refused.exit_code == 2 and "proposed_rear_steer" in refused.output
    result = st("evaluate", drive, *words, tmp_path / "out", "--effects", law / "effects")
    assert result.exit_code == 0, result.output
    message = json.loads((tmp_path / "out" / "evaluation.json").read_text())["runs"]["weave"]
    errors = {m: message[m]["hindsight"]["lateral"]["rmse"] for m in ("nonlinear", "augmented")}
    assert errors["nonlinear"] != errors["augmented"]
    result = st("export", law / "proposed.yaml", "--effects", law / "effects", "--output", tmp_path / "exported")
    assert result.exit_code == 0, result.output
    described = json.loads((tmp_path / "exported" / "model.json").read_text())
    assert "proposed_rear_steer" in described["effects"]


def test_drives_are_identified_with_a_proposed_effect(law, tmp_path):
    drive = write_drive(tmp_path / "weave.csv", weave(60.0))
    words = ("identify", "stiffness", drive, "--model", law / "proposed.yaml", "--vehicle", LEAF, "--output")
    result = st(*words, tmp_path / "out", "--effects", law / "effects")
    assert result.exit_code == 0, result.output
    message = json.loads((tmp_path / "out" / "identification.json").read_text())
    assert "proposed_rear_steer" in json.dumps(message)
    refused = st("identify", "steering-offset", drive, "--model", law / "proposed.yaml", "--effects", law / "effects",
                 "--output", tmp_path / "no")
    assert refused.exit_code == 2 and "steering-offset uses no model" in refused.output


def test_the_file_reads_back_as_the_model_that_was_written(law):
    load_folder(str(law / "effects"))
    model = ModelFile.from_yaml((law / "proposed.yaml").read_text()).model()
    assert model.values["proposed_rear_steer"] == {"share": 1.0} and model.values["mass"] == {"factor": 1.1}
