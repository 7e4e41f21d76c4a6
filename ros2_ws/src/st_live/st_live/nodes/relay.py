"""Relays topics of the suite to Foxglove over a WebSocket, byte for byte, on computers without foxglove_bridge."""

import argparse
import contextlib
import sys
from fnmatch import fnmatchcase

import foxglove
from foxglove import Channel, Schema
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from st_recordings.bag_metadata import UnknownTypeError, read_definition
from st_ros import spin
from st_ros.polling import PolledSubscription, create_steady_timer, find_message_class, match_qos

# Topics for viewers; raw packets and frames are not relayed.
TOPICS = ("/ins/odometry", "/ins/status", "/vehicle/*", "/predictor/*", "/evaluator/*", "/view/*", "/tf",
          "/tf_static", "/diagnostics", "/diagnostics_agg")
QUEUE_DEPTH = 100
FORWARD_PERIOD = 0.02  # s between reads of the queues
TOPIC_SCAN_PERIOD = 0.5  # s between searches for new topics


class RelayNode(Node):
    def __init__(self) -> None:
        super().__init__("foxglove_relay")
        self._relays: dict[str, tuple[PolledSubscription, Channel] | None] = {}
        create_steady_timer(self, FORWARD_PERIOD, self._forward)
        create_steady_timer(self, TOPIC_SCAN_PERIOD, self._open_new_topics)

    def _forward(self) -> None:
        for subscription, channel in filter(None, self._relays.values()):
            for data, received_ns, _ in subscription.take(QUEUE_DEPTH):
                channel.log(bytes(data), log_time=received_ns)

    def _open_new_topics(self) -> None:
        for topic, types in self.get_topic_names_and_types():
            is_new = topic not in self._relays and any(fnmatchcase(topic, f"*{pattern}") for pattern in TOPICS)
            if is_new and (publishers := self.get_publishers_info_by_topic(topic)):
                self._relays[topic] = self._relay(topic, types[0], publishers)

    def _relay(self, topic: str, type_name: str, publishers: list) -> tuple[PolledSubscription, Channel] | None:
        message_type = find_message_class(type_name)
        definition = ""
        with contextlib.suppress(UnknownTypeError):
            definition = read_definition(type_name)
        if message_type is None or not definition:
            print(f"{topic} is not relayed: type {type_name} is not installed", flush=True)
            return None
        qos = match_qos(publishers, QUEUE_DEPTH)
        # Best effort, so that no publisher waits for a viewer; latched messages are sent only once and must arrive.
        if qos.durability == DurabilityPolicy.VOLATILE:
            qos.reliability = ReliabilityPolicy.BEST_EFFORT
        schema = Schema(name=type_name, encoding="ros2msg", data=definition.encode())
        print(f"relaying {topic} ({type_name})", flush=True)
        return (PolledSubscription(self, message_type, topic, qos, raw=True),
                Channel(topic, message_encoding="cdr", schema=schema))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=8765)
    options = parser.parse_args()
    try:
        server = foxglove.start_server(name="single-track predictor suite", host=options.host, port=options.port)
    except (OSError, RuntimeError) as error:
        print(f"cannot serve on {options.host}:{options.port}: {error}", file=sys.stderr)
        return 2
    print(f"serving on {options.host}:{server.port}", flush=True)
    status = spin.run(RelayNode)
    server.stop()
    return status


if __name__ == "__main__":
    sys.exit(main())
