"""Receives odometry and steering for predictor and evaluator, each from a single publisher."""

import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import QoSProfile
from st_core.evaluation import Evaluator
from st_core.prediction import Predictor
from st_core.timeseries import NANOSECOND
from st_msgs.msg import Steering
from st_ros import diagnostics
from st_ros.diagnostics import Check
from st_ros.polling import UNRESOLVED_NODE, PolledSubscription, to_nanoseconds, wait_for_any

from .. import convert

SILENCE_TIMEOUT = 1.0  # s without a message after which a different publisher can replace the accepted one
WARNING_DURATION = 10.0  # s from the last rejected message to the end of the warning
MAX_NUMBER_GAP = 1000  # largest gap in the accepted publisher's message numbers: 4 s at 250 Hz
UNUSABLE_SAMPLE = "values not finite, or stamp repeated or more than 0.5 s older than the newest"
QUEUE_DEPTH = 4000  # queued messages per topic: 16 s at 250 Hz, in case the node gets no processor time


class PublisherLock:
    """Accepts only messages of the first publisher of an input, so that measurements of two cars are never mixed.

    A message does not name its publisher, but each publisher numbers its messages consecutively: they form a chain.
    No message is used if nodes with different names publish before the first message is accepted, or if two chains
    reach the same number. A killed node stays in the graph for a while. The node that replaces it has the same name and
    numbers its messages from 1; a chain that began before the last accepted message belongs to a different node.

    names: full node names of all publishers at the last `update`. rejected_count: number of messages rejected so far.
    """

    def __init__(self) -> None:
        self.names: tuple[str, ...] = ()
        self.rejected_count = 0
        self._has_competitors = self._are_indistinguishable = False
        self._accepted_number: int | None = None  # sequence number of the newest accepted message
        self._accepted_at: float | None = None  # [s]
        self._rejected_chains: dict[int, tuple[float, float]] = {}  # newest number: first and last time of arrival [s]
        self._rejected_at: float | None = None  # [s]

    def update(self, names: Sequence[str]) -> None:
        """Set the node name of each publisher in the graph."""
        self.names, self._has_competitors = tuple(sorted(names)), len(names) > 1
        self._are_indistinguishable = self._are_indistinguishable and self._has_competitors

    def accept(self, number: int | None, now: float) -> bool:
        """Whether to use a message. number: as sent by its publisher, None or 0 if unknown. now: arrival time [s]."""
        if not self._has_competitors or self._continues_chain(number, now):
            self._accepted_number, self._accepted_at = number, now
            return True
        self.rejected_count += 1
        self._rejected_at = now
        if number is not None:
            began_at, _ = self._rejected_chains.pop(number - 1, (now, now))
            self._rejected_chains[number] = began_at, now
        return False

    def _continues_chain(self, number: int | None, now: float) -> bool:
        if self._are_indistinguishable or not number:
            return False
        if self._accepted_number is None or self._accepted_at is None:
            return self._have_one_name()
        self._rejected_chains = {newest: times for newest, times in self._rejected_chains.items()
                                 if now - times[1] < SILENCE_TIMEOUT}
        if number == self._accepted_number + 1:
            self._are_indistinguishable = self._accepted_number in self._rejected_chains
            return not self._are_indistinguishable
        if now - self._accepted_at <= SILENCE_TIMEOUT:
            return False
        # Messages were lost, or the node was restarted.
        candidates = {newest for newest, (began_at, _) in self._rejected_chains.items()
                      if began_at > self._accepted_at and self._may_follow(newest)}
        is_new = number - 1 in candidates or number - 1 not in self._rejected_chains
        return is_new and self._may_follow(number) and not candidates - {number - 1}

    def _may_follow(self, number: int) -> bool:
        return self._accepted_number is not None and (0 < number - self._accepted_number <= MAX_NUMBER_GAP or (
            self._have_one_name() and number <= MAX_NUMBER_GAP))

    def _have_one_name(self) -> bool:
        return len(set(self.names)) == 1 and UNRESOLVED_NODE not in self.names

    def describe_conflict(self, now: float) -> str:
        """Warning about competing publishers; "" if there are none. now: on the clock of `accept` [s]."""
        has_rejected = self._rejected_at is not None and now - self._rejected_at < WARNING_DURATION
        if not self._has_competitors or not (len(set(self.names)) > 1 or has_rejected):
            return ""
        names = ", ".join(self.names)
        if self._are_indistinguishable or self._accepted_number is None:
            return f"published by {len(self.names)} nodes that cannot be distinguished; none is used: {names}"
        return f"published by {len(self.names)} nodes ({names}); only messages of the first publisher are used"


