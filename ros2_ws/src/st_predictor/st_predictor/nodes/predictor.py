"""Node predictor: at each tick, predicts a path with every model from the newest instant with INS and steering data."""

import math
import time
from collections.abc import Mapping
from statistics import median
from types import MappingProxyType, SimpleNamespace

import numpy as np
from nav_msgs.msg import Path as PathMessage
from rclpy.node import Node
from rclpy.qos import QoSProfile
from st_core.course import Course
from st_core.evaluation import Evaluator, Mode
from st_core.models import get_model
from st_core.prediction import Predictor, Skip, Start, compile_models, configuration_hash
from st_core.timeseries import NANOSECOND
from st_core.types import InputSequence, Trajectory
from st_msgs.msg import Band, PredictorStatus
from st_ros import diagnostics, parameters, spin
from st_ros.diagnostics import Check, Diagnostics
from st_ros.polling import LATCHED, create_steady_timer

from .. import convert, params
from ._bands import PredictionBands
from ._future_inputs import CourseInput, PlanInput
from ._inputs import Inputs

MAX_OVERRUN_NS = 10_000_000_000  # a longer time between ticks is a clock jump, as in a replay, and not an overrun
DRAIN_PERIOD = 0.02  # s; queues are emptied between ticks, so that a tick has little input to process
STATUS_PERIOD = 1.0  # s
# Messages queued for a slow subscriber. Fast DDS resends the whole queue to a subscriber that was stopped: after a stop
# of 3 s a recorder received nothing for 90 s at depth 50 (half a megabyte per topic), and for 3 s at depth 10.
# In a replay at 100 predictions per second, a recorder delayed by 0.5 s lost 50 of 590 at depth 10, none at 1000.
LIVE_DEPTH, REPLAY_DEPTH = 10, 1000
MAX_WAIT_FRACTION = 0.5  # longest wait for samples as a fraction of the period, so that the next tick is not late
JUMP_WARNING_DURATION = 10.0  # s, of the warning about a position jump
BUSY_TICK_FRACTION = 0.5  # fraction of the period; a longer tick causes a warning


class TickCounter:
    """Counts ticks from the first one with inputs. rclpy's timer keeps its schedule and drops missed ticks."""

    def __init__(self) -> None:
        self._counts = {"predicted": 0, "skipped_stale": 0, "skipped_overrun": 0, "skipped_slow": 0}
        self._has_started = False
        self._next_due_ns: int | None = None
        self._reported_overruns = 0

    def count_missed(self, next_due_ns: int, period_ns: int) -> int:
        """Number of ticks dropped since the last call, 0 after a clock jump. next_due_ns: time of the next tick."""
        previous_ns, self._next_due_ns = self._next_due_ns, next_due_ns
        if previous_ns is None or not 0 < next_due_ns - previous_ns < MAX_OVERRUN_NS:
            return 0
        return max(0, round((next_due_ns - previous_ns) / period_ns) - 1)

    def count(self, missed_count: int, skip_kind: str | None) -> None:
        """Count a tick and the `missed_count` ticks dropped before it. skip_kind: why it made no prediction, "stale"
        (inputs) or "slow" (below the minimum speed); None if it made one."""
        if self._has_started or skip_kind != "stale":
            self._counts["skipped_overrun"] += missed_count if self._has_started else 0
            self._counts[f"skipped_{skip_kind}" if skip_kind else "predicted"] += 1
            self._has_started = True

    def count_new_overruns(self) -> int:
        """Number of overruns since the previous call."""
        reported, self._reported_overruns = self._reported_overruns, self._counts["skipped_overrun"]
        return self._reported_overruns - reported

    def as_dict(self) -> dict[str, int]:
        """The counts by field name of st_msgs/PredictorStatus."""
        return {"due": sum(self._counts.values()), **self._counts}


