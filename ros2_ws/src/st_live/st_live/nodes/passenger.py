"""Node passenger: serves the passenger's page of a running suite. A process of its own that no other waits for.

It subscribes best effort with short queues: a publisher neither waits for it nor resends, so that it can be slow,
stopped or killed without delaying a prediction.
"""

import argparse
import signal
import sys
import threading
import time
from pathlib import Path

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from st_core.palette import colour_of
from st_msgs.msg import InsStatus, Prediction, PredictionError, PredictorStatus, Steering
from st_predictor import convert
from st_recordings.car import read_vehicle
from st_ros.polling import PolledSubscription
from st_ros.scheduling import lower

from ..suite import VIEW_NICE
from ..view.page_server import PageServer
from ..view.passenger import MODELS, TOPICS, PassengerFrames

PERIOD = 0.1  # s between frames
TYPES = {"status": PredictorStatus, "ins_status": InsStatus, "odometry": Odometry, "steering": Steering,
         "prediction": Prediction, "plan": convert.PLANNED, "course": convert.PLANNED, "error": PredictionError,
         "diagnostics": DiagnosticArray}
# Messages kept of a topic: a few of the frequent ones; scores of one instant arrive together.
DEPTH = {"error": 200, "diagnostics": 50}
NEWEST = 3


class PassengerNode(Node):
    def __init__(self, frames: PassengerFrames, server: PageServer):
        super().__init__("passenger")
        self._frames, self._server = frames, server
        self._subscriptions_by_topic = {"predictor/status": self._subscribe("predictor/status")}
        self.stop = threading.Event()

    def _subscribe(self, topic: str) -> PolledSubscription:
        kind = TOPICS[topic]
        qos = QoSProfile(depth=DEPTH.get(kind, NEWEST), reliability=ReliabilityPolicy.BEST_EFFORT)
        return PolledSubscription(self, TYPES[kind], topic, qos)

    def run(self) -> None:
        executor = SingleThreadedExecutor(context=self.context)
        executor.add_node(self)
        due, started = time.monotonic(), False
        while not self.stop.is_set():
            executor.spin_once(timeout_sec=0.0)
            for topic, subscription in self._subscriptions_by_topic.items():
                for message, received_ns, _ in subscription.take():
                    waited = max((time.time_ns() - received_ns) * 1e-9, 0.0)  # in the queue
                    self._frames.take(topic, message, time.monotonic() - waited)
                    started = True
            if started and len(self._subscriptions_by_topic) == 1:
                # Not before: a player of recordings counts the subscribers of its topics before it begins.
                self._subscriptions_by_topic |= {
                    topic: self._subscribe(topic) for topic, kind in TOPICS.items()
                    if topic not in self._subscriptions_by_topic and TYPES[kind]}
            if self._server.clients:
                self._server.publish(self._frames.frame(time.monotonic()))
            due = max(due + PERIOD, time.monotonic())  # frames missed are not made up for
            self.stop.wait(max(due - time.monotonic(), 0.01))
        executor.shutdown()
        self.destroy_node()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--vehicle", type=Path, required=True)
    parser.add_argument("--map-frame", default="map")
    parser.add_argument("--title", default="run")
    parser.add_argument("--address", default="127.0.0.1", help="of this host, to listen on")
    parser.add_argument("--port", type=int, default=0, help="0: a free one")
    options = parser.parse_args()
    car = read_vehicle(options.vehicle)
    settings = {"title": options.title, "car": {"length": car.length, "width": car.width},
                "models": {model: colour_of(model) for model in MODELS}}
    try:
        server = PageServer(options.address, options.port, settings)
    except OSError as error:
        print(f"{options.address}:{options.port}: {error.strerror or error}", file=sys.stderr)
        return 2
    lower(VIEW_NICE)
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = PassengerNode(PassengerFrames(car, options.map_frame), server)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: node.stop.set())
    threading.Thread(target=server.serve_forever, name="page", daemon=True).start()
    print(f"serving on {options.address}:{server.port}", flush=True)
    node.run()
    server.stop()
    rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