class _Input:
    """One input topic. accepted_count, unusable_count: numbers of accepted and of unusable messages. problem: why the
    newest message cannot be used, or "". arrival_ns: time of its arrival [ns], host UTC."""

    def __init__(self, node: Node, signal: str, message_type: type, topic: str, on_change: Callable[[], None]):
        self.signal, self._on_change = signal, on_change
        self.subscription = PolledSubscription(node, message_type, topic, QoSProfile(depth=QUEUE_DEPTH))
        self.lock = PublisherLock()
        self.accepted_count = self.unusable_count = self.lost_count = self.arrival_ns = self._number = 0
        self.problem = ""

    def take_accepted(self) -> Iterator[Any]:
        """Queued messages of the accepted publisher."""
        previous_warning, count = self.lock.describe_conflict(_read_utc()), self.subscription.count_publishers()
        # Add new publishers before reading, and remove ended ones only afterwards: their messages may be queued.
        if count > len(self.lock.names):
            self.lock.update(self.subscription.find_publisher_names())
        for message, arrival_ns, number in self.subscription.take(QUEUE_DEPTH, "publication_sequence_number"):
            if self.lock.accept(number, arrival_ns * NANOSECOND):
                self.lost_count += max((number or 0) - self._number - 1, 0) if self._number else 0
                self.arrival_ns, self._number = arrival_ns, number or 0
                yield message
        if count > 1 or count < len(self.lock.names):
            self.lock.update(self.subscription.find_publisher_names())
        if previous_warning != self.lock.describe_conflict(_read_utc()):
            self._on_change()

    def count(self, problem: str) -> None:
        """Count a message. problem: why it cannot be used, or ""."""
        self.accepted_count += 1
        self.unusable_count += bool(problem)
        self.problem = problem

    def make_check(self) -> Check:
        name, values = f"input {self.signal}", {"received": self.accepted_count, "unusable": self.unusable_count,
                                                 "lost": self.lost_count}
        if self.problem:
            return Check(name, diagnostics.WARN, f"unusable: {self.problem}", values)
        if not self.accepted_count:
            return Check(name, diagnostics.STALE, f"no message accepted on {self.subscription.topic} yet", values)
        return Check(name, diagnostics.OK, "usable", values)


class Inputs:
    """Receives both inputs for `core`. on_change: called when the warning about competing publishers changes."""

    def __init__(self, node: Node, map_frame: str, core: Predictor | Evaluator, on_change: Callable[[], None]):
        self._node, self._map_frame, self._core = node, map_frame, core
        self._ins = _Input(node, "INS", Odometry, "ins/odometry", on_change)
        self._steering = _Input(node, "steering", Steering, "vehicle/steering", on_change)
        self._inputs = self._ins, self._steering

    def wait(self, since_ns: int, timeout: float) -> None:
        """Process messages for `timeout` [s], or until each input has a message since `since_ns` (host UTC)."""
        end = time.monotonic() + timeout
        self.drain()
        while (min(entry.arrival_ns for entry in self._inputs) < since_ns
               and (remaining := end - time.monotonic()) > 0.0):
            wait_for_any(self._node, [entry.subscription for entry in self._inputs], remaining)
            self.drain()

    def drain(self) -> None:
        """Process all queued messages."""
        for message in self._ins.take_accepted():
            sample = convert.read_ins_sample(message, self._map_frame)
            problem = sample if isinstance(sample, str) else "" if self._core.add_ins(sample) else UNUSABLE_SAMPLE
            self._ins.count(problem)
        for message in self._steering.take_accepted():
            if not message.valid:
                self._steering.count("marked invalid by its source (wrong counter or checksum, or angle not finite)")
            else:
                accepted = self._core.add_steering(to_nanoseconds(message.header.stamp), message.road_wheel_angle)
                self._steering.count("" if accepted else UNUSABLE_SAMPLE)

    def explain(self, reason: str) -> str:
        """The reason for a missing prediction, with the problem of the newest message if `reason` names that input."""
        for entry in self._inputs:
            if entry.problem and reason.startswith(entry.signal):
                return f"{reason}; messages arrive but are unusable: {entry.problem}"
        return reason

    def make_checks(self) -> list[Check]:
        warnings = {entry.subscription.topic: entry.lock.describe_conflict(_read_utc()) for entry in self._inputs}
        counts = {f"{entry.signal} messages of other publishers": entry.lock.rejected_count for entry in self._inputs}
        text = "; ".join(f"{topic} is {warning}" for topic, warning in warnings.items() if warning)
        level = diagnostics.ERROR if text else diagnostics.OK
        return [Check("publishers", level, text or "no competing publishers", counts),
                *(entry.make_check() for entry in self._inputs)]


def _read_utc() -> float:
    """Host UTC [s], the clock of the arrival stamps."""
    return time.time_ns() * NANOSECOND
