"""The two inputs that predictor and evaluator share: odometry and steering, taken when the node has time for them."""

import time
from collections.abc import Callable, Iterator
from typing import Any

from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import QoSProfile
from st_core.filtering import NANOSECOND
from st_core.types import InsSample
from st_msgs.msg import Steering
from st_ros import diagnostics
from st_ros.diagnostics import Check
from st_ros.polling import NAMELESS, PolledSubscription, wait_for_any
from st_ros.stamps import to_nanoseconds

from .. import convert
from ..one_publisher import OnePublisher

# Waiting messages per topic: 16 s at 250 Hz, so that a node that others keep from the processor loses nothing.
QUEUE_DEPTH = 4000


class Inputs:
    """Hands every usable sample to `add_ins` and `add_steering` and remembers why the others were refused."""

    def __init__(
        self, node: Node, map_frame: str,
        add_ins: Callable[[InsSample], bool], add_steering: Callable[[int, float], bool],
        on_news: Callable[[], None],
    ):
        """on_news: called where what `checks` says has changed so that it should be told at once."""
        qos = QoSProfile(depth=QUEUE_DEPTH)
        self._node, self._map_frame = node, map_frame
        self._add_ins, self._add_steering, self._on_news = add_ins, add_steering, on_news
        self._odometry = PolledSubscription(node, Odometry, "ins/odometry", qos)
        self._steering = PolledSubscription(node, Steering, "vehicle/steering", qos)
        self.received = {"INS": 0, "steering": 0}
        self.refused = {"INS": 0, "steering": 0}
        self.last_refusal = {"INS": "", "steering": ""}  # empty while the newest message was usable
        self._publishers = {"INS": OnePublisher(), "steering": OnePublisher()}
        self._arrived_ns = {"INS": 0, "steering": 0}  # newest message of each, by the host's UTC

    def wait(self, since_ns: int, longest: float) -> None:
        """Take what comes until a message of each signal has arrived since an instant (host UTC [ns]).

        longest [s]: then it is over, whatever has come.
        """
        end = time.monotonic() + longest
        self.drain()
        while min(self._arrived_ns.values()) < since_ns and (left := end - time.monotonic()) > 0.0:
            wait_for_any(self._node, (self._odometry, self._steering), left)
            self.drain()

    def drain(self) -> None:
        """Take what is waiting."""
        for message in self._taken("INS", self._odometry):
            sample = convert.ins_sample(message, self._map_frame)
            if isinstance(sample, str):
                self._refuse("INS", sample)
            else:
                self._note("INS", self._add_ins(sample))
        for message in self._taken("steering", self._steering):
            if not message.valid:
                self._refuse("steering", "marked invalid by the bridge (counter or checksum)")
            else:
                time_ns = to_nanoseconds(message.header.stamp)
                self._note("steering", self._add_steering(time_ns, message.road_wheel_angle))

    def _taken(self, signal: str, subscription: PolledSubscription) -> Iterator[Any]:
        """What waits, of the publisher that was there."""
        publisher = self._publishers[signal]
        before, count = publisher.says(_now()), subscription.publisher_count()
        # A publisher is counted before its first message can come; what one that has gone left behind comes after.
        if count > len(publisher.names):
            publisher.look(_names(subscription, count))
        for message, arrived_ns, number in subscription.take_numbered(QUEUE_DEPTH):
            if publisher.use(number, arrived_ns * NANOSECOND):
                self._arrived_ns[signal] = arrived_ns
                yield message
        if count > 1 or count < len(publisher.names):
            publisher.look(_names(subscription, count))
        if before != publisher.says(_now()):
            self._on_news()

    def why(self, reason: str) -> str:
        """A reason for no prediction, with what is wrong with the messages that do arrive."""
        for signal, refusal in self.last_refusal.items():
            if refusal and reason.startswith(signal):
                return f"{reason}; messages arrive but are refused: {refusal}"
        return reason

    def checks(self) -> list[Check]:
        said = {topic: self._publishers[signal].says(_now())
                for signal, topic in (("INS", self._odometry.topic), ("steering", self._steering.topic))}
        unused = {f"{signal} messages of others": one.unused for signal, one in self._publishers.items()}
        text = "; ".join(f"{topic} is {words}" for topic, words in said.items() if words)
        return [
            Check("publishers", diagnostics.ERROR if text else diagnostics.OK, text or "one of each input", unused),
            *(Check(f"input {signal}", diagnostics.WARN if self.last_refusal[signal] else diagnostics.OK,
                  f"refused: {self.last_refusal[signal]}" if self.last_refusal[signal] else "usable",
                  {"received": self.received[signal], "refused": self.refused[signal]})
              for signal in self.received),
        ]

    def _note(self, signal: str, accepted: bool) -> None:
        if accepted:
            self.received[signal] += 1
            self.last_refusal[signal] = ""
        else:
            self._refuse(signal, "not finite, repeated, or older than what came before")

    def _refuse(self, signal: str, reason: str) -> None:
        self.received[signal] += 1
        self.refused[signal] += 1
        self.last_refusal[signal] = reason


def _names(subscription: PolledSubscription, count: int) -> list[str]:
    """The node of each publisher; one whose node discovery has not brought yet is called so."""
    names = subscription.publishers()
    return names + [NAMELESS] * (count - len(names))


def _now() -> float:
    """UTC, as messages are stamped on arrival [s]."""
    return time.time_ns() * NANOSECOND
