"""Who arrives. DDS matches publishers and subscriptions; whether anything comes through only the messages say."""

import time
from collections.abc import Iterable

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy
from rclpy.serialization import deserialize_message

# A node of the suite speaks on /diagnostics each second; who has said and published nothing for this long is named [s].
PATIENCE = 10.0
DIAGNOSTICS = "/diagnostics"
NAMELESS = "_NODE_NAME"  # the middleware's word for one whose name has not arrived either


class Heard:
    """Nodes with a topic of their own among those that `node` records, and how long each has been silent."""

    def __init__(self, node: Node):
        self._node = node
        self._topics: dict[str, float] = {}  # when each last brought a message, by the steady clock [s]
        self._speakers: dict[str, float] = {}  # when a node was last named on /diagnostics
        self._since: dict[str, float] = {}

    def arrived(self, topic: str, data: bytes) -> None:
        now = time.monotonic()
        self._topics[topic] = now
        if topic == DIAGNOSTICS:
            message = deserialize_message(data, DiagnosticArray)
            self._speakers.update((status.name.partition(": ")[0], now) for status in message.status)

    def silent(self, topics: Iterable[str]) -> dict[str, float]:
        """Seconds since the last message of each node that publishes on `topics` and was not heard for `PATIENCE`."""
        now = time.monotonic()
        own: dict[str, list[str]] = {}
        for topic in topics:
            names = {topic if info.node_name.startswith(NAMELESS) else info.node_name
                     for info in self._node.get_publishers_info_by_topic(topic)
                     if info.qos_profile.durability == DurabilityPolicy.VOLATILE}  # latched: once and no more
            if len(names) == 1:  # on a topic of several, a message does not say whose it is
                own.setdefault(names.pop(), []).append(topic)
        self._since = {name: self._since.get(name, now) for name in own}
        last = {name: max(self._since[name], self._speakers.get(name, 0.0), *(self._topics.get(t, 0.0) for t in mine))
                for name, mine in own.items()}
        return {name: now - at for name, at in sorted(last.items()) if now - at > PATIENCE}
