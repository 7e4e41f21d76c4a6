"""Declares node parameters with type, unit and range; a wrong name, type or value prevents the start of the node."""

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

from rcl_interfaces.msg import ParameterDescriptor
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

BUILT_IN = ("use_sim_time", "start_type_description_service")  # declared by rclpy on every node


class ConfigurationError(ValueError):
    """A parameter, file or device prevents the start of a node; the message is one line."""


@dataclass(frozen=True)
class Parameter:
    """Declaration of a node parameter."""

    name: str  # as in the YAML file
    default: Any  # also defines the type; a float accepts integers
    description: str
    unit: str = ""  # of the value, or "" if it has none
    minimum: float = -math.inf  # inclusive
    maximum: float = math.inf  # inclusive
    choices: tuple[Any, ...] = ()  # permitted values; empty: any

    def describe_limit(self) -> str:
        if self.choices:
            return "one of " + ", ".join(map(str, self.choices))
        return f"{self.minimum:g} to {self.maximum:g}" + (f" {self.unit}" if self.unit else "")

    def check(self, value: Any) -> Any:
        """Convert a value to the declared type. NaN is valid only if it is the default. Raises ConfigurationError."""
        kind = type(self.default)
        if kind is float and isinstance(value, int) and not isinstance(value, bool):
            value = float(value)
        if kind in (list, tuple):
            if value is None:  # rcl passes `[]` as None
                return []
            if not isinstance(value, Sequence) or isinstance(value, str):
                raise ConfigurationError(f"{self.name}: {value!r} is not a list")
            return [str(v) for v in value] if all(isinstance(d, str) for d in self.default) else list(value)
        if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
            raise ConfigurationError(f"{self.name}: {value!r} has type {type(value).__name__}, not {kind.__name__}")
        if self.choices and value not in self.choices:
            raise ConfigurationError(f"{self.name}: {value!r} is not {self.describe_limit()}")
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        is_unset = is_number and math.isnan(value) and math.isnan(self.default)
        if is_number and not is_unset and not self.minimum <= value <= self.maximum:
            raise ConfigurationError(f"{self.name}: {value} is outside {self.describe_limit()}")
        return value


def declare(node: Node, parameters: Sequence[Parameter]) -> SimpleNamespace:
    """Declare parameters on a node; returns their checked values as attributes, and as attribute `message_prefix` the
    names of the parameter file, if one was given, and of the node. Raises ConfigurationError with this prefix, key and
    limit, also for a parameter that is given but not declared."""
    overrides = dict(node._parameter_overrides)  # rclpy has no public access to them before the declaration
    arguments = list(getattr(node.context, "_cli_args", None) or sys.argv)
    files = [arguments[i + 1] for i, option in enumerate(arguments[:-1]) if option == "--params-file"]
    origin = f"{files[-1]}: " if files else ""
    declared_names = {p.name for p in parameters}
    for name in overrides:
        if name not in declared_names and name not in BUILT_IN and not name.startswith("qos_overrides."):
            raise ConfigurationError(
                f"{origin}{node.get_name()}: unknown parameter {name}; known: {', '.join(sorted(declared_names))}")
    values = SimpleNamespace(message_prefix=f"{origin}{node.get_name()}.")
    for parameter in parameters:
        try:
            raw_value = overrides[parameter.name].value if parameter.name in overrides else parameter.default
            value = parameter.check(raw_value)
        except ConfigurationError as error:
            raise ConfigurationError(f"{origin}{node.get_name()}.{error}") from None
        override = {parameter.name: RosParameter(parameter.name, value=value)} if value != [] else {}
        node._parameter_overrides.update(override)
        # Read-only, because a node reads its parameters only when it starts.
        description = parameter.description + (f" [{parameter.unit}]" if parameter.unit else "")
        descriptor = ParameterDescriptor(description=description, read_only=True, dynamic_typing=True)
        node.declare_parameter(parameter.name, value if value != [] else [""], descriptor)
        setattr(values, parameter.name, value)
    return values
