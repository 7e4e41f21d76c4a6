"""From messages of the suite, live or recorded, to pictures: what is new is kept until the next one is drawn."""

from typing import Any

from st_core.types import InsSample
from st_predictor import convert
from st_predictor.map_drawing import History
from st_ros.stamps import to_nanoseconds

from . import words
from .scene import Scene

MODELS = ("kinematic", "linear", "nonlinear", "augmented")
WORDS_PERIOD = 1.0  # s between texts
PASSENGER_PERIOD = 0.4  # s; faster, large numbers cannot be read
# Topic, and the method that takes its messages.
TOPICS = {
    "predictor/status": "status", "ins/status": "ins_status", "ins/odometry": "odometry",
    "vehicle/steering": "steering",
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
        self._ticks = "predictor: not heard yet"
        self._health: dict[str, Any] = {}
        self._words_due_ns = 0
        self._shown: InsSample | None = None
        self._heard_ns = {"odometry": 0, "diagnostics": 0}  # when the newest came
        self._passenger_due_ns = 0
        self._mode, self._mode_ns = "", 0

    def take(self, topic: str, message: Any, heard_ns: int = 0) -> None:
        """heard_ns: when it came, by the host's UTC; 0 for a recording."""
        if TOPICS[topic] in self._heard_ns:
            self._heard_ns[TOPICS[topic]] = heard_ns
        getattr(self, f"_{TOPICS[topic]}")(message)

    def draw(self, now_ns: int = 0) -> None:
        """One picture of the newest sample, if there is one. now_ns: host UTC; 0 for a recording."""
        sample, self._sample = self._sample, None
        self._shown = sample or self._shown
        if self._shown is not None:
            # Also while nothing comes: a picture that stands must say so.
            self._passenger(self._shown, now_ns)
        if sample is None:
            return
        self._history.add_pose(sample.time_ns, sample.x, sample.y)
        self._scene.motion(sample.time_ns, sample.velocity_x, sample.yaw_rate, self._angle)
        self._scene.paths(sample.time_ns, (sample.x, sample.y, sample.yaw), self._history)
        if not 0 <= self._words_due_ns - sample.time_ns <= WORDS_PERIOD * 1e9:
            self._words_due_ns = sample.time_ns + round(WORDS_PERIOD * 1e9)
            text = words.page(self._rows, self._ticks, list(self._health.values()))
            self._scene.words(sample.time_ns, text)

    def _passenger(self, sample: InsSample, now_ns: int) -> None:
        ages = {name: (now_ns - heard_ns) * 1e-9 if now_ns else None for name, heard_ns in self._heard_ns.items()}
        age = ages["odometry"]
        time_ns = sample.time_ns + round(max(age or 0.0, 0.0) * 1e9)
        if 0 <= self._passenger_due_ns - time_ns <= PASSENGER_PERIOD * 1e9:
            return
        self._passenger_due_ns = time_ns + round(PASSENGER_PERIOD * 1e9)
        silent = (ages["diagnostics"] or 0.0) > words.SILENT
        light = words.light([] if silent else list(self._health.values()), age)
        text = words.passenger(sample.velocity_x, sample.yaw_rate, self._angle, self._mode,
                               (time_ns - self._mode_ns) * 1e-9, light, age)
        self._scene.passenger(time_ns, text, light[0])

    def _ins_status(self, message: Any) -> None:
        self._mode, self._mode_ns = message.position_mode_text, to_nanoseconds(message.header.stamp)

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
