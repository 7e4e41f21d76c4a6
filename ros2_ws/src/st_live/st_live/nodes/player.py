"""Plays odometry, steering, plans and map origin of a recording, and /clock, for `st replay` and `st verify`.

Messages are published byte for byte in the order of their log times, except that an external steering topic is
converted to st_msgs/Steering; /clock advances in steps. At a rate of 0 the clock waits until predictor and evaluator
have caught up, judging by the stamps in their messages.
"""

import json
import math
import sys
import time
from collections.abc import Mapping, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Any

import rclpy
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions
from rosbags.highlevel import AnyReader
from rosgraph_msgs.msg import Clock
from st_msgs.msg import Prediction, PredictionError, PredictorStatus, Steering
from st_recordings.runs.cdr import load_typestore
from st_recordings.runs.reconstruct import extract_steering_angle, get_stamp
from st_recordings.runs.run_types import SteeringField
from st_ros import polling, spin
from st_ros.polling import LATCHED, PolledSubscription, find_message_class, from_nanoseconds, wait_for_any

INPUT_TOPICS = ("/ins/odometry", "/vehicle/steering")  # as published; the names in the recording may differ
CLOCK_STEP_NS = 10_000_000
QUEUE_DEPTH = 1000
DISCOVERY_TIMEOUT = 15.0  # s
STATUS_PERIOD = 0.5  # s
MIN_SUBSCRIBERS = 3  # of a topic: predictor, evaluator, recorder
PLAN, ORIGIN = "/plan/inputs", "/ins/origin"
SUBSCRIBER_EXCEPTIONS = {PLAN: 2, ORIGIN: 1}  # plan: predictor and recorder; origin: at least the recorder
# s, longest wait for a node at rate 0; the short one applies after a wait without progress, for example at standstill.
TIMEOUT, SHORT_TIMEOUT = 2.0, 0.005
DRAIN_TIME = 1.0  # s after the last message, for the last predictions to reach evaluator and recorder
SCORE_DELAY = 1.0  # s; the clock may lead the newest scored start by the horizon plus this delay


class Follower:
    """Follows the progress of a node by the stamps in its messages. sources: message type and stamp field, by topic.
    lead: permitted lead of the clock [s]."""

    def __init__(self, node: Node, sources: Mapping[str, tuple[type, str]], lead: float):
        self._node, self._lead_ns, qos = node, round(lead * 1e9), QoSProfile(depth=QUEUE_DEPTH)
        self._sources = [(PolledSubscription(node, message_type, topic, qos), attrgetter(field))
                         for topic, (message_type, field) in sources.items()]
        self._newest_ns = 0
        self._has_progressed = True

    def wait(self, clock_ns: int) -> None:
        """Wait until the node is at most `lead` behind the clock, but no longer than the timeout."""
        end = time.monotonic() + (TIMEOUT if self._has_progressed else SHORT_TIMEOUT)
        previous_ns = self._newest_ns
        subscriptions = [subscription for subscription, _ in self._sources]
        while True:
            for subscription, read_stamp in self._sources:
                for message, _, _ in subscription.take(QUEUE_DEPTH):
                    self._newest_ns = max(self._newest_ns, polling.to_nanoseconds(read_stamp(message)))
            caught_up = self._newest_ns >= clock_ns - self._lead_ns
            if caught_up or time.monotonic() > end:
                self._has_progressed = caught_up or self._newest_ns > previous_ns  # progress restores the long timeout
                return
            wait_for_any(self._node, subscriptions, max(end - time.monotonic(), 0.0))


