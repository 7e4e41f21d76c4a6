"""Reads predictions, scores and the configuration of the live nodes from recordings."""

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from st_core.vehicle import VehicleParameters

from .car import read_vehicle
from .paths import config
from .runs import RunError
from .runs.bag_storage import open_bag, recorded_parameters, recorded_text
from .runs.cdr import get_field

PREDICTION, ERROR = "st_msgs/msg/Prediction", "st_msgs/msg/PredictionError"
PLANNED = "st_msgs/msg/PlannedPrediction"
STATE_FIELDS = ("x", "y", "velocity_x", "velocity_y", "yaw", "yaw_rate")
# Phrases in the evaluator's reason for an incomplete score (st_core: MeasurementHistory, TimeSeries.describe_unknown).
JUMP_REASON = "position jumps"
END_REASON = ": ends "  # a signal has no later sample
Progress = Callable[[int, int], None]


@dataclass(frozen=True, eq=False)
class Predictions:
    """Predictions of one model and mode."""

    starts_ns: np.ndarray  # (n,) ascending
    states: np.ndarray  # (n, points, 6) at the CG [SI], in the order of STATE_FIELDS
    step: float  # [s]
    hashes: frozenset[str]  # of the configurations


@dataclass(frozen=True, eq=False)
class PlannedPredictions(Predictions):
    """Predictions with the inputs of a plan or course, (n, 2 * points - 1) at half steps."""

    road_wheel_angle: np.ndarray  # [rad]
    velocity_x_dot: np.ndarray  # [m/s^2]

    def inputs_at(self, starts_ns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Inputs (m, 2 * points - 1) of the predictions at start times (m,) [ns]; NaN without a prediction."""
        index = np.searchsorted(self.starts_ns, starts_ns).clip(max=len(self.starts_ns) - 1)
        has_prediction = (self.starts_ns[index] == starts_ns)[:, None]
        return (np.where(has_prediction, self.road_wheel_angle[index], np.nan),
                np.where(has_prediction, self.velocity_x_dot[index], np.nan))


@dataclass(frozen=True, eq=False)
class Scores:
    """Scores of one model and mode."""

    starts_ns: np.ndarray  # (n,)
    errors: np.ndarray  # (n, points, 3) longitudinal, lateral [m], yaw [rad]
    complete: np.ndarray  # (n,)
    signal_ends: np.ndarray  # (n,) whether a score is incomplete because a signal ends, as at the end of the run
    has_jump: np.ndarray  # (n,) whether a score is incomplete because the position jumps within the horizon

    def at(self, starts_ns: np.ndarray) -> "Scores":
        """The scores of the given start times [ns]."""
        rows = np.isin(self.starts_ns, starts_ns)
        return Scores(*(getattr(self, f.name)[rows] for f in fields(self)))


@dataclass(frozen=True)
class RecordedConfiguration:
    vehicle: str | None  # text of the vehicle file
    nodes: Mapping[str, Mapping[str, Any]]  # node -> parameters


def recorded_configuration(records: Mapping[str, Mapping[str, str]]) -> RecordedConfiguration:
    """Configuration from the metadata records of a recording (`BagDrive.records`); vehicle: None if not recorded."""
    nodes = recorded_parameters(records)
    vehicle = recorded_text(records, str(nodes.get("predictor", {}).get("vehicle_file", "")))
    return RecordedConfiguration(vehicle or records.get("configuration", {}).get("vehicle"), nodes)


def find_configuration(records: Mapping[str, Mapping[str, str]],
                       vehicle: Path | None) -> tuple[VehicleParameters, RecordedConfiguration, str]:
    """(vehicle, recorded configuration, source of the vehicle). The vehicle is from the given file, or else from the
    recording, or else from config/car/leaf/vehicle.yaml. Raises RunError, ConfigurationError.
    """
    recorded = recorded_configuration(records)
    if vehicle is None and recorded.vehicle is not None:
        return VehicleParameters.from_yaml(recorded.vehicle, "the vehicle in the recording"), recorded, "the recording"
    file = vehicle or config("car/leaf/vehicle.yaml")
    return read_vehicle(file), recorded, str(file)


def read_predictions(bag: Path, progress: Progress | None = None) -> dict[str, Predictions]:
    """Forecasts by model. Raises RunError if the predictions of a model have different horizons or steps."""
    return {model: Predictions(*columns) for model, columns in _read_by_model(bag, PREDICTION, (), progress).items()}


def read_planned(bag: Path, mode: str, progress: Progress | None = None) -> dict[str, PlannedPredictions]:
    """Reads predictions of mode plan or course by model, as `read_predictions` does."""
    inputs = ("road_wheel_angle", "velocity_x_dot")
    return {model: PlannedPredictions(*columns)
            for model, columns in _read_by_model(bag, PLANNED, inputs, progress, f"/{mode}").items()}


def _read_by_model(bag: Path, type_name: str, input_fields: Sequence[str], progress: Progress | None,
                   topic_end: str = "") -> dict[str, list[Any]]:
    """Model -> [starts_ns, states, step, hashes, *arrays of the input fields]."""
    rows = defaultdict[str, dict[int, list[np.ndarray]]](dict)
    steps, hashes = defaultdict[str, set[float]](set), defaultdict[str, set[str]](set)
    for message in read_messages([bag], type_name, progress, topic_end):
        states = np.stack([getattr(message, name) for name in STATE_FIELDS], axis=-1)
        rows[message.model][get_field(message, "header.stamp")] = [
            states, *(getattr(message, name) for name in input_fields)]
        steps[message.model].add(float(message.step))
        hashes[message.model].add(message.configuration_hash)
    by_model = {}
    for model, entries in rows.items():
        if len(steps[model]) > 1 or len({len(arrays[0]) for arrays in entries.values()}) > 1:
            raise RunError(bag, f"predictions of {model} have different horizons or steps")
        starts = sorted(entries)
        states, *inputs = (np.stack(column) for column in zip(*(entries[s] for s in starts), strict=True))
        by_model[model] = [np.array(starts, np.int64), states, steps[model].pop(), frozenset(hashes[model]), *inputs]
    return by_model


def read_scores(bags: Sequence[Path], progress: Progress | None = None) -> dict[tuple[str, str], Scores]:
    """Reads the scores in all bags, by model and mode; of several scores for one start, the last is used."""
    rows = defaultdict[tuple[str, str], dict[int, tuple[np.ndarray, bool, bool, bool]]](dict)
    for message in read_messages(bags, ERROR, progress):
        errors = np.stack([message.longitudinal, message.lateral, message.yaw], axis=-1)
        reason = message.incomplete_reason
        rows[message.model, message.mode][get_field(message, "header.stamp")] = (
            errors, bool(message.complete), END_REASON in reason, JUMP_REASON in reason)
    scores = {}
    for key, entries in rows.items():
        starts = sorted(entries)
        errors, *flags = zip(*(entries[start] for start in starts), strict=True)
        scores[key] = Scores(np.array(starts, np.int64), np.stack(errors), *map(np.array, flags))
    return scores


def read_messages(bags: Sequence[Path], type_name: str, progress: Progress | None = None,
                  topic_end: str = "") -> Iterator[Any]:
    """Yields the messages of a type in topics with names that end with `topic_end`.

    progress: called with the number of messages read in a bag, and the number of all such messages in it.
    """
    for bag in bags:
        storage = open_bag(bag)
        topics = [t for t in storage.topics if t.type_name == type_name and t.name.endswith(topic_end)]
        total = sum(t.count for t in topics)
        for count, (_, message) in enumerate(chain.from_iterable(map(storage.deserialise, topics)), 1):
            yield message
            if progress and (count % 500 == 0 or count == total):
                progress(count, total)
