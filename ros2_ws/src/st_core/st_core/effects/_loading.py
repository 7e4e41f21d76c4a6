"""Effects of the user: every module of a folder."""

import hashlib
import importlib
import sys
from pathlib import Path
from types import ModuleType

from ..errors import ConfigurationError
from ._base import EFFECTS


def load_folder(path: str | Path) -> tuple[str, ...]:
    """Import every module of a folder (names that begin with _ are helpers) and return the effects registered, sorted.

    A folder loaded before is not read again. Raises ConfigurationError naming the file when there is no such folder, a
    module fails to import or registers nothing, or a name is taken; nothing of that folder is then registered.
    """
    folder = Path(path).resolve()
    if not folder.is_dir():
        raise ConfigurationError(f"{path}: not a folder of effects")
    # The same folder has the same package name in every process: compiled kernels are cached by it.
    package = "st_effects_" + hashlib.sha256(str(folder).encode()).hexdigest()[:12]
    if package not in sys.modules:
        _load(folder, package)
    return tuple(sorted(name for name, effect in EFFECTS.items() if effect.__module__.startswith(package + ".")))


def _load(folder: Path, package: str) -> None:
    files = sorted(file for file in folder.glob("*.py") if not file.name.startswith("_"))
    if not files:
        raise ConfigurationError(f"{folder}: holds no effect, that is no *.py")
    known = set(EFFECTS)
    root = ModuleType(package)
    root.__path__ = [str(folder)]
    sys.modules[package] = root
    importlib.invalidate_caches()
    try:
        for file in files:
            before = len(EFFECTS)
            _import(f"{package}.{file.stem}", file)
            if len(EFFECTS) == before:
                raise ConfigurationError(f"{file}: registers no effect; decorate its class with @register")
    except ConfigurationError:
        for name in set(EFFECTS) - known:
            del EFFECTS[name]
        for name in [m for m in sys.modules if m == package or m.startswith(package + ".")]:
            del sys.modules[name]
        raise


def _import(module: str, file: Path) -> None:
    try:
        importlib.import_module(module)
    except ConfigurationError as error:
        raise ConfigurationError(f"{file}: {error}") from None
    except Exception as error:
        text = " ".join(str(error).split())
        raise ConfigurationError(f"{file}: cannot be loaded: {type(error).__name__}: {text}") from error
