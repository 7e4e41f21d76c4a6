"""What the terminal shows of a running suite, heard over DDS: statistics, tick counts, diagnostics."""

import contextlib
import threading
import time
from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from st_core.palette import MODEL_COLOUR
from st_msgs.msg import ErrorSummary, Prediction, PredictorStatus
from st_ros.polling import PolledSubscription

LOOK_PERIOD = 0.25  # s between looks for a newest prediction
FORGET_AFTER = 5.0  # s without hearing of a diagnostic before it is shown as silent
STALE = 3


@dataclass(frozen=True)
class Status:
    """One diagnostic line. level: 0 ok, 1 warning, 2 error, 3 stale."""

    name: str
    level: int
    message: str
    heard_at: float  # s, monotonic

    def is_silent(self, now: float) -> bool:
        return now - self.heard_at > FORGET_AFTER


@dataclass
class Heard:
    summary: ErrorSummary | None = None
    ticks: PredictorStatus | None = None
    health: dict[str, Status] = field(default_factory=dict)
    prediction: Prediction | None = None  # a newest one, of any model


class Monitor:
    """Listens in a thread of its own; `heard` is replaced, never changed, so reading needs no lock."""

    def __init__(self, domain_id: int | None = None):
        self.heard = Heard()
        self._taking = threading.Lock()
        self._context = rclpy.Context()
        rclpy.init(
            context=self._context, domain_id=domain_id, signal_handler_options=rclpy.signals.SignalHandlerOptions.NO
        )
        self._node = Node("st_monitor", context=self._context)
        self._node.create_subscription(ErrorSummary, "evaluator/summary", self._on_summary, 10)
        self._node.create_subscription(PredictorStatus, "predictor/status", self._on_ticks, 10)
        self._node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 50)
        newest = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        self._predictions = [
            PolledSubscription(self._node, Prediction, f"predictor/{model}/prediction", newest)
            for model in MODEL_COLOUR
        ]
        self._node.create_timer(LOOK_PERIOD, self._look)
        self._health = self._node.create_publisher(DiagnosticArray, "/diagnostics_agg", 10)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._thread = threading.Thread(target=self._spin, name="monitor", daemon=True)
        self._thread.start()

    def node_names(self) -> list[str]:
        """Of all nodes in the graph but this one; two of one name stand there twice."""
        return [name for name in self._node.get_node_names() if name != self._node.get_name()]

    def wait_for_nodes(self, names: set[str], timeout: float) -> set[str]:
        """Wait until all are in the graph; returns those still missing."""
        end = time.monotonic() + timeout
        while missing := names - set(self.node_names()):
            if time.monotonic() > end:
                break
            time.sleep(0.05)
        return missing

    def graph(self, names: Iterable[str]) -> dict[str, tuple[set[str], set[str]]]:
        """Node -> (topics it publishes, topics it subscribes)."""
        return {n: ({topic for topic, _ in self._node.get_publisher_names_and_types_by_node(n, "/")},
                    {topic for topic, _ in self._node.get_subscriber_names_and_types_by_node(n, "/")}) for n in names}

    def heard_from(self, name: str) -> float:
        """When a node last spoke on /diagnostics [s, monotonic]; minus infinity: never."""
        own = f"{name}: "
        return max((s.heard_at for n, s in self.heard.health.items() if n.startswith(own)), default=float("-inf"))

    def note(self, status: Status) -> None:
        """Put a line of our own beside those that are heard."""
        self._take({status.name: status})

    def publish_health(self) -> None:
        """All that is known as one array, as a diagnostic aggregator does: first the whole suite, then each line."""
        now, known = time.monotonic(), self.heard.health
        lines = [DiagnosticStatus(name=s.name, message=s.message, level=bytes([STALE if s.is_silent(now) else s.level]))
                 for s in sorted(known.values(), key=lambda s: s.name)]
        worst = max((line.level[0] for line in lines), default=STALE)
        bad = [line.name for line in lines if line.level[0]]
        text = "all nodes well" if not bad else f"{len(bad)} of {len(lines)} checks are not well: {', '.join(bad)}"
        message = DiagnosticArray(status=[DiagnosticStatus(name="suite", level=bytes([worst]), message=text), *lines])
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._health.publish(message)

    def close(self) -> None:
        self._executor.shutdown()
        self._thread.join()
        self._node.destroy_node()
        rclpy.try_shutdown(context=self._context)

    def __enter__(self) -> "Monitor":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _spin(self) -> None:
        with contextlib.suppress(ExternalShutdownException):
            self._executor.spin()

    def _on_summary(self, message: ErrorSummary) -> None:
        with self._taking:
            self.heard = replace(self.heard, summary=message)

    def _on_ticks(self, message: PredictorStatus) -> None:
        with self._taking:
            self.heard = replace(self.heard, ticks=message)

    def _look(self) -> None:
        for subscription in self._predictions:
            for message, _, _ in subscription.take():
                with self._taking:
                    self.heard = replace(self.heard, prediction=message)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        now = time.monotonic()
        self._take({s.name: Status(s.name, int.from_bytes(s.level, "little"), s.message, now) for s in message.status})

    def _take(self, news: dict[str, Status]) -> None:
        with self._taking:  # from its own thread and from the caller's
            self.heard = replace(self.heard, health={**self.heard.health, **news})
