"""Publishes odometry and steering of a car on a circle, exactly known, so that predictions can be checked by hand.

    python circle_feeder.py --duration 5 [--rate 100] [--radius 30] [--speed 8] [--silence steering:1:2] ...

The INS point moves on the circle at constant speed, left turn; header stamps are the host's clock. A --silence
SIGNAL:FROM:UNTIL leaves one signal out between two times [s]; --jump T:BY moves all stamps after T by BY seconds;
--nan FROM:UNTIL sends odometry with NaN.
"""

import argparse
import math
import time

import rclpy
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile
from st_msgs.msg import Steering
from st_ros.stamps import from_nanoseconds


def pose_at(t: float, radius: float, speed: float) -> tuple[float, float, float]:
    """x, y, yaw of the INS point t seconds after the start; the centre is (0, radius)."""
    angle = speed / radius * t
    return radius * math.sin(angle), radius - radius * math.cos(angle), angle


def odometry(stamp_ns: int, t: float, options: argparse.Namespace) -> Odometry:
    x, y, yaw = pose_at(t, options.radius, options.speed)
    message = Odometry(child_frame_id="ins_link")
    message.header.stamp = from_nanoseconds(stamp_ns)
    message.header.frame_id = options.frame
    position, orientation = message.pose.pose.position, message.pose.pose.orientation
    position.x, position.y, orientation.z, orientation.w = x, y, math.sin(yaw / 2), math.cos(yaw / 2)
    message.twist.twist.linear.x = options.speed
    message.twist.twist.angular.z = options.speed / options.radius
    return message


def within(t: float, spans: list[tuple[float, float]]) -> bool:
    return any(begin <= t < end for begin, end in spans)


def spans_of(texts: list[str]) -> list[tuple[float, float]]:
    return [(float(a), float(b)) for a, b in (text.split(":") for text in texts)]


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--duration", type=float, default=5.0)
    parser.add_argument("--rate", type=float, default=100.0)
    parser.add_argument("--radius", type=float, default=30.0)
    parser.add_argument("--speed", type=float, default=8.0)
    parser.add_argument("--angle", type=float, default=math.atan(2.7 / 30.0))
    parser.add_argument("--frame", default="map")
    parser.add_argument("--silence", action="append", default=[])
    parser.add_argument("--nan", action="append", default=[])
    parser.add_argument("--jump", default="")
    parser.add_argument("--subscribers", type=int, default=1, help="begin when this many listen to each topic")
    parser.add_argument("--zero", type=int, default=0, help="stamp of t = 0 [ns]; 0: now")
    options = parser.parse_args()
    silence = {
        signal: spans_of([text.partition(":")[2] for text in options.silence if text.startswith(signal)])
        for signal in ("odometry", "steering")
    }
    nan = spans_of(options.nan)
    jump_at, jump_by = spans_of([options.jump])[0] if options.jump else (math.inf, 0.0)

    rclpy.init()
    node = rclpy.create_node("feeder")
    qos = QoSProfile(depth=50)
    ins = node.create_publisher(Odometry, "ins/odometry", qos)
    steering = node.create_publisher(Steering, "vehicle/steering", qos)
    while min(ins.get_subscription_count(), steering.get_subscription_count()) < options.subscribers:
        time.sleep(0.02)
    zero_ns, began = options.zero or time.time_ns(), time.monotonic()
    print("feeding", zero_ns, flush=True)
    for k in range(round(options.duration * options.rate)):
        t = k / options.rate
        time.sleep(max(0.0, began + t - time.monotonic()))
        stamp_ns = zero_ns + round((t + (jump_by if t >= jump_at else 0.0)) * 1e9)
        if not within(t, silence["odometry"]):
            message = odometry(stamp_ns, t, options)
            if within(t, nan):
                message.twist.twist.linear.x = math.nan
            ins.publish(message)
        if not within(t, silence["steering"]):
            angle = Steering(road_wheel_angle=options.angle, steering_wheel_angle=17.3 * options.angle, valid=True)
            angle.header.stamp = from_nanoseconds(stamp_ns)
            steering.publish(angle)
    node.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    main()
