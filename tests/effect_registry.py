"""Restores the registry of effects after a test that adds effects."""

import sys
from collections.abc import Iterator

from st_core.effects import EFFECTS


def restored() -> Iterator[None]:
    """Generator for `pytest.fixture`: removes the effects and modules that a test has added."""
    before, modules = dict(EFFECTS), set(sys.modules)
    yield
    EFFECTS.clear()
    EFFECTS.update(before)
    for name in [m for m in sys.modules if m.startswith("st_effects_") and m not in modules]:
        del sys.modules[name]
