"""Node st_monitor: receives and formats statistics and diagnostics of a running suite, and aggregates diagnostics."""

import math
import threading
import time
from collections.abc import Iterable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rich.console import Group, RenderableType
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text
from st_core.palette import MODEL_COLOUR
from st_msgs.msg import ErrorSummary, Prediction, PredictorStatus
from st_recordings.paths import json_ready
from st_recordings.results import format_band_lines
from st_ros.diagnostics import ERROR, STALE
from st_ros.polling import PolledSubscription, create_steady_timer

AGGREGATE_PERIOD = 1.0  # s between messages on /diagnostics_agg
PREDICTION_PERIOD = 0.25  # s between reads of the newest prediction
TABLE_MODES = ("hindsight", "forecast", "course", "plan")
AXES, STATISTICS = ("longitudinal", "lateral"), ("mean", "max", "rmse")
STATUS_TIMEOUT, MISSED_REPORTS = 5.0, 3  # s, report intervals; a status is silent if not updated for longer than both
N_INTERVALS = 3  # stored report intervals; the longest is used, because a change of level causes an extra report
LEVEL_NAMES = ("ok", "warning", "error", "stale")


@dataclass(frozen=True)
class Status:
    """One diagnostic line. level: 0 ok, 1 warning, 2 error, 3 stale."""

    name: str
    level: int
    message: str
    received_at: float  # s, monotonic
    intervals: tuple[float, ...] = ()  # s between the last statuses with this name, newest last

    def is_silent(self, now: float) -> bool:
        return now - self.received_at > max(STATUS_TIMEOUT, MISSED_REPORTS * max(self.intervals, default=0.0))


@dataclass
class SuiteState:
    """The newest messages of a running suite."""

    summary: ErrorSummary | None = None
    predictor_status: PredictorStatus | None = None
    health: dict[str, Status] = field(default_factory=dict)
    prediction: Prediction | None = None  # the newest, of any model


class Monitor(AbstractContextManager):
    """ROS node with a thread that receives messages. Values in `state` are replaced, so readers need no lock."""

    def __init__(self, domain_id: int | None = None):
        self.state = SuiteState()
        self._lock = threading.Lock()
        self._context = rclpy.Context()
        rclpy.init(context=self._context, domain_id=domain_id,
                   signal_handler_options=rclpy.signals.SignalHandlerOptions.NO)
        self._node = Node("st_monitor", context=self._context)
        for name, kind, topic in (("summary", ErrorSummary, "evaluator/summary"),
                                  ("predictor_status", PredictorStatus, "predictor/status")):
            self._node.create_subscription(kind, topic, partial(setattr, self.state, name), 10)
        self._node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 50)
        newest = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        self._predictions = [PolledSubscription(self._node, Prediction, f"predictor/{model}/prediction", newest)
                             for model in MODEL_COLOUR]
        create_steady_timer(self._node, PREDICTION_PERIOD, self._read_predictions)
        self._aggregate = self._node.create_publisher(DiagnosticArray, "/diagnostics_agg", 10)
        create_steady_timer(self._node, AGGREGATE_PERIOD, self._publish_aggregate)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._thread = threading.Thread(target=self._executor.spin, name="monitor", daemon=True)
        self._thread.start()

    def find_node_names(self) -> list[str]:
        """Names of the other nodes in the graph, without other monitors; a name used by two nodes is listed twice."""
        return [name for name in self._node.get_node_names() if name != self._node.get_name()]

    def wait_for_nodes(self, names: set[str], timeout: float) -> set[str]:
        """Wait until all nodes publish diagnostics, at most `timeout` [s]; returns the missing nodes. A node may be in
        the graph for seconds before it publishes them: the predictor first compiles its models."""
        end = time.monotonic() + timeout
        while time.monotonic() < end:
            ready = {info.node_name for info in self._node.get_publishers_info_by_topic("/diagnostics")}
            if not (missing := names - ready):
                break
            time.sleep(0.05)
        return missing

    def add_statuses(self, statuses: Iterable[Status]) -> None:
        """Store statuses of this process or of a node; each replaces the earlier one with the same name."""
        with self._lock:
            self.state.health = {**self.state.health, **{s.name: s for s in statuses}}

    def _publish_aggregate(self) -> None:
        """Publish the worst level of the suite, stale if no status has arrived, followed by every status."""
        now, statuses = time.monotonic(), self.state.health
        lines = []
        for s in sorted(statuses.values(), key=lambda s: s.name):
            silence = f"silent for {now - s.received_at:.0f} s" if s.is_silent(now) else ""
            lines.append(DiagnosticStatus(name=s.name, message=silence or s.message,
                                          level=bytes([STALE if silence else s.level])))
        worst = max((line.level[0] for line in lines), default=STALE)
        failed = [line.name for line in lines if line.level[0]]
        text = (f"{len(failed)} of {len(lines)} checks are not OK: {', '.join(failed)}" if failed
                else "all nodes OK" if lines else "no diagnostics yet")
        message = DiagnosticArray(status=[DiagnosticStatus(name="suite", level=bytes([worst]), message=text), *lines])
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._aggregate.publish(message)

    def __exit__(self, *_: object) -> None:
        self._executor.shutdown()
        self._thread.join()
        self._node.destroy_node()
        rclpy.try_shutdown(context=self._context)

    def _read_predictions(self) -> None:
        for subscription in self._predictions:
            for message, _, _ in subscription.take():
                self.state.prediction = message

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        now, health = time.monotonic(), self.state.health
        intervals = {name: (*status.intervals, now - status.received_at)[-N_INTERVALS:]
                     for name, status in health.items()}
        self.add_statuses(Status(s.name, int.from_bytes(s.level, "little"), s.message, now, intervals.get(s.name, ()))
                          for s in message.status)


