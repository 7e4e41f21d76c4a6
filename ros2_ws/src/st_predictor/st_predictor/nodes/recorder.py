"""Node recorder: writes the serialised messages of selected topics into a rosbag2 directory (MCAP)."""

import contextlib
import hashlib
import itertools
import json
import shutil
import time
from collections.abc import Iterable
from fnmatch import fnmatchcase
from pathlib import Path
from types import SimpleNamespace

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy
from rclpy.serialization import deserialize_message
from rclpy.topic_endpoint_info import TopicEndpointInfo
from st_recordings.bag_metadata import Qos, UnknownTypeError
from st_ros import diagnostics, parameters, spin
from st_ros.diagnostics import Check, Diagnostics
from st_ros.parameters import ConfigurationError
from st_ros.polling import UNRESOLVED_PREFIX, PolledSubscription, create_steady_timer, find_message_class, match_qos
from st_ros.scheduling import BACKGROUND_NICE

from .. import convert, params
from ._bag import is_complete, make_recording_check, open_bag

WORK_PERIOD = 0.05  # s between reads of the queues; a queued message keeps its time of arrival
TOPIC_SCAN_PERIOD = 0.25  # s between searches for new topics
RESUME_PERIOD = 5.0  # s between attempts to resume in a new bag, for example after a full disk
RESUME_SPACE = 200_000_000  # bytes of free disk space required for a new bag
RESUME_WARNING_DURATION = 10.0  # s; duration of the warning about a resumed recording
DIAGNOSTICS = "/diagnostics"
SILENCE_TIMEOUT = 10.0  # s until a silent node is reported; the recorded nodes publish /diagnostics every second
QUEUE_DEPTH = 1000  # queued messages per topic: 4 s at 250 Hz, for a slow disk


class PublisherWatchdog:
    """Finds nodes that publish a recorded topic but whose messages do not arrive. DDS may match a publisher with a
    subscription that never receives its data, so only a message proves a connection."""

    def __init__(self, node: Node):
        self._node = node
        self._topic_times: dict[str, float] = {}  # time of the newest message of each topic, steady clock [s]
        self._node_times: dict[str, float] = {}  # time of the newest /diagnostics of each node [s]
        self._discovery_times: dict[str, float] = {}  # time of discovery of each node [s]

    def record_arrival(self, topic: str, data: bytes) -> None:
        now = time.monotonic()
        self._topic_times[topic] = now
        if topic == DIAGNOSTICS:
            message = deserialize_message(data, DiagnosticArray)
            self._node_times.update((status.name.partition(": ")[0], now) for status in message.status)

    def find_silent_nodes(self, topics: Iterable[str]) -> dict[str, float]:
        """Seconds of silence above SILENCE_TIMEOUT, by node, of nodes that are the only publisher of one of `topics`. A
        node without a known name is represented by its topic."""
        now = time.monotonic()
        node_topics: dict[str, list[str]] = {}
        for topic in topics:
            names = {topic if info.node_name.startswith(UNRESOLVED_PREFIX) else info.node_name
                     for info in self._node.get_publishers_info_by_topic(topic)
                     if info.qos_profile.durability == DurabilityPolicy.VOLATILE}  # latched topics are published once
            if len(names) == 1:  # with several publishers it is unknown which of them sent a message
                node_topics.setdefault(names.pop(), []).append(topic)
        self._discovery_times = {name: self._discovery_times.get(name, now) for name in node_topics}
        silences = {name: now - max(self._discovery_times[name], self._node_times.get(name, 0.0),
                                    *(self._topic_times.get(topic, 0.0) for topic in own_topics))
                    for name, own_topics in sorted(node_topics.items())}
        return {name: silence for name, silence in silences.items() if silence > SILENCE_TIMEOUT}


