"""Results of a run, read without ROS: measured track, scores, tick counts, coverage of bands; and its summary.json."""

import importlib.metadata
import json
import platform
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from st_core.evaluation import Statistic

from .paths import json_ready, source_version
from .runs.bag import definitions, numbers, open_bag
from .runs.bag_storage import Storage
from .runs.cdr import field_of, typestore
from .runs.ins_log import yaw_of

MODES = ("forecast", "hindsight")
SEGMENTS = 6  # predictions drawn on the map
ODOMETRY, STATUS, ERRORS = "/ins/odometry", "/predictor/status", "/evaluator/errors"
ERROR = "st_msgs/msg/PredictionError"
_MEAN_FIELDS = ("header.stamp", "complete", "longitudinal_mean", "lateral_mean", "yaw_mean")


@dataclass(frozen=True)
class Track:
    """Measured INS point in the map frame. time_ns: UTC; x, y in m, yaw in rad (not wrapped)."""

    time_ns: np.ndarray
    x: np.ndarray
    y: np.ndarray
    yaw: np.ndarray


@dataclass(frozen=True, eq=False)
class MeanErrors:
    """Scores of one model and mode in order of their start: start_ns (n,), complete (n,), means over the horizon (n,).

    longitudinal, lateral in m, yaw in rad; NaN where not complete.
    """

    start_ns: np.ndarray
    complete: np.ndarray
    longitudinal: np.ndarray
    lateral: np.ndarray
    yaw: np.ndarray


@dataclass(frozen=True, eq=False)
class Segment:
    """One hindsight prediction to be drawn: time (n,) in ns UTC, errors (n,) in m along the measured heading."""

    time_ns: np.ndarray
    longitudinal: np.ndarray
    lateral: np.ndarray


SUMMARY, TYPE = "/evaluator/summary", "st_msgs/msg/ErrorSummary"
QUESTIONS = {"forecast": "forecast", "hindsight": "model", "course": "course", "plan": "plan"}


class BandCounts(Protocol):
    """Coverage of the bands of one model and mode (st_msgs/ErrorSummary)."""

    model: str
    mode: str
    n_bands: int
    coverage_50: float
    coverage_90: float


@dataclass(frozen=True)
class Results:
    """scores: by model and mode. segments: of SEGMENTS starts spread over the run, by model and start.
    bands: how often they held, where there were some.
    """

    track: Track
    scores: dict[tuple[str, str], MeanErrors]
    segments: dict[tuple[str, int], Segment]
    ticks: dict[str, Any]
    configuration_hash: str
    bands: list[BandCounts] = field(default_factory=list)

    def models(self) -> list[str]:
        return list(dict.fromkeys(model for model, _ in self.scores))

    def starts_drawn(self) -> list[int]:
        return sorted({start_ns for _, start_ns in self.segments})


def read_results(folder: Path) -> Results:
    """Read bag/ and errors/ of a run folder. Only what is drawn is kept of the errors over the horizons."""
    bag, errors = open_bag(folder / "bag"), open_bag(folder / "errors")
    scores, configuration = _scores(errors)
    summary = _last(errors, SUMMARY, TYPE)
    return Results(_track(folder / "bag", bag), scores, _segments(errors, scores), _ticks(bag), configuration,
                   [row for row in summary.statistics if row.n_bands] if summary else [])


def _track(path: Path, bag: Storage) -> Track:
    point = [f"pose.pose.position.{k}" for k in "xy"]
    turn = [f"pose.pose.orientation.{k}" for k in "xyzw"]
    topic = next((t for t in bag.topics() if t.name == ODOMETRY and t.count), None)
    if topic is None:
        return Track(np.empty(0, np.int64), *(np.empty(0),) * 3)
    values = numbers(path, bag, topic, ["header.stamp", *point, *turn], typestore(definitions()))
    x, y = (values[name] for name in point)
    return Track(values["header.stamp"], x, y, np.unwrap(yaw_of(*(values[name] for name in turn))))


def _last(bag: Storage, topic: str, type_name: str) -> Any:
    """The last message of a topic; None without one."""
    last = deque(bag.messages(topic), maxlen=1)
    return typestore(definitions()).deserialize_cdr(last[0], type_name) if last else None


