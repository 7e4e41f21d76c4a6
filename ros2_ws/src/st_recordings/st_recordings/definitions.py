"""Message definitions and type hashes of the installed interface packages, as a bag stores them.

They are read from `share/<package>/msg/` of every prefix in AMENT_PREFIX_PATH; no ROS import.
"""

import json
import os
import re
from functools import cache
from pathlib import Path

SEPARATOR = "=" * 80
PRIMITIVES = frozenset((
    "bool", "byte", "char", "float32", "float64", "string", "wstring",
    "int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64",
))
_FIELD = re.compile(r"^\s*([A-Za-z][\w/]*)(?:<=\d+)?(?:\[[^\]]*\])?\s+[A-Za-z]\w*")


class UnknownTypeError(LookupError):
    """The interface package of a message type is not installed."""


def _file(type_name: str, suffix: str) -> Path:
    package, _, name = type_name.replace("/msg/", "/").partition("/")
    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        path = Path(prefix, "share", package, "msg", name + suffix)
        if prefix and path.is_file():
            return path
    missing = f"share/{package}/msg/{name}{suffix}"
    raise UnknownTypeError(f"message type {type_name} is not installed: no {missing} in AMENT_PREFIX_PATH")


@cache
def definition(type_name: str) -> str:
    """The .msg text of a type ("pkg/msg/Type") followed by those of all types it uses, in the `ros2msg` layout.

    Raises UnknownTypeError.
    """
    text = _file(type_name, ".msg").read_text()
    parts, seen = [text.rstrip("\n") + "\n"], {_short(type_name)}
    waiting = _uses(type_name, text)
    while waiting:
        used = waiting.pop(0)
        if used in seen:
            continue
        seen.add(used)
        text = _file(used, ".msg").read_text()
        parts.append(f"{SEPARATOR}\nMSG: {used}\n{text.rstrip(chr(10))}\n")
        waiting += _uses(used, text)
    return "".join(parts)


@cache
def type_hash(type_name: str) -> str:
    """The hash (RIHS01_...) the interface was built with. Raises UnknownTypeError."""
    document = json.loads(_file(type_name, ".json").read_text())
    for entry in document["type_hashes"]:
        if entry["type_name"] == type_name:
            return str(entry["hash_string"])
    raise UnknownTypeError(f"message type {type_name}: its description file holds no hash")


def _short(type_name: str) -> str:
    return type_name.replace("/msg/", "/")


def _uses(owner: str, text: str) -> list[str]:
    """Types named in a definition, as pkg/Type, in order of appearance."""
    used = []
    for line in text.splitlines():
        match = _FIELD.match(line.split("#", 1)[0])
        if match is None or (name := match.group(1)) in PRIMITIVES:
            continue
        if "/" not in name:
            name = f"{'std_msgs' if name == 'Header' else owner.partition('/')[0]}/{name}"
        used.append(_short(name))
    return used
