"""Errors about files: one sentence for the user, naming the file and what to do."""

from pathlib import Path


class RunError(ValueError):
    """A run, or a file of one, that cannot be used."""

    def __init__(self, path: Path | str, what: str, advice: str = ""):
        self.path, self.what, self.advice = path, what, advice
        super().__init__(printable(f"{path}: {what}" + (f"; {advice}" if advice else "")))


def printable(text: str) -> str:
    """Names and pieces of damaged files as one line for a terminal: control characters are shown, not obeyed."""
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def share(count: int, total: int, what: str) -> str:
    """A part of a recording with its share, "98 of 249 rows (39 %)"."""
    percent = 100.0 * count / max(total, 1)
    return f"{count} of {total} {what} ({f'{percent:.0f}' if percent >= 10 else f'{percent:.2g}'} %)"


def short(error: Exception) -> str:
    """The text of another library's error in one line, or its kind."""
    return (" ".join(str(error).split()) or type(error).__name__)[:120]


PACKED = {b"\x1f\x8b": "gzip", b"PK\x03\x04": "zip, or a spreadsheet", b"BZh": "bzip2", b"\xfd7zXZ": "xz",
          b"7z\xbc\xaf": "7-Zip", b"\x28\xb5\x2f\xfd": "zstd"}
"""First bytes of a compressed file -> its kind."""


def check_readable(path: Path) -> None:
    """Raises RunError for a file that is missing, empty or not to be opened."""
    try:
        if not path.is_file():
            raise RunError(path, "the file does not exist" if not path.exists() else "this is a folder, not a file")
        with path.open("rb") as stream:
            head = stream.read(6)
            if not head:
                raise RunError(path, "the file is empty", "remove it from the command")
            if packed := next((name for mark, name in PACKED.items() if head.startswith(mark)), None):
                raise RunError(path, f"this is a compressed file ({packed})", "unpack it first")
    except OSError as error:
        raise RunError(path, f"cannot be read: {error.strerror}") from None
