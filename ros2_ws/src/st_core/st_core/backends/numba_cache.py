"""Cache of compiled kernels on disk, shared by all processes.

Each kernel has a folder, named by a hash of all its dependencies: source files and values of its functions, modules of
this package, numba, numpy, Python and the CPU. numba's own cache checks only the file of the kernel; it would return
outdated code after a change in another file.
"""

import contextlib
import hashlib
import os
import platform
import shutil
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from types import BuiltinFunctionType, CodeType, FunctionType, ModuleType
from typing import Any

import numba
import numpy as np
from numba.core.errors import NumbaError
from numba.core.registry import cpu_target

KERNEL_LIFETIME = 30 * 86400.0  # s without use after which a kernel is deleted: each edit of an equation adds one


def enable_cache(kernel, identity: str) -> Path | None:
    """Enable the cache of a kernel that is not compiled yet, and delete old kernels. Returns its folder, or None."""
    files = sorted(Path(__file__).parent.glob("*.py"))
    parts = (identity, numba.__version__, np.__version__, platform.python_version(),
             *map(str, cpu_target.target_context.codegen().magic_tuple()),
             *(hashlib.sha256(file.read_bytes()).hexdigest() for file in files))
    key = hashlib.sha256("\n".join(parts).encode()).hexdigest()[:32]
    bases = [Path(__file__).parent / "__pycache__" / "kernels"]
    if numba.config.CACHE_DIR:  # NUMBA_CACHE_DIR, set by the user
        bases.insert(0, Path(numba.config.CACHE_DIR) / "st_core")
    with contextlib.suppress(RuntimeError):  # no home directory
        bases.append(Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "st_core" / "kernels")
    for base in bases:
        try:
            folder = base / key
            folder.mkdir(parents=True, exist_ok=True)
            os.utime(folder)  # marks it as in use; fails in another user's folder
            # numba reads CACHE_DIR when caching is enabled, and rejects a folder that it cannot write to.
            previous, numba.config.CACHE_DIR = numba.config.CACHE_DIR, str(folder)
            try:
                kernel.enable_caching()
            finally:
                numba.config.CACHE_DIR = previous
            # numba's own key pickles the closure, which differs between processes.
            kernel._cache._index_key = lambda signature, codegen: (signature, codegen.magic_tuple(), key)
        except (OSError, RuntimeError, AttributeError):  # not writable, or an incompatible version of numba
            continue
        with contextlib.suppress(OSError):
            for old in base.iterdir():
                if old.stat().st_mtime < time.time() - KERNEL_LIFETIME:
                    shutil.rmtree(old, ignore_errors=True)
        return folder
    return None


def compile_or_load(kernel, signature) -> None:
    """Compile a kernel or load it from the cache; compile it uncached if the folder is damaged or not writable."""
    try:
        kernel.compile(signature)
    except NumbaError:
        raise
    except Exception:  # unpickling a truncated file can raise almost any exception
        if kernel.signatures:
            return  # compiled, but not saved
        with contextlib.suppress(OSError):
            kernel._cache.flush()
        kernel._cache.disable()
        kernel.compile(signature)


def find_reachable_functions(function: FunctionType, excluded: frozenset[str] = frozenset()) -> list[FunctionType]:
    """The function and all plain functions that it can call, directly or indirectly; each once, callees first.

    Functions are found by the names in code and closures, including attributes of modules. excluded: modules to omit.
    """
    functions: list[FunctionType] = []
    visited: set[FunctionType] = set()

    def collect(function: FunctionType) -> None:
        if function in visited or function.__module__ in excluded:
            return
        visited.add(function)
        for _, value in find_references(function):
            if isinstance(value, FunctionType):
                collect(value)
        functions.append(function)

    collect(function)
    return functions


def find_references(function: FunctionType) -> Iterator[tuple[str, Any]]:
    """(name, value) of the closure variables, globals and attributes of modules to which a function refers."""
    cells = function.__closure__ or ()
    yield from zip(function.__code__.co_freevars, (cell.cell_contents for cell in cells), strict=True)
    names = _find_names(function.__code__)
    for name in names:
        value = function.__globals__.get(name)
        if isinstance(value, ModuleType):
            yield from ((f"{name}.{attribute}", getattr(value, attribute)) for attribute in names
                        if hasattr(value, attribute))
        elif name in function.__globals__:
            yield name, value


def _find_names(code: CodeType) -> list[str]:
    inner = [name for constant in code.co_consts if isinstance(constant, CodeType) for name in _find_names(constant)]
    return list(dict.fromkeys((*code.co_names, *inner)))


class UnhashableError(Exception):
    """A value without a representation that is the same in every process."""


def compute_fingerprint(function: FunctionType, excluded: frozenset[str] = frozenset()) -> str:
    """sha256 (hex) of a function, of all functions that it can reach, and of the values and source files that they use;
    the same in every process. Raises UnhashableError for a value such as an array, a list or an instance."""
    digest = hashlib.sha256()
    functions = find_reachable_functions(function, excluded)
    numbers = {f: str(i) for i, f in enumerate(functions)}
    describe = partial(_describe_value, numbers=numbers)
    for file in map(Path, sorted({f.__code__.co_filename for f in functions})):
        # Without a file, as for a function entered at a prompt, only code and constants are hashed.
        digest.update(hashlib.sha256(file.read_bytes() if file.is_file() else b"").digest())
    for f in functions:
        referenced = [f"{key}={describe(value)}" for key, value in find_references(f)]
        parts = (f.__module__, f.__qualname__, f.__code__.co_code.hex(), _describe_constants(f.__code__), *referenced,
                 *map(describe, f.__defaults__ or ()))
        digest.update("\x00".join(parts).encode() + b"\x01")
    return digest.hexdigest()


def _describe_constants(code: CodeType) -> str:
    return repr([_describe_constants(c) + c.co_code.hex() if isinstance(c, CodeType) else c for c in code.co_consts])


def _describe_value(value: Any, numbers: dict[FunctionType, str]) -> str:
    if value is None or isinstance(value, bool | int | float | str | bytes):
        return f"{type(value).__name__}:{value!r}"
    if isinstance(value, FunctionType):
        return f"function {numbers[value]}" if value in numbers else f"{value.__module__}.{value.__qualname__}"
    if isinstance(value, ModuleType):
        return f"module {value.__name__}"
    if isinstance(value, type):
        return f"class {value.__module__}.{value.__qualname__}{getattr(value, '_fields', '')}"
    if isinstance(value, tuple):
        return f"{_describe_value(type(value), numbers)}({','.join(_describe_value(v, numbers) for v in value)})"
    if isinstance(value, BuiltinFunctionType) and isinstance(value.__self__, ModuleType):
        return f"{value.__module__}.{value.__qualname__}"
    raise UnhashableError(f"{value!r}")
