"""Two publishers of an input: the first is used, the other is reported; a restarted one is accepted."""

import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")
pytest.importorskip("st_msgs", reason="needs the built workspace")

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from intruder import ELSEWHERE
from rclpy.executors import SingleThreadedExecutor
from ros_processes import Processes, wait_for
from st_msgs.msg import Prediction
from support import ROOT

pytestmark = [
    pytest.mark.ros, pytest.mark.slow,
    pytest.mark.timing("nodes run in real time; one that waits for its turn skips ticks"),
]
LEAF = ROOT / "config" / "vehicle" / "leaf.yaml"


class Listener:
    """Output of the predictor: newest text of its check `publishers`, and starts of its predictions [m]."""

    def __init__(self, domain: int):
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=domain)
        self._node = rclpy.create_node("listener", context=self.context)
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self._node)
        self._node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 50)
        self._node.create_subscription(Prediction, "predictor/linear/prediction", self._on_prediction, 50)
        self.said = ""
        self.starts: list[float] = []

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        self.said = next((s.message for s in message.status if s.name == "predictor: publishers"), self.said)

    def _on_prediction(self, message: Prediction) -> None:
        self.starts.append(message.x[0])

    def until(self, condition: Callable[[], object], what: str) -> None:
        def received() -> object:
            for _ in range(20):
                self._executor.spin_once(timeout_sec=0.01)
            return condition()

        wait_for(received, 60.0, what)

    def more_predictions(self, count: int = 10) -> None:
        expected = len(self.starts) + count
        self.until(lambda: len(self.starts) >= expected, f"{count} more predictions, {self.said}")

    def close(self) -> None:
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.try_shutdown(context=self.context)


@pytest.fixture
def processes(tmp_path: Path) -> Iterator[Processes]:
    running = Processes(tmp_path)
    yield running
    running.close()


def feeder(processes: Processes) -> subprocess.Popen:
    return processes.start([sys.executable, str(ROOT / "tests" / "circle_feeder.py"), "--duration", "600"], "feeder")


def test_an_intruder_is_named_and_not_used_and_the_own_node_is_taken_again(processes: Processes) -> None:
    listener = Listener(int(processes.environment["ROS_DOMAIN_ID"]))
    try:
        processes.node("st_predictor", "predictor", f"vehicle_file:={LEAF}")
        first = feeder(processes)
        listener.more_predictions()
        assert listener.said == "one of each input"

        intruder = processes.start([sys.executable, str(ROOT / "tests" / "intruder.py")], "intruder")
        listener.until(lambda: "/intruder" in listener.said, "the intruder is named")
        listener.more_predictions()
        intruder.terminate()
        intruder.wait(20)
        listener.until(lambda: listener.said == "one of each input", "well again")
        listener.more_predictions()

        # Dead without a word it stays in the graph for a while, beside the one that takes its place.
        first.send_signal(signal.SIGKILL)
        first.wait(20)
        feeder(processes)
        listener.more_predictions()
        assert max(map(abs, listener.starts)) < ELSEWHERE / 2
    finally:
        listener.close()
