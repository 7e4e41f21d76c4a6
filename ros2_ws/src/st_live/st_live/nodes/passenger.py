"""Node passenger: serves a web page with the predicted paths of a run, for a passenger in the car.

The node has its own process, and subscribes with best-effort reliability and short queues. Publishers neither wait for
it nor retransmit messages, so it can be slow, stopped or killed without delaying a prediction.
"""

import json
import math
import sys
import threading
import time
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from st_core.errors import ConfigurationError
from st_core.palette import MODEL_COLOUR
from st_core.types import InsSample, cg_to_ins_position, map_to_body
from st_core.vehicle import VehicleParameters
from st_msgs.msg import InsStatus, PredictionError, PredictorStatus, Steering
from st_predictor import convert
from st_predictor.map_drawing import Pose
from st_recordings.car import read_vehicle
from st_ros import spin
from st_ros.polling import PolledSubscription, create_steady_timer
from st_ros.scheduling import BACKGROUND_NICE

from ..page import PageServer

TRACK_SPAN, TRACK_STEP = 20.0, 0.2  # s, duration of the measured track shown, and time between its points
PATH_STRIDE = 2  # every PATH_STRIDE-th point of a prediction is sent
MAX_AGE = 1.0  # s since receipt; an older prediction or steering angle is not shown
DIAGNOSTICS_TIMEOUT = 3.0  # s without a message on /diagnostics_agg, which the `Monitor` sends once a second
BAND_LEVEL = 0.9
LEVEL_NAMES = ("ok", "warning", "error", "error")  # of diagnostic_msgs; stale counts as an error
INPUTS_OF_MODE = {"forecast": "held", "course": "of the course", "plan": "planned"}  # the last mode with data is shown
TOPICS = {  # by topic: kind of message, type, and queue depth; the errors of all models arrive together
    "predictor/status": ("status", PredictorStatus, 3), "ins/status": ("ins_status", InsStatus, 3),
    "ins/odometry": ("odometry", Odometry, 3), "vehicle/steering": ("steering", Steering, 3),
    **{topic: (mode, kind, 3) for (mode, _), (topic, kind) in convert.list_prediction_topics(MODEL_COLOUR).items()},
    "evaluator/errors": ("error", PredictionError, 200), "/diagnostics_agg": ("diagnostics", DiagnosticArray, 3),
}
FRAME_PERIOD = 0.1  # s


