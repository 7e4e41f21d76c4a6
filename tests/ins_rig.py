"""A running oxts_bridge, a simulated unit that sends to it over UDP, and the messages it publishes over DDS."""

import os
import signal
import socket
import subprocess
import time
from collections import defaultdict
from pathlib import Path

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TwistWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile
from ros_processes import executable, free_domain
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu, NavSatFix, TimeReference
from st_live import suite
from st_msgs.msg import InsStatus, Ncom, Trigger
from tf2_msgs.msg import TFMessage

LATCHED = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
TOPICS = {
    "ins/odometry": (Odometry, 1000),
    "ins/imu": (Imu, 1000),
    "ins/nav_sat_fix": (NavSatFix, 1000),
    "ins/velocity": (TwistWithCovarianceStamped, 1000),
    "ins/time_reference": (TimeReference, 1000),
    "ins/ncom": (Ncom, 1000),
    "ins/trigger": (Trigger, 1000),
    "ins/status": (InsStatus, LATCHED),
    "ins/origin": (NavSatFix, LATCHED),
    "/tf": (TFMessage, 1000),
    "/tf_static": (TFMessage, LATCHED),
    "/diagnostics": (DiagnosticArray, 100),
    "/clock": (Clock, 1000),
}


def launch(parameters: dict, log_folder: Path, domain: int) -> subprocess.Popen:
    words = [word for name, value in parameters.items() for word in ("-p", f"{name}:={value}")]
    environment = os.environ | suite.make_loopback_environment(os.environ) | {
        "ROS_DOMAIN_ID": str(domain),
        "ROS_LOG_DIR": str(log_folder),
    }
    command = [executable("oxts_bridge", "oxts_bridge"), "--ros-args", *words]
    return subprocess.Popen(command, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE)


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        return sock.getsockname()[1]


def stamp_ms(message) -> float:
    return message.header.stamp.sec * 1000 + message.header.stamp.nanosec / 1e6


class Rig:
    """A running node, a unit that sends to it, and the messages published so far."""

    def __init__(self, port, parameters, log_folder):
        self.port = port
        self.unit = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        domain = free_domain()
        self.process = launch(parameters, log_folder, domain)
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=domain)
        self.node = rclpy.create_node("rig", context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.seen = defaultdict(list)
        for topic, (kind, qos) in TOPICS.items():
            self.node.create_subscription(kind, topic, self.seen[topic].append, qos)

    def spin(self, condition, limit=20.0) -> bool:
        end = time.monotonic() + limit
        while not condition():
            if time.monotonic() > end:
                return False
            self.executor.spin_once(timeout_sec=0.01)
        return True

    def wait_connected(self):
        """Waits until node and test have discovered each other, so that no later message is lost."""
        assert self.spin(lambda: self.node.count_publishers("ins/odometry")), self.process.poll()
        self.spin(lambda: False, 0.7)  # whether the node has matched its subscribers is not visible here

    def send(self, *packets):
        for packet in packets:
            self.unit.sendto(packet, ("127.0.0.1", self.port))

    def messages(self, topic, count):
        assert self.spin(lambda: len(self.seen[topic]) >= count), f"{len(self.seen[topic])} of {count} on {topic}"
        return self.seen[topic]

    def check(self, name):
        """Newest diagnostic of that name: (level, message, values)."""
        for array in reversed(self.seen["/diagnostics"]):
            for status in array.status:
                if status.name == f"oxts_bridge: {name}":
                    return status.level[0], status.message, {v.key: v.value for v in status.values}
        return None, "", {}

    def stop(self, number=signal.SIGINT) -> tuple[int, str]:
        self.unit.close()
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)
        self.process.send_signal(number)
        try:
            _, errors = self.process.communicate(timeout=20)
        except subprocess.TimeoutExpired:
            self.process.kill()
            raise
        return self.process.returncode, errors
