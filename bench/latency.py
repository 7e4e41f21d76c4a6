"""From the UDP datagram at the socket to the three paths published, at 250 Hz NCOM and full CAN rate."""

import os
import time

import numpy as np
import rclpy
from _suite import running_suite
from rclpy.node import Node
from rclpy.qos import QoSProfile
from st_msgs.msg import Ncom, Prediction
from st_ros.polling import PolledSubscription
from st_ros.stamps import to_nanoseconds

MODELS = ("kinematic", "linear", "nonlinear")


PERIOD = 0.05  # s; messages wait in the middleware, each with the time it arrived


class Listener(Node):
    """Notes when the datagram behind each start state reached the host, and when its last prediction was published."""

    def __init__(self) -> None:
        super().__init__("latency_listener")
        self.received: list[int] = []  # kernel receive time of each packet, ns
        self.predictions: list[tuple[int, str, int, int]] = []
        qos = QoSProfile(depth=1000)
        self._packets = PolledSubscription(self, Ncom, "ins/ncom", qos)
        self._models = [PolledSubscription(self, Prediction, f"predictor/{m}/prediction", qos) for m in MODELS]

    def take(self) -> None:
        self.received += [to_nanoseconds(message.header.stamp) for message, _, _ in self._packets.take()]
        for subscription in self._models:
            for message, arrived, _ in subscription.take():
                times = to_nanoseconds(message.header.stamp), to_nanoseconds(message.issued_at)
                self.predictions.append((times[0], message.model, times[1], arrived))


def run() -> dict:
    """Latency in ms: newest datagram used -> last of three predictions published, and -> received by a subscriber."""
    seconds = float(os.environ.get("ST_BENCH_SECONDS", "60"))
    with running_suite(seconds + 10):
        rclpy.init()
        node = Listener()
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            node.take()
            time.sleep(PERIOD)
        node.destroy_node()
        rclpy.try_shutdown()
    return _evaluate(node)


def latencies(node: Listener) -> tuple[list[float], list[float]]:
    """Of each tick with three predictions [ms]: newest datagram used -> last one published, and -> last one heard."""
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
    return to_published, to_heard


def _evaluate(node: Listener) -> dict:
    to_published, to_heard = latencies(node)
    times = np.array(sorted(node.received))
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
