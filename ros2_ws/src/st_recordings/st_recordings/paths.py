"""Finds paths and the version of the project, creates output folders, and writes files and JSON."""

import json
import math
import os
import re
import shutil
import subprocess
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import fields, is_dataclass
from datetime import UTC, datetime
from functools import lru_cache, wraps
from importlib import metadata
from pathlib import Path
from typing import Any, TypeVar

T = TypeVar("T")
DISTRIBUTION = "single-track-predictor"
INSTALLED_FILES = Path(__file__).parent / "share"  # exists in the wheel only
MIN_FREE_SPACE = 10_000_000  # bytes, enough for the shortest run


def project_root() -> Path:
    """Checkout set by ./st, else share/ of the wheel, else the checkout of the current folder. Raises SystemExit."""
    if "ST_ENVIRONMENT" in os.environ:
        return Path(os.environ["ST_ENVIRONMENT"])
    for folder in (INSTALLED_FILES, Path.cwd(), *Path.cwd().parents):
        if (folder / "config" / "nodes.yaml").exists():
            return folder
    raise SystemExit("st: project folder not found: start with ./st, or from inside the checkout")


def config(relative: str) -> Path:
    """A file or folder below config/."""
    return project_root() / "config" / relative


def source_version() -> str:
    """Version of the wheel if its files are used, else `git describe` of the checkout; "unknown" without either."""
    try:
        if (root := project_root()) == INSTALLED_FILES:  # the wheel may be installed inside a different git repository
            return metadata.version(DISTRIBUTION)
        command = ["git", "-C", str(root), "describe", "--always", "--dirty", "--tags"]
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=5).stdout.strip()
    except (OSError, subprocess.SubprocessError, metadata.PackageNotFoundError):
        return "unknown"


class OutputError(OSError):
    """An output file or folder cannot be used. The text is one line for the user."""


_created_folders: list[Path] = []


def new_folder(output: Path | None, name: str, create: bool = True) -> Path:
    """Absolute path of `output`, or else of runs/<name>-<time>, created if `create`. Raises OutputError if it is a
    file, is not empty, or cannot be read or created; with `create`, also if its disk is full."""
    folder = output or Path("runs") / f"{name}-{datetime.now(UTC):%Y%m%d-%H%M%S}"
    try:
        if folder.exists() and (folder.is_file() or any(folder.iterdir())):
            problem = "is a file" if folder.is_file() else "is not empty"
            raise OutputError(f"{folder} {problem}: choose another --output (existing files are not overwritten)")
        if create:
            if not folder.exists():
                _created_folders.append(folder.absolute())
            folder.mkdir(parents=True, exist_ok=True)
            if (free_space := shutil.disk_usage(folder).free) < MIN_FREE_SPACE:
                raise OutputError(f"{folder}: its disk is full ({free_space / 1e6:.1f} MB left, "
                                  f"{MIN_FREE_SPACE / 1e6:.0f} MB required): free space, or choose another --output")
    except OutputError:
        raise
    except OSError as error:
        raise OutputError(f"{folder}: cannot be created or read: {error.strerror}") from None
    return folder.absolute()


def remove_empty_folders() -> None:
    """Removes the folders made by `new_folder` in which nothing was written, when a command ends with an error."""
    while _created_folders:
        with suppress(OSError):
            _created_folders.pop().rmdir()


def replace_file(path: Path, text: str) -> None:
    """Replaces a file atomically: a reader sees the old or the new text. After an OSError the old one is unchanged."""
    temporary = path.with_name(f"{path.name}.new")
    try:
        with temporary.open("w", encoding="utf-8") as stream:
            stream.write(text)
            stream.flush()
            os.fsync(stream.fileno())
        temporary.replace(path)
    except OSError:
        temporary.unlink(missing_ok=True)
        raise


def cached_by_version(maxsize: int) -> Callable[[Callable[[Path], T]], Callable[[Path], T]]:
    """Decorator that caches a function of a file until the size or modification time of the file changes.

    maxsize: number of results that are kept.
    """
    def find_version(file: Path) -> tuple[int, int] | None:
        try:
            status = file.stat()
            return status.st_mtime_ns, status.st_size
        except OSError:
            return None

    def decorate(function: Callable[[Path], T]) -> Callable[[Path], T]:
        cached_function = lru_cache(maxsize)(lambda file, version: function(file))
        return wraps(function)(lambda file: cached_function(file, find_version(file)))

    return decorate


def natural_sort_key(path: Path) -> tuple[list[tuple[bool, int, str]], str]:
    """Sort key for file names with numbers: drive_9 comes before drive_10."""
    parts = re.split(r"(\d+)", path.stem)
    return [(part.isdecimal(), int(part) if part.isdecimal() else 0, part) for part in parts], path.suffix


def json_ready(value: Any) -> Any:
    """Converts a value to the Python types of JSON: dataclasses and mappings to dicts, tuples and NumPy arrays to
    lists; NaN and infinity become None."""
    if is_dataclass(value):
        value = {field.name: getattr(value, field.name) for field in fields(value)}
    elif hasattr(value, "tolist"):  # NumPy arrays and numbers
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(k): json_ready(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [json_ready(v) for v in value]
    if isinstance(value, bool | int | str) or value is None:
        return value
    number = float(value)
    return number if math.isfinite(number) else None


def json_text(content: Mapping[str, Any]) -> str:
    return json.dumps(json_ready(content), indent=1, allow_nan=False, ensure_ascii=False) + "\n"
