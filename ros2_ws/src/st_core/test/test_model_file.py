"""model.yaml: round trip, and errors that name file, key and limit."""

from dataclasses import replace

import numpy as np
import pytest
import yaml
from st_core.augmented import augment
from st_core.effects import EFFECTS, find_applicable_effects
from st_core.errors import ConfigurationError
from st_core.model_file import EffectValue, ModelFile, ModelProvenance
from st_core.models import MODELS
from st_core.prediction import predict
from st_core.types import ControlInput, VehicleState

STATE, INPUTS = VehicleState(0.0, 0.0, 12.0, 0.1, 0.3, 0.2), ControlInput(0.08, -0.5)
PROVENANCE = ModelProvenance("2026-11-21", "0.1.0", {"run one.ncom": "ab12", 'with "quotes".mf4': "cd34"},
                             "fitted: 7 runs, ü")


def make_file(leaf) -> ModelFile:
    model = augment("nonlinear", {"steering_lag": {"time_constant": 0.08}, "crosswind": {"wind_x": 1e-7, "wind_y": 5.0},
                                  "friction": {"factor": 0.85}})
    intervals = {("steering_lag", "time_constant"): (0.07, 0.09), ("crosswind", "wind_y"): (4.0, 6.5)}
    return ModelFile.from_model(model, leaf, PROVENANCE, intervals, source="fit to two runs")


MINIMAL = """
base: linear
effects:
  mass:
    factor: {value: 1.1, unit: "1"}
"""


@pytest.mark.parametrize("embed", [True, False])
def test_file_round_trip(leaf, embed):
    file = make_file(leaf) if embed else replace(make_file(leaf), vehicle=None)
    reloaded = ModelFile.from_yaml(file.to_yaml(), "model.yaml")
    assert reloaded == file and reloaded.hash == file.hash and reloaded.provenance == PROVENANCE
    assert (reloaded.vehicle.hash if reloaded.vehicle else "") == (leaf.hash if embed else "")
    assert reloaded.vehicle_hash == leaf.hash
    assert reloaded.effects["steering_lag"]["time_constant"] == EffectValue(0.08, (0.07, 0.09), "fit to two runs")
    assert reloaded.effects["crosswind"]["wind_x"].interval is None
    path = predict(reloaded.model(), leaf, STATE, INPUTS)
    np.testing.assert_array_equal(path.states, predict(file.model(), leaf, STATE, INPUTS).states)


@pytest.mark.parametrize("base", MODELS)
def test_every_effect_survives_a_round_trip(leaf, base):
    file = ModelFile.from_model(augment(base, find_applicable_effects(base)), leaf, ModelProvenance())
    reloaded = ModelFile.from_yaml(file.to_yaml())
    assert reloaded == file and reloaded.model().values == file.model().values


def test_handwritten_file_needs_base_and_effects_only():
    file = ModelFile.from_yaml(MINIMAL)
    assert file.model().values["mass"]["factor"] == 1.1
    assert (file.vehicle, file.vehicle_hash, file.provenance.date) == (None, "", "")
    assert ModelFile.from_yaml("base: linear\neffects: {}").model().effects == ()
    dated = ModelFile.from_yaml(MINIMAL + "provenance: {date: 2026-11-21}\n")  # YAML parses it as a date
    assert dated.provenance.date == "2026-11-21"


def test_hash_depends_on_what_changes_a_prediction(leaf):
    file = make_file(leaf)
    assert replace(file, provenance=ModelProvenance(), vehicle=None).hash == file.hash
    changes = {"base": "linear", "effects": {}, "vehicle_hash": "0"}
    assert len({file.hash, *(replace(file, **{k: v}).hash for k, v in changes.items())}) == 4


