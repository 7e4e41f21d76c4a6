"""Where compiled kernels are kept, so that the next process finds them.

One folder for each kernel, named by a hash of everything its machine code depends on: the sources and values of all
equations and plug-ins it was made of, these backend modules, numba, numpy, Python and the CPU. numba's own cache looks
at the kernel's own file only and would hand out stale code when a helper changes.
"""

import contextlib
import hashlib
import os
import platform
import shutil
import time
from collections.abc import Iterator
from pathlib import Path

import numba
import numpy as np
from numba.core.errors import NumbaError
from numba.core.registry import cpu_target

# Kernels nobody asked for in this time are deleted [s]; each edit of an equation leaves one behind.
KEEP = 30 * 86400.0


def enable(kernel, fingerprint: str) -> Path | None:
    """Let a jitted function, not compiled yet, be kept between processes. Returns its folder, None where nothing may
    be written: then it is compiled in every process.
    """
    key = hashlib.sha256("\n".join((fingerprint, *_surroundings())).encode()).hexdigest()[:32]
    for base in _candidates():
        try:
            folder = _make(base, key)
            _attach(kernel, folder, key)
        except (OSError, RuntimeError, AttributeError):  # not writable, or another numba
            continue
        _forget_old(base)
        return folder
    return None


def compiled(kernel, signature) -> None:
    """Compile, or take what an earlier process kept. A damaged or unwritable folder costs time, not the answer."""
    try:
        kernel.compile(signature)
    except NumbaError:
        raise
    except Exception:  # unpickling what was cut off raises nearly anything
        if kernel.signatures:
            return  # compiled, not kept
        with contextlib.suppress(OSError):
            kernel._cache.flush()
        kernel._cache.disable()
        kernel.compile(signature)


def _surroundings() -> Iterator[str]:
    yield from (numba.__version__, np.__version__, platform.python_version())
    yield from map(str, cpu_target.target_context.codegen().magic_tuple())
    for file in sorted(Path(__file__).parent.glob("*.py")):
        yield hashlib.sha256(file.read_bytes()).hexdigest()


def _candidates() -> Iterator[Path]:
    if numba.config.CACHE_DIR:  # NUMBA_CACHE_DIR: the user has decided
        yield Path(numba.config.CACHE_DIR) / "st_core"
    yield Path(__file__).parent / "__pycache__" / "kernels"
    with contextlib.suppress(RuntimeError):  # no home
        yield Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "st_core" / "kernels"


def _make(base: Path, key: str) -> Path:
    folder = base / key
    folder.mkdir(parents=True, exist_ok=True)
    os.utime(folder)  # in use; fails in a folder of someone else
    return folder


def _attach(kernel, folder: Path, key: str) -> None:
    # numba reads CACHE_DIR when the cache is switched on, and refuses a folder it cannot write to.
    before, numba.config.CACHE_DIR = numba.config.CACHE_DIR, str(folder)
    try:
        kernel.enable_caching()
    finally:
        numba.config.CACHE_DIR = before
    # Its own key pickles what the closure holds, which is not the same bytes in every process.
    kernel._cache._index_key = lambda signature, codegen: (signature, codegen.magic_tuple(), key)


def _forget_old(base: Path) -> None:
    limit = time.time() - KEEP
    with contextlib.suppress(OSError):
        for folder in base.iterdir():
            if folder.stat().st_mtime < limit:
                shutil.rmtree(folder, ignore_errors=True)