class RecorderNode(Node):
    def __init__(self) -> None:
        super().__init__("recorder")
        values = parameters.declare(self, params.RECORDER)
        if not values.output_directory:
            raise ConfigurationError(
                f"{values.message_prefix}output_directory: not set; set it to a new directory for the bag")
        namespace = self.get_namespace().rstrip("/")
        self._patterns = [topic if topic.startswith("/") else f"{namespace}/{topic}" for topic in values.topics]
        self._values, self._records = values, make_metadata(values)
        self._bag = open_bag(values, self._records)
        self._stop_reason = ""  # why an earlier bag of this run ended
        self._next_attempt, self._resume_time = float("inf"), float("-inf")
        # By topic: subscription, channel of the bag, message type, and QoS of the publishers.
        self._recorded_topics: dict[str, tuple[PolledSubscription, int, str, list[Qos]]] = {}
        self._omitted_topics: dict[str, str] = {}  # reason by topic
        self._watchdog = PublisherWatchdog(self)
        self._uses_sim_time = self.get_parameter("use_sim_time").value
        create_steady_timer(self, WORK_PERIOD, self._record_messages)
        create_steady_timer(self, TOPIC_SCAN_PERIOD, self._subscribe_to_new_topics)
        self._diagnostics = Diagnostics(self, str(self._bag.directory), self._make_checks)
        self._subscribe_to_new_topics()
        self.get_logger().info(f"recording into {self._bag.directory}")

    def _subscribe_to_new_topics(self) -> None:
        for topic, types in self.get_topic_names_and_types():
            is_new = topic not in self._recorded_topics and topic not in self._omitted_topics
            is_selected = any(fnmatchcase(topic, pattern) for pattern in self._patterns)
            if is_new and is_selected and (publishers := self.get_publishers_info_by_topic(topic)):
                self._subscribe(topic, types, publishers)

    def _subscribe(self, topic: str, types: list[str], publishers: list[TopicEndpointInfo]) -> None:
        if len(types) != 1:
            self._omitted_topics[topic] = f"published with {len(types)} types: {', '.join(types)}"
            return
        message_type = find_message_class(types[0])
        if message_type is None:
            self._omitted_topics[topic] = f"message type {types[0]} is not installed"
            return
        try:
            qos = [convert.make_bag_qos(p.qos_profile) for p in publishers]
            channel = self._bag.add_topic(topic, types[0], qos)
        except UnknownTypeError as error:
            self._omitted_topics[topic] = str(error)
            return
        subscription = PolledSubscription(self, message_type, topic, match_qos(publishers, QUEUE_DEPTH), raw=True)
        self._recorded_topics[topic] = subscription, channel, types[0], qos

    def _record_messages(self) -> None:
        for topic, (subscription, channel, _, _) in self._recorded_topics.items():
            for data, received_ns, sent_ns in subscription.take(QUEUE_DEPTH):
                log_ns = self.get_clock().now().nanoseconds if self._uses_sim_time else received_ns
                self._bag.write(channel, data, log_ns, sent_ns or log_ns)
                self._watchdog.record_arrival(topic, data)
        self._bag.flush_when_due()
        if self._bag.error and self._values.number_if_exists:
            self._resume()

    def _resume(self) -> None:
        """Resume in a new bag if the disk has space; at once if the file was moved, else after RESUME_PERIOD."""
        now = time.monotonic()
        if self._next_attempt == float("inf"):
            self._next_attempt = now if self._bag.was_moved else now + RESUME_PERIOD
        if now < self._next_attempt:
            return
        self._next_attempt = now + RESUME_PERIOD
        with contextlib.suppress(OSError, ConfigurationError):
            folder = self._bag.directory
            existing = next(path for path in (folder, *folder.parents) if path.exists())
            if shutil.disk_usage(existing).free < RESUME_SPACE:
                return
            bag = open_bag(self._values, self._records)
            self._next_attempt = float("inf")
            self._stop_reason, self._bag, self._resume_time = self._bag.error, bag, now
            for topic, (subscription, _, message_type, qos) in self._recorded_topics.items():
                self._recorded_topics[topic] = subscription, bag.add_topic(topic, message_type, qos), message_type, qos
            self.get_logger().warning(f"{self._stop_reason}; recording resumed in {bag.directory}")

    def _make_checks(self) -> list[Check]:
        level, text = diagnostics.OK, f"{len(self._recorded_topics)} recorded"
        if self._omitted_topics:
            level = diagnostics.WARN
            text = "not recorded: " + "; ".join(f"{topic}: {reason}" for topic, reason in self._omitted_topics.items())
        elif not self._recorded_topics:
            level, text = diagnostics.WARN, "none of the topics has a publisher yet"
        topics = Check("topics", level, text, {"topics": len(self._recorded_topics)})
        has_resumed = time.monotonic() - self._resume_time < RESUME_WARNING_DURATION
        suffix = (f"; recording resumes when the disk is writable and {RESUME_SPACE / 1e6:.0f} MB are free"
                  if self._values.number_if_exists else "")
        return [make_recording_check(self._bag, self._stop_reason, has_resumed, suffix), topics,
                self._make_publishers_check()]

    def _make_publishers_check(self) -> Check:
        if DIAGNOSTICS not in self._recorded_topics:
            return Check("publishers", diagnostics.OK, f"not checked: {DIAGNOSTICS} is not recorded")
        self._record_messages()  # so that messages still queued, after a delay of this node, count as received
        if silent_nodes := self._watchdog.find_silent_nodes(self._recorded_topics):
            silences = ", ".join(f"{name} for {seconds:.0f} s" for name, seconds in silent_nodes.items())
            return Check("publishers", diagnostics.WARN, f"nothing recorded from {silences}, not even /diagnostics")
        return Check("publishers", diagnostics.OK, "no silent publisher found")

    @property
    def exit_status(self) -> int:
        """1 if the recording has a gap or was not written completely, else 0."""
        return int(bool(self._stop_reason) or not is_complete(self._bag))

    def close(self) -> None:
        self._record_messages()
        self._bag.close()
        if self._bag.error:
            self.get_logger().error(self._bag.error)


