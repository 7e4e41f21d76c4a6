"""The registry of effects after a test that adds some: as it was before."""

import sys
from collections.abc import Iterator

from st_core.effects import EFFECTS


def restored() -> Iterator[None]:
    """A fixture, once `pytest.fixture` is put around it."""
    before, modules = dict(EFFECTS), set(sys.modules)
    yield
    EFFECTS.clear()
    EFFECTS.update(before)
    for name in [m for m in sys.modules if m.startswith("st_effects_") and m not in modules]:
        del sys.modules[name]
