"""Reads the results in a run folder (measured track, scores, tick counts, band coverage), and writes summary.json."""

import importlib.metadata
import json
import platform
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from st_core.evaluation import Statistic

from .paths import json_ready, replace_file, source_version
from .recorded_results import ERROR, read_messages
from .runs.bag_storage import Storage, open_bag
from .runs.cdr import get_field
from .runs.ins_log import yaw_from_quaternion

MODES = ("forecast", "hindsight")
DRAWN_STARTS = 6  # maximum number of start times with drawn hindsight predictions
ODOMETRY_TOPIC, STATUS_TOPIC, SUMMARY_TOPIC = "/ins/odometry", "/predictor/status", "/evaluator/summary"
BAND_MODES = ("forecast", "hindsight", "course", "plan")  # in the order of the report


@dataclass(frozen=True)
class Track:
    """Measured positions of the INS point in the map frame [m], and unwrapped yaw [rad]. time_ns: UTC."""

    time_ns: np.ndarray
    x: np.ndarray
    y: np.ndarray
    yaw: np.ndarray


@dataclass(frozen=True, eq=False)
class MeanErrors:
    """Scores (n,) of one model and mode, in order of their start times.

    longitudinal, lateral [m], yaw [rad]: means over the horizon, NaN where the score is not complete.
    """

    start_ns: np.ndarray
    complete: np.ndarray
    longitudinal: np.ndarray
    lateral: np.ndarray
    yaw: np.ndarray


@dataclass(frozen=True, eq=False)
class Segment:
    """One hindsight prediction to draw: times (n,) [ns, UTC]; errors (n,) [m] along and across the measured heading."""

    time_ns: np.ndarray
    longitudinal: np.ndarray
    lateral: np.ndarray


@dataclass(frozen=True)
class Results:
    """Content of a run folder."""

    track: Track
    scores: dict[tuple[str, str], MeanErrors]  # by model and mode
    segments: dict[tuple[str, int], Segment]  # by model and start [ns, UTC]; at most DRAWN_STARTS starts
    ticks: dict[str, Any]
    configuration_hash: str
    bands: list[Any] = field(default_factory=list)  # statistics of st_msgs/ErrorSummary with n_bands > 0

    def models(self) -> list[str]:
        return list(dict.fromkeys(model for model, _ in self.scores))

    def drawn_starts(self) -> list[int]:
        return sorted({start_ns for _, start_ns in self.segments})


def read_results(folder: Path) -> Results:
    """Reads bag/ and errors/ of a run folder. Error series within the horizon are kept only for drawn predictions."""
    bag, errors = open_bag(folder / "bag"), open_bag(folder / "errors")
    scores, configuration_hash = _read_scores(folder / "errors")
    summary = _read_last_message(errors, SUMMARY_TOPIC, "st_msgs/msg/ErrorSummary")
    bands = [row for row in summary.statistics if row.n_bands] if summary else []
    return Results(_read_track(bag), scores, _read_segments(folder / "errors", scores),
                   _read_ticks(bag), configuration_hash, bands)


def _read_track(bag: Storage) -> Track:
    topic = next((t for t in bag.topics if t.name == ODOMETRY_TOPIC), None)
    if topic is None:
        return Track(np.empty(0, np.int64), *(np.empty(0),) * 3)
    pose = [*(f"position.{axis}" for axis in "xy"), *(f"orientation.{axis}" for axis in "xyzw")]
    fields = ["header.stamp", *(f"pose.pose.{name}" for name in pose)]
    time_ns, x, y, *quaternion = bag.read_fields(topic, fields).values()
    return Track(time_ns, x, y, np.unwrap(yaw_from_quaternion(*quaternion)))


def _read_last_message(bag: Storage, topic: str, type_name: str) -> Any:
    last = deque(bag.messages(topic), maxlen=1)
    return bag.store.deserialize_cdr(last[0], type_name) if last else None


def _read_ticks(bag: Storage) -> dict[str, Any]:
    status = _read_last_message(bag, STATUS_TOPIC, "st_msgs/msg/PredictorStatus")
    if status is None:
        return {"due": 0, "predicted": 0, "skipped": 0}
    skipped = {"stale": status.skipped_stale, "overrun": status.skipped_overrun, "slow": status.skipped_slow}
    return {"due": status.due, "predicted": status.predicted, "skipped": sum(skipped.values()),
            "skipped_by_reason": skipped}


