"""Reads and writes configuration in a safe subset of YAML: mappings with text keys, lists and plain values.

Files may come from other people, so other features of YAML are rejected: aliases (a few hundred bytes can expand to
billions of values), tags, duplicate keys (PyYAML silently uses the last one), several documents, deep nesting.
"""

import difflib
import hashlib
import json
import re
from collections.abc import Iterable, Mapping
from typing import Any

import yaml

from .errors import ConfigurationError

MAX_CHARACTERS = 1 << 20
MAX_NESTING = 40
LARGEST_INTEGER = 2**63  # a larger integer is a mistake and could overflow a float
_PLAIN_KEY = re.compile(r"(?!(?:y|n|yes|no|on|off|true|false|null)$)[a-z]\w*", re.IGNORECASE)  # PyYAML reads it as text


class _Loader(yaml.SafeLoader):
    _levels = 0

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        event = self.peek_event()
        line = event.start_mark.line + 1
        if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None):
            raise ConfigurationError(f"anchors (&) and aliases (*) are not allowed (line {line}); write the value out")
        if getattr(event, "tag", None):
            raise ConfigurationError(f"tags (!) are not allowed (line {line}); write the plain value")
        self._levels += 1
        if self._levels > MAX_NESTING:
            raise ConfigurationError(f"more than {MAX_NESTING} levels of nesting (line {line})")
        node = super().compose_node(parent, index)
        self._levels -= 1
        return node

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict:
        keys = set()
        for key_node, value_node in node.value:
            line = key_node.start_mark.line + 1
            if key_node.tag == "tag:yaml.org,2002:merge":
                raise ConfigurationError(f"merging (<<) is not allowed (line {line}); write the values out")
            key = self.construct_object(key_node, deep=True)
            if not isinstance(key, str):
                is_decimal_comma = node.flow_style and type(key) is int and not value_node.value  # for example {x: 1,5}
                comma = "; write decimal points, not commas" if is_decimal_comma else ""
                raise ConfigurationError(f"{_shorten(key)}: a key must be a string (line {line}){comma}")
            if not key.isprintable():
                raise ConfigurationError(f"{_shorten(key)}: a key must be printable (line {line})")
            if key in keys:
                raise ConfigurationError(f"{key}: given twice (line {line}); remove one")
            keys.add(key)
        return super().construct_mapping(node, deep)

    def construct_checked_scalar(self, node: yaml.ScalarNode) -> Any:
        """A number or date. Raises ConfigurationError, with the line, if it cannot be converted or is too large."""
        try:
            value = yaml.SafeLoader.yaml_constructors[node.tag](self, node)
        except (ValueError, OverflowError) as error:
            raise ConfigurationError(f"{_shorten(node.value)}: {error} (line {node.start_mark.line + 1})") from None
        if isinstance(value, int) and abs(value) > LARGEST_INTEGER:
            raise ConfigurationError(f"{_shorten(node.value)}: number too large (line {node.start_mark.line + 1})")
        return value


for _kind in ("int", "float", "timestamp"):
    _Loader.add_constructor(f"tag:yaml.org,2002:{_kind}", _Loader.construct_checked_scalar)


def load(text: str) -> Any:
    """The document in a text; None if empty. Raises ConfigurationError, with a one-line message, for invalid YAML."""
    if len(text) > MAX_CHARACTERS:
        raise ConfigurationError(f"{len(text)} characters are too many for a configuration (limit {MAX_CHARACTERS})")
    try:
        return _Loader(text).get_single_data()
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        location = f", line {mark.line + 1}" if mark else ""
        problem = " ".join(str(getattr(error, "problem", None) or error).split())
        raise ConfigurationError(f"not valid YAML{location}: {problem}") from None
    except RecursionError:
        raise ConfigurationError(f"not valid YAML: more than {MAX_NESTING} levels of nesting") from None


def _shorten(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 80 else text[:77] + "..."


def check_keys(prefix: str, section: Mapping[Any, Any], known: list[str], required: Iterable[str] = ()) -> None:
    """Raises ConfigurationError for an unknown or missing key. prefix: text before the key in messages."""
    for key in section:
        if key not in known:
            raise ConfigurationError(
                f"{prefix}{key}: unknown key{suggest_key(str(key), known)}; known: {', '.join(known)}")
    for key in required:
        if key not in section:
            raise ConfigurationError(f"{prefix}{key}: missing; add it")


def suggest_key(key: str, known: Iterable[str]) -> str:
    """The text ", did you mean KEY?" with the most similar known key; "" if none is similar."""
    matches = difflib.get_close_matches(key, known, n=1)
    return f", did you mean {matches[0]}?" if matches else ""


def format_number(value: float) -> str:
    """A number with all its digits, in a form that PyYAML reads as a number (1.0e-06, not 1e-06)."""
    text = repr(float(value))
    return text if "e" not in text or "." in text else text.replace("e", ".0e")


def hash_content(content: Any) -> str:
    """sha256 (hex) of mappings, lists and plain values; the order of the keys does not matter."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def dump(content: Mapping[str, Any], indent: str = "") -> str:
    """YAML text: mappings that contain mappings are in block style, everything else is in flow style."""
    lines = []
    for key, value in content.items():
        is_block = isinstance(value, Mapping) and any(isinstance(part, Mapping) for part in value.values())
        text = "\n" + dump(value, indent + "  ") if is_block else f" {dump_flow(value)}\n"
        lines.append(f"{indent}{_dump_key(key)}:{text}")
    return "".join(lines)


def dump_flow(value: Any) -> str:
    """A value in flow style."""
    if isinstance(value, float):
        return format_number(value)
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{_dump_key(key)}: {dump_flow(part)}" for key, part in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(dump_flow, value)) + "]"
    return json.dumps(value, ensure_ascii=False)


def _dump_key(key: str) -> str:
    return key if _PLAIN_KEY.fullmatch(key) else json.dumps(key, ensure_ascii=False)