class PassengerFrames:
    """Turns messages of a running suite into frames for the page. Times of receipt [s] are from the monotonic clock.
    `pose` is the pose of the CG in the map; track and paths are in the body axes of this pose: x forward, y left."""

    def __init__(self, car: VehicleParameters, map_frame: str):
        self._car, self._map_frame = car, map_frame
        self._sample: InsSample | None = None
        self._received_at: float | None = None  # time of the newest odometry
        self._steering: tuple[float | None, float] = None, -math.inf  # [rad], received [s]
        self._reason = ""
        self._position_mode: tuple[str, float] = ("", 0.0)  # text, received [s]
        self._track: deque[tuple[float, float, float]] = deque()  # (time of measurement [s], x, y [m])
        # By mode and model: (received [s], message), and (received [s], errors [m] and horizon [s]).
        self._predictions: dict[str, dict[str, tuple[float, Any]]] = {mode: {} for mode in INPUTS_OF_MODE}
        self._errors: dict[str, dict[str, tuple[float, dict[str, float]]]] = {mode: {} for mode in INPUTS_OF_MODE}
        self._checks: tuple[list[tuple[int, str]], float] = [], 0.0  # (level, text) of each check; received [s]

    def take(self, topic: str, message: Any, now: float) -> None:
        """Process a message on one of TOPICS, received at `now`."""
        kind, _, _ = TOPICS[topic]
        if kind == "odometry":
            self._take_odometry(message, now)
        elif kind == "ins_status":
            self._position_mode = message.position_mode_text, now
        elif kind == "steering":
            usable = message.valid and math.isfinite(message.road_wheel_angle)
            self._steering = message.road_wheel_angle if usable else None, now
        elif kind == "status":
            self._reason = message.reason
        elif kind == "diagnostics":
            checks = message.status[1:]  # the first is the summary of all
            self._checks = [(check.level[0], f"{check.name}: {check.message}") for check in checks], now
        elif kind == "error" and message.complete and message.mode in INPUTS_OF_MODE:
            self._errors[message.mode][message.model] = now, {  # at the end of the horizon
                "longitudinal": round(message.longitudinal[-1], 2), "lateral": round(message.lateral[-1], 2),
                "horizon": round(message.horizon[-1], 2)}
        elif kind in self._predictions:
            content = convert.read_trajectory(message)
            if not isinstance(content, str) and np.isfinite(content[1].states).all():
                self._predictions[kind][message.model] = now, message

    def make_frame(self, now: float) -> dict[str, Any]:
        """Content of the page, for JSON; without pose, speed, track and paths before the first odometry."""
        level, text = self._find_worst_check(now)
        sample, (position_mode, mode_time), (angle, angle_time) = self._sample, self._position_mode, self._steering
        current_modes = [mode for mode, predictions in self._predictions.items()
                         if mode == "forecast" or any(now - time < MAX_AGE for time, _ in predictions.values())]
        frame: dict[str, Any] = {
            "received": self._received_at and round(self._received_at, 4), "light": level, "text": text,
            "mode": position_mode, "mode_age": round(now - mode_time, 1), "reason": self._reason,
            "errors": {model: error | {"age": round(now - received, 1)} for mode in current_modes
                       for model, (received, error) in self._errors[mode].items()},
            "steering": None if angle is None or now - angle_time > MAX_AGE else round(angle, 4),
        }
        if sample is None:
            return frame
        pose = Pose(*self._find_cg(sample), sample.yaw)
        track = np.array([point[1:] for point in self._track]).reshape(-1, 2)
        return frame | {
            "pose": [round(value, 3) for value in pose], "speed": round(sample.velocity_x, 2),
            "track": _to_car_axes(track[:, 0], track[:, 1], pose),
            "paths": {model: self._make_path(message, pose, mode) for mode, predictions in self._predictions.items()
                      for model, (received, message) in predictions.items() if now - received < MAX_AGE},
        }

    def _find_cg(self, sample: InsSample) -> tuple[float, float]:
        x, y = cg_to_ins_position(sample.x, sample.y, sample.yaw, -self._car.cg_to_ins_x, -self._car.cg_to_ins_y)
        return float(x), float(y)

    def _make_path(self, message: Any, pose: Pose, mode: str) -> dict[str, Any]:
        x, y, yaw = (np.asarray(column)[::PATH_STRIDE] for column in (message.x, message.y, message.yaw))
        path: dict[str, Any] = {"points": _to_car_axes(x, y, pose), "step": PATH_STRIDE * message.step,
                                "inputs": INPUTS_OF_MODE[mode], "yaw": np.round(yaw - pose.yaw, 3).tolist()}
        # The forecast from the same start contains the bands of all modes.
        _, forecast = self._predictions["forecast"].get(message.model, (0.0, None))
        bands = forecast.bands if forecast and forecast.header.stamp == message.header.stamp else ()
        band = next((b for b in bands if b.mode == mode and abs(b.level - BAND_LEVEL) < 1e-6), None)
        if band is not None:
            path["band"] = np.round(np.asarray(band.across, float)[::PATH_STRIDE], 2).tolist()
        return path

    def _find_worst_check(self, now: float) -> tuple[str, str]:
        """(level, text) of the worst check; without checks the level is "none"."""
        checks, received = self._checks
        if not checks:
            return "none", "no diagnostics"
        if now - received > DIAGNOSTICS_TIMEOUT:
            return "error", f"no diagnostics for {now - received:.0f} s"
        level, text = max(checks, key=lambda check: (0, 1, 3, 2)[min(check[0], 3)])  # an error ranks above stale
        if level == 0:
            return "ok", "all checks OK"
        others = sum(other > 0 for other, _ in checks) - 1
        return LEVEL_NAMES[min(level, 3)], text + (f", and {others} more" if others else "")

    def _take_odometry(self, message: Any, now: float) -> None:
        sample = convert.read_ins_sample(message, self._map_frame)
        if isinstance(sample, str):
            return
        measured_at = sample.time_ns * 1e-9
        if self._track and measured_at < self._track[-1][0]:  # a replay has restarted
            self._track.clear()
            for errors in self._errors.values():
                errors.clear()
        self._sample, self._received_at = sample, now
        if not self._track or measured_at - self._track[-1][0] >= TRACK_STEP:
            self._track.append((measured_at, *self._find_cg(sample)))
            while measured_at - self._track[0][0] > TRACK_SPAN:
                self._track.popleft()


