"""Two publishers of an input: the first is used, the other is reported; a restarted one is accepted."""

import signal
import subprocess
import sys
from collections.abc import Callable

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")
pytest.importorskip("st_msgs", reason="needs the built workspace")

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from intruder import ELSEWHERE
from rclpy.executors import SingleThreadedExecutor
from ros_processes import Processes, wait_for
from st_msgs.msg import Prediction
from support import LEAF, ROOT

pytestmark = [
    pytest.mark.ros, pytest.mark.slow,
    pytest.mark.timing("nodes run in real time; one that waits for its turn skips ticks"),
]


class Listener:
    """Output of the predictor: newest text of its check `publishers`, and x at the starts of its predictions [m]."""

    def __init__(self, domain: int):
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=domain)
        self._node = rclpy.create_node("listener", context=self.context)
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self._node)
        self._node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 50)
        self._node.create_subscription(Prediction, "predictor/linear/prediction", self._on_prediction, 50)
        self.text = ""
        self.starts: list[float] = []

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        self.text = next((s.message for s in message.status if s.name == "predictor: publishers"), self.text)

    def _on_prediction(self, message: Prediction) -> None:
        self.starts.append(message.x[0])

    def wait_until(self, condition: Callable[[], object], what: str) -> None:
        def received() -> object:
            for _ in range(20):
                self._executor.spin_once(timeout_sec=0.01)
            return condition()

        wait_for(received, 60.0, what)

    def wait_for_predictions(self, count: int = 10) -> None:
        expected = len(self.starts) + count
        self.wait_until(lambda: len(self.starts) >= expected, f"{count} more predictions, {self.text}")

    def close(self) -> None:
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.try_shutdown(context=self.context)


def start_feeder(processes: Processes) -> subprocess.Popen:
    return processes.start([sys.executable, str(ROOT / "tests" / "circle_feeder.py"), "--duration", "600"], "feeder")


def test_intruder_is_reported_and_unused_and_restarted_publisher_is_accepted(processes: Processes) -> None:
    listener = Listener(int(processes.environment["ROS_DOMAIN_ID"]))
    try:
        processes.node("st_predictor", "predictor", f"vehicle_file:={LEAF}")
        first = start_feeder(processes)
        listener.wait_for_predictions()
        assert listener.text == "no competing publishers"

        intruder = processes.start([sys.executable, str(ROOT / "tests" / "intruder.py")], "intruder")
        listener.wait_until(lambda: "/intruder" in listener.text, "the intruder is reported")
        listener.wait_for_predictions()
        intruder.terminate()
        intruder.wait(20)
        listener.wait_until(lambda: listener.text == "no competing publishers", "a single publisher again")
        listener.wait_for_predictions()

        # A killed node remains in the graph for some time, together with its replacement.
        first.send_signal(signal.SIGKILL)
        first.wait(20)
        start_feeder(processes)
        listener.wait_for_predictions()
        assert max(map(abs, listener.starts)) < ELSEWHERE / 2
    finally:
        listener.close()
