"""What is known of an effect stands in its file: no list, table or branch elsewhere names one."""

import ast

from st_core.effects import EFFECTS
from st_core.vehicle import VEHICLE_QUANTITIES
from support import ROOT

SOURCES = ROOT / "ros2_ws" / "src"
EFFECTS_FOLDER = "st_core/st_core/effects/"
# The same word with another meaning.
KEYS_OF_A_VEHICLE_FILE = frozenset(VEHICLE_QUANTITIES)
LOAD_OF_A_TYRE = frozenset(("load",))
ESTIMATES_OF_CHECKS = ("checks", "checking")  # folders; an effect names the estimate that measures it: `identity`
VIRTUAL_CAR = "st_sim"  # has settings of its own and shares nothing with the models


def names_in(source: str) -> set[str]:
    """Names of effects that are texts in a source, alone or with their parameter: "mass", "mass.factor"."""
    texts = {node.value for node in ast.walk(ast.parse(source))
             if isinstance(node, ast.Constant) and isinstance(node.value, str)}
    return {text for text in texts if text.partition(".")[0] in EFFECTS}


def is_looked_at(path) -> bool:
    """path: of a source, relative to ros2_ws/src."""
    return (path.parts[1] != "test" and not path.as_posix().startswith(EFFECTS_FOLDER) and path.parts[0] != VIRTUAL_CAR
            and not set(ESTIMATES_OF_CHECKS) & set(path.parts))


def test_a_name_is_seen():
    assert names_in('table = {"friction": 1}\nif name == "mass.factor": pass\n"friction, as a word in a sentence"') == {
        "friction", "mass.factor"}
    assert names_in((SOURCES / EFFECTS_FOLDER / "friction.py").read_text()) >= {"friction", "rear_stiffness"}


def test_no_effect_is_named_outside_its_file():
    found = {path.as_posix(): sorted(names_in((SOURCES / path).read_text()) - KEYS_OF_A_VEHICLE_FILE - LOAD_OF_A_TYRE)
             for path in (p.relative_to(SOURCES) for p in SOURCES.rglob("*.py")) if is_looked_at(path)}
    assert len(found) > 200
    assert {path: names for path, names in found.items() if names} == {}
