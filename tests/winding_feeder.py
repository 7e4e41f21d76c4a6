"""Publishes odometry and steering of a drive on a winding road as fast as the node identifier takes them.

Stamps are those of the drive. Steering offset, steering ratio and stiffnesses differ from the vehicle file. The feeder
waits for the duration that the node reports as processed, so that no message is lost on a busy machine, and ends with
an error if the node stops processing.
"""

import argparse
import math
import time
from pathlib import Path

import rclpy
from circle_feeder import odometry, steering
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile
from st_core.vehicle import VehicleParameters
from st_msgs.msg import Steering, TrackedParameters
from st_ros import spin
from winding_road import Truth, winding_road

PROGRESS_TIMEOUT = 30.0  # s without progress of the node
MAX_BACKLOG = 6.0  # s of driving that the node may lag behind; its queues hold 10 s


def main() -> None:
    options = parse_arguments()
    car = VehicleParameters.from_yaml(options.vehicle.read_text(), str(options.vehicle))
    truth = Truth(math.radians(options.offset), options.ratio, options.scale)
    drive = winding_road(car, truth, options.seconds, options.seed)
    rclpy.init()
    node = rclpy.create_node("feeder")
    qos = QoSProfile(depth=1000)
    ins = node.create_publisher(Odometry, "ins/odometry", qos)
    angles = node.create_publisher(Steering, "vehicle/steering", qos)
    progress = Progress(node)
    while not (progress.received and is_subscribed(node, ins) and is_subscribed(node, angles)):
        rclpy.spin_once(node, timeout_sec=0.1)
    zero = time.time_ns()
    print("feeding", flush=True)
    for t, x, y, yaw, v_x, v_y, rate, angle in drive.tolist():
        progress.wait_for(t - MAX_BACKLOG)
        stamp_ns = zero + round(t * 1e9)
        ins.publish(odometry(stamp_ns, x, y, yaw, v_x, v_y, rate))
        angles.publish(steering(stamp_ns, angle, car.road_wheel_angle(angle)))
    progress.wait_for(options.seconds - 1.0)
    spin.flush(node)
    node.destroy_node()
    rclpy.shutdown()


class Progress:
    """Duration of driving that the identifier reports as processed. The topic is latched, so one message arrives before
    the drive starts."""

    def __init__(self, node: Node) -> None:
        self._node, self.received, self._processed = node, False, 0.0
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        node.create_subscription(TrackedParameters, "identifier/parameters", self._update, latched)

    def _update(self, message: TrackedParameters) -> None:
        self.received, self._processed = True, message.seconds_used + message.seconds_rejected

    def wait_for(self, seconds: float) -> None:
        last, since = self._processed, time.monotonic()
        while self._processed < seconds:
            rclpy.spin_once(self._node, timeout_sec=1.0)
            if self._processed > last:
                last, since = self._processed, time.monotonic()
            if time.monotonic() - since > PROGRESS_TIMEOUT:
                raise SystemExit(f"the identifier has processed {self._processed:.1f} s, expected {seconds:.1f} s")


def is_subscribed(node: Node, publisher: Publisher) -> bool:
    """Whether the identifier and all other subscribers are matched with the publisher; earlier samples are lost."""
    readers = node.get_subscriptions_info_by_topic(publisher.topic_name)
    return "identifier" in {r.node_name for r in readers} and publisher.get_subscription_count() >= len(readers)


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--vehicle", type=Path, required=True)
    parser.add_argument("--seconds", type=float, default=80.0, help="of driving")
    parser.add_argument("--offset", type=float, default=-4.0, help="of the steering wheel sensor [deg]")
    parser.add_argument("--ratio", type=float, default=16.6)
    parser.add_argument("--scale", type=float, default=0.85, help="of both cornering stiffnesses")
    parser.add_argument("--seed", type=int, default=1)
    return parser.parse_args()


if __name__ == "__main__":
    main()
