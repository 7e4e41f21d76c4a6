"""Publishes odometry and steering of a drive on a winding road as fast as the node identifier takes them.

Stamps are those of the drive. The car of the vehicle file has an offset, a ratio and a stiffness of its own. What the
node says it has taken is waited for, so that a busy machine loses nothing.
"""

import argparse
import math
import time
from pathlib import Path

import rclpy
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile
from st_core.vehicle import VehicleParameters
from st_msgs.msg import Steering, TrackedParameters
from st_ros.stamps import from_nanoseconds
from winding_road import Truth, winding_road

SETTLING = 0.5
AHEAD = 6.0  # s of driving the node may be behind; its queues hold ten


def main() -> None:
    options = parse_arguments()
    car = VehicleParameters.from_yaml(options.vehicle.read_text(), str(options.vehicle))
    truth = Truth(math.radians(options.offset), options.ratio, options.scale)
    drive = winding_road(car, truth, options.seconds, options.seed)
    rclpy.init()
    node = rclpy.create_node("feeder")
    qos = QoSProfile(depth=1000)
    ins = node.create_publisher(Odometry, "ins/odometry", qos)
    steering = node.create_publisher(Steering, "vehicle/steering", qos)
    while not (node.count_subscribers("ins/odometry") and node.count_subscribers("vehicle/steering")):
        time.sleep(0.02)
    time.sleep(SETTLING)
    zero, taken = time.time_ns(), [0.0]

    def note(message: TrackedParameters) -> None:
        taken[0] = message.seconds_used + message.seconds_rejected

    node.create_subscription(TrackedParameters, "identifier/parameters", note, 10)
    print("feeding", flush=True)
    for t, x, y, yaw, v_x, v_y, rate, hand in drive.tolist():
        while t > taken[0] + AHEAD:
            rclpy.spin_once(node, timeout_sec=1.0)
        message = Odometry(child_frame_id="ins_link")
        message.header.stamp, message.header.frame_id = from_nanoseconds(zero + round(t * 1e9)), "map"
        position, orientation = message.pose.pose.position, message.pose.pose.orientation
        position.x, position.y = x, y
        orientation.z, orientation.w = math.sin(yaw / 2), math.cos(yaw / 2)
        twist = message.twist.twist
        twist.linear.x, twist.linear.y, twist.angular.z = v_x, v_y, rate
        ins.publish(message)
        angle = Steering(steering_wheel_angle=hand, road_wheel_angle=car.road_wheel_angle(hand), valid=True)
        angle.header.stamp = message.header.stamp
        steering.publish(angle)
    while taken[0] < options.seconds - 1.0:
        rclpy.spin_once(node, timeout_sec=1.0)
    node.destroy_node()
    rclpy.shutdown()


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
