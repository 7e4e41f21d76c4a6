"""Reads and checks the values of a YAML document; every error is one line that names the file and the key or line."""

import math
import textwrap
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from st_core import yaml_text
from st_core.errors import ConfigurationError, add_prefix


def read_text(path: Path | str) -> str:
    """The text of a file in UTF-8. Raises ConfigurationError; its message, one line, begins with the path."""
    try:
        return Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None


def read_document(path: Path) -> Any:
    """The document in a file; None if empty. Raises ConfigurationError; its message, one line, begins with the path."""
    text = read_text(path)
    return add_prefix(f"{path}: ", lambda: yaml_text.load(text))


def to_one_line(error: object) -> str:
    """The text of an error as one printable line of at most 300 characters."""
    text = "".join(c if c.isprintable() else " " for c in str(error))
    return textwrap.shorten(text, 300, placeholder=" ...") or type(error).__name__


_TYPE_NAMES = {str: "a string", bool: "true or false", int: "a whole number"}


class Entry:
    """One mapping of the document. origin: name of the file, for errors. path: dotted key of the mapping. The methods
    raise ConfigurationError for a missing or unknown key, and for a value of a wrong type or outside its limits."""

    def __init__(self, origin: str, path: str, value: Any):
        self.origin = origin
        self.path = path
        if not isinstance(value, dict) or not all(isinstance(key, str) for key in value):
            raise ConfigurationError(f"{origin}: {path or 'the document'}: expected a mapping with string keys")
        self._value = value

    def error(self, key: str, problem: str) -> ConfigurationError:
        return ConfigurationError(f"{self.origin}: {self._path_of(key)}: {problem}")

    def _path_of(self, key: str) -> str:
        return f"{self.path}.{key}" if self.path else key

    def _value_of(self, key: str) -> Any:
        if key not in self._value:
            raise self.error(key, "missing")
        return self._value[key]

    def __iter__(self) -> Iterator[str]:
        return iter(self._value)

    def allow_only(self, *keys: str) -> None:
        for key in self._value:
            if key not in keys:
                raise self.error(key, f"unknown key; known: {', '.join(keys)}")

    def entry(self, key: str) -> "Entry":
        return Entry(self.origin, self._path_of(key), self._value_of(key))

    def entries(self, key: str) -> list["Entry"]:
        values = self._value.get(key, [])
        if not isinstance(values, list):
            raise self.error(key, "expected a list")
        return [Entry(self.origin, f"{self._path_of(key)}[{i}]", value) for i, value in enumerate(values)]

    def get(self, key: str, kind: type) -> Any:
        """The value of a key, of exactly this type."""
        value = self._value_of(key)
        if type(value) is not kind:
            raise self.error(key, f"{value!r} is not {_TYPE_NAMES[kind]}")
        return value

    def choice(self, key: str, allowed: Iterable[Any]) -> Any:
        value = self._value_of(key)
        value = "off" if value is False else value  # YAML reads a bare `off` as false
        options = list(allowed)
        if isinstance(value, bool) or value not in options:
            raise self.error(key, f"{value!r} is not one of {', '.join(str(o) or repr(o) for o in options)}")
        return value

    def number(self, key: str, minimum: float, maximum: float, default: float | None = None) -> float:
        if key not in self._value and default is not None:
            return default
        return self._number(key, self._value_of(key), minimum, maximum)

    def integer(self, key: str, minimum: int, maximum: int) -> int:
        return int(self._number(key, self.get(key, int), minimum, maximum))

    def duration(self, key: str, minimum: float, maximum: float) -> float:
        """A number of seconds with its unit, `key: {value: 1.0, unit: s}`."""
        entry = self.entry(key)
        entry.allow_only("value", "unit")
        entry.choice("unit", ("s",))
        return entry.number("value", minimum, maximum)

    def interval(self, key: str, default: tuple[float, float]) -> tuple[float, float]:
        if key not in self._value:
            return default
        value = self._value[key]
        if not isinstance(value, list) or len(value) != 2:
            raise self.error(key, "expected [minimum, maximum]")
        low, high = (self._number(key, v, -1e12, 1e12) for v in value)
        if not low < high:
            raise self.error(key, f"{low:g} is not below {high:g}")
        return low, high

    def _number(self, key: str, value: Any, minimum: float, maximum: float) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float) or math.isnan(value):
            raise self.error(key, f"{value!r} is not a number")
        if not minimum <= value <= maximum:
            raise self.error(key, f"{value:g} is outside {minimum:g} to {maximum:g}")
        return float(value)