@pytest.mark.parametrize(("old", "new", "message"), [
    ("base: nonlinear", "base: bicycle", r"unknown model 'bicycle'"),
    ("base: nonlinear", "base: linear", r"effect friction: does not apply to a linear model"),
    ("base: nonlinear\n", "", r"base: missing"),
    ("base: nonlinear", "base: 3", r"base: 3 is not a string"),
    ("provenance:", "provenence:", r"provenence: unknown key, did you mean provenance\?"),
    ("steering_lag:", "steering_lagg:", r"unknown effect 'steering_lagg', did you mean steering_lag\?"),
    ("time_constant:", "time:", r"effects\.steering_lag\.time: unknown key"),
    ("value: 0.08", "value: 0.8", r"effects\.steering_lag\.time_constant: 0\.8 is outside 0 to 0\.5 s"),
    ("value: 0.08", "value: fast", r"effects\.steering_lag\.time_constant: 'fast' is not a number"),
    ("value: 0.08, ", "", r"effects\.steering_lag\.time_constant\.value: missing"),
    ('unit: "s"', 'unit: "ms"', r"effects\.steering_lag\.time_constant: unit 'ms' is not s; convert"),
    ("[0.07, 0.09]", "[0.09, 0.07]", r"interval: \[0\.09, 0\.07\] is not \[low, high\] around the value 0\.08"),
    ("[0.07, 0.09]", "0.01", r"interval: 0\.01 is not \[low, high\]"),
    ("value: 0.08", "value: 0.081", r"hash: .* does not match the content"),
    ("value: 1590.0", "value: 1600.0", r"vehicle\.hash: .* does not match vehicle\.parameters"),
    ("mass: {value: 1590.0", "mass: {value: 1.0", r"vehicle\.parameters: mass: 1 kg does not fit a car"),
    ("date:", "day:", r"provenance\.day: unknown key"),
    ('"ab12"', "12", r"provenance\.data\.run one\.ncom: 12 is not a string"),
    ("  steering_lag:", "  mass: 3\n  steering_lag:", r"effects\.mass: expected a mapping"),
    ("effects:", "effects: [", r"not valid YAML, line"),
    ("    wind_x:", "    wind_y: {value: 1.0, unit: m/s}\n    wind_x:", r"wind_y: given twice"),
])
def test_mistakes_name_file_key_and_limit(leaf, old, new, message):
    text = make_file(leaf).to_yaml()
    assert old in text
    with pytest.raises(ConfigurationError, match=rf"^model\.yaml: .*{message}") as caught:
        ModelFile.from_yaml(text.replace(old, new, 1), "model.yaml")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["", "- 1", "linear", "base: linear", "base: linear\neffects: [mass]"])
def test_other_yaml_is_rejected(text):
    with pytest.raises(ConfigurationError, match=r"^m: (the file: expected a mapping|effects)"):
        ModelFile.from_yaml(text, "m")


def test_edited_file_without_hash_is_accepted(leaf):
    lines = make_file(leaf).to_yaml().replace("value: 0.08", "value: 0.081").splitlines()
    file = ModelFile.from_yaml("\n".join(line for line in lines if not line.startswith("hash:")))
    assert file.effects["steering_lag"]["time_constant"].value == 0.081


def test_other_vehicle_is_rejected(leaf):
    file = make_file(leaf)
    file.check_vehicle(leaf, "leaf.yaml")
    ModelFile.from_yaml(MINIMAL).check_vehicle(leaf, "leaf.yaml")
    with pytest.raises(ConfigurationError, match=r"vehicle\.hash: the values are valid for .*, but heavy\.yaml is .* "
                                                  r"\(they differ in mass: 1590, 1700 kg\); use"):
        file.check_vehicle(replace(leaf, mass=1700.0), "heavy.yaml")


def test_file_is_plain_yaml(leaf):
    document = yaml.safe_load(make_file(leaf).to_yaml())
    assert document["effects"]["crosswind"]["wind_x"]["value"] == 1e-7
    assert document["vehicle"]["parameters"]["mass"]["value"] == 1590.0
    assert set(document["effects"]) <= set(EFFECTS)
