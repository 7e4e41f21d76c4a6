"""Start, spin and end a node: exit status 0 on SIGINT or SIGTERM, 2 on a wrong configuration."""

import atexit
import gc
import signal
import sys
import time
from collections.abc import Callable
from types import FrameType

import rclpy
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from . import scheduling
from .parameters import ConfigurationError

WAKE_PERIOD = 0.1  # s, longest time until the executor reacts to a stop signal
# Longest wait at the end of a node until its subscribers acknowledged all messages [s]. Fast DDS detects what was lost
# over UDP with its next heartbeat, every 3 s; ros2 launch kills after 5 s.
FLUSH_TIMEOUT = 4.0


def run(make_node: Callable[[], Node], arguments: list[str] | None = None, nice: int = 0) -> int:
    """Spin the node until a stop signal; returns the exit status. nice: of the process once the node is up.

    A node may have `finished: bool` (ends the spinning), `exit_status: int` (read at the end) and `close()` (called
    once before it is destroyed; it can still publish). Waits for acknowledgement at most `FLUSH_TIMEOUT`.
    """
    stop = StopRequest()
    node = executor = None
    status = 0
    try:
        # rclpy's own handlers shut the context down at once: `close` could not publish.
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    except Exception as error:  # rclpy has no public base class; a parameter file that does not parse ends here
        print(f"cannot start: {_one_line(error)}", file=sys.stderr, flush=True)
        return 2
    try:
        node = make_node()
        # Excludes the objects created so far, which live as long as the process, from garbage collection: a collection
        # that includes them delays a node by 26 to 75 ms.
        gc.collect()
        gc.freeze()
        if nice:
            scheduling.lower_priority(nice)
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        while not stop.requested and rclpy.ok() and not getattr(node, "finished", False):
            executor.spin_once(timeout_sec=WAKE_PERIOD)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except ConfigurationError as error:
        print(f"{error}", file=sys.stderr, flush=True)
        status = 2
    finally:
        if node is not None:
            if hasattr(node, "close"):
                node.close()
            if rclpy.ok():
                flush(node)
            status = status or getattr(node, "exit_status", 0)
            if executor is not None:
                # At the interpreter's exit its destructor may find the context destroyed and report an error.
                executor.shutdown()
            node.destroy_node()
        rclpy.try_shutdown()
    return status


def flush(node: Node) -> None:
    """Wait until the reliable subscribers acknowledged all messages, at most `FLUSH_TIMEOUT`."""
    end = time.monotonic() + FLUSH_TIMEOUT
    for publisher in node.publishers:
        publisher.wait_for_all_acked(Duration(seconds=max(0.0, end - time.monotonic())))


class StopRequest:
    """SIGINT and SIGTERM as a flag; further signals are ignored, so that closing is not interrupted."""

    def __init__(self) -> None:
        self.requested = False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._request)
            # The interpreter removes handlers before it ends; a late signal would then turn a clean exit into a kill.
            atexit.register(signal.signal, number, signal.SIG_IGN)

    def _request(self, number: int, frame: FrameType | None) -> None:
        self.requested = True


def _one_line(error: Exception) -> str:
    """The message of an error without the source locations that rcl appends."""
    return " ".join(str(error).partition(", at /")[0].split())
