"""docs/manual/effects.md against the registry, and its example as it stands there."""

import re

import pytest
from st_core.augmented import augment
from st_core.effects import ANY, EFFECTS, load_folder
from support import ROOT

TEXT = (ROOT / "docs" / "manual" / "effects.md").read_text()
OWN = sorted(name for name in EFFECTS if EFFECTS[name].__module__.startswith("st_core."))


def rows() -> dict[str, list[str]]:
    lines = re.findall(r"^\| `(\w+)` \|(.*)\|$", TEXT, re.M)
    return {name: [cell.strip() for cell in rest.split("|")] for name, rest in lines}


def test_every_effect_stands_in_the_table_and_no_other():
    assert sorted(rows()) == OWN


@pytest.mark.parametrize("name", OWN)
def test_its_row_is_what_the_code_says(name):
    effect = EFFECTS[name]
    on, parameters = rows()[name]
    assert on.split() == [kind[0] for kind in ("kinematic", "linear", "nonlinear") if kind in effect.applies_to & ANY]
    assert parameters == "; ".join(f"`{p.name}` [{p.unit}] {p.null:g}, {p.bounds[0]:g} to {p.bounds[1]:g}"
                                   for p in effect.parameters if p.fit)


def test_the_example_of_an_own_effect_works(tmp_path):
    example = next(block for block in re.findall(r"```python\n(.*?)```", TEXT, re.S) if "@register" in block)
    (tmp_path / "trailer.py").write_text(example)
    before = dict(EFFECTS)
    try:
        assert load_folder(tmp_path) == ("trailer",)
        assert augment("linear", ["trailer"]).values["trailer"]["gain"] == 0.5
    finally:
        EFFECTS.clear()
        EFFECTS.update(before)
