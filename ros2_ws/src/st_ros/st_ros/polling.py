"""Topics at high rates: polled subscriptions, publishers that skip unread messages, and stamps in nanoseconds.

A polled subscription is emptied by the node itself, usually from a timer, instead of waking the executor per message:
rclpy rebuilds its wait set for every wake-up, which at 250 Hz on several topics costs more than the messages do.
Messages wait in the middleware's queue (`depth` per topic), in order, each with its time of arrival.
"""

import importlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from builtin_interfaces.msg import Time
from rclpy.callback_groups import CallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile

# Prefix of rmw's name for a node that discovery has not resolved yet, and the text shown for it.
UNRESOLVED_PREFIX = "_NODE_NAME"
UNRESOLVED_NODE = "a node without a name yet"
# Interval between counts of a publisher's subscribers [s]: one count costs as much as filling a message.
SUBSCRIBER_COUNT_PERIOD = 0.05
# Depth: four seconds at 250 Hz, so that a briefly blocked subscriber (busy machine, suspended laptop) loses nothing.
SAMPLE_QOS = QoSProfile(depth=1000)
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)  # late subscribers get the newest message


def steady_timer(node: Node, period: float, callback: Callable[[], object]) -> None:
    """Call back every `period` seconds of a steady clock, also while the clock of a replay is paused."""
    node.create_timer(period, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))


class _NeverReady(CallbackGroup):
    """Keeps its subscriptions out of the executor's wait set."""

    def can_execute(self, entity: Any) -> bool:
        return False

    def beginning_execution(self, entity: Any) -> bool:
        return False

    def ending_execution(self, entity: Any) -> None:
        raise AssertionError("a polled subscription is never executed")


class PolledSubscription:
    """Subscription that the node reads itself. raw: serialised bytes in place of messages."""

    def __init__(self, node: Node, message_type: type, topic: str, qos: QoSProfile, raw: bool = False):
        self._node = node
        self._group = _NeverReady()
        self.subscription = node.create_subscription(
            message_type, topic, _unused, qos, callback_group=self._group, raw=raw)
        self._take = self.subscription.handle.take_message
        self._arguments = (message_type, raw)

    @property
    def topic(self) -> str:
        return self.subscription.topic_name

    def take(self, limit: int = 1000) -> Iterator[tuple[Any, int, int]]:
        """At most `limit` waiting messages, oldest first, as (message, received_ns, sent_ns).

        received_ns: host UTC of its receipt; sent_ns: host UTC of its publication (0: unknown).
        """
        for message, info in self._waiting(limit):
            yield message, info["received_timestamp"], info["source_timestamp"]

    def take_numbered(self, limit: int = 1000) -> Iterator[tuple[Any, int, int | None]]:
        """As `take`, with the publisher's sequence number (from 1) in place of sent_ns; None if the middleware does not
        report it."""
        for message, info in self._waiting(limit):
            yield message, info["received_timestamp"], info["publication_sequence_number"]

    def _waiting(self, limit: int) -> Iterator[tuple[Any, dict[str, Any]]]:
        for _ in range(limit):
            taken = self._take(*self._arguments)
            if taken is None:
                return
            yield taken

    def publisher_count(self) -> int:
        """Matched publishers, including those that were killed and are not yet removed from the graph."""
        return self.subscription.get_publisher_count()

    def publishers(self) -> list[str]:
        """Full node name of each publisher of the topic; UNRESOLVED_NODE for one not resolved yet."""
        found = self._node.get_publishers_info_by_topic(self.topic)
        return [UNRESOLVED_NODE if publisher.node_name.startswith(UNRESOLVED_PREFIX)
                else f"{publisher.node_namespace.rstrip('/')}/{publisher.node_name}" for publisher in found]

    def destroy(self) -> None:
        self._node.destroy_subscription(self.subscription)


def wait_for_any(node: Node, subscriptions: Sequence[PolledSubscription], seconds: float) -> None:
    """Sleep until one subscription has a message, at most `seconds`; callbacks of the node do not run meanwhile."""
    waiting = rclpy_implementation.WaitSet(len(subscriptions), 0, 0, 0, 0, 0, node.context.handle)
    with waiting:
        waiting.clear_entities()
        for subscription in subscriptions:
            waiting.add_subscription(subscription.subscription.handle)
        waiting.wait(round(seconds * 1e9))


def _unused(message: Any) -> None:
    raise AssertionError("a polled subscription has no callback")


class OnDemandPublisher:
    """A publisher that reports whether it has subscribers, so that messages are only filled if there are any.

    publisher None: the topic is switched off.
    """

    def __init__(self, publisher: Publisher | None):
        self._publisher = publisher
        self._counted_at = float("-inf")
        self._has_subscribers = False

    def has_subscribers(self, now: float) -> bool:
        """Whether there were subscribers at most SUBSCRIBER_COUNT_PERIOD ago. now: of a monotonic clock [s]."""
        if self._publisher is not None and now - self._counted_at > SUBSCRIBER_COUNT_PERIOD:
            self._counted_at = now
            self._has_subscribers = self._publisher.get_subscription_count() > 0
        return self._has_subscribers

    def publish(self, message: Any) -> None:
        if self._publisher is not None:
            self._publisher.publish(message)


def message_class(type_name: str) -> type | None:
    """The Python class of "pkg/msg/Type"; None if its package is not installed."""
    package, _, name = type_name.replace("/msg/", "/").partition("/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError):
        return None


def to_nanoseconds(stamp: Time) -> int:
    """Nanoseconds since 1970 of a ROS stamp."""
    return stamp.sec * 1_000_000_000 + stamp.nanosec


def from_nanoseconds(nanoseconds: int) -> Time:
    """ROS stamp of nanoseconds since 1970; raises OverflowError outside 1901..2038, the range of the message."""
    sec, nanosec = divmod(nanoseconds, 1_000_000_000)
    if not -(2**31) <= sec < 2**31:
        raise OverflowError(f"stamp {nanoseconds} ns does not fit a ROS time")
    return Time(sec=sec, nanosec=nanosec)
