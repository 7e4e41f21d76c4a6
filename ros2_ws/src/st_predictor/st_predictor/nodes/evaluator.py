"""Node evaluator: scores each prediction once its horizon has passed, and publishes and records the errors."""

import time
from pathlib import Path
from typing import Any

import numpy as np
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message
from st_core.bands import CoverageMonitor
from st_core.evaluation import ErrorStatistics, Evaluator, Mode, Score
from st_core.models import get_model
from st_core.prediction import predict
from st_core.types import ControlInput, Trajectory, VehicleState
from st_msgs.msg import ErrorSummary, Prediction, PredictionError
from st_recordings.mcap import BagWriter, make_qos
from st_ros import diagnostics, parameters, spin
from st_ros.diagnostics import Check, Diagnostics
from st_ros.polling import LATCHED, PolledSubscription, create_steady_timer
from st_ros.scheduling import BACKGROUND_NICE

from .. import convert, params
from ..consistency import ConsistencyMonitor
from ._bag import is_complete, make_recording_check, open_bag
from ._bands import make_coverage_check, read_bands
from ._inputs import Inputs

WORK_PERIOD, SUMMARY_PERIOD = 0.05, 1.0  # s
MODES = ("forecast", "hindsight")  # scored for every forecast, in the order of the summary
DIAGNOSTIC_LEVELS = {"warning": diagnostics.WARN, "error": diagnostics.ERROR}
HISTORY_SPAN = 65.0  # s of measurements stored: longest horizon of a predictor, 60 s, and 5 s for late messages
ERROR_DEPTH = 1000  # at the end of a run, the scores of a whole horizon are published at once for all models and modes
QUEUE_DEPTH = 500  # queued predictions per topic: 50 s at 10 Hz, 5 s of a fast replay
# SI units; above rounding differences between computers, below the effect of a different vehicle file (cm in 1 s).
TRAJECTORY_TOLERANCE = 1.0e-6


