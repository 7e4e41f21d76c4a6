"""From messages of the suite, live or recorded, to pictures: what is new is kept until the next one is drawn."""

from typing import Any

from st_core.types import InsSample
from st_predictor import convert
from st_predictor.history import History
from st_ros.stamps import to_nanoseconds

from . import words
from .scene import Scene

MODELS = ("kinematic", "linear", "nonlinear", "augmented")
WORDS_PERIOD = 1.0  # s between texts
# Topic, and the method that takes its messages.
TOPICS = {
    "predictor/status": "status", "ins/odometry": "odometry", "vehicle/steering": "steering",
    **{f"predictor/{model}/prediction": "prediction" for model in MODELS},
    "evaluator/errors": "error", "evaluator/summary": "summary", "/diagnostics": "diagnostics",
}


class Feed:
    """Messages as rclpy or rosbags hand them over."""

    def __init__(self, scene: Scene, map_frame: str):
        self._scene, self._map_frame = scene, map_frame
        self._history = History()
        self._sample: InsSample | None = None
        self._angle: float | None = None
        self._rows: list[Any] = []
        self._ticks, self._health = "predictor: not heard yet", {}
        self._words_due_ns = 0

    def take(self, topic: str, message: Any) -> None:
        getattr(self, f"_{TOPICS[topic]}")(message)

    def draw(self) -> None:
        """One picture of the newest sample, if there is one."""
        sample, self._sample = self._sample, None
        if sample is None:
            return
        self._history.add_pose(sample.time_ns, sample.x, sample.y)
        self._scene.motion(sample.time_ns, sample.velocity_x, sample.yaw_rate, self._angle)
        self._scene.paths(sample.time_ns, (sample.x, sample.y, sample.yaw), self._history)
        if not 0 <= self._words_due_ns - sample.time_ns <= WORDS_PERIOD * 1e9:
            self._words_due_ns = sample.time_ns + round(WORDS_PERIOD * 1e9)
            text = words.page(self._rows, self._ticks, list(self._health.values()))
            self._scene.words(sample.time_ns, text)

    def _odometry(self, message: Any) -> None:
        read = convert.ins_sample(message, self._map_frame)
        self._sample = self._sample if isinstance(read, str) else read

    def _steering(self, message: Any) -> None:
        self._angle = message.road_wheel_angle

    def _prediction(self, message: Any) -> None:
        self._history.add_path(message.model, convert.ins_path(message))

    def _error(self, message: Any) -> None:
        if message.complete and message.mode == "forecast":
            end_ns = to_nanoseconds(message.header.stamp) + round(message.horizon[-1] * 1e9)
            self._scene.error(end_ns, message.model, message.longitudinal_mean, message.lateral_mean)

    def _summary(self, message: Any) -> None:
        self._rows = message.statistics

    def _status(self, message: Any) -> None:
        skipped = message.skipped_stale + message.skipped_overrun + message.skipped_slow
        why = f" ({message.reason})" if message.reason else ""
        self._ticks = f"Ticks {message.due}, predicted {message.predicted}, skipped {skipped}{why}"

    def _diagnostics(self, message: Any) -> None:
        for s in message.status:
            level = s.level if isinstance(s.level, int) else int.from_bytes(s.level, "little")
            self._health[s.name] = (level, s.name, s.message)
