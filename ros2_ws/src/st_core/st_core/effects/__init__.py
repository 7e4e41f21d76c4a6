"""Physical effects as plug-ins: one file per effect, in this folder or in a folder given to `load_folder`."""

import hashlib
import importlib
import itertools
import pkgutil
import sys
from collections.abc import Sequence
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
    HOOKS,
    SLOTS,
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

for _module in sorted(info.name for info in pkgutil.iter_modules(__path__)):
    if not _module.startswith("_"):
        importlib.import_module(f"{__name__}.{_module}")

__all__ = ["ANY", "COMBINATIONS", "DYNAMIC", "EFFECTS", "EFFECT_KINDS", "HOOKS", "SLOTS", "TOTAL_DELAY", "Effect",
           "Instant", "Measured", "Parameter", "find_applicable_effects", "find_confounded_effects", "find_source_file",
           "get_effect", "load_file", "load_folder", "register", "unload_folder"]


def load_folder(path: str) -> tuple[str, ...]:
    """Import every module of a folder, except names with a leading _, and return the names of its effects, sorted. A
    folder that is already loaded is not read again. Raises ConfigurationError, naming the file, for a missing folder, a
    module that fails to import or registers nothing, and a name in use. No effect of the folder is then registered."""
    finder, package = _find_package(path)
    if package not in sys.modules:
        names = _list_modules(finder)
        if not names:
            raise ConfigurationError(f"{finder.path}: contains no effect (no file *.py)")
        _load_modules(finder, package, names)
    return tuple(sorted(name for name, effect in EFFECTS.items() if effect.__module__.startswith(package + ".")))


def load_file(folder: str, name: str) -> tuple[type[Effect], ...]:
    """Import one module of a folder, unless it is already imported, and return its effects. Raises the errors of
    `load_folder`."""
    finder, package = _find_package(folder)

    def list_registered() -> tuple[type[Effect], ...]:
        return tuple(e for e in EFFECTS.values() if find_source_file(e) == f"{finder.path}/{name}.py")
    if not list_registered():
        _load_modules(finder, package, [name])
    return list_registered()


def unload_folder(path: str) -> None:
    """Remove the effects of a folder from EFFECTS, so that a later search does not include them."""
    _, package = _find_package(path)
    for name in [m for m in sys.modules if m == package or m.startswith(package + ".")]:
        del sys.modules[name]
    for name in [n for n, effect in EFFECTS.items() if effect.__module__.startswith(package + ".")]:
        del EFFECTS[name]


def _list_modules(finder: FileFinder) -> list[str]:
    found = pkgutil.iter_importer_modules(finder)  # type: ignore[attr-defined]  # public, but not in the stubs
    return sorted(name for name, _ in found if not name.startswith("_"))


def _find_package(path: str) -> tuple[FileFinder, str]:
    """(finder of the modules of a folder, name of the package that they are imported into)."""
    finder = pkgutil.get_importer(str(path))
    if not isinstance(finder, FileFinder):
        raise ConfigurationError(f"{path}: not a folder of effects")
    # A folder has the same package name in every process, because it is part of the key of cached kernels.
    return finder, "st_effects_" + hashlib.sha256(finder.path.encode()).hexdigest()[:12]


def _load_modules(finder: FileFinder, package: str, names: Sequence[str]) -> None:
    """Import modules of a folder; if one fails, no effect of the folder remains registered."""
    importlib.invalidate_caches()
    before = set(EFFECTS)
    root = ModuleType(package)
    root.__path__ = [finder.path]
    sys.modules[package] = root
    try:
        for name in names:
            _import_module(f"{package}.{name}", f"{finder.path}/{name}.py")
        available = {*EFFECTS, *_list_modules(finder)}  # each file has the name of its effect
        for name, key in itertools.product(sorted(set(EFFECTS) - before), ("confounded_with", "members")):
            for other in (other for other in getattr(EFFECTS[name], key) if other not in available):
                raise ConfigurationError(f"{finder.path}: effect {name}: {key}: unknown effect {other}"
                                         f"{suggest_key(other, available)}")
    except ConfigurationError:
        unload_folder(finder.path)
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
