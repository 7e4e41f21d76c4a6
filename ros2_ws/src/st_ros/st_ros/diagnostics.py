"""Publishes the named checks of a node and the scheduling of its process on /diagnostics."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from . import scheduling
from .polling import create_steady_timer

OK, WARN, ERROR, STALE = 0, 1, 2, 3
PUBLISH_PERIOD = 1.0  # s


@dataclass(frozen=True)
class Check:
    """One entry of /diagnostics. level: OK, WARN, ERROR or STALE. values: key-value pairs in display order."""

    name: str
    level: int
    message: str
    values: Mapping[str, Any] = field(default_factory=dict)


class Diagnostics:
    """Publishes the checks from `collect` every PUBLISH_PERIOD and on `publish`; logs each change of a level."""

    def __init__(self, node: Node, hardware_id: str, collect: Callable[[], list[Check]]):
        self._node = node
        self._hardware_id = hardware_id
        self._collect = collect
        self._levels: dict[str, int] = {}  # by name of the check, as last published
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        create_steady_timer(node, PUBLISH_PERIOD, self.publish, in_sim_time=True)

    def publish(self) -> None:
        message = DiagnosticArray()
        message.header.stamp = self._node.get_clock().now().to_msg()
        values = scheduling.read_scheduling()
        for check in (*self._collect(), Check("scheduling", OK, scheduling.describe_scheduling(values), values)):
            status = DiagnosticStatus(name=f"{self._node.get_name()}: {check.name}", message=check.message,
                                      hardware_id=self._hardware_id, level=bytes([check.level]))
            status.values = [KeyValue(key=str(k), value=f"{v:.6g}" if isinstance(v, float) else str(v))
                             for k, v in check.values.items()]
            message.status.append(status)
            self._log_change(check)
        self._publisher.publish(message)

    def _log_change(self, check: Check) -> None:
        if check.level == self._levels.get(check.name, OK):
            return
        self._levels[check.name] = check.level
        text = f"{check.name}: {check.message}"
        if check.level == OK:
            self._node.get_logger().info(text)
        elif check.level == WARN:
            self._node.get_logger().warning(text)
        else:
            self._node.get_logger().error(text)
