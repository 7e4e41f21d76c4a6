"""The live view: hears the suite, draws it for the browser. A process of its own that nothing waits for.

It listens best effort with short queues: a publisher neither waits for it nor sends it anything twice, so it can be
slow, stopped or killed without a prediction being late.
"""

import argparse
import os
import signal
import sys
import time
from pathlib import Path as FilePath
from types import FrameType

import rclpy
import rerun as rr
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from st_core.vehicle import VehicleParameters
from st_msgs.msg import ErrorSummary, Prediction, PredictionError, PredictorStatus, Steering
from st_predictor import convert
from st_predictor.history import History
from st_ros.polling import PolledSubscription
from st_ros.stamps import to_nanoseconds

from ..view import words
from ..view.layout import blueprint
from ..view.scene import Scene

PERIOD = 0.1  # s between pictures
WORDS_PERIOD = 1.0  # s between texts
NICENESS = 10  # the predictor goes first
MODELS = ("kinematic", "linear", "nonlinear", "augmented")
NEWEST = 5  # messages kept of what comes often
SCORES = 200  # scores of the same instant come together


class Viewer:
    def __init__(self, scene: Scene, map_frame: str):
        self.stop = False
        self._scene, self._map_frame = scene, map_frame
        self._node = Node("viewer")
        self._history = History()
        self._status = self._listen(PredictorStatus, "predictor/status", NEWEST)
        # The other topics wait until the predictor is heard: a player counts listeners before it begins.
        self._odometry = self._steering = None
        self._predictions: dict[str, PolledSubscription] = {}
        self._errors = self._summary = self._diagnostics = None
        self._rows, self._ticks, self._health = [], "predictor: not heard yet", {}
        self._angle: float | None = None
        self._pose: tuple[int, float, float, float] | None = None
        self._words_due = 0.0

    def _listen(self, message_type: type, topic: str, depth: int) -> PolledSubscription:
        qos = QoSProfile(depth=depth, reliability=ReliabilityPolicy.BEST_EFFORT)
        return PolledSubscription(self._node, message_type, topic, qos)

    def _listen_to_all(self) -> None:
        self._odometry = self._listen(Odometry, "ins/odometry", NEWEST)
        self._steering = self._listen(Steering, "vehicle/steering", NEWEST)
        for model in MODELS:
            self._predictions[model] = self._listen(Prediction, f"predictor/{model}/prediction", NEWEST)
        self._errors = self._listen(PredictionError, "evaluator/errors", SCORES)
        self._summary = self._listen(ErrorSummary, "evaluator/summary", NEWEST)
        self._diagnostics = self._listen(DiagnosticArray, "/diagnostics", 50)

    def spin(self) -> None:
        executor = SingleThreadedExecutor()
        executor.add_node(self._node)
        due = time.monotonic()
        while not self.stop:
            executor.spin_once(timeout_sec=0.0)
            for status, _, _ in self._status.take():
                skipped = status.skipped_stale + status.skipped_overrun + status.skipped_slow
                why = f" ({status.reason})" if status.reason else ""
                self._ticks = f"Ticks {status.due}, predicted {status.predicted}, skipped {skipped}{why}"
                if self._odometry is None:
                    self._listen_to_all()
            if self._odometry is not None:
                self._draw()
            # After a pause no picture is made up for.
            due = max(due + PERIOD, time.monotonic())
            time.sleep(max(due - time.monotonic(), 0.01))
        executor.shutdown()
        self._node.destroy_node()

    def _draw(self) -> None:
        for message, _, _ in self._steering.take():
            self._angle = message.road_wheel_angle
        for model, subscription in self._predictions.items():
            for message, _, _ in subscription.take():
                self._history.add_path(model, convert.ins_path(message))
        sample = None
        for message, _, _ in self._odometry.take():
            read = convert.ins_sample(message, self._map_frame)
            sample = sample if isinstance(read, str) else read
        if sample is not None:
            self._history.add_pose(sample.time_ns, sample.x, sample.y)
            self._scene.motion(sample.time_ns, sample.velocity_x, sample.yaw_rate, self._angle)
            self._scene.paths(sample.time_ns, (sample.x, sample.y, sample.yaw), self._history)
            self._pose = sample
        for message, _, _ in self._errors.take():
            if message.complete and message.mode == "forecast":
                end_ns = to_nanoseconds(message.header.stamp) + round(message.horizon[-1] * 1e9)
                self._scene.error(end_ns, message.model, message.longitudinal_mean, message.lateral_mean)
        self._write()

    def _write(self) -> None:
        for message, _, _ in self._summary.take():
            self._rows = message.statistics
        for message, _, _ in self._diagnostics.take():
            self._health |= {s.name: (int.from_bytes(s.level, "little"), s.name, s.message) for s in message.status}
        if self._pose is not None and time.monotonic() >= self._words_due:
            self._words_due = time.monotonic() + WORDS_PERIOD
            text = words.page(self._rows, self._ticks, list(self._health.values()))
            self._scene.words(self._pose.time_ns, text)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--vehicle", type=FilePath, required=True)
    parser.add_argument("--map-frame", default="map")
    parser.add_argument("--title", default="run")
    parser.add_argument("--server", help="address of the server to draw into, rerun+http://host:port/proxy")
    parser.add_argument("--save", type=FilePath, help="file to write as well, .rrd")
    options = parser.parse_args()
    os.nice(NICENESS)
    car = VehicleParameters.from_yaml(options.vehicle.read_text(encoding="utf-8"), str(options.vehicle))
    recording = rr.RecordingStream("single_track_predictor")
    recording.send_recording_name(options.title)
    sinks = [rr.GrpcSink(options.server)] if options.server else []
    sinks += [rr.FileSink(str(options.save))] if options.save else []
    recording.set_sinks(*sinks, default_blueprint=blueprint())
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    viewer = Viewer(Scene(recording, car), options.map_frame)

    def stop(number: int, frame: FrameType | None) -> None:
        viewer.stop = True

    signal.signal(signal.SIGINT, stop)
    signal.signal(signal.SIGTERM, stop)
    viewer.spin()
    recording.flush()
    recording.disconnect()
    rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
