"""Everything about an effect is in its own file: no list, table or branch elsewhere names an effect."""

import ast

from st_core.effects import EFFECTS
from st_core.vehicle import VEHICLE_QUANTITIES
from support import ROOT

SOURCES = ROOT / "ros2_ws" / "src"
EFFECTS_FOLDER = "st_core/st_core/effects/"
# The same words with another meaning: keys of a vehicle file, and the load on a tyre.
OTHER_MEANINGS = frozenset((*VEHICLE_QUANTITIES, "load"))
CHECK_FOLDERS = {"checks", "checking"}  # an effect names the estimate of the checks that measures it in `identity`
VIRTUAL_CAR = "st_sim"  # has its own settings and shares nothing with the models


def effect_names(source: str) -> set[str]:
    """String literals that are the name of an effect, alone or with a parameter: "mass", "mass.factor"."""
    texts = {node.value for node in ast.walk(ast.parse(source))
             if isinstance(node, ast.Constant) and isinstance(node.value, str)}
    return {text for text in texts if text.partition(".")[0] in EFFECTS}


def is_checked(path) -> bool:
    """path: of a source, relative to ros2_ws/src."""
    return (path.parts[1] != "test" and not path.as_posix().startswith(EFFECTS_FOLDER) and path.parts[0] != VIRTUAL_CAR
            and not CHECK_FOLDERS & set(path.parts))


def test_effects_are_named_only_in_their_own_files():
    found = {path.as_posix(): sorted(effect_names((SOURCES / path).read_text()) - OTHER_MEANINGS)
             for path in (p.relative_to(SOURCES) for p in SOURCES.rglob("*.py")) if is_checked(path)}
    assert len(found) > 200
    assert {path: names for path, names in found.items() if names} == {}
