"""Folders for what a verb leaves behind."""

from datetime import UTC, datetime
from pathlib import Path


class OutputError(OSError):
    """A folder that cannot be used; one line for the user."""


def new_folder(given: Path | None, name: str, create: bool = True) -> Path:
    """The folder given, or runs/<name>-<time>; never one that already holds something. Raises OutputError."""
    folder = given or Path("runs") / f"{name}-{datetime.now(UTC):%Y%m%d-%H%M%S}"
    try:
        if folder.exists() and (folder.is_file() or any(folder.iterdir())):
            what = "is a file" if folder.is_file() else "is not empty"
            raise OutputError(f"{folder} {what}: name another --output (nothing is ever overwritten)")
        if create:
            folder.mkdir(parents=True, exist_ok=True)
    except OutputError:
        raise
    except OSError as error:
        raise OutputError(f"{folder}: cannot be made: {error.strerror}") from None
    return folder.absolute()
