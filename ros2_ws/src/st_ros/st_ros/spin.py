"""Starts, spins and stops a node; exit status: that of the node, 0 by default, or 2 for an invalid configuration."""

import atexit
import gc
import signal
import sys
import time
from collections.abc import Callable

import rclpy
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from . import scheduling
from .parameters import ConfigurationError

WAKE_PERIOD = 0.1  # s, longest time until a stop signal ends the spinning
# s, longest wait of a closing node until its subscribers have acknowledged all messages: longer than the 3 s between
# heartbeats, with which Fast DDS detects messages lost over UDP, and shorter than the 5 s until ros2 launch kills it.
FLUSH_TIMEOUT = 4.0


def run(make_node: Callable[[], Node], arguments: list[str] | None = None, nice: int = 0) -> int:
    """Make a node, spin it until a stop signal, and return the exit status. nice: its nice value while it spins. A node
    may have `finished: bool` (ends the spinning), `exit_status: int` (read at the end) and `close()` (called once
    before the node is destroyed, while it can still publish)."""
    stop_requested = catch_stop_signals()
    node, executor, status = None, None, 0
    try:
        # rclpy's own handlers would shut the context down at once, and `close` could not publish.
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    except Exception as error:  # such as an invalid parameter file; rclpy's errors have no common base class
        text = str(error).partition(", at /")[0]  # without the source locations that rcl appends
        print(f"cannot start: {' '.join(text.split())}", file=sys.stderr, flush=True)
        return 2
    try:
        node = make_node()
        # Objects created so far live as long as the process; collecting garbage among them takes 26 to 75 ms.
        gc.collect()
        gc.freeze()
        if nice:
            scheduling.lower_priority(nice)
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        while not stop_requested() and rclpy.ok() and not getattr(node, "finished", False):
            executor.spin_once(timeout_sec=WAKE_PERIOD)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except ConfigurationError as error:
        print(error, file=sys.stderr, flush=True)
        status = 2
    finally:
        if node is not None:
            if hasattr(node, "close"):
                node.close()
            if rclpy.ok():
                flush(node)
            status = status or getattr(node, "exit_status", 0)
            if executor is not None:
                # At interpreter exit, its destructor may find the context destroyed and report an error.
                executor.shutdown()
            node.destroy_node()
        rclpy.try_shutdown()
    return status


def flush(node: Node) -> None:
    """Wait until the reliable subscribers have acknowledged all messages, at most FLUSH_TIMEOUT."""
    end = time.monotonic() + FLUSH_TIMEOUT
    for publisher in node.publishers:
        publisher.wait_for_all_acked(Duration(seconds=max(0.0, end - time.monotonic())))


def catch_stop_signals() -> Callable[[], bool]:
    """Record SIGINT and SIGTERM instead of ending the process; returns a function that checks whether one arrived."""
    received: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: received.append(number))
        # The interpreter removes the handlers before it exits; a signal after that would change the exit status.
        atexit.register(signal.signal, number, signal.SIG_IGN)
    return lambda: bool(received)
