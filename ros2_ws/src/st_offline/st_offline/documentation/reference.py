"""docs/reference.md: commands, topics, message fields and node parameters, from the code itself."""

import importlib
import math
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

from st_recordings.paths import project_root
from st_ros.parameters import Parameter
from typer.core import TyperGroup, TyperOption

from .topics import TOPICS

NODES = {  # node: module and name of its parameter table
    "oxts_bridge": ("oxts_bridge.settings", "PARAMETERS"),
    "canedge_bridge": ("canedge_bridge.node", "PARAMETERS"),
    "predictor": ("st_predictor.params", "PREDICTOR"),
    "evaluator": ("st_predictor.params", "EVALUATOR"),
    "recorder": ("st_predictor.params", "RECORDER"),
    "markers": ("st_predictor.params", "MARKERS"),
    "identifier": ("st_predictor.params", "IDENTIFIER"),
}
_FIELD = re.compile(
    r"^(?P<type>[\w/]+(?:\[[^\]]*\])?)\s+(?P<name>\w+)\s*(?:=\s*(?P<value>\S+))?\s*(?:#\s*(?P<text>.*))?$")


def page(st: TyperGroup) -> str:
    """The whole page; st: the command."""
    parts = [
        "# Reference\n\nLook up commands, topics, message fields and node parameters. `./st docs` writes this page "
        "from the code, and a test fails when it is out of date. Units are SI, axes ISO 8855: "
        "[conventions.md](method/conventions.md).\n",
        "## Commands\n", *commands(st),
        "## Topics\n", topics(),
        "## Messages\n", *messages(project_root() / "ros2_ws" / "src" / "st_msgs" / "msg"),
        "## Node parameters\n\nDefaults with comments: [config/nodes.yaml](../config/nodes.yaml).\n", *nodes(),
    ]
    return "\n".join(parts).rstrip() + "\n"


def commands(st: TyperGroup) -> Iterable[str]:
    for name, command in sorted(st.commands.items()):
        arguments = [p for p in command.params if p.param_type_name == "argument"]
        options = [p for p in command.params if isinstance(p, TyperOption) and p.name != "help"]
        usage = " ".join([f"./st {name}", *(f"{a.name.upper()}{'…' if a.nargs == -1 else ''}" for a in arguments)])
        yield f"### `{usage}`\n\n{_plain(command.help)}\n"
        if options:
            yield table(("option", ""), (
                (f"`{o.opts[0]}`" + _kind(o), _plain(o.help)) for o in options))


def topics() -> str:
    return table(("topic", "type", "published by", ""), ((f"`{topic}`", *others) for topic, *others in TOPICS))


def messages(folder: Path) -> Iterable[str]:
    for file in sorted(folder.glob("*.msg")):
        lines = [line.strip() for line in file.read_text().splitlines() if line.strip()]
        heading = [line.lstrip("# ") for line in lines if line.startswith("#")]
        rows = []
        for line in (line for line in lines if not line.startswith("#")):
            field = _FIELD.match(line)
            if field is None:
                raise ValueError(f"{file}: {line}")
            name = field["name"] + (f" = {field['value']}" if field["value"] else "")
            rows.append((f"`{name}`", field["type"].replace("<=", "≤"), field["text"] or ""))
        yield f"### st_msgs/msg/{file.stem}\n\n{' '.join(heading)}\n"
        yield table(("field", "type", "unit, sign, meaning"), rows)


def nodes() -> Iterable[str]:
    for node, (module, name) in NODES.items():
        yield f"### {node}\n"
        parameters: Sequence[Parameter] = getattr(importlib.import_module(module), name)
        yield table(("parameter", "default", "unit", "range", ""), (
            (f"`{p.name}`", f"`{_default(p.default)}`", p.unit, _range(p), p.description) for p in parameters))


def table(heading: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [heading, ["---"] * len(heading), *rows]
    return "\n".join("| " + " | ".join(str(cell).replace("|", "\\|") for cell in row) + " |" for row in lines) + "\n"


def _kind(option: TyperOption) -> str:
    """What stands after the option: nothing for a switch, else the kind of its value."""
    name = getattr(option.type_descriptor.annotation, "__name__", "text")
    return "" if option.is_flag else f" {({'Path': 'file', 'str': 'text'}).get(name, name)}"


def _plain(text: str | None) -> str:
    return " ".join((text or "").split())


def _default(value: object) -> str:
    if isinstance(value, float) and math.isnan(value):
        return ".nan"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(str, value)) + "]"
    return '""' if value == "" else str(value).lower() if isinstance(value, bool) else str(value)


def _range(parameter: Parameter) -> str:
    if parameter.choices:
        return ", ".join(map(str, parameter.choices))
    return f"{parameter.minimum:g} to {parameter.maximum:g}" if math.isfinite(parameter.minimum) else ""
