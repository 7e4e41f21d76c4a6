"""The live view: hears the suite, draws it for the browser. A process of its own that nothing waits for.

It listens best effort with short queues: a publisher neither waits for it nor sends it anything twice, so it can be
slow, stopped or killed without a prediction being late.
"""

import argparse
import signal
import sys
import time
from pathlib import Path
from types import FrameType

import rclpy
import rerun as rr
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from st_msgs.msg import ErrorSummary, InsStatus, Prediction, PredictionError, PredictorStatus, Steering
from st_recordings.car import read_vehicle
from st_ros.polling import PolledSubscription
from st_ros.scheduling import lower

from ..importance import VIEW_NICE
from ..view.feed import TOPICS, Feed
from ..view.scene import Scene, recording

PERIOD = 0.1  # s between pictures
FLUSH = 0.2  # s; every piece costs the page something
TYPES = {"status": PredictorStatus, "ins_status": InsStatus, "odometry": Odometry, "steering": Steering,
         "prediction": Prediction, "error": PredictionError, "summary": ErrorSummary, "diagnostics": DiagnosticArray}
# Messages kept of a topic: the newest few of what comes often; scores of one instant come together.
DEPTH = {"error": 200, "diagnostics": 50}
NEWEST = 5


class Viewer:
    def __init__(self, feed: Feed):
        self.stop = False
        self._feed = feed
        self._node = Node("viewer")
        self._heard = {"predictor/status": self._listen("predictor/status")}

    def _listen(self, topic: str) -> PolledSubscription:
        kind = TOPICS[topic]
        qos = QoSProfile(depth=DEPTH.get(kind, NEWEST), reliability=ReliabilityPolicy.BEST_EFFORT)
        return PolledSubscription(self._node, TYPES[kind], topic, qos)

    def spin(self) -> None:
        executor = SingleThreadedExecutor()
        executor.add_node(self._node)
        due, predicting = time.monotonic(), False
        while not self.stop:
            executor.spin_once(timeout_sec=0.0)
            for topic, subscription in self._heard.items():
                for message, heard_ns, _ in subscription.take():
                    self._feed.take(topic, message, heard_ns)
                    predicting = True
            if len(self._heard) == 1 and predicting:
                # Not before: a player of recordings counts its listeners before it begins.
                self._heard |= {topic: self._listen(topic) for topic in TOPICS if topic not in self._heard}
            self._feed.draw(time.time_ns())
            # After a pause no picture is made up for.
            due = max(due + PERIOD, time.monotonic())
            time.sleep(max(due - time.monotonic(), 0.01))
        executor.shutdown()
        self._node.destroy_node()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--vehicle", type=Path, required=True)
    parser.add_argument("--map-frame", default="map")
    parser.add_argument("--title", default="run")
    parser.add_argument("--server", help="address of the server to draw into, rerun+http://host:port/proxy")
    parser.add_argument("--save", type=Path, help="file to write as well, .rrd")
    options = parser.parse_args()
    lower(VIEW_NICE)
    sinks = [*([rr.GrpcSink(options.server)] if options.server else ()),
             *([rr.FileSink(str(options.save))] if options.save else ())]
    drawing = recording(options.title, FLUSH, *sinks)
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    viewer = Viewer(Feed(Scene(drawing, read_vehicle(options.vehicle)), options.map_frame))

    def stop(number: int, frame: FrameType | None) -> None:
        viewer.stop = True

    signal.signal(signal.SIGINT, stop)
    signal.signal(signal.SIGTERM, stop)
    viewer.spin()
    drawing.flush()
    drawing.disconnect()
    rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