def _read_scores(errors: Path) -> tuple[dict[tuple[str, str], MeanErrors], str]:
    """(scores by model and mode, configuration hash of the last score or "" without scores)."""
    rows: dict[tuple[str, str], list[tuple[Any, ...]]] = {}
    configuration_hash = ""
    for message in read_messages([errors], ERROR):
        configuration_hash = message.configuration_hash
        rows.setdefault((message.model, message.mode), []).append(
            (get_field(message, "header.stamp"), message.complete,
             message.longitudinal_mean, message.lateral_mean, message.yaw_mean))
    scores = {}
    for key, entries in rows.items():
        start_ns, *others = zip(*sorted(entries), strict=True)
        scores[key] = MeanErrors(np.array(start_ns, np.int64), *map(np.array, others))
    return scores, configuration_hash


def _read_segments(errors: Path, scores: dict[tuple[str, str], MeanErrors]) -> dict[tuple[str, int], Segment]:
    """Reads the segments of evenly spaced starts at which the hindsight scores of all models are complete."""
    complete = [set(s.start_ns[s.complete].tolist()) for (_, mode), s in scores.items() if mode == "hindsight"]
    common = sorted(set.intersection(*complete)) if complete else []
    if not common:
        return {}
    starts = {common[i] for i in np.linspace(0, len(common) - 1, DRAWN_STARTS).round().astype(int)}
    segments = {}
    for message in read_messages([errors], ERROR):
        start_ns = get_field(message, "header.stamp")
        if start_ns in starts and message.mode == "hindsight":
            segments[message.model, start_ns] = Segment(start_ns + message.horizon * 1e9, message.longitudinal,
                                                        message.lateral)
    return segments


def summarise(results: Results, extra: dict[str, Any]) -> dict[str, Any]:
    """Content of summary.json: statistics of the horizon means of complete scores, band coverage, ticks."""
    models: dict[str, Any] = {}
    for model in results.models():
        modes = [*MODES, *(mode for name, mode in results.scores if name == model and mode not in MODES)]
        models[model] = {mode: _summarise_errors(results.scores.get((model, mode))) for mode in modes}
    for row in results.bands:
        models[row.model][row.mode]["bands"] = {"n": row.n_bands, "0.5": row.coverage_50, "0.9": row.coverage_90}
    units = {"longitudinal": "m", "lateral": "m", "yaw": "rad"}
    return {**extra, "units": units, "models": models, "ticks": results.ticks,
            "configuration_hash": results.configuration_hash, "versions": collect_versions()}


def _summarise_errors(scores: MeanErrors | None) -> dict[str, Any]:
    complete = scores.complete if scores else np.zeros(0, dtype=bool)
    result: dict[str, Any] = {"n_starts": int(complete.sum()), "n_incomplete": int((~complete).sum())}
    for axis in ("longitudinal", "lateral", "yaw"):
        statistic = Statistic()
        if scores:
            statistic.add(getattr(scores, axis)[complete])
        result[axis] = {k: json_ready(getattr(statistic, k)) for k in ("mean", "max", "rmse")}
    return result


def write_summary(path: Path, summary: dict[str, Any]) -> None:
    """Writes summary.json. Raises OSError."""
    replace_file(path, json.dumps(summary, indent=2, allow_nan=False) + "\n")


def collect_versions() -> dict[str, str]:
    """Versions of the suite, of Python, and of the installed libraries on which results depend."""
    versions = {"source": source_version(), "python": platform.python_version()}
    for name in ("numpy", "scipy", "mcap", "rosbags", "cantools", "python-can", "ros-jazzy-rclpy"):
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return versions


def format_band_lines(rows: Sequence[Any]) -> list[str]:
    """Formats the observed coverage of the bands, one line for each mode, with the largest number of scores of a model.

    rows: statistics of st_msgs/ErrorSummary.
    """
    lines = []
    for mode in BAND_MODES:
        rows_of_mode = [row for row in rows if row.mode == mode and row.n_bands]
        if rows_of_mode:
            coverage = ", ".join(f"{row.model} {100 * row.coverage_90:.0f} % | {100 * row.coverage_50:.0f} %"
                                 for row in rows_of_mode)
            count = max(row.n_bands for row in rows_of_mode)
            lines.append(f"inside the 90 | 50 % band, {mode}: {coverage} of {count} scores")
    return lines
