"""Errors and warnings about recordings; each states the file, the problem and, if known, the remedy."""

import codecs
import logging
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

_COMPRESSED = {b"\x1f\x8b": "gzip", b"pk\x03\x04": "zip, or a spreadsheet", b"bzh": "bzip2", b"\xfd7zxz": "xz",
               b"7z\xbc\xaf": "7-Zip", b"\x28\xb5\x2f\xfd": "zstd"}
FOREIGN_MAGIC = {
    **{magic: (f"a compressed file ({kind})", "unpack it first") for magic, kind in _COMPRESSED.items()},
    b"version https://git-lfs": ("a pointer of Git LFS instead of the file", "fetch the file with `git lfs pull`"),
    **dict.fromkeys((b"<!doctype html", b"<html"), ("a web page instead of the file", "download the file itself")),
    b"%pdf-": ("a PDF document", "export the data as .csv")}
"""First bytes, in lower case, of a file that is never a recording -> (what it is, advice)."""
CP1252_FALLBACK = "single_track_cp1252"
"""Name of an error handler that decodes Windows-1252 bytes in a text that is otherwise UTF-8."""
codecs.register_error(CP1252_FALLBACK, lambda error: (
    error.object[error.start:error.end].decode("cp1252", "replace"), error.end))  # type: ignore[attr-defined]
_COMMON_CHINESE = re.compile(rb"[\xa1-\xa3\xb0-\xd7](?:[\xa1-\xfe]|\Z)")  # punctuation and first level of GB 2312
_LOGGER = logging.getLogger("st_recordings")
logged_warnings: set[str] = set()
MAX_SIMILAR_WARNINGS = 3  # number of similar warnings that are logged in full while warnings are grouped
# While warnings are grouped: text without file and numbers -> the warnings that share it.
_groups: ContextVar[dict[str, list[str]] | None] = ContextVar("_groups", default=None)


def find_codec(head: bytes) -> str:
    """Codec of a text, from its first bytes: UTF-16, with or without a byte order mark; GBK if they are not UTF-8 and
    contain only ASCII and at least two common Chinese characters; else UTF-8, to be decoded with CP1252_FALLBACK."""
    if head[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return "utf-16"
    for codec, text, zeros in (("utf-16-le", head[:200:2], head[1:200:2]), ("utf-16-be", head[1:200:2], head[:200:2])):
        if len(head) > 1 and all(text) and not any(zeros):
            return codec
    is_utf8 = head.startswith(head.decode("utf-8", "ignore").encode())
    is_chinese = len({*_COMMON_CHINESE.findall(head)}) > 1 and _COMMON_CHINESE.sub(b"", head).isascii()
    return "gb18030" if is_chinese and not is_utf8 else "utf-8-sig"


class RunError(ValueError):
    """A run or one of its files cannot be used. path: the file, folder or option that the message names."""

    def __init__(self, path: Path | str, problem: str, advice: str = ""):
        self.path, self.problem, self.advice = path, problem, advice
        super().__init__(escape_unprintable(f"{path}: {problem}" + (f"; {advice}" if advice else "")))


@contextmanager
def convert_errors(path: Path, fault: str, advice: str, *types: type[Exception]) -> Iterator[None]:
    """Context in which errors of these types, from libraries, become a RunError with their text in brackets; a missing
    library becomes one that names the library."""
    try:
        yield
    except ModuleNotFoundError as error:
        advice = f"read it without a sourced ROS 2, install it by pip install {error.name}, or export the file as .csv"
        raise RunError(path, f"cannot be read without the Python package {error.name}", advice) from None
    except types as error:
        raise error if isinstance(error, RunError) else RunError(path, f"{fault} ({shorten(error)})", advice) from None


def escape_unprintable(text: str) -> str:
    """Escapes control characters, which damaged files may contain, and line breaks."""
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def format_count(count: int, total: int, noun: str) -> str:
    """Formats a count and its percentage of the total, such as "98 of 249 rows (39 %)"."""
    percent = min(100.0 * count / max(total, 1), 99.9 if count < total else 100.0)
    digits = f"{percent:.2g}" if percent < 10 else f"{percent:.3g}" if percent > 99.0 else f"{percent:.0f}"
    return f"{count} of {total} {noun} ({digits} %)"


def shorten(error: Exception) -> str:
    """The text of an error as one line of at most 120 characters; the name of its type if it has no text."""
    return (" ".join(str(error).split()) or type(error).__name__)[:120]


def log_warnings(warnings: Iterable[str]) -> None:
    """Logs each warning, but the same text only once per process."""
    for warning in warnings:
        if warning in logged_warnings:
            continue
        logged_warnings.add(warning)
        if (groups := _groups.get()) is not None:
            similar = groups.setdefault(re.sub(r"[\d.]+", "", warning.partition(": ")[2]), [])
            similar.append(warning)
            if len(similar) > MAX_SIMILAR_WARNINGS:
                continue
        _LOGGER.warning("warning: %s", escape_unprintable(warning))


@contextmanager
def group_similar_warnings() -> Iterator[None]:
    """Context that groups warnings that differ only in file and numbers. The first MAX_SIMILAR_WARNINGS of a group are
    logged in full; on exit, one more warning gives the number of the others and at most 10 of their files."""
    groups: dict[str, list[str]] = {}
    token = _groups.set(groups)
    try:
        yield
    finally:
        _groups.reset(token)
        for similar in groups.values():
            if others := similar[MAX_SIMILAR_WARNINGS:]:
                _LOGGER.warning("warning: %s", escape_unprintable(
                    f"{len(others)} more such as {similar[0][:100]}...: {_list_files(others)}"))


def join_problems(problems: Iterable[str]) -> str:
    """Joins error messages; messages that differ only in the file name are merged into one that lists the files."""
    groups: dict[str, list[str]] = {}
    for problem in problems:
        file, _, message = problem.partition(": ")
        stem = Path(file).stem
        groups.setdefault(re.sub(rf"\b{re.escape(stem)}\b", "", message) if stem else message, []).append(problem)
    return "; ".join(f"{first} (the same in {_list_files(others)})" if others else first
                     for first, *others in groups.values())


def _list_files(messages: Sequence[str]) -> str:
    """The files that the messages name, at most 10."""
    more = f" and {len(messages) - 10} more" if len(messages) > 10 else ""
    return ", ".join(message.partition(": ")[0] for message in messages[:10]) + more


def check_readable(path: Path) -> None:
    """Raises RunError for a folder, or a file that is missing, empty, unreadable or begins with FOREIGN_MAGIC."""
    try:
        if not path.is_file():
            raise RunError(path, "this is a folder, not a file" if path.exists() else "the file does not exist")
        with path.open("rb") as stream:
            head = stream.read(24).lower()
            if not head:
                raise RunError(path, "the file is empty", "remove it from the command")
            for magic in filter(head.startswith, FOREIGN_MAGIC):
                raise RunError(path, f"this is {FOREIGN_MAGIC[magic][0]}", FOREIGN_MAGIC[magic][1])
    except OSError as error:
        raise RunError(path, f"cannot be read: {error.strerror}") from None
