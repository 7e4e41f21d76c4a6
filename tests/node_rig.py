"""A bridge as a process, the messages that it publishes over DDS, and its diagnostics."""

import os
import signal
import subprocess
import time
from collections import defaultdict
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import SingleThreadedExecutor
from ros_processes import executable, free_domain
from st_live import suite


def launch(package: str, parameters: Mapping[str, Any], log_folder: Path, domain: int) -> subprocess.Popen:
    """Starts the node of a package whose executable has the same name."""
    words = [word for name, value in parameters.items() for word in ("-p", f"{name}:={value}")]
    environment = os.environ | suite.make_loopback_environment(os.environ) | {
        "ROS_DOMAIN_ID": str(domain), "ROS_LOG_DIR": str(log_folder)}
    return subprocess.Popen([executable(package, package), "--ros-args", *words], env=environment, text=True,
                            stdout=subprocess.PIPE, stderr=subprocess.PIPE)


class NodeRig:
    """A running node and the messages received from it, by topic."""

    def __init__(self, package: str, topics: Mapping[str, tuple[type, Any]], parameters: Mapping[str, Any],
                 log_folder: Path):
        """topics: name -> (type, QoS profile or depth)."""
        self.package = package
        domain = free_domain()
        self.process = launch(package, parameters, log_folder, domain)
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=domain)
        self.node = rclpy.create_node("rig", context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.received: dict[str, list] = defaultdict(list)
        for topic, (kind, qos) in {**topics, "/diagnostics": (DiagnosticArray, 100)}.items():
            self.node.create_subscription(kind, topic, self.received[topic].append, qos)

    def spin(self, condition: Callable[[], object], limit: float = 20.0,
             feed: Callable[[], object] | None = None) -> bool:
        """Receives until the condition is true, for at most `limit` [s]; calls feed() every 10 ms."""
        end, due = time.monotonic() + limit, 0.0
        while not condition():
            if time.monotonic() > end:
                return False
            if feed is not None and time.monotonic() >= due:
                due = time.monotonic() + 0.01
                feed()
            self.executor.spin_once(timeout_sec=0.005)
        return True

    def spin_for(self, seconds: float) -> None:
        self.spin(lambda: False, seconds)

    def messages(self, topic: str, count: int) -> list:
        """Waits for so many messages."""
        received = self.received[topic]
        assert self.spin(lambda: len(received) >= count), f"{len(received)} of {count} on {topic}"
        return received

    def check(self, name: str) -> tuple[int | None, str, dict[str, str]]:
        """Newest diagnostic of that name: (level, message, values)."""
        for array in reversed(self.received["/diagnostics"]):
            for status in array.status:
                if status.name == f"{self.package}: {name}":
                    return status.level[0], status.message, {v.key: v.value for v in status.values}
        return None, "", {}

    def stop(self, number: int = signal.SIGINT) -> tuple[int, str]:
        """Ends the node by a signal: (exit status, stdout and stderr)."""
        self.process.send_signal(number)
        try:
            output = "".join(self.process.communicate(timeout=20))
        except subprocess.TimeoutExpired:
            self.process.kill()
            raise
        return self.process.returncode, output

    def close(self) -> None:
        """Ends the node unless the test did, and checks that it ended without an error."""
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)
        if self.process.returncode is None:
            status, output = self.stop()
            assert status == 0 and "Traceback" not in output, output
