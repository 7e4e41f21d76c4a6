"""Physical effects as plug-ins: one file per effect, in this folder or in a folder that `load_folder` imports."""

import hashlib
import importlib
import itertools
import pkgutil
import sys
from collections.abc import Iterable, Sequence
from importlib.machinery import FileFinder
from types import ModuleType

from ..errors import ConfigurationError
from ..yaml_text import suggest_key
from ._base import (
    ANY,
    COMBINATIONS,
    DYNAMIC,
    EFFECT_KINDS,
    EFFECTS,
    REAR_STEERING,
    TOTAL_DELAY,
    Effect,
    Instant,
    Measured,
    Parameter,
    find_applicable_effects,
    find_confounded_effects,
    find_source_file,
    get_effect,
    register,
)
from ._relation import LaggedRelationEffect, RelationEffect, fix_curve

__all__ = ["ANY", "COMBINATIONS", "DYNAMIC", "EFFECTS", "EFFECT_KINDS", "REAR_STEERING", "TOTAL_DELAY", "Effect",
           "Instant", "LaggedRelationEffect", "Measured", "Parameter", "RelationEffect", "find_applicable_effects",
           "find_confounded_effects", "find_source_file", "fix_curve", "get_effect", "load_file", "load_folder",
           "register", "unload_folder"]


def load_folder(path: str) -> tuple[str, ...]:
    """Import every module of a folder, except names with a leading _, and return the names of its effects, sorted.

    A folder with a module that is already loaded is not read again. Raises ConfigurationError, naming folder or file,
    for a missing folder or one without modules, a module that fails to import or registers nothing, a name in use, and
    an unknown name in confounded_with or members. No effect of the folder is then registered.
    """
    folder, package = _find_package(path)
    if package not in sys.modules:
        names = _list_modules([folder])
        if not names:
            raise ConfigurationError(f"{folder}: contains no effect (*.py without leading _)")
        _load_modules(folder, package, names)
    return tuple(sorted(name for name, effect in EFFECTS.items() if effect.__module__.startswith(package + ".")))


def load_file(path: str, name: str) -> tuple[type[Effect], ...]:
    """Import one module of a folder, unless it is loaded, and return its effects. Raises as `load_folder` does."""
    folder, package = _find_package(path)
    file = f"{folder}/{name}.py"
    if file not in map(find_source_file, EFFECTS.values()):
        _load_modules(folder, package, [name])
    return tuple(effect for effect in EFFECTS.values() if find_source_file(effect) == file)


def unload_folder(path: str) -> None:
    """Remove the effects of a folder from EFFECTS, so that a later search does not include them."""
    _, package = _find_package(path)
    for name in [m for m in sys.modules if m == package or m.startswith(package + ".")]:
        del sys.modules[name]
    for name in [n for n, effect in EFFECTS.items() if effect.__module__.startswith(package + ".")]:
        del EFFECTS[name]


def _list_modules(folders: Iterable[str]) -> list[str]:
    return sorted(module.name for module in pkgutil.iter_modules(folders) if not module.name.startswith("_"))


def _find_package(path: str) -> tuple[str, str]:
    """(absolute path of a folder, name of the package for its modules)."""
    finder = pkgutil.get_importer(str(path))
    if not isinstance(finder, FileFinder):
        raise ConfigurationError(f"{path}: not a folder of effects")
    # The package name must be the same in every process, because it is part of the key of cached kernels.
    return finder.path, "st_effects_" + hashlib.sha256(finder.path.encode()).hexdigest()[:12]


def _load_modules(folder: str, package: str, names: Sequence[str]) -> None:
    """Import modules of a folder; if one fails, no effect of the folder remains registered."""
    importlib.invalidate_caches()
    before = set(EFFECTS)
    root = ModuleType(package)
    root.__path__ = [folder]
    sys.modules[package] = root
    try:
        for name in names:
            _import_module(f"{package}.{name}", f"{folder}/{name}.py")
        available = {*EFFECTS, *_list_modules([folder])}  # the names of files that are not imported yet count as known
        for name, key in itertools.product(sorted(set(EFFECTS) - before), ("confounded_with", "members")):
            for other in (other for other in getattr(EFFECTS[name], key) if other not in available):
                raise ConfigurationError(f"{folder}: effect {name}: {key}: unknown effect {other}"
                                         f"{suggest_key(other, available)}")
    except ConfigurationError:
        unload_folder(folder)
        raise


def _import_module(module: str, file: str) -> None:
    before = len(EFFECTS)
    try:
        importlib.import_module(module)
    except ConfigurationError as error:
        raise ConfigurationError(f"{file}: {error}") from None
    except Exception as error:
        text = " ".join(str(error).split())
        raise ConfigurationError(f"{file}: cannot be loaded: {type(error).__name__}: {text}") from error
    if len(EFFECTS) == before:
        raise ConfigurationError(f"{file}: registers no effect; decorate its class with @register")


for _module in _list_modules(__path__):
    importlib.import_module(f"{__name__}.{_module}")