def _to_car_axes(x: np.ndarray, y: np.ndarray, pose: Pose) -> list[list[float]]:
    """[[forward, left], ...] [m] of map points x, y [m], relative to a car at `pose`."""
    forward, left = map_to_body(x - pose.x, y - pose.y, pose.yaw)
    return np.round(np.stack([forward, left], axis=1), 2).tolist()


class PassengerNode(Node):
    def __init__(self, frames: PassengerFrames, server: PageServer):
        super().__init__("passenger")
        self._frames, self._server = frames, server
        self._subscriptions_by_topic = {"predictor/status": self._subscribe("predictor/status")}
        create_steady_timer(self, FRAME_PERIOD, self._send_frame)

    def _subscribe(self, topic: str) -> PolledSubscription:
        _, message_type, depth = TOPICS[topic]
        qos = QoSProfile(depth=depth, reliability=ReliabilityPolicy.BEST_EFFORT)
        return PolledSubscription(self, message_type, topic, qos)

    def _send_frame(self) -> None:
        has_new_data = False
        for topic, subscription in self._subscriptions_by_topic.items():
            for message, received_ns, _ in subscription.take():
                queue_time = max((time.time_ns() - received_ns) * 1e-9, 0.0)
                self._frames.take(topic, message, time.monotonic() - queue_time)
                has_new_data = True
        if has_new_data and len(self._subscriptions_by_topic) == 1:
            # Subscribe only now, because the player of `st replay` counts the subscribers of its topics at its start.
            self._subscriptions_by_topic |= {topic: self._subscribe(topic) for topic in TOPICS
                                             if topic not in self._subscriptions_by_topic}
        if self._server.client_count:
            self._server.publish(self._frames.make_frame(time.monotonic()))


def main() -> int:
    """Serve the page. Argument: JSON with vehicle (file), map_frame, title, and the address and port to listen on."""
    options = json.loads(sys.argv[1])
    address, port = options["address"], options["port"]
    try:
        car = read_vehicle(Path(options["vehicle"]))
        settings = {
            "title": options["title"], "car": {"length": car.length, "width": car.width}, "models": MODEL_COLOUR}
        server = PageServer(address, port, settings)
    except (ConfigurationError, OSError) as error:
        where = f"{address}:{port}: " if isinstance(error, OSError) else ""
        print(f"{where}{getattr(error, 'strerror', None) or error}", file=sys.stderr)
        return 2
    threading.Thread(target=server.serve_forever, name="page", daemon=True).start()
    print(f"serving on {address}:{server.server_port}", flush=True)
    status = spin.run(lambda: PassengerNode(PassengerFrames(car, options["map_frame"]), server), nice=BACKGROUND_NICE)
    server.stop()
    return status


if __name__ == "__main__":
    sys.exit(main())
