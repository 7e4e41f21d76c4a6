"""Writes docs/reference.md: commands, topics, message fields and node parameters, read from the code."""

import importlib
import math
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Literal, get_args, get_origin

from st_recordings.paths import project_root
from st_ros.parameters import Parameter
from typer.core import TyperGroup, TyperOption

NODES = {  # node -> module and name of its parameter table
    "oxts_bridge": ("oxts_bridge.node", "PARAMETERS"),
    "canedge_bridge": ("canedge_bridge.node", "PARAMETERS"),
    "predictor": ("st_predictor.params", "PREDICTOR"),
    "evaluator": ("st_predictor.params", "EVALUATOR"),
    "recorder": ("st_predictor.params", "RECORDER"),
    "markers": ("st_predictor.params", "MARKERS"),
    "identifier": ("st_predictor.params", "IDENTIFIER"),
}
# Topic, type, publisher, description. <model> stands for each model.
TOPICS = (
    ("/ins/odometry", "nav_msgs/msg/Odometry", "oxts_bridge",
     "INS point in the map frame (ENU), body velocities; 100 or 250 Hz"),
    ("/ins/imu", "sensor_msgs/msg/Imu", "oxts_bridge", "accelerations and angular rates, body axes"),
    ("/ins/nav_sat_fix", "sensor_msgs/msg/NavSatFix", "oxts_bridge", "latitude, longitude, ellipsoidal height"),
    ("/ins/velocity", "geometry_msgs/msg/TwistWithCovarianceStamped", "oxts_bridge", "body velocities with accuracy"),
    ("/ins/time_reference", "sensor_msgs/msg/TimeReference", "oxts_bridge", "host time of receipt, and UTC of the INS"),
    ("/ins/status", "st_msgs/msg/InsStatus", "oxts_bridge", "modes, satellites, accuracies; latched"),
    ("/ins/trigger", "st_msgs/msg/Trigger", "oxts_bridge", "event inputs and outputs of the INS"),
    ("/ins/origin", "sensor_msgs/msg/NavSatFix", "oxts_bridge", "origin of the map frame; latched"),
    ("/ins/ncom", "st_msgs/msg/Ncom", "oxts_bridge", "every NCOM packet as received"),
    ("/vehicle/steering", "st_msgs/msg/Steering", "canedge_bridge", "steering wheel and road wheel angle, > 0: left"),
    ("/vehicle/wheel_speeds", "st_msgs/msg/WheelSpeeds", "canedge_bridge", "speeds of the four wheels, m/s"),
    ("/vehicle/ins_on_can", "st_msgs/msg/InsOnCan", "canedge_bridge", "values of the INS on CAN, for clock alignment"),
    ("/can/frames", "st_msgs/msg/CanFrames", "canedge_bridge", "raw frames, with publish_frames"),
    ("/plan/inputs", "st_msgs/msg/InputPlan", "your planner", "steering and acceleration, or speed and curvature"),
    ("/predictor/<model>/path", "nav_msgs/msg/Path", "predictor", "predicted path of the INS point; 10 Hz"),
    ("/predictor/<model>/prediction", "st_msgs/msg/Prediction", "predictor", "the whole trajectory, state at the CG"),
    ("/predictor/<model>/plan", "st_msgs/msg/PlannedPrediction", "predictor",
     "the trajectory with the inputs of a plan, and these inputs; while a plan is used"),
    ("/predictor/<model>/course", "st_msgs/msg/PlannedPrediction", "predictor",
     "the trajectory with the inputs of a recorded course; while a course is used"),
    ("/predictor/status", "st_msgs/msg/PredictorStatus", "predictor",
     "number of predictions due, made and skipped; latched"),
    ("/evaluator/errors", "st_msgs/msg/PredictionError", "evaluator", "scores: forecast, plan, course and hindsight"),
    ("/evaluator/summary", "st_msgs/msg/ErrorSummary", "evaluator", "running statistics; latched"),
    ("/identifier/parameters", "st_msgs/msg/TrackedParameters", "identifier",
     "steering and stiffness estimated while driving; latched, never applied"),
    ("/view/markers", "visualization_msgs/msg/MarkerArray", "markers",
     "car, track, earlier predictions, errors, names; 10 Hz"),
    ("/view/bands", "visualization_msgs/msg/MarkerArray", "markers",
     "90 % and 50 % bands of the newest predictions, one namespace per model"),
    ("/view/<model>/error", "geometry_msgs/msg/Vector3Stamped", "markers",
     "mean error of a forecast: x longitudinal, y lateral [m], z yaw [rad]"),
    ("/tf", "tf2_msgs/msg/TFMessage", "oxts_bridge", "odom -> base_link"),
    ("/tf_static", "tf2_msgs/msg/TFMessage", "oxts_bridge", "map -> odom, base_link -> ins_link; latched"),
    ("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", "all", "named checks of every node, once a second"),
    ("/diagnostics_agg", "diagnostic_msgs/msg/DiagnosticArray", "st", "all checks, the worst level first"),
)

