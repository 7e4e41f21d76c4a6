"""Publishes odometry and steering of a car on an exact circle, so that predictions can be verified by hand.

The INS point moves at constant speed in a left turn that starts at the origin towards east. Stamps are those of the
host's clock unless --zero is given. --help lists the faults that can be added.
"""

import argparse
import math
import time

import rclpy
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock
from st_msgs.msg import Steering
from st_ros import spin
from st_ros.polling import from_nanoseconds

SETTLING_TIME = 0.5  # s


def pose_at(t: float, radius: float, speed: float) -> tuple[float, float, float]:
    """x, y, yaw of the INS point t seconds after the start; the centre is (0, radius)."""
    angle = speed / radius * t
    return radius * math.sin(angle), radius - radius * math.cos(angle), angle


def odometry(stamp_ns: int, x: float, y: float, yaw: float, velocity_x: float, velocity_y: float, yaw_rate: float,
             frame: str = "map") -> Odometry:
    message = Odometry(child_frame_id="ins_link")
    message.header.stamp, message.header.frame_id = from_nanoseconds(stamp_ns), frame
    position, orientation = message.pose.pose.position, message.pose.pose.orientation
    position.x, position.y, orientation.z, orientation.w = x, y, math.sin(yaw / 2), math.cos(yaw / 2)
    twist = message.twist.twist
    twist.linear.x, twist.linear.y, twist.angular.z = velocity_x, velocity_y, yaw_rate
    return message


def steering(stamp_ns: int, steering_wheel_angle: float, road_wheel_angle: float, valid: bool = True) -> Steering:
    message = Steering(steering_wheel_angle=steering_wheel_angle, road_wheel_angle=road_wheel_angle, valid=valid)
    message.header.stamp = from_nanoseconds(stamp_ns)
    return message


def within(t: float, spans: list[tuple[float, float]]) -> bool:
    return any(begin <= t < end for begin, end in spans)


def main() -> None:
    options = parse_arguments()
    rclpy.init()
    node = rclpy.create_node("feeder")
    qos = QoSProfile(depth=1000)  # as in the bridges, for retransmission of messages that UDP has lost
    ins = node.create_publisher(Odometry, "ins/odometry", qos)
    angles = node.create_publisher(Steering, "vehicle/steering", qos)
    clock = node.create_publisher(Clock, "/clock", qos) if options.loop else None
    subscribers = {"ins/odometry": options.subscribers, "vehicle/steering": options.subscribers}
    subscribers |= {topic: int(count) for topic, _, count in (text.rpartition(":") for text in options.wait_for)}
    while any(node.count_subscribers(topic) < count for topic, count in subscribers.items()):
        time.sleep(0.02)
    # The graph is complete here shortly before all publishers are matched with their subscribers.
    time.sleep(SETTLING_TIME)
    zero_ns, began = options.zero or time.time_ns(), time.monotonic()
    print("feeding", zero_ns, flush=True)
    for k in range(round(options.duration * options.rate)):
        t = k / options.rate
        time.sleep(max(0.0, began + t - time.monotonic()))
        if options.loop:
            t %= options.loop
        stamp_ns = zero_ns + round((t + sum(by for begin, end, by in options.jump if begin <= t < end)) * 1e9)
        if clock:
            clock.publish(Clock(clock=from_nanoseconds(stamp_ns)))
        if not within(t, options.silent_odometry):
            speed = math.nan if within(t, options.nan) else options.speed
            ins.publish(odometry(stamp_ns, *pose_at(t, options.radius, options.speed), speed, 0.0,
                                 options.speed / options.radius, options.frame))
        if not within(t, options.silent_steering):
            angles.publish(steering(stamp_ns, 17.3 * options.angle, options.angle,
                                    not within(t, options.invalid_steering)))
    spin.flush(node)
    node.destroy_node()
    rclpy.shutdown()


def parse_arguments() -> argparse.Namespace:
    def numbers(text: str) -> tuple[float, ...]:
        return tuple(map(float, text.split(":")))

    parser = argparse.ArgumentParser()
    parser.add_argument("--duration", type=float, default=5.0)
    parser.add_argument("--rate", type=float, default=100.0)
    parser.add_argument("--radius", type=float, default=30.0)
    parser.add_argument("--speed", type=float, default=8.0)
    parser.add_argument("--angle", type=float, default=0.09, help="of the road wheels [rad]")
    parser.add_argument("--frame", default="map")
    for name in ("silent-odometry", "silent-steering", "invalid-steering", "nan"):
        parser.add_argument(f"--{name}", action="append", default=[], type=numbers, metavar="FROM:UNTIL")
    parser.add_argument("--jump", action="append", default=[], type=numbers, metavar="FROM:UNTIL:BY", help="of stamps")
    parser.add_argument("--loop", type=float, default=0.0, help="period of the drive [s]; also publishes /clock")
    parser.add_argument("--subscribers", type=int, default=1, help="start when each topic has this many subscribers")
    parser.add_argument("--wait-for", action="append", default=[], metavar="TOPIC:N", help="the same for another topic")
    parser.add_argument("--zero", type=int, default=0, help="stamp of the start [ns]; 0: now")
    return parser.parse_args()


if __name__ == "__main__":
    main()
