"""Reads the configuration, predictions, scores and other results that live nodes recorded, and summarises them."""

import importlib.metadata
import platform
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from itertools import chain
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from st_core.evaluation import Statistic
from st_core.vehicle import VehicleParameters

from .car import read_vehicle
from .paths import config, json_ready, source_version
from .runs.bag_storage import Storage, find_file_text, open_bag, parse_parameters
from .runs.cdr import get_field
from .runs.errors import RunError
from .runs.ins_log import yaw_from_quaternion

PREDICTION_TYPE, ERROR_TYPE = "st_msgs/msg/Prediction", "st_msgs/msg/PredictionError"
PLANNED_TYPE = "st_msgs/msg/PlannedPrediction"
STATE_FIELDS = ("x", "y", "velocity_x", "velocity_y", "yaw", "yaw_rate")
INPUT_FIELDS = ("road_wheel_angle", "velocity_x_dot")  # [rad], [m/s^2]
# Phrases in the evaluator's reason for an incomplete score (st_core: MeasurementHistory, TimeSeries.describe_unknown).
JUMP_REASON = "position jumps"
END_REASON = ": ends "  # a signal has no later sample
MODES = ("forecast", "hindsight")
MAX_DRAWN_STARTS = 6  # maximum number of start times with drawn hindsight predictions
ODOMETRY_TOPIC, STATUS_TOPIC, SUMMARY_TOPIC = "/ins/odometry", "/predictor/status", "/evaluator/summary"
BAND_MODES = (*MODES, "course", "plan")  # in the order of the report
Key = TypeVar("Key")


