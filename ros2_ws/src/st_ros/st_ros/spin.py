"""Start a node, spin it, and leave nothing behind: exit 0 on SIGINT or SIGTERM, 2 on a wrong configuration."""

import sys
from collections.abc import Callable

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node

from .parameters import ConfigurationError


def run(make_node: Callable[[], Node], arguments: list[str] | None = None) -> int:
    """Spin the node until it is told to stop.

    A node may have `exit_status: int` (read at the end) and `close()` (called once before it is destroyed).
    """
    rclpy.init(args=arguments)
    node = None
    status = 0
    try:
        node = make_node()
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        while rclpy.ok() and not getattr(node, "finished", False):
            executor.spin_once(timeout_sec=0.5)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except ConfigurationError as error:
        print(f"{error}", file=sys.stderr, flush=True)
        status = 2
    finally:
        if node is not None:
            if hasattr(node, "close"):
                node.close()
            status = status or getattr(node, "exit_status", 0)
            node.destroy_node()
        rclpy.try_shutdown()
    return status