class EvaluatorNode(Node):
    """Publishes the error of each prediction once its horizon has passed, and a summary once a second."""

    def __init__(self) -> None:
        super().__init__("evaluator")
        values = parameters.declare(self, params.EVALUATOR)
        self._vehicle = params.load_vehicle(values)
        self._model_file = params.load_model(values, self._vehicle)
        file_models = [self._model_file.model()] if self._model_file else []
        self._models = params.translate_errors(
            values, lambda: [get_model(m).name for m in (*values.models, *file_models)], "models: ")
        settings = params.read_prediction_settings(values)
        self._core = Evaluator(self._vehicle, settings, HISTORY_SPAN, file_models)
        self._consistency = ConsistencyMonitor(self._vehicle)
        self._map_frame = values.map_frame
        self._diagnostics = Diagnostics(self, self._vehicle.name, self._make_checks)
        self._inputs = Inputs(self, values.map_frame, self._core, self._diagnostics.publish)
        self._statistics = {(model, mode): ErrorStatistics() for model in self._models for mode in MODES}
        self._coverages = CoverageMonitor()
        self._hashes: dict[tuple[str, str, int], str] = {}  # by model, mode and start [ns] of pending predictions
        self._configuration_mismatch: dict[tuple[str, str], bool] = {}  # by hash and model
        self._rejection = ""
        self._bag, self._bag_topics = self._open_bag(values, settings)
        qos = QoSProfile(depth=QUEUE_DEPTH)
        topics = convert.list_prediction_topics(self._models)
        self._predictions = {key: PolledSubscription(self, kind, topic, qos) for key, (topic, kind) in topics.items()}
        qos = QoSProfile(depth=ERROR_DEPTH)
        self._error_publisher = self.create_publisher(PredictionError, "evaluator/errors", qos)
        self._summary_publisher = self.create_publisher(ErrorSummary, "evaluator/summary", LATCHED)
        # Steady clock: messages must be processed and written even while a replay's clock is paused.
        create_steady_timer(self, WORK_PERIOD, self._process_messages)
        create_steady_timer(self, SUMMARY_PERIOD, self._publish_summary)
        self.get_logger().info(f"scoring models {', '.join(self._models)}; vehicle {self._vehicle.name}")

    def _open_bag(self, values, settings) -> tuple[BagWriter | None, dict[str, int]]:
        if not values.output_directory:
            return None, {}
        configuration = {"vehicle": self._vehicle.to_yaml(), "vehicle_name": self._vehicle.name,
                         "vehicle_hash": self._vehicle.hash, "vehicle_file": Path(values.vehicle_file).name,
                         "maximum_gap": f"{settings.maximum_gap:g}", "filter_cutoff": f"{settings.filter_cutoff:g}"}
        if self._model_file:
            configuration |= {"model": self._model_file.to_yaml(), "model_hash": self._model_file.hash,
                              "model_file": Path(values.model_file).name}
        bag = open_bag(values, {"configuration": configuration})
        errors = bag.add_topic(self.resolve_topic_name("evaluator/errors"), "st_msgs/msg/PredictionError")
        summary = bag.add_topic(self.resolve_topic_name("evaluator/summary"), "st_msgs/msg/ErrorSummary",
                                (make_qos(durability="transient_local", depth=1),))
        return bag, {"errors": errors, "summary": summary}

    def _process_messages(self) -> None:
        self._inputs.drain()
        for (mode, model), subscription in self._predictions.items():
            for message, _, _ in subscription.take(QUEUE_DEPTH):
                self._add_prediction(mode, model, message, subscription.topic)
        self._publish_scores(self._core.poll())
        if self._bag:
            self._bag.flush_when_due()
        self._consistency.poll(self._core.history, time.monotonic())

    def _add_prediction(self, mode: Mode, model: str, message: Any, topic: str) -> None:
        content = convert.read_trajectory(message)
        if message.model != model or message.header.frame_id != self._map_frame:
            content = (f"model {message.model!r} in frame {message.header.frame_id!r}, expected {model!r} in "
                       f"{self._map_frame!r}")
        if isinstance(content, str):
            self._rejection = f"prediction on {topic} rejected: {content}"
            return
        self._rejection = ""
        start_ns, trajectory = content
        if mode == "forecast":
            self._check_configuration(model, message, trajectory)
            self._coverages.add_bands(model, start_ns, read_bands(message))
        for scored_mode in MODES if mode == "forecast" else (mode,):
            self._hashes[model, scored_mode, start_ns] = message.configuration_hash
        self._core.add_prediction(model, start_ns, trajectory, mode)

    def _check_configuration(self, model: str, message: Prediction, trajectory: Trajectory) -> None:
        """Recompute one forecast per configuration, to check that the predictor uses this vehicle and model."""
        key, view = (message.configuration_hash, model), self._core.view(model)
        if key in self._configuration_mismatch:
            return
        start = VehicleState(*trajectory.states[0].tolist())
        inputs = ControlInput(message.road_wheel_angle, message.velocity_x_dot)
        horizon = trajectory.step * (len(trajectory.states) - 1)
        predicted = predict(view.model, self._vehicle, start, inputs, horizon, trajectory.step)
        # A model with memory also depends on earlier steering angles, which the message does not contain.
        self._configuration_mismatch[key] = not view.has_steering_dynamics and not np.allclose(
            predicted.states, trajectory.states, rtol=0.0, atol=TRAJECTORY_TOLERANCE, equal_nan=True)

    def _publish_scores(self, scores: list[Score]) -> None:
        for score in scores:
            self._statistics.setdefault((score.model, score.mode), ErrorStatistics()).add(score)
            self._coverages.add_score(score)
            key = score.model, score.mode, score.start_ns
            message = convert.make_prediction_error_message(score, self._map_frame, self._hashes.pop(key, ""))
            self._error_publisher.publish(message)
            self._record("errors", message)

    def _publish_summary(self) -> None:
        message = ErrorSummary(pending=self._core.pending_count)
        message.header.stamp = self.get_clock().now().to_msg()
        message.header.frame_id = self._map_frame
        message.statistics = [convert.make_statistics_message(*key, statistics, self._coverages.by_pair.get(key))
                              for key, statistics in self._statistics.items()]
        self._summary_publisher.publish(message)
        self._record("summary", message)

    def _record(self, topic: str, message: PredictionError | ErrorSummary) -> None:
        if self._bag:
            self._bag.write(self._bag_topics[topic], serialize_message(message), self.get_clock().now().nanoseconds)

    def _make_checks(self) -> list[Check]:
        complete = sum(s.n_starts for s in self._statistics.values())
        incomplete = sum(s.n_incomplete for s in self._statistics.values())
        pending = self._core.pending_count
        values = {"scores complete": complete, "scores incomplete": incomplete, "pending predictions": pending}
        mismatched = sorted({model for (_, model), mismatch in self._configuration_mismatch.items() if mismatch})
        level, text = diagnostics.OK, "scoring" if complete or incomplete or pending else "no prediction yet"
        if self._rejection:
            level, text = diagnostics.WARN, self._rejection
        elif mismatched:
            level, text = diagnostics.WARN, (
                f"predictions of {', '.join(mismatched)} were made with a different vehicle or model than this node "
                "uses: set the same vehicle_file and model_file in predictor and evaluator")
        recording = (make_recording_check(self._bag, suffix="; compute lost errors with st evaluate") if self._bag else
                     Check("recording", diagnostics.OK, "off (output_directory is empty)"))
        verdict = self._consistency.verdict
        severity = DIAGNOSTIC_LEVELS.get(verdict.severity, diagnostics.OK)
        consistency = Check("consistency", severity, verdict.message, verdict.values)
        return [Check("scoring", level, text, values), recording, consistency, make_coverage_check(self._coverages),
                *self._inputs.make_checks()]

    @property
    def exit_status(self) -> int:
        """1 if the recording is incomplete, else 0."""
        return int(self._bag is not None and not is_complete(self._bag))

    def close(self) -> None:
        self._process_messages()
        self._publish_scores(self._core.flush())
        self._publish_summary()
        if self._bag:
            self._bag.close()
            if self._bag.error:
                self.get_logger().error(self._bag.error)


def main() -> int:
    return spin.run(EvaluatorNode, nice=BACKGROUND_NICE)
