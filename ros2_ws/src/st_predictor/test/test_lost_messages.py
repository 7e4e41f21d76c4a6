"""Messages that the middleware dropped because a node had not read them are counted."""

import time

import pytest
import rclpy
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile
from st_predictor.nodes import _inputs

pytestmark = pytest.mark.ros


def test_dropped_messages_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_inputs, "QUEUE_DEPTH", 2)
    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node("lost_messages", context=context)
    entry = _inputs._Input(node, "INS", Odometry, "lost_messages/odometry", lambda: None)
    publisher = node.create_publisher(Odometry, "lost_messages/odometry", QoSProfile(depth=10))
    end = time.monotonic() + 10.0
    while not (entry.subscription.count_publishers() and publisher.get_subscription_count()):
        assert time.monotonic() < end
        time.sleep(0.01)
    for count, lost in ((1, 0), (2, 0), (5, 3)):
        for _ in range(count):
            publisher.publish(Odometry())
        time.sleep(0.3)
        list(entry.take_accepted())
        assert entry.lost_count == lost
    node.destroy_node()
    rclpy.shutdown(context=context)