def render_progress(state: SuiteState, elapsed: float, duration: float | None, title: str) -> RenderableType:
    """Terminal view of a run, with the motion at the newest prediction. elapsed, duration [s]; None: until Ctrl-C."""
    progress = Table.grid(padding=(0, 1))
    if duration:
        bar = ProgressBar(total=duration, completed=min(elapsed, duration), width=40)
        progress.add_row(title, bar, f"{elapsed:4.0f} / {duration:.0f} s")
    else:
        progress.add_row(title, f"{elapsed:4.0f} s", "(Ctrl-C to stop)")
    p, motion = state.prediction, Text("no prediction yet", style="dim")
    if p is not None and len(p.velocity_x):
        side, speed = "left" if p.road_wheel_angle > 0 else "right", p.velocity_x[0]
        motion = Text(f"{speed:.1f} m/s, wheels {abs(math.degrees(p.road_wheel_angle)):.1f} deg {side}, "
                      f"v_x r {speed * p.yaw_rate[0]:+.1f} m/s², {p.model} took {p.compute_time * 1e3:.1f} ms")
    return Group(progress, motion, render_results(state))


def render_results(state: SuiteState) -> RenderableType:
    """Errors so far, observed coverage of the bands, numbers of predictions, and health."""
    coverage = [Text(text) for text in format_band_lines(state.summary.statistics if state.summary else [])]
    return Group(render_errors(state), *coverage, render_counts(state.predictor_status), render_health(state))


def render_errors(state: SuiteState) -> RenderableType:
    statistics = state.summary.statistics if state.summary else []
    if not any(s.n_starts for s in statistics):
        return Text("waiting for the end of the first prediction", style="dim")
    models: dict[str, dict[str, Any]] = {}
    for s in statistics:
        models.setdefault(s.model, {})[s.mode] = {"n_starts": s.n_starts, **{
            axis: {name: json_ready(getattr(s, f"{axis}_{name}")) for name in STATISTICS} for axis in AXES}}
    return make_error_table(models, digits=2)


def make_error_table(models: Mapping[str, Mapping[str, Any]], title: str | None = None, digits: int = 3) -> Table:
    """Table of mean, largest magnitude and RMS of the horizon means of the errors [m]; the smallest value of each mode
    is bold. models: as in summary.json. digits: number of decimal places."""
    table = Table(title=title, title_justify="left", title_style="bold", box=None, padding=(0, 1))
    for column in ("mode", "model", "scored", *(f"{axis}, m\nmean | max | RMSE" for axis in AXES)):
        table.add_column(column, justify="left" if column in ("mode", "model") else "right", no_wrap=True)
    for mode in TABLE_MODES:
        rows = {model: modes[mode] for model, modes in models.items() if mode in modes}
        for model, row in rows.items():
            cells = [Text(" | ").join(_format_statistic(rows, model, axis, name, digits) for name in STATISTICS)
                     for axis in AXES]
            table.add_row(mode, Text(model, style=MODEL_COLOUR.get(model, "")), str(row["n_starts"]), *cells)
        table.add_section()
    return table


def _format_statistic(rows: Mapping[str, Any], model: str, axis: str, name: str, digits: int) -> Text:
    value = rows[model][axis][name]
    magnitudes = [abs(v) for row in rows.values() if (v := row[axis][name]) is not None]
    is_best = value is not None and abs(value) <= min(magnitudes) + 0.5 * 10.0**-digits
    return Text("-" if value is None else f"{value:.{digits}f}", style="bold" if is_best else "")


def render_counts(status: PredictorStatus | None) -> Text:
    if status is None:
        return Text("predictor: no status yet", style="dim")
    skipped = status.skipped_stale + status.skipped_overrun + status.skipped_slow
    text = Text(f"predictions due {status.due}, made {status.predicted}, skipped {skipped}")
    if status.state_age > 0.0:
        text.append(f"; median age of start states {status.state_age * 1e3:.0f} ms")
    if status.reason:
        text.append(f"  ({status.reason})", style="yellow")
    return text


def render_health(state: SuiteState) -> Text:
    """Statuses that are silent or not OK, errors first; "all nodes OK" if there are none; "" before the first."""
    now = time.monotonic()
    text = Text()
    for status in sorted(state.health.values(), key=lambda s: ((3, 2, 0, 1)[min(s.level, STALE)], s.name)):
        is_silent = status.is_silent(now)
        if status.level == 0 and not is_silent:
            continue
        level = "silent" if is_silent else LEVEL_NAMES[min(status.level, STALE)]
        style = "red" if status.level >= ERROR or is_silent else "yellow"
        text.append(f"{level}: {status.name}: {status.message}\n", style=style)
    return text if text else Text("all nodes OK" if state.health else "", style="green")