@dataclass(frozen=True, eq=False)
class Predictions:
    """Predictions of one model and mode."""

    starts_ns: np.ndarray  # (n,) ascending
    states: np.ndarray  # (n, points, 6) at the CG [SI], in the order of STATE_FIELDS
    step: float  # [s]
    hashes: frozenset[str]  # of the predictor's configurations
    inputs: tuple[np.ndarray, ...] = ()  # INPUT_FIELDS of a plan or course, (n, 2 * points - 1) at half steps

    def inputs_at(self, starts_ns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Inputs (m, 2 * points - 1) of the predictions at start times (m,) [ns]; NaN without a prediction."""
        index = np.searchsorted(self.starts_ns, starts_ns).clip(max=len(self.starts_ns) - 1)
        has_prediction = (self.starts_ns[index] == starts_ns)[:, None]
        road_wheel_angle, velocity_x_dot = (np.where(has_prediction, values[index], np.nan) for values in self.inputs)
        return road_wheel_angle, velocity_x_dot


@dataclass(frozen=True, eq=False)
class Scores:
    """Scores of one model and mode."""

    starts_ns: np.ndarray  # (n,)
    errors: np.ndarray  # (n, points, 3) longitudinal, lateral [m], yaw [rad]
    complete: np.ndarray  # (n,)
    signal_ends: np.ndarray  # (n,) whether a score is incomplete because a signal ends, usually with the run
    has_jump: np.ndarray  # (n,) whether a score is incomplete because the position jumps within the horizon

    def at(self, starts_ns: np.ndarray) -> "Scores":
        """The scores of the predictions that start at these times [ns]."""
        rows = np.isin(self.starts_ns, starts_ns)
        return Scores(*(getattr(self, f.name)[rows] for f in fields(self)))


@dataclass(frozen=True)
class RecordedConfiguration:
    vehicle: str | None  # text of the vehicle file
    nodes: Mapping[str, Mapping[str, Any]]  # node -> parameters


@dataclass(frozen=True)
class Track:
    """Measured positions of the INS point in the map frame [m], and unwrapped yaw [rad]. time_ns: UTC."""

    time_ns: np.ndarray
    x: np.ndarray
    y: np.ndarray
    yaw: np.ndarray


@dataclass(frozen=True, eq=False)
class MeanErrors:
    """Mean errors over each horizon (n,) of one model and mode, in order of the start times.

    longitudinal, lateral [m], yaw [rad]: NaN where the score is not complete.
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
    segments: dict[tuple[str, int], Segment]  # by model and start [ns, UTC]; for at most MAX_DRAWN_STARTS starts
    ticks: dict[str, Any]  # numbers of the predictor's ticks: due, predicted, skipped, and skipped by reason
    configuration_hash: str  # of one of the last scores; "" without scores
    bands: list[Any] = field(default_factory=list)  # statistics of st_msgs/ErrorSummary with n_bands > 0

    def models(self) -> list[str]:
        return list(dict.fromkeys(model for model, _ in self.scores))


def parse_configuration(records: Mapping[str, Mapping[str, str]]) -> RecordedConfiguration:
    """Configuration from the metadata records of a recording (`BagDrive.records`); vehicle: None if not recorded."""
    nodes = parse_parameters(records)
    vehicle = find_file_text(records, str(nodes.get("predictor", {}).get("vehicle_file", "")))
    return RecordedConfiguration(vehicle or records.get("configuration", {}).get("vehicle"), nodes)


def find_configuration(records: Mapping[str, Mapping[str, str]],
                       vehicle: Path | None) -> tuple[VehicleParameters, RecordedConfiguration, str]:
    """(vehicle, recorded configuration, source of the vehicle). The vehicle is from the given file, or else from the
    recording, or else from config/car/leaf/vehicle.yaml. Raises RunError, ConfigurationError.
    """
    recorded = parse_configuration(records)
    if vehicle is None and recorded.vehicle is not None:
        return VehicleParameters.from_yaml(recorded.vehicle, "the vehicle in the recording"), recorded, "the recording"
    file = vehicle or config("car/leaf/vehicle.yaml")
    return read_vehicle(file), recorded, str(file)


def read_predictions(bag: Path, mode: str = "") -> dict[str, Predictions]:
    """Reads forecasts, or predictions of mode plan or course, by model. Raises RunError if the predictions of a model
    have different horizons or steps."""
    inputs = INPUT_FIELDS if mode else ()
    columns = _collect_columns(
        read_messages([bag], PLANNED_TYPE if mode else PREDICTION_TYPE, f"/{mode}" if mode else ""),
        lambda message: (message.model, len(message.x), float(message.step)),
        lambda message: (np.stack([getattr(message, name) for name in STATE_FIELDS], axis=-1),
                         message.configuration_hash, *(getattr(message, name) for name in inputs)))
    models = Counter(model for model, _, _ in columns)
    if repeated := [model for model, count in models.items() if count > 1]:
        raise RunError(bag, f"predictions of {repeated[0]} have different horizons or steps")
    return {model: Predictions(starts_ns, states, step, frozenset(hashes.tolist()), tuple(inputs))
            for (model, _, step), (starts_ns, states, hashes, *inputs) in columns.items()}


def _collect_columns(messages: Iterable[Any], get_key: Callable[[Any], Key],
                     get_values: Callable[[Any], Sequence[Any]]) -> dict[Key, list[np.ndarray]]:
    """Key -> [ascending start times (n,) [ns], *columns (n, ...)]; of several with the same start, the last is used."""
    rows = defaultdict[Key, dict[int, Sequence[Any]]](dict)
    for message in messages:
        rows[get_key(message)][get_field(message, "header.stamp")] = get_values(message)
    columns = {}
    for key, entries in rows.items():
        starts_ns = sorted(entries)
        columns[key] = [np.array(starts_ns, np.int64), *map(np.stack, zip(*map(entries.get, starts_ns), strict=True))]
    return columns


def read_scores(bags: Sequence[Path]) -> dict[tuple[str, str], Scores]:
    """Reads the scores in all bags, by model and mode; of several scores for one start, the last is used."""
    columns = _collect_columns(
        read_messages(bags, ERROR_TYPE), lambda message: (message.model, message.mode),
        lambda message: (np.stack([message.longitudinal, message.lateral, message.yaw], axis=-1), message.complete,
                         END_REASON in message.incomplete_reason, JUMP_REASON in message.incomplete_reason))
    return {key: Scores(*parts) for key, parts in columns.items()}


def read_messages(bags: Sequence[Path], type_name: str, topic_end: str = "") -> Iterator[Any]:
    """Yields the messages of a type in topics with names that end with `topic_end`. Raises RunError."""
    for bag in bags:
        storage = open_bag(bag)
        topics = [t for t in storage.topics if t.type_name == type_name and t.name.endswith(topic_end)]
        for _, message in chain.from_iterable(map(storage.deserialise, topics)):
            yield message


def read_results(folder: Path) -> Results:
    """Reads bag/ and errors/ of a run folder; errors over time only for drawn predictions. Raises RunError."""
    bag, errors = open_bag(folder / "bag"), open_bag(folder / "errors")
    columns = _collect_columns(
        read_messages([folder / "errors"], ERROR_TYPE), lambda message: (message.model, message.mode),
        lambda message: (message.complete, message.longitudinal_mean, message.lateral_mean, message.yaw_mean,
                         message.configuration_hash))
    scores = {key: MeanErrors(*parts[:-1]) for key, parts in columns.items()}
    hashes = [str(parts[-1][-1]) for parts in columns.values()]
    summary = _read_last_message(errors, SUMMARY_TOPIC, "st_msgs/msg/ErrorSummary")
    bands = [row for row in summary.statistics if row.n_bands] if summary else []
    return Results(_read_track(bag), scores, _read_segments(folder / "errors", scores), _read_ticks(bag),
                   hashes[-1] if hashes else "", bands)


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
    skip_counts = {"stale": status.skipped_stale, "overrun": status.skipped_overrun, "slow": status.skipped_slow}
    return {"due": status.due, "predicted": status.predicted, "skipped": sum(skip_counts.values()),
            "skipped_by_reason": skip_counts}


def _read_segments(errors: Path, scores: dict[tuple[str, str], MeanErrors]) -> dict[tuple[str, int], Segment]:
    """Segments of evenly spaced starts, among those at which the hindsight scores of all models are complete."""
    complete_starts = [set(s.start_ns[s.complete].tolist()) for (_, mode), s in scores.items() if mode == "hindsight"]
    common_starts = sorted(set.intersection(*complete_starts)) if complete_starts else []
    if not common_starts:
        return {}
    starts = {common_starts[i] for i in np.linspace(0, len(common_starts) - 1, MAX_DRAWN_STARTS).round().astype(int)}
    segments = {}
    for message in read_messages([errors], ERROR_TYPE):
        start_ns = get_field(message, "header.stamp")
        if start_ns in starts and message.mode == "hindsight":
            segments[message.model, start_ns] = Segment(start_ns + message.horizon * 1e9, message.longitudinal,
                                                        message.lateral)
    return segments


def summarise(results: Results, extra: dict[str, Any]) -> dict[str, Any]:
    """Content of summary.json: `extra`, statistics of the mean errors of complete scores, band coverage, ticks."""
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
    """One line per mode: the observed coverage of each model's bands, and the largest number of scores of a model.

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
