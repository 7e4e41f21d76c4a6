"""Tools for topics at high rates: polled subscriptions, publishers on demand, and stamps in nanoseconds.

The node itself reads a polled subscription, usually from a timer, so that the executor does not wake up for each
message: rclpy rebuilds its wait set at every wake-up, which at 250 Hz on several topics takes longer than processing
the messages. The middleware queues the messages in order until they are read, each with its time of arrival.
"""

import importlib
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from builtin_interfaces.msg import Time
from rclpy.callback_groups import CallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.timer import Timer
from rclpy.topic_endpoint_info import TopicEndpointInfo

UNRESOLVED_PREFIX = "_NODE_NAME"  # prefix of the placeholder for a name that discovery has not resolved
UNRESOLVED_NODE = "a node whose name is not known yet"  # text shown for such a node
SUBSCRIBER_COUNT_PERIOD = 0.05  # s between counts of subscribers, because a count takes as long as filling a message
SAMPLE_QOS = QoSProfile(depth=1000)  # 4 s at 250 Hz, so that a briefly blocked subscriber loses no message
# s from receipt to processing; after that, bridges omit what predictions do not need, to catch up. Half of 0.2 s
# (stale_after), the age of samples at which predictions stop.
MAX_BACKLOG = 0.1
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)  # late subscribers get the last message


def create_steady_timer(node: Node, period: float, callback: Callable[[], object], in_sim_time: bool = False) -> Timer:
    """Call `callback` every `period` [s] of real time, even while the clock of a replay is paused, and after the host's
    clock is set back; with `in_sim_time`, every `period` of simulated time in a node that uses it."""
    follows_clock = in_sim_time and node.get_parameter("use_sim_time").value
    return node.create_timer(period, callback, clock=None if follows_clock else Clock(clock_type=ClockType.STEADY_TIME))


class _PolledGroup(CallbackGroup):
    """Callback group that keeps its subscription out of the executor's wait set."""

    def can_execute(self, entity: Any) -> bool:
        return False


class PolledSubscription:
    """Subscription that the node reads itself. raw: `take` yields serialised bytes instead of messages."""

    def __init__(self, node: Node, message_type: type, topic: str, qos: QoSProfile, raw: bool = False):
        self._node = node
        self.subscription = node.create_subscription(
            message_type, topic, lambda message: None, qos, callback_group=_PolledGroup(), raw=raw)
        self._take = self.subscription.handle.take_message
        self._arguments = (message_type, raw)

    @property
    def topic(self) -> str:
        return self.subscription.topic_name

    def take(self, limit: int = 1000, entry: str = "source_timestamp") -> Iterator[tuple[Any, int, Any]]:
        """Yield at most `limit` waiting messages, oldest first, as (message, host UTC at receipt [ns], entry of
        rmw_message_info). entry: source_timestamp (host UTC at publication [ns], 0 if unknown) or
        publication_sequence_number (counted by the publisher from 1, None if unknown)."""
        for _ in range(limit):
            result = self._take(*self._arguments)
            if result is None:
                return
            message, info = result
            yield message, info["received_timestamp"], info[entry]

    def count_publishers(self) -> int:
        """Number of matched publishers, including killed ones until they are removed from the graph."""
        return self.subscription.get_publisher_count()

    def find_publisher_names(self) -> list[str]:
        """Full node name of each matched publisher; UNRESOLVED_NODE if it is not resolved or not in the graph yet."""
        names = [UNRESOLVED_NODE if publisher.node_name.startswith(UNRESOLVED_PREFIX)
                 else f"{publisher.node_namespace.rstrip('/')}/{publisher.node_name}"
                 for publisher in self._node.get_publishers_info_by_topic(self.topic)]
        return names + [UNRESOLVED_NODE] * (self.count_publishers() - len(names))


def wait_for_any(node: Node, subscriptions: Sequence[PolledSubscription], seconds: float) -> None:
    """Sleep until a subscription has a message, at most `seconds`; callbacks of the node do not run meanwhile."""
    wait_set = rclpy_implementation.WaitSet(len(subscriptions), 0, 0, 0, 0, 0, node.context.handle)
    with wait_set:
        wait_set.clear_entities()
        for subscription in subscriptions:
            wait_set.add_subscription(subscription.subscription.handle)
        wait_set.wait(round(seconds * 1e9))


class OnDemandPublisher:
    """Publisher for messages that are filled only while it has subscribers and is not paused. publisher: None if
    disabled."""

    def __init__(self, publisher: Publisher | None):
        self._publisher = publisher
        self.is_paused = False
        self._count_time = float("-inf")
        self._has_subscribers = False

    def has_subscribers(self) -> bool:
        """Whether the topic has subscribers, counted every SUBSCRIBER_COUNT_PERIOD; False if disabled or paused."""
        if self._publisher is not None and (now := time.monotonic()) - self._count_time > SUBSCRIBER_COUNT_PERIOD:
            self._count_time = now
            self._has_subscribers = self._publisher.get_subscription_count() > 0
        return self._has_subscribers and not self.is_paused

    def publish(self, message: Any) -> None:
        if self._publisher is not None:
            self._publisher.publish(message)


def match_qos(publishers: Sequence[TopicEndpointInfo], depth: int) -> QoSProfile:
    """The strictest QoS compatible with all publishers: reliable or transient local only if all publishers are."""
    profiles = [p.qos_profile for p in publishers]
    is_reliable = all(p.reliability == ReliabilityPolicy.RELIABLE for p in profiles)
    is_latched = all(p.durability == DurabilityPolicy.TRANSIENT_LOCAL for p in profiles)
    return QoSProfile(depth=depth,
                      reliability=ReliabilityPolicy.RELIABLE if is_reliable else ReliabilityPolicy.BEST_EFFORT,
                      durability=DurabilityPolicy.TRANSIENT_LOCAL if is_latched else DurabilityPolicy.VOLATILE)


def find_message_class(type_name: str) -> type | None:
    """The Python class of "pkg/msg/Type"; None if it is not installed."""
    package, _, name = type_name.replace("/msg/", "/").partition("/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError):
        return None


def to_nanoseconds(stamp: Time) -> int:
    """Nanoseconds since 1970 of a ROS stamp."""
    return stamp.sec * 1_000_000_000 + stamp.nanosec


def from_nanoseconds(nanoseconds: int) -> Time:
    """ROS stamp of nanoseconds since 1970. Raises OverflowError outside 1901 to 2038, the range of the message."""
    sec, nanosec = divmod(nanoseconds, 1_000_000_000)
    if not -(2**31) <= sec < 2**31:
        raise OverflowError(f"stamp {nanoseconds} ns is outside the range of a ROS time, 1901 to 2038")
    return Time(sec=sec, nanosec=nanosec)
