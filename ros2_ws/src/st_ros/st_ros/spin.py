"""Start a node, spin it, and leave nothing behind: exit 0 on SIGINT or SIGTERM, 2 on a wrong configuration."""

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

# How long a signal may wait for the executor to come back [s].
WAKE_PERIOD = 0.1
# How long a node waits at its end until its subscribers have all it published [s]. Of what got lost over UDP Fast DDS
# tells with its next heartbeat, every 3 s; ros2 launch loses patience after 5 s.
LAST_WORDS = 4.0


def run(make_node: Callable[[], Node], arguments: list[str] | None = None, nice: int = 0) -> int:
    """Spin the node until it is told to stop. nice: how far others go first, once it is up; 0: they do not.

    A node may have `finished: bool` (ends the spinning), `exit_status: int` (read at the end) and `close()` (called
    once before it is destroyed; it can still publish). What it published is waited for, at most `LAST_WORDS`.
    """
    stop = _StopRequest()
    node = executor = None
    status = 0
    try:
        # rclpy's own handlers shut the context down at once: no last word could be published.
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    except Exception as error:  # rclpy has no public base class; a parameter file that does not parse ends here
        print(f"start refused: {_one_line(error)}", file=sys.stderr, flush=True)
        return 2
    try:
        node = make_node()
        _freeze()
        if nice:
            scheduling.lower(nice)
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
                settle(node)
            status = status or getattr(node, "exit_status", 0)
            if executor is not None:
                # Left to the interpreter's exit, its destructor may find the context gone and complain.
                executor.shutdown()
            node.destroy_node()
        rclpy.try_shutdown()
    return status


def _freeze() -> None:
    """Take what a start has made, which lives as long as the process, out of the garbage collector's sight: walking
    over it held a node up for 26 to 75 ms at a time."""
    gc.collect()
    gc.freeze()


def settle(node: Node) -> None:
    """Wait until the reliable subscribers have what was published, at most `LAST_WORDS`."""
    end = time.monotonic() + LAST_WORDS
    for publisher in node.publishers:
        publisher.wait_for_all_acked(Duration(seconds=max(0.0, end - time.monotonic())))


class _StopRequest:
    """SIGINT and SIGTERM as a flag; later ones change nothing, so that closing is not cut short."""

    def __init__(self) -> None:
        self.requested = False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._request)
            # The interpreter takes handlers away before it ends; a signal would then kill what has ended well.
            atexit.register(signal.signal, number, signal.SIG_IGN)

    def _request(self, number: int, frame: FrameType | None) -> None:
        self.requested = True


def _one_line(error: Exception) -> str:
    # Without the places in rcl's own sources.
    return " ".join(str(error).partition(", at /")[0].split())