def _ticks(bag: Storage) -> dict[str, Any]:
    status = _last(bag, STATUS, "st_msgs/msg/PredictorStatus")
    if status is None:
        return {"due": 0, "predicted": 0, "skipped": 0}
    skipped = {"stale": status.skipped_stale, "overrun": status.skipped_overrun, "slow": status.skipped_slow}
    return {"due": status.due, "predicted": status.predicted, "skipped": sum(skipped.values()),
            "skipped_by_reason": skipped}


def _scores(errors: Storage) -> tuple[dict[tuple[str, str], MeanErrors], str]:
    """(scores, the configuration hash of the last one)."""
    rows: dict[tuple[str, str], list[tuple[int, bool, float, float, float]]] = {}
    configuration = ""
    for message in _messages(errors):
        configuration = message.configuration_hash
        row: Any = tuple(field_of(message, name) for name in _MEAN_FIELDS)
        rows.setdefault((message.model, message.mode), []).append(row)
    scores = {}
    for key, entries in rows.items():
        start_ns, complete, *means = zip(*sorted(entries), strict=True)
        scores[key] = MeanErrors(np.array(start_ns, np.int64), np.array(complete), *(np.array(m) for m in means))
    return scores, configuration


def _messages(errors: Storage) -> Iterator[Any]:
    store = typestore(definitions())
    return (store.deserialize_cdr(data, ERROR) for data in errors.messages(ERRORS))


def _segments(errors: Storage, scores: dict[tuple[str, str], MeanErrors]) -> dict[tuple[str, int], Segment]:
    """Of evenly spread starts that every model completed in hindsight."""
    complete = [set(s.start_ns[s.complete].tolist()) for (_, mode), s in scores.items() if mode == "hindsight"]
    common = sorted(set.intersection(*complete)) if complete else []
    starts = {common[i] for i in np.linspace(0, len(common) - 1, SEGMENTS).round().astype(int)} if common else set()
    segments = {}
    for message in _messages(errors) if starts else ():
        start_ns = field_of(message, "header.stamp")
        if start_ns in starts and message.mode == "hindsight":
            segments[message.model, start_ns] = Segment(start_ns + message.horizon * 1e9, message.longitudinal,
                                                        message.lateral)
    return segments


def summarise(results: Results, about: dict[str, Any]) -> dict[str, Any]:
    """The content of summary.json: errors in m, statistics over the horizon means of complete scores."""
    models: dict[str, Any] = {}
    for model in results.models():
        modes = [*MODES, *(mode for name, mode in results.scores if name == model and mode not in MODES)]
        models[model] = {mode: _statistics(results.scores.get((model, mode))) for mode in modes}
    for row in results.bands:  # shares are null where nothing was counted
        models[row.model][row.mode]["bands"] = {"n": int(row.n_bands)} | json_ready(
            {"0.5": row.coverage_50, "0.9": row.coverage_90})
    return {**about, "models": models, "ticks": results.ticks, "configuration_hash": results.configuration_hash,
            "versions": versions()}


def write_summary(path: Path, summary: dict[str, Any]) -> None:
    """Writes the file whole or, on a full disk, not at all."""
    part = path.with_name(f"{path.name}.part")
    try:
        part.write_text(json.dumps(summary, indent=2, allow_nan=False) + "\n")
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def versions() -> dict[str, str]:
    names = ("numpy", "scipy", "mcap", "rosbags", "cantools", "python-can", "ros-jazzy-rclpy")
    found = {"source": source_version(), "python": platform.python_version()}
    for name in names:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def _statistics(scores: MeanErrors | None) -> dict[str, Any]:
    complete = scores.complete if scores else np.zeros(0, dtype=bool)
    result: dict[str, Any] = {"n_starts": int(complete.sum()), "n_incomplete": int((~complete).sum())}
    for axis in ("longitudinal", "lateral", "yaw"):
        statistic = Statistic()
        if scores:
            statistic.add(getattr(scores, axis)[complete])
        result[axis] = {k: json_ready(getattr(statistic, k)) for k in ("mean", "max", "rmse")}
    return result


def band_lines(rows: Sequence[BandCounts]) -> list[str]:
    """Coverage of the published bands as the evaluator counted it, one line for each kind of score with bands."""
    found = []
    for mode, question in QUESTIONS.items():
        of_mode = [row for row in rows if row.mode == mode and row.n_bands]
        if of_mode:
            words = ", ".join(f"{row.model} {100 * row.coverage_90:.0f} % | {100 * row.coverage_50:.0f} %"
                              for row in of_mode)
            found.append(f"inside the 90 | 50 % band, {question}: {words} of {max(row.n_bands for row in of_mode)}")
    return found


