"""The CAN logs there are: a further text or binary format is one line here. What reads it is imported when it reads."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from .mf4 import MAKERS_CONTAINERS

MF4_EXTENSIONS = (".mf4", ".mdf")
_BLF_HEAD = 16  # bytes: "LOBJ", length of the head, version, length of the object, kind


@dataclass(frozen=True)
class Format:
    """How python-can reads a text or binary log. extensions: lower case. mark: whether the head of a file is of it."""

    name: str
    extensions: tuple[str, ...]
    mark: Callable[[bytes], bool]
    reader: Callable[[str], Iterable[Any]]


def _is_candump(head: bytes) -> bool:
    line = head.lstrip().split(b"\n", 1)[0]
    return line.startswith(b"(") and b") " in line and b"#" in line


def _io(name: str) -> Any:
    return import_module(f"can.io.{name}")


def _blf(file: str) -> Iterable[Any]:
    from can.io import blf

    class Reader(blf.BLFReader):
        """python-can's reader never gets past an object that says it has no length."""

        def _parse_data(self, data: bytes) -> Iterator[Any]:
            at = data.find(b"LOBJ", 0, 8)
            while 0 <= at <= len(data) - _BLF_HEAD:
                length = int.from_bytes(data[at + 8:at + 12], "little")
                if length < _BLF_HEAD:
                    raise blf.BLFParseError(f"an object of {length} bytes")
                at = data.find(b"LOBJ", at + length, at + length + 8)
            return super()._parse_data(data)

    return Reader(file)


FORMATS = (
    Format("candump", (".log", ".candump"), _is_candump, lambda file: _io("canutils").CanutilsLogReader(file)),
    Format("Vector ASC", (".asc",), lambda head: head.lstrip()[:5].lower() == b"date " or b"\nbase hex" in head,
           lambda file: _io("asc").ASCReader(file, relative_timestamp=False)),
    Format("Vector BLF", (".blf",), lambda head: head.startswith(b"LOGG"), _blf),
    Format("PEAK trace", (".trc",), lambda head: b";$FILEVERSION" in head or b";   Message Number" in head,
           lambda file: _io("trc").TRCReader(file)),
)
EXTENSIONS = frozenset(e for f in FORMATS for e in f.extensions) | {*MF4_EXTENSIONS, *MAKERS_CONTAINERS}