_FIELD = re.compile(
    r"^(?P<type>[\w/]+(?:\[[^\]]*\])?)\s+(?P<name>\w+)\s*(?:=\s*(?P<value>\S+))?\s*(?:#\s*(?P<text>.*))?$")


def make_reference_page(st: TyperGroup) -> str:
    """Text of the page; st: the command group with all verbs."""
    parts = [
        "# Reference\n\nLook up commands, topics, message fields and node parameters. `./st docs` writes this page "
        "from the code, and a test fails when it is out of date. Units are SI, axes ISO 8855: "
        "[conventions.md](method/conventions.md).\n",
        "## Commands\n", *describe_commands(st),
        "## Topics\n", describe_topics(),
        "## Messages\n", *describe_messages(project_root() / "ros2_ws" / "src" / "st_msgs" / "msg"),
        "## Node parameters\n\nDefaults with comments: [config/nodes.yaml](../config/nodes.yaml).\n", *describe_nodes(),
    ]
    return "\n".join(parts).rstrip() + "\n"


def describe_commands(st: TyperGroup) -> Iterable[str]:
    for name, command in sorted(st.commands.items()):
        arguments = [p for p in command.params if p.param_type_name == "argument"]
        options = [p for p in command.params if isinstance(p, TyperOption) and p.name != "help"]
        usage = " ".join([f"./st {name}", *(f"{a.name.upper()}{'…' if a.nargs == -1 else ''}" for a in arguments)])
        yield f"### `{usage}`\n\n{_join_lines(command.help)}\n"
        if options:
            yield format_table(("option", ""), (
                (f"`{o.opts[0]}`" + _format_option_type(o), _join_lines(o.help)) for o in options))


def describe_topics() -> str:
    return format_table(("topic", "type", "published by", ""), ((f"`{topic}`", *others) for topic, *others in TOPICS))


def describe_messages(folder: Path) -> Iterable[str]:
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
        yield format_table(("field", "type", "unit, sign, meaning"), rows)


def describe_nodes() -> Iterable[str]:
    for node, (module, name) in NODES.items():
        yield f"### {node}\n"
        parameters: Sequence[Parameter] = getattr(importlib.import_module(module), name)
        yield format_table(("parameter", "default", "unit", "range", ""), (
            (f"`{p.name}`", f"`{_to_yaml(p.default)}`", p.unit, _format_range(p), p.description) for p in parameters))


def format_table(heading: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [heading, ["---"] * len(heading), *rows]
    return "\n".join("| " + " | ".join(str(cell).replace("|", "\\|") for cell in row) + " |" for row in lines) + "\n"


def _format_option_type(option: TyperOption) -> str:
    """Text after the name of an option: the type of each value, or the choices; empty for a flag."""
    if option.is_flag:
        return ""
    annotation = option.type_descriptor.annotation
    kind, parts = get_origin(annotation), get_args(annotation)
    if kind is Literal:
        return " " + " or ".join(f"`{part}`" for part in parts)
    types = parts if kind is tuple else parts[:1] or (annotation,)
    names = (getattr(part, "__name__", "text") for part in types)
    return " " + " ".join({"Path": "file", "str": "text", "float": "number", "int": "integer"}.get(n, n) for n in names)


def _join_lines(text: str | None) -> str:
    return " ".join((text or "").split())


def _to_yaml(value: object) -> str:
    if isinstance(value, float) and math.isnan(value):
        return ".nan"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(str, value)) + "]"
    return '""' if value == "" else str(value).lower() if isinstance(value, bool) else str(value)


def _format_range(parameter: Parameter) -> str:
    if parameter.choices:
        return ", ".join(map(str, parameter.choices))
    return f"{parameter.minimum:g} to {parameter.maximum:g}" if math.isfinite(parameter.minimum) else ""
