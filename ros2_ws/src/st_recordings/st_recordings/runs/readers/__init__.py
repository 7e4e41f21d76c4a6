"""Kinds of recordings as plug-ins: one file each, found by being in this folder.

A file registers one `Reader`. What is slow to load it imports when it reads: most runs are of one kind.
"""

import importlib
import pkgutil

from ._base import READERS, Reader, reader_of, register

for _module in sorted(info.name for info in pkgutil.iter_modules(__path__)):
    if not _module.startswith("_"):
        importlib.import_module(f"{__name__}.{_module}")

__all__ = ["READERS", "Reader", "reader_of", "register"]