def make_metadata(values: SimpleNamespace) -> dict[str, dict[str, str]]:
    """Metadata records of the bag: start time, configuration files with their common hash, and `metadata_json`. Raises
    ConfigurationError naming the file or the parameter."""
    records: dict[str, dict[str, str]] = {"recording": {"recorder": "st_predictor", "started_ns": str(time.time_ns())}}
    texts: dict[str, str] = {}
    paths = {name: Path(name).absolute() for name in values.configuration_files if name}
    for name, path in paths.items():
        # Key of a file: its name, preceded by as many parent folders as are needed to make it unique.
        others = set(paths.values()) - {path}
        length = next(n for n in itertools.count(1) if all(o.parts[-n:] != path.parts[-n:] for o in others))
        texts[Path(*path.parts[-length:]).as_posix()] = params.read_text(values, "configuration_files", name)
    if texts:
        joined_text = "".join(f"{name}\n{text}" for name, text in sorted(texts.items()))
        records["configuration"] = {**texts, "hash": hashlib.sha256(joined_text.encode()).hexdigest()}
    if values.metadata_json:
        try:
            metadata = json.loads(values.metadata_json)
        except ValueError as error:
            raise ConfigurationError(f"{values.message_prefix}metadata_json: {error}") from None
        if not isinstance(metadata, dict) or not all(isinstance(entries, dict) for entries in metadata.values()):
            raise ConfigurationError(f'{values.message_prefix}metadata_json: expected {{"record": {{"key": "text"}}}}')
        for name, entries in metadata.items():
            record = records.setdefault(name, {})
            record.update({k: v if isinstance(v, str) else json.dumps(v) for k, v in entries.items()})
    return records


def main() -> int:
    return spin.run(RecorderNode, nice=BACKGROUND_NICE)