class PredictorNode(Node):
    """Publishes a prediction and a path of every model at each tick, and its status once a second."""

    def __init__(self) -> None:
        super().__init__("predictor")
        values = parameters.declare(self, params.PREDICTOR)
        self._vehicle = params.load_vehicle(values)
        backend = self._make_core(values)
        self._map_frame = values.map_frame
        self._diagnostics = Diagnostics(self, self._vehicle.name, self._make_checks)
        self._inputs = Inputs(self, values.map_frame, self._core, self._diagnostics.publish)
        self._plan = PlanInput(self, values.plan_frame, self._vehicle)
        settings = self._core.settings
        course = params.read_file(values, "course_file", Course.from_yaml)
        self._course = CourseInput(self, course, self._vehicle, settings.horizon, settings.step)
        self._path_builder = convert.PathBuilder(values.map_frame, settings.steps + 1)
        self._uses_sim_time = self.get_parameter("use_sim_time").value
        qos = QoSProfile(depth=REPLAY_DEPTH if self._uses_sim_time else LIVE_DEPTH)
        topics = convert.list_prediction_topics(self._core.models)
        self._prediction_publishers = {key: self.create_publisher(kind, topic, qos)
                                       for key, (topic, kind) in topics.items()}
        self._path_publishers = {model: self.create_publisher(PathMessage, f"predictor/{model}/path", qos)
                                 for model in self._core.models}
        self._status_publisher = self.create_publisher(PredictorStatus, "predictor/status", LATCHED)
        self._counter = TickCounter()
        self._skip: Skip | None = Skip("stale", "INS: nothing received yet")
        self._last_start_ns: int | None = None
        self._diverged_models: set[str] = set()  # models whose newest prediction is not finite
        self._reported_jumps = 0
        self._slowest_tick = 0.0
        self._state_age = math.nan  # last published median [s]
        self._state_ages: list[float] = []  # ages of the start states of the forecasts since the last status [s]
        self._period = 1.0 / values.rate
        # No wait in simulated time, which advances only while the executor runs; times of arrival are host times.
        self._max_wait = 0.0 if self._uses_sim_time else min(values.sample_wait, MAX_WAIT_FRACTION * self._period)
        create_steady_timer(self, DRAIN_PERIOD, self._inputs.drain)
        self._timer = create_steady_timer(self, self._period, self._tick, in_sim_time=True)
        create_steady_timer(self, STATUS_PERIOD, self._publish_status, in_sim_time=True)
        self.get_logger().info(
            f"{', '.join(self._core.models)} of {self._vehicle.name}: {settings.horizon:g} s in steps of "
            f"{settings.step:g} s at {values.rate:g} Hz, "
            f"configuration {', '.join(h[:12] for h in dict.fromkeys(self._hashes.values()))}; models {backend}")

    def _make_core(self, values: SimpleNamespace) -> str:
        """Create the core with its models, hashes and bands; returns how the models are executed, for the log."""
        settings = params.read_prediction_settings(values)
        file = params.load_model(values, self._vehicle)
        models = [*values.models, *([file.model()] if file else [])]
        parsed_models = params.translate_errors(values, lambda: [get_model(model) for model in models], "models: ")
        runners, backend = compile_models(parsed_models if values.compiled else (), self._vehicle, settings)
        scorer = Evaluator(self._vehicle, settings, 0.0, parsed_models, runners) if values.adaptive_bands else None
        self._core = params.translate_errors(values, lambda: Predictor(
            self._vehicle, parsed_models, settings, runners, scorer.history if scorer else None))
        file_hashes = dict.fromkeys(self._core.models, "")
        if file:
            file_hashes[parsed_models[-1].name] = file.hash
        self._hashes = {model: configuration_hash(self._vehicle, settings, h) for model, h in file_hashes.items()}
        self._bands = PredictionBands(values, self._vehicle, file_hashes, settings, scorer)
        return backend or "interpreted"

    def _tick(self) -> None:
        period_ns = round(self._period / NANOSECOND)
        remaining_ns = self._timer.time_until_next_call()
        missed_count = self._counter.count_missed(self._timer.clock.now().nanoseconds + remaining_ns, period_ns)
        # Waiting for the next sample makes the start state of the prediction newer.
        self._inputs.wait(self.get_clock().now().nanoseconds + remaining_ns - period_ns, self._max_wait)
        tick_start = time.perf_counter()
        start = self._find_start(self.get_clock().now().nanoseconds)
        previous_skip, self._skip = self._skip, start if isinstance(start, Skip) else None
        self._counter.count(missed_count, self._skip.kind if self._skip else None)
        if isinstance(start, Start):
            self._predict(start)
        self._bands.observe_scores()
        if self._skip and self._uses_sim_time:
            self._publish_status()  # the player of `st replay` waits for a message from every tick
        has_changed = (previous_skip and previous_skip.kind) != (self._skip and self._skip.kind)
        if has_changed or self._reported_jumps != self._core.history.jump_count:
            self._reported_jumps = self._core.history.jump_count
            self._diagnostics.publish()
        self._slowest_tick = max(self._slowest_tick, time.perf_counter() - tick_start)

    def _find_start(self, now_ns: int) -> Start | Skip:
        start = self._core.find_start(now_ns)
        if isinstance(start, Skip):
            return start
        last_start_ns, self._last_start_ns = self._last_start_ns, start.time_ns
        if start.time_ns != last_start_ns:
            return start
        # A planner does not need the same prediction twice, and the statistics would count it twice.
        signal, age = max(self._core.ages(now_ns).items(), key=lambda item: item[1])
        return Skip("stale", f"{signal}: no new sample since the last tick, the newest is {age:.2f} s old")

    def _predict(self, start: Start) -> None:
        self._plan.drain()
        previous_status = bool(self._plan.problem), self._course.is_used
        predictions: dict[Mode, dict[str, Trajectory]] = {}
        if plan_inputs := self._plan.find_inputs(self._core, start):
            predictions["plan"] = self._publish_predictions(start, "plan", *plan_inputs)
        if (inputs := self._course.find_inputs(self._core, start)) is not None:
            predictions["course"] = self._publish_predictions(start, "course", inputs)
        predictions["forecast"] = self._publish_predictions(start, "forecast", bands=self._bands.make_messages(
            self._core.history, start.time_ns, ("forecast", "hindsight", *predictions)))
        # Paths are published last: only viewers read them, and filling one takes longer than running all models.
        # Viewers cannot draw a path that is not finite; the evaluator scores it as incomplete.
        finite = {model: t for model, t in predictions["forecast"].items() if np.isfinite(t.states).all()}
        self._diverged_models = predictions["forecast"].keys() - finite.keys()
        for model, trajectory in finite.items():
            path = self._path_builder.fill(start.time_ns, trajectory, self._core.car(model))
            self._path_publishers[model].publish(path)
        self._bands.add_predictions(start, predictions)
        if previous_status != (bool(self._plan.problem), self._course.is_used):
            self._diagnostics.publish()

    def _publish_predictions(self, start: Start, mode: Mode, inputs: InputSequence | None = None, plan_ns: int = 0,
                             bands: Mapping[str, list[Band]] = MappingProxyType({})) -> dict[str, Trajectory]:
        """Publish the predictions of all models; returns them by model. inputs: of a plan or course; None: held."""
        trajectories = {}
        for model in self._core.models:
            run_start = time.perf_counter()
            model_inputs = None if inputs is None else self._core.select_inputs(model, inputs)
            trajectories[model] = self._core.run(start, model, model_inputs)
            compute_time = time.perf_counter() - run_start
            message = convert.make_prediction_message(
                start, model, trajectories[model], self._core.car(model), self._map_frame, self._hashes[model],
                model_inputs, plan_ns)
            message.compute_time = compute_time
            if mode == "forecast":
                message.bands = bands.get(model, [])
            now = self.get_clock().now()
            message.issued_at = now.to_msg()
            self._prediction_publishers[mode, model].publish(message)
            if mode == "forecast":
                self._state_ages.append((now.nanoseconds - start.time_ns) * NANOSECOND)
        return trajectories

    def _publish_status(self) -> None:
        ages, self._state_ages = self._state_ages, []
        message = PredictorStatus(reason=self._explain_skip(), **self._counter.as_dict())
        message.state_age, message.state_age_max = (median(ages), max(ages)) if ages else (math.nan, math.nan)
        self._state_age = message.state_age
        message.header.stamp = self.get_clock().now().to_msg()
        message.header.frame_id = self._map_frame
        self._status_publisher.publish(message)

    def _explain_skip(self) -> str:
        return self._inputs.explain(self._skip.reason) if self._skip else ""

    def _make_checks(self) -> list[Check]:
        counts = self._counter.as_dict()
        level, text = diagnostics.OK, "predicting"
        if self._skip:
            level = diagnostics.OK if self._skip.kind == "slow" else diagnostics.ERROR
            text = f"no prediction: {self._explain_skip()}"
        elif self._diverged_models:
            models = ", ".join(sorted(self._diverged_models))
            level, text = diagnostics.WARN, f"prediction not finite, path not published: {models}"
        ages = self._core.ages(self.get_clock().now().nanoseconds)
        known_ages = {f"age {signal} [s]": age for signal, age in ages.items() if math.isfinite(age)}
        slowest, self._slowest_tick = self._slowest_tick, 0.0
        overruns = self._counter.count_new_overruns()
        is_late = overruns > 0 or slowest > BUSY_TICK_FRACTION * self._period
        timing = f"slowest tick {slowest * 1e3:.1f} ms" + (f", {overruns} ticks skipped by overrun" if overruns else "")
        return [
            Check("prediction", level, text, {**counts, **known_ages}),
            Check("timing", diagnostics.WARN if is_late else diagnostics.OK, timing,
                  {"slowest tick [ms]": slowest * 1e3, "period [ms]": self._period * 1e3,
                   "state age at issue, median [ms]": self._state_age * 1e3}),
            self._make_position_check(), self._make_steering_check(), self._bands.make_check(),
            self._plan.make_check(self._skip is None), self._course.make_check(self._skip is None),
            *self._inputs.make_checks()]

    def _make_position_check(self) -> Check:
        history = self._core.history
        values = {"jumps": history.jump_count}
        if history.last_jump is None:
            return Check("position", diagnostics.OK, "no jump yet", values)
        age = (self.get_clock().now().nanoseconds - history.last_jump.time_ns) * NANOSECOND
        text = f"jump of {history.last_jump.size:.2f} m not explained by velocity; {history.jump_count} since start-up"
        if age < JUMP_WARNING_DURATION:
            return Check("position", diagnostics.WARN, f"{text}; no prediction or score extends across it", values)
        return Check("position", diagnostics.OK, f"last {text}", values | {"age [s]": age})

    def _make_steering_check(self) -> Check:
        frozen = self._core.frozen_steering.frozen_angle
        if frozen is None:
            return Check("steering", diagnostics.OK, "no frozen angle detected")
        text = (f"angle constant at {frozen.angle:.4f} rad for {frozen.duration:.1f} s, but the yaw rate corresponds "
                f"to {frozen.low:.4f} to {frozen.high:.4f} rad: check whether the sensor is frozen")
        return Check("steering", diagnostics.WARN, text)

    def close(self) -> None:
        self._publish_status()


def main() -> int:
    return spin.run(PredictorNode)
