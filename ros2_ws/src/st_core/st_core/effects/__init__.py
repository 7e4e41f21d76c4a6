"""Physical effects as plug-ins: one file each, found by being in this folder, or in one given to `load_folder`."""

import importlib
import pkgutil

from ._base import (
    ANY,
    COMBINATIONS,
    DYNAMIC,
    EFFECT_KINDS,
    EFFECTS,
    HOOKS,
    SLOTS,
    Effect,
    Instant,
    Measured,
    Parameter,
    applicable,
    get_effect,
    register,
    source_file,
    twins_of,
)
from ._loading import load_file, load_folder

for _module in sorted(info.name for info in pkgutil.iter_modules(__path__)):
    if not _module.startswith("_"):
        importlib.import_module(f"{__name__}.{_module}")

__all__ = ["ANY", "COMBINATIONS", "DYNAMIC", "EFFECTS", "EFFECT_KINDS", "HOOKS", "SLOTS", "Effect", "Instant",
           "Measured", "Parameter", "applicable", "get_effect", "load_file", "load_folder", "register", "source_file",
           "twins_of"]
