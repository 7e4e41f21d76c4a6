"""A subscription that is emptied by the node itself (usually from a timer) instead of waking the executor per message.

rclpy rebuilds its wait set for every wake-up: at 250 Hz on several topics that costs more than the messages do.
Messages wait in the middleware's queue (`depth` per topic), in order, each with the time it arrived.
"""

from collections.abc import Iterator, Sequence
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import QoSProfile

# How rmw begins the name of a node that discovery has not brought yet, and what a person reads instead.
_UNKNOWN = "_NODE_NAME"
NAMELESS = "a node without a name yet"


class _NeverReady(CallbackGroup):
    """Keeps its subscriptions out of the executor's wait set."""

    def can_execute(self, entity: Any) -> bool:
        return False

    def beginning_execution(self, entity: Any) -> bool:
        return False

    def ending_execution(self, entity: Any) -> None:
        raise AssertionError("a polled subscription is never executed")


class PolledSubscription:
    """raw=True hands out the serialised bytes instead of messages."""

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

        received_ns: host UTC when it arrived here; sent_ns: when it was published (0: unknown).
        """
        for message, info in self._waiting(limit):
            yield message, info["received_timestamp"], info["source_timestamp"]

    def take_numbered(self, limit: int = 1000) -> Iterator[tuple[Any, int, int | None]]:
        """As `take`, with the number its publisher gave the message in place of when it was sent.

        Each publisher counts its own messages from 1; None where the middleware does not tell.
        """
        for message, info in self._waiting(limit):
            yield message, info["received_timestamp"], info["publication_sequence_number"]

    def _waiting(self, limit: int) -> Iterator[tuple[Any, dict[str, Any]]]:
        for _ in range(limit):
            taken = self._take(*self._arguments)
            if taken is None:
                return
            yield taken

    def publisher_count(self) -> int:
        """Publishers this subscription hears, those included that ended without a word and are not given up yet."""
        return self.subscription.get_publisher_count()

    def publishers(self) -> list[str]:
        """Full name of the node of each publisher of the topic; one that is not known yet is called so."""
        found = self._node.get_publishers_info_by_topic(self.topic)
        return [NAMELESS if one.node_name.startswith(_UNKNOWN) else f"{one.node_namespace.rstrip('/')}/{one.node_name}"
                for one in found]

    def destroy(self) -> None:
        self._node.destroy_subscription(self.subscription)


def wait_for_any(node: Node, subscriptions: Sequence[PolledSubscription], seconds: float) -> None:
    """Sleep until one of them has a message, at most so long; a message that waits already returns at once.

    For a callback of the node that needs what is about to arrive: nothing else of the node runs meanwhile.
    """
    waiting = rclpy_implementation.WaitSet(len(subscriptions), 0, 0, 0, 0, 0, node.context.handle)
    with waiting:
        waiting.clear_entities()
        for one in subscriptions:
            waiting.add_subscription(one.subscription.handle)
        waiting.wait(round(seconds * 1e9))


def _unused(message: Any) -> None:
    raise AssertionError("a polled subscription has no callback")
