"""YAML that a person writes and a program checks: plain, no key unknown, none missing; and how it is written."""

import difflib
import json
from collections.abc import Iterable, Mapping
from typing import Any

from .errors import ConfigurationError
from .plain_yaml import load


def check_keys(prefix: str, section: Mapping[Any, Any], known: list[str], required: Iterable[str] = ()) -> None:
    """Raises ConfigurationError naming, after `prefix`, an unknown key and the nearest known one, or a missing key."""
    for key in section:
        if key not in known:
            near = nearest(str(key), known)
            raise ConfigurationError(f"{prefix}{key}: unknown key{near}; known are {', '.join(known)}")
    for key in required:
        if key not in section:
            raise ConfigurationError(f"{prefix}{key}: missing; add it")


def nearest(key: str, known: Iterable[str]) -> str:
    """", did you mean ...?", or nothing when no known key is near."""
    near = difflib.get_close_matches(key, known, n=1)
    return f", did you mean {near[0]}?" if near else ""


def number(value: float) -> str:
    """All digits, in a form YAML reads as a number (1.0e-06, not 1e-06)."""
    text = repr(float(value))
    return text if "e" not in text or "." in text else text.replace("e", ".0e")


def quoted(text: str) -> str:
    """A text in double quotes."""
    return json.dumps(text, ensure_ascii=False)


__all__ = ["check_keys", "load", "nearest", "number", "quoted"]
