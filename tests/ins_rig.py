"""A running oxts_bridge and a simulated unit that sends to it over UDP."""

import socket
from pathlib import Path
from typing import Any

from geometry_msgs.msg import TwistWithCovarianceStamped
from nav_msgs.msg import Odometry
from node_rig import NodeRig
from rclpy.qos import DurabilityPolicy, QoSProfile
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu, NavSatFix, TimeReference
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
    "/clock": (Clock, 1000),
}


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        return sock.getsockname()[1]


def stamp_ms(message) -> float:
    return message.header.stamp.sec * 1000 + message.header.stamp.nanosec / 1e6


class InsRig(NodeRig):
    """A running node and a unit that sends to it."""

    def __init__(self, parameters: dict[str, Any], log_folder: Path):
        """parameters: of the node, with its udp_port."""
        self.port = parameters["udp_port"]
        self.unit = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        super().__init__("oxts_bridge", TOPICS, parameters, log_folder)

    def wait_connected(self) -> None:
        """Waits until node and test have discovered each other, so that no later message is lost."""
        assert self.spin(lambda: self.node.count_publishers("ins/odometry")), self.process.poll()
        self.spin_for(0.7)  # whether the node has matched its subscribers is not visible here

    def send(self, *packets: bytes) -> None:
        for packet in packets:
            self.unit.sendto(packet, ("127.0.0.1", self.port))

    def close(self) -> None:
        self.unit.close()
        super().close()
