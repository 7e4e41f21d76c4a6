"""Draws a recorded run into a Rerun recording (.rrd), one picture per 0.1 s of the recording."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

import rerun as rr
from rosbags.highlevel import AnyReader
from st_core.types import InsSample
from st_predictor import convert
from st_predictor.map_drawing import History
from st_recordings.recorded import configuration_of
from st_recordings.results import BandCounts, band_lines
from st_recordings.runs.bag import definitions, open_bag, read_bag
from st_recordings.runs.cdr import typestore
from st_ros.stamps import to_nanoseconds

from ..configuration import recordings_of
from .rerun_scene import Scene, recording

PERIOD_NS = 100_000_000
FLUSH = 5.0  # s; few large chunks load quickly
TEXT_PERIOD_NS = 1_000_000_000
MODELS = ("kinematic", "linear", "nonlinear", "augmented")
LEVELS = ("ok", "warning", "**error**", "stale")
# Topic -> method that takes its messages.
TOPICS = {
    "predictor/status": "status", "ins/odometry": "odometry", "vehicle/steering": "steering",
    **{f"predictor/{model}/prediction": "prediction" for model in MODELS},
    "evaluator/errors": "error", "evaluator/summary": "summary", "/diagnostics": "diagnostics",
}


class Row(BandCounts, Protocol):
    """One model and mode of st_msgs/ErrorSummary."""

    n_starts: int
    longitudinal_rmse: float
    lateral_rmse: float


def draw(path: Path, file: Path, vehicle: Path | None = None) -> int:
    """Draw a bag, or the bag in the folder of a run, into `file` (.rrd); returns the number of pictures.

    vehicle: file instead of the recorded one, for the outline. Raises RunError, ConfigurationError.
    """
    bag, _ = recordings_of(path)
    open_bag(bag)
    car, recorded, _ = configuration_of(read_bag(bag).records, vehicle)
    stream = recording(path.name, FLUSH, rr.FileSink(str(file)))
    feed = Feed(Scene(stream, car), recorded.nodes.get("predictor", {}).get("map_frame", "map"))
    pictures, due_ns = 0, 0
    with AnyReader([bag], default_typestore=typestore(definitions())) as reader:
        connections = [c for c in reader.connections if _suite_topic(c.topic)]
        for connection, log_ns, data in reader.messages(connections=connections):
            if log_ns >= due_ns:
                feed.draw()
                pictures, due_ns = pictures + 1, log_ns + PERIOD_NS
            feed.take(str(_suite_topic(connection.topic)), reader.deserialize(data, connection.msgtype))
    feed.draw()
    stream.flush()
    stream.disconnect()
    return pictures


def _suite_topic(name: str) -> str | None:
    """The key of TOPICS for a recorded topic in any namespace; None for other topics."""
    return next((topic for topic in TOPICS if name == topic or name.endswith(f"/{topic.lstrip('/')}")), None)


class Feed:
    """Collects messages between pictures and draws the newest state."""

    def __init__(self, scene: Scene, map_frame: str):
        self._scene, self._map_frame = scene, map_frame
        self._history = History()
        self._sample: InsSample | None = None
        self._angle: float | None = None
        self._rows: list[Any] = []
        self._ticks = "predictor: no status yet"
        self._health: dict[str, tuple[int, str, str]] = {}
        self._text_due_ns = 0

    def take(self, topic: str, message: Any) -> None:
        getattr(self, f"_{TOPICS[topic]}")(message)

    def draw(self) -> None:
        """One picture of the newest sample, if there is a new one."""
        sample, self._sample = self._sample, None
        if sample is None:
            return
        self._history.add_pose(sample.time_ns, sample.x, sample.y)
        self._scene.motion(sample.time_ns, sample.velocity_x, sample.yaw_rate, self._angle)
        self._scene.paths(sample.time_ns, (sample.x, sample.y, sample.yaw), self._history)
        if not 0 <= self._text_due_ns - sample.time_ns <= TEXT_PERIOD_NS:
            self._text_due_ns = sample.time_ns + TEXT_PERIOD_NS
            self._scene.text(sample.time_ns, error_text(self._rows, self._ticks, list(self._health.values())))

    def _odometry(self, message: Any) -> None:
        sample = convert.ins_sample(message, self._map_frame)
        self._sample = self._sample if isinstance(sample, str) else sample

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
        reason = f" ({message.reason})" if message.reason else ""
        self._ticks = f"Ticks {message.due}, predicted {message.predicted}, skipped {skipped}{reason}"

    def _diagnostics(self, message: Any) -> None:
        for s in message.status:
            level = s.level if isinstance(s.level, int) else int.from_bytes(s.level, "little")
            self._health[s.name] = (level, s.name, s.message)


def error_text(rows: Sequence[Row], ticks: str, health: Sequence[tuple[int, str, str]]) -> str:
    """Markdown of the running errors and of the checks not OK. health: (level, name, message) of every check."""
    lines = ["| model | mode | starts | RMSE long., m | lat., m |", "|---|---|--:|--:|--:|"]
    for mode in ("forecast", "hindsight"):
        for row in (r for r in rows if r.mode == mode and r.n_starts):
            errors = (row.longitudinal_rmse, row.lateral_rmse)
            numbers = " | ".join("-" if math.isnan(e) else f"{e:.2f}" for e in errors)
            lines.append(f"| {row.model} | {mode} | {row.n_starts} | {numbers} |")
    if len(lines) == 2:
        lines = ["Waiting for the first complete horizon."]
    lines += ["", *(f"- {line}" for line in band_lines(rows)), "", ticks, ""]
    wrong = [entry for entry in health if entry[0] > 0]
    lines += [f"- {LEVELS[min(level, 3)]}: {name}: {message}" for level, name, message in sorted(wrong, reverse=True)]
    if health and not wrong:
        lines.append("All nodes OK.")
    return "\n".join(lines)
