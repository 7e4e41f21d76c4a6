"""Polled subscriptions: messages in order, and a wait that ends with the first message or at its timeout."""

import threading

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")

import rclpy
from ros_processes import free_domain, wait_for
from st_ros.polling import PolledSubscription, wait_for_any
from std_msgs.msg import Float64

pytestmark = [pytest.mark.ros, pytest.mark.timing("timers of real time")]


@pytest.fixture
def node():
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=free_domain())
    node = rclpy.create_node("polling", context=context)
    yield node
    node.destroy_node()
    rclpy.try_shutdown(context=context)


def test_wait_ends_with_a_message(node) -> None:
    subscriptions = [PolledSubscription(node, Float64, name, 10) for name in ("a", "b")]
    publisher = node.create_publisher(Float64, "b", 10)
    wait_for(publisher.get_subscription_count, what="the subscription is matched")
    timer = threading.Timer(0.1, lambda: publisher.publish(Float64(data=2.0)))
    timer.start()
    wait_for_any(node, subscriptions, 20.0)
    assert [[message.data for message, _, _ in one.take()] for one in subscriptions] == [[], [2.0]]
    timer.join()


def test_wait_ends_immediately_with_pending_messages_or_at_its_timeout(node) -> None:
    subscription = PolledSubscription(node, Float64, "a", 10)
    publisher = node.create_publisher(Float64, "a", 10)
    wait_for(publisher.get_subscription_count, what="the subscription is matched")
    wait_for_any(node, [subscription], 0.05)
    assert not list(subscription.take())
    for value in (1.0, 2.0):
        publisher.publish(Float64(data=value))
    for _ in range(2):  # a message that is not taken ends the next wait too
        wait_for_any(node, [subscription], 20.0)
    taken: list[float] = []
    wait_for(lambda: _collect(subscription, taken) == [1.0, 2.0], what="both messages")


def _collect(subscription, taken: list[float]) -> list[float]:
    taken += [message.data for message, _, _ in subscription.take()]
    return taken
