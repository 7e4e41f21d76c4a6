"""A node that publishes another car's odometry, 640 m away, at 100 Hz on the topic of the own one."""

import rclpy
from nav_msgs.msg import Odometry

ELSEWHERE, SPEED = 640.0, 8.0  # m, m/s
PERIOD = 0.01  # s


def main() -> None:
    rclpy.init()
    node = rclpy.create_node("intruder")
    publisher = node.create_publisher(Odometry, "ins/odometry", 10)
    message = Odometry()
    message.header.frame_id = "map"
    message.pose.pose.position.x, message.pose.pose.orientation.w = ELSEWHERE, 1.0
    message.twist.twist.linear.x = SPEED

    def publish() -> None:
        message.header.stamp = node.get_clock().now().to_msg()
        publisher.publish(message)

    node.create_timer(PERIOD, publish)
    rclpy.spin(node)


if __name__ == "__main__":
    main()
