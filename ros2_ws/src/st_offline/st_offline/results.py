"""What a run left behind, read without ROS: measured track, scores, tick counts; and summary.json made of them."""

import importlib.metadata
import json
import math
import platform
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader
from st_core.evaluation import ErrorStatistics, Score

from .paths import source_version

MODES = ("forecast", "hindsight")


@dataclass(frozen=True)
class Track:
    """Measured INS point in the map frame. time_ns: UTC; x, y in m, yaw in rad (not wrapped)."""

    time_ns: np.ndarray
    x: np.ndarray
    y: np.ndarray
    yaw: np.ndarray


@dataclass(frozen=True)
class Results:
    track: Track
    scores: list[Score]
    ticks: dict[str, int]
    configuration_hash: str

    def models(self) -> list[str]:
        return list(dict.fromkeys(score.model for score in self.scores))

    def select(self, model: str, mode: str) -> list[Score]:
        return [s for s in self.scores if s.model == model and s.mode == mode]


def read_results(folder: Path) -> Results:
    """Read bag/ and errors/ of a run folder."""
    odometry, ticks = [], {"due": 0, "predicted": 0, "skipped": 0}
    for topic, message in _messages(folder / "bag", ("/ins/odometry", "/predictor/status")):
        if topic == "/ins/odometry":
            p, q = message.pose.pose.position, message.pose.pose.orientation
            yaw = math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z))
            odometry.append((_nanoseconds(message.header.stamp), p.x, p.y, yaw))
        else:
            skipped = {"stale": message.skipped_stale, "overrun": message.skipped_overrun, "slow": message.skipped_slow}
            ticks = {
                "due": message.due,
                "predicted": message.predicted,
                "skipped": sum(skipped.values()),
                "skipped_by_reason": skipped,
            }
    time_ns = np.array([row[0] for row in odometry], dtype=np.int64)
    x, y, yaw = (np.array([row[k] for row in odometry]) for k in (1, 2, 3))
    scores, configuration = [], ""
    for _, message in _messages(folder / "errors", ("/evaluator/errors",)):
        configuration = message.configuration_hash
        scores.append(
            Score(
                model=message.model,
                mode=message.mode,
                start_ns=_nanoseconds(message.header.stamp),
                complete=message.complete,
                incomplete_reason=message.incomplete_reason,
                horizon=message.horizon,
                longitudinal=message.longitudinal,
                lateral=message.lateral,
                yaw=message.yaw,
                longitudinal_mean=message.longitudinal_mean,
                lateral_mean=message.lateral_mean,
                yaw_mean=message.yaw_mean,
            )
        )
    return Results(Track(time_ns, x, y, np.unwrap(yaw)), scores, ticks, configuration)


def summarise(results: Results, about: dict[str, Any]) -> dict[str, Any]:
    """The content of summary.json: errors in m, statistics over the horizon means of complete scores."""
    models: dict[str, Any] = {}
    for model in results.models():
        models[model] = {mode: _statistics(results.select(model, mode)) for mode in MODES}
    return {
        **about,
        "models": models,
        "ticks": results.ticks,
        "configuration_hash": results.configuration_hash,
        "versions": versions(),
    }


def write_summary(path: Path, summary: dict[str, Any]) -> None:
    path.write_text(json.dumps(summary, indent=2, allow_nan=False) + "\n")


def versions() -> dict[str, str]:
    names = ("numpy", "scipy", "mcap", "rosbags", "cantools", "python-can", "ros-jazzy-rclpy")
    found = {"source": source_version(), "python": platform.python_version()}
    for name in names:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def _statistics(scores: list[Score]) -> dict[str, Any]:
    statistics = ErrorStatistics()
    for score in scores:
        statistics.add(score)
    return {
        "n_starts": statistics.n_starts,
        "n_incomplete": statistics.n_incomplete,
        **{
            axis: {k: _finite(getattr(getattr(statistics, axis), k)) for k in ("mean", "max", "rmse")}
            for axis in ("longitudinal", "lateral", "yaw")
        },
    }


def _finite(value: float) -> float | None:
    """JSON has no NaN: nothing scored is null."""
    return float(value) if math.isfinite(value) else None


def _messages(folder: Path, topics: tuple[str, ...]):
    with AnyReader([folder]) as reader:
        wanted = [c for c in reader.connections if c.topic in topics]
        for connection, _, raw in reader.messages(connections=wanted):
            yield connection.topic, reader.deserialize(raw, connection.msgtype)


def _nanoseconds(stamp: Any) -> int:
    return stamp.sec * 1_000_000_000 + stamp.nanosec