class Player:
    """Plays one bag.

    settings: bag (path); rate (speed relative to the recording, 0: as fast as the nodes can follow); odometry, steering
    (topics in the recording); steering_field (fields of SteeringField for an external steering topic, else null);
    steering_ratio, steering_wheel_offset [rad] (of the car); horizon [s], tick_rate [Hz], models (of the predictor).
    """

    def __init__(self, settings: Mapping[str, Any]):
        self._stop_requested = spin.catch_stop_signals()
        self._settings, self._bag, self._rate = settings, Path(settings["bag"]), settings["rate"]
        self._published_topics = dict(zip((settings["odometry"], settings["steering"]), INPUT_TOPICS, strict=True))
        self._steering_field = SteeringField(**field) if (field := settings["steering_field"]) else None
        self._node = Node("player")
        self._clock = self._node.create_publisher(Clock, "/clock", QoSProfile(depth=QUEUE_DEPTH))
        self._followers = [] if self._rate > 0 else [
            # With a lead of one tick, exactly one tick is due, and that tick publishes a prediction or a status.
            Follower(self._node, {f"predictor/{settings['models'][-1]}/prediction": (Prediction, "issued_at"),
                                  "predictor/status": (PredictorStatus, "header.stamp")},
                     1.0 / settings["tick_rate"]),
            Follower(self._node, {"evaluator/errors": (PredictionError, "header.stamp")},
                     settings["horizon"] + SCORE_DELAY),
        ]
        self._reported_at = 0.0

    def play(self) -> int:
        """Play the recording; returns 0 after its end or a stop signal, 1 if subscribers are missing at the start."""
        with AnyReader([self._bag], default_typestore=load_typestore()) as reader:
            publishers = self._create_publishers(reader.connections)
            if not self._wait_for_subscribers(list(publishers.values())):
                print("recorder, predictor or evaluator has not subscribed to its inputs", file=sys.stderr)
                return 1
            connections = [c for c in reader.connections if c.topic in publishers]
            first_ns = clock_ns = self._advance(reader.start_time, reader.start_time, time.monotonic())
            start_time, duration = time.monotonic(), (reader.end_time - reader.start_time) * 1e-9
            for connection, log_ns, data in reader.messages(connections=connections):
                while clock_ns + CLOCK_STEP_NS <= log_ns and not self._stop_requested():
                    clock_ns = self._advance(clock_ns + CLOCK_STEP_NS, first_ns, start_time)
                    self._report((clock_ns - first_ns) * 1e-9, duration)
                if self._stop_requested():
                    break
                if self._steering_field and connection.topic == self._settings["steering"]:
                    message = reader.deserialize(data, connection.msgtype)
                    publishers[connection.topic].publish(self._convert_steering(message, self._steering_field, log_ns))
                else:
                    publishers[connection.topic].publish(bytes(data))
            self._advance(clock_ns + CLOCK_STEP_NS, first_ns, start_time)
        self._report(duration, duration, time.monotonic() - start_time)
        time.sleep(DRAIN_TIME)
        return 0

    def close(self) -> None:
        spin.flush(self._node)
        self._node.destroy_node()

    def _create_publishers(self, connections: Sequence[Any]) -> dict[str, Publisher]:
        publishers: dict[str, Publisher] = {}
        for connection in connections:
            if connection.msgtype == "st_msgs/msg/InputPlan":
                self._published_topics[connection.topic] = PLAN
            elif connection.topic.endswith(ORIGIN) and connection.msgtype == "sensor_msgs/msg/NavSatFix":
                self._published_topics[connection.topic] = ORIGIN
            if connection.topic in self._published_topics and connection.topic not in publishers:
                is_converted = self._steering_field and connection.topic == self._settings["steering"]
                message_type = Steering if is_converted else find_message_class(connection.msgtype)
                name = self._published_topics[connection.topic]
                qos = LATCHED if name == ORIGIN else QoSProfile(depth=QUEUE_DEPTH)
                publishers[connection.topic] = self._node.create_publisher(message_type, name, qos)
        return publishers

    def _convert_steering(self, message: Any, field: SteeringField, log_ns: int) -> Steering:
        wheel, road = math.nan, extract_steering_angle(self._bag, message, field)
        if field.quantity == "wheel":
            wheel, road = road, (road - self._settings["steering_wheel_offset"]) / self._settings["steering_ratio"]
        converted = Steering(steering_wheel_angle=wheel, road_wheel_angle=road, valid=math.isfinite(road))
        converted.header.stamp = from_nanoseconds(get_stamp(message, log_ns))
        return converted

    def _wait_for_subscribers(self, publishers: Sequence[Publisher]) -> bool:
        """Wait for the subscribers of every topic and of the clock, or a stop signal; False after the timeout."""
        end = time.monotonic() + DISCOVERY_TIMEOUT
        expected = {p: SUBSCRIBER_EXCEPTIONS.get(p.topic_name, MIN_SUBSCRIBERS) for p in (*publishers, self._clock)}
        while any(p.get_subscription_count() < n for p, n in expected.items()) and not self._stop_requested():
            if time.monotonic() > end:
                return False
            time.sleep(0.05)
        return True

    def _advance(self, clock_ns: int, first_ns: int, start_time: float) -> int:
        if self._rate > 0:
            time.sleep(max(0.0, start_time + (clock_ns - first_ns) * 1e-9 / self._rate - time.monotonic()))
        self._clock.publish(Clock(clock=from_nanoseconds(clock_ns)))
        for follower in self._followers:
            follower.wait(clock_ns)
        return clock_ns

    def _report(self, played_time: float, duration: float, wall_time: float = 0.0) -> None:
        """Print the progress [s] as JSON, at most once per STATUS_PERIOD; at the end, with the `wall_time` [s]."""
        now = time.monotonic()
        if wall_time or now - self._reported_at > STATUS_PERIOD:
            self._reported_at = now
            status = {"played": round(played_time, 2), "duration": round(duration, 2), "wall": round(wall_time, 2)}
            print(json.dumps(status), flush=True)


def main() -> int:
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    player = Player(json.loads(sys.argv[1]))
    try:
        return player.play()
    finally:
        player.close()
        rclpy.try_shutdown()


if __name__ == "__main__":
    sys.exit(main())
