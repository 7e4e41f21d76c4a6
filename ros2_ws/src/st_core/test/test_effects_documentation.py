"""docs/manual/effects.md against the registry: its table of effects and its example."""

import re

import pytest
from effect_registry import restored
from st_core.augmented import augment
from st_core.effects import ANY, EFFECTS, load_folder
from st_core.models import MODELS
from st_core.prediction import predict
from st_core.types import ControlInput, VehicleState
from support import ROOT

TEXT = (ROOT / "docs" / "manual" / "effects.md").read_text()
BUILT_IN = sorted(name for name in EFFECTS if EFFECTS[name].__module__.startswith("st_core."))


registry = pytest.fixture(restored)


def table_rows() -> dict[str, list[str]]:
    lines = re.findall(r"^\| `(\w+)` \|(.*)\|$", TEXT, re.M)
    return {name: [cell.strip() for cell in rest.split("|")] for name, rest in lines}


def test_table_lists_every_built_in_effect():
    assert sorted(table_rows()) == BUILT_IN


@pytest.mark.parametrize("name", BUILT_IN)
def test_table_row_matches_the_effect(name):
    effect = EFFECTS[name]
    bases, parameters = table_rows()[name]
    assert bases.split() == [base[0] for base in MODELS if base in effect.applies_to & ANY]
    assert parameters == "; ".join(f"`{p.name}` [{p.unit}] {p.null:g}, {p.bounds[0]:g} to {p.bounds[1]:g}"
                                   for p in effect.parameters if p.fit)


def test_example_of_a_model_with_effects_works(leaf):
    names = {"predict": predict, "vehicle": leaf, "state": VehicleState(0.0, 0.0, 10.0, 0.0, 0.0, 0.0),
             "inputs": ControlInput(0.05, 0.0)}
    exec(re.findall(r"```python\n(.*?)```", TEXT, re.S)[0], names)
    assert names["model"].values == {"steering_lag": {"time_constant": 0.07}, "friction": {"factor": 0.85}}


def test_example_of_a_user_effect_works(tmp_path, registry):
    example = next(block for block in re.findall(r"```python\n(.*?)```", TEXT, re.S) if "@register" in block)
    (tmp_path / "trailer.py").write_text(example)
    assert load_folder(tmp_path) == ("trailer",)
    assert augment("linear", ["trailer"]).values["trailer"]["gain"] == 0.5
