"""YAML that a person writes and a program checks: no key twice, no key unknown, none missing."""

import difflib
import json
from collections.abc import Iterable, Mapping
from typing import Any

import yaml

from .errors import ConfigurationError


class _Loader(yaml.SafeLoader):
    """Refuses a key given twice; YAML itself keeps the last one without a word."""

    def construct_mapping(self, node, deep=False):
        seen = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if not isinstance(key, str):
                raise ConfigurationError(f"{key!r}: a key must be a text (line {key_node.start_mark.line + 1})")
            if key in seen:
                raise ConfigurationError(f"{key}: given twice (line {key_node.start_mark.line + 1}); remove one")
            seen.add(key)
        return super().construct_mapping(node, deep)


def load(text: str) -> Any:
    """The document; raises ConfigurationError with the line for what is no YAML or gives a key twice."""
    try:
        return yaml.load(text, _Loader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        place = f", line {mark.line + 1}" if mark else ""
        raise ConfigurationError(f"not valid YAML{place}: {getattr(error, 'problem', None) or error}") from None


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
