"""From the UDP datagram at the socket to the three paths published, at 250 Hz NCOM and full CAN rate."""

import contextlib
import os
import threading
import time

import numpy as np
import rclpy
from _suite import running_suite
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from st_msgs.msg import Ncom, Prediction

MODELS = ("kinematic", "linear", "nonlinear")


class Listener(Node):
    """Notes when the datagram behind each start state reached the host, and when its last prediction was published."""

    def __init__(self) -> None:
        super().__init__("latency_listener")
        self.received: list[int] = []  # kernel receive time of each packet, ns
        self.predictions: list[tuple[int, str, int, int]] = []
        self.create_subscription(Ncom, "ins/ncom", self._on_ncom, 500)
        for model in MODELS:
            self.create_subscription(Prediction, f"predictor/{model}/prediction", self._on_prediction, 100)

    def _on_ncom(self, message: Ncom) -> None:
        self.received.append(message.header.stamp.sec * 10**9 + message.header.stamp.nanosec)

    def _on_prediction(self, message: Prediction) -> None:
        measured = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        issued = message.issued_at.sec * 10**9 + message.issued_at.nanosec
        self.predictions.append((measured, message.model, issued, time.time_ns()))


def run() -> dict:
    """Latency in ms: newest datagram used -> last of three predictions published, and -> received by a subscriber."""
    seconds = float(os.environ.get("ST_BENCH_SECONDS", "60"))
    with running_suite(seconds + 10):
        rclpy.init()
        node = Listener()
        executor = SingleThreadedExecutor()
        executor.add_node(node)

        def spin() -> None:
            with contextlib.suppress(ExternalShutdownException):
                executor.spin()

        thread = threading.Thread(target=spin)
        thread.start()
        time.sleep(seconds)
        executor.shutdown()
        thread.join()
        node.destroy_node()
        rclpy.try_shutdown()
    return _evaluate(node)


def _evaluate(node: Listener) -> dict:
    times = np.array(sorted(node.received))
    issued: dict[int, list[int]] = {}
    heard: dict[int, list[int]] = {}
    for measured, _, out, arrived in node.predictions:
        issued.setdefault(measured, []).append(out)
        heard.setdefault(measured, []).append(arrived)
    to_published, to_heard = [], []
    for measured, out in issued.items():
        if len(out) != len(MODELS):
            continue
        # The packet that made this start state known is the first one received after the instant it describes.
        k = int(np.searchsorted(times, measured))
        if k < len(times):
            to_published.append((max(out) - times[k]) * 1e-6)
            to_heard.append((max(heard[measured]) - times[k]) * 1e-6)
    gaps = np.diff(times) * 1e-6
    return {
        "packets_heard": len(times),
        "ticks_with_three_predictions": len(to_published),
        "datagram_to_third_prediction_published_ms": _percentiles(to_published),
        "datagram_to_third_prediction_heard_ms": _percentiles(to_heard),
        "between_packets_ms": _percentiles(gaps),
    }


def _percentiles(values: object) -> dict:
    return {f"p{q}": float(np.percentile(values, q)) for q in (50, 99)} | {"max": float(np.max(values))}


if __name__ == "__main__":
    print(run())
