"""Cache of compiled kernels on disk, shared by all processes.

Each kernel has a folder, named by a hash of all its dependencies: sources and values of all equations and plug-ins,
these backend modules, numba, numpy, Python and the CPU. The cache of numba checks only the file of the kernel, so it
would return outdated code after a change in another file.
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

KERNEL_LIFETIME = 30 * 86400.0  # s; kernels not used for this long are deleted: each edit of an equation adds one


def enable_cache(kernel, fingerprint: str) -> Path | None:
    """Cache a function before it is compiled; delete unused kernels. Returns the folder; None if none can be used."""
    files = sorted(Path(__file__).parent.glob("*.py"))
    parts = (fingerprint, numba.__version__, np.__version__, platform.python_version(),
             *map(str, cpu_target.target_context.codegen().magic_tuple()),
             *(hashlib.sha256(file.read_bytes()).hexdigest() for file in files))
    key = hashlib.sha256("\n".join(parts).encode()).hexdigest()[:32]
    for base in _list_base_folders():
        try:
            folder = base / key
            folder.mkdir(parents=True, exist_ok=True)
            os.utime(folder)  # records that it is used; fails in another user's folder
            # numba reads CACHE_DIR when the cache is switched on, and refuses a folder it cannot write to.
            previous, numba.config.CACHE_DIR = numba.config.CACHE_DIR, str(folder)
            try:
                kernel.enable_caching()
            finally:
                numba.config.CACHE_DIR = previous
            # numba's own key pickles the closure, which differs between processes.
            kernel._cache._index_key = lambda signature, codegen: (signature, codegen.magic_tuple(), key)
        except (OSError, RuntimeError, AttributeError):  # not writable, or another version of numba
            continue
        with contextlib.suppress(OSError):
            for old in base.iterdir():
                if old.stat().st_mtime < time.time() - KERNEL_LIFETIME:
                    shutil.rmtree(old, ignore_errors=True)
        return folder
    return None


def compile_or_load(kernel, signature) -> None:
    """Compile a kernel or load it from the cache; compile it without cache if the folder is damaged or unwritable."""
    try:
        kernel.compile(signature)
    except NumbaError:
        raise
    except Exception:  # unpickling a truncated file raises many kinds of errors
        if kernel.signatures:
            return  # compiled, but not saved
        with contextlib.suppress(OSError):
            kernel._cache.flush()
        kernel._cache.disable()
        kernel.compile(signature)


def _list_base_folders() -> Iterator[Path]:
    if numba.config.CACHE_DIR:  # NUMBA_CACHE_DIR, set by the user
        yield Path(numba.config.CACHE_DIR) / "st_core"
    yield Path(__file__).parent / "__pycache__" / "kernels"
    with contextlib.suppress(RuntimeError):  # no home
        yield Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "st_core" / "kernels"
