"""From the samples at the socket to the three paths published, at 250 Hz NCOM and full CAN rate."""

import os
import time

import numpy as np
import psutil
import rclpy
from _suite import running_suite
from oxts_bridge.batch import decode_file
from rclpy.node import Node
from rclpy.qos import QoSProfile
from st_msgs.msg import Ncom, Prediction, Steering
from st_ros.polling import PolledSubscription
from st_ros.stamps import to_nanoseconds

MODELS = ("kinematic", "linear", "nonlinear")
PERIOD = 0.05  # s; messages wait in the middleware, each with the time it arrived


class Listener(Node):
    """Notes when what each start state is made of reached the host, and when its last prediction was published.

    Receive times are the kernel's. The virtual car's steering latency is zero: the stamp of its angle is the receive
    time of its frame.
    """

    def __init__(self) -> None:
        super().__init__("latency_listener")
        self.packets: list[tuple[int, bytes]] = []  # (received [ns], as sent)
        self.steering: list[int] = []  # received [ns]
        self.predictions: list[tuple[int, int, int]] = []  # (start, issued, heard) [ns]
        qos = QoSProfile(depth=1000)
        self._packets = PolledSubscription(self, Ncom, "ins/ncom", qos)
        self._steering = PolledSubscription(self, Steering, "vehicle/steering", qos)
        self._models = [PolledSubscription(self, Prediction, f"predictor/{m}/prediction", qos) for m in MODELS]

    def take(self) -> None:
        self.packets += [(to_nanoseconds(message.header.stamp), bytes(message.raw_packet))
                         for message, _, _ in self._packets.take()]
        self.steering += [to_nanoseconds(message.header.stamp) for message, _, _ in self._steering.take()]
        for subscription in self._models:
            self.predictions += [(to_nanoseconds(message.header.stamp), to_nanoseconds(message.issued_at), arrived)
                                 for message, arrived, _ in subscription.take()]


def run() -> dict:
    """Latency [ms]: both samples of a start at the host -> last of three predictions published, and -> heard.

    cpu_percent: of a core, per process. ST_BENCH_SECONDS, ST_BENCH_NCOM_RATE [Hz] change the run.
    """
    seconds = float(os.environ.get("ST_BENCH_SECONDS", "60"))
    with running_suite(seconds + 10, int(os.environ.get("ST_BENCH_NCOM_RATE", "250"))) as suite:
        rclpy.init()
        node = Listener()
        pids = {child.name: child.process.pid for child in suite.children}
        before, begin = {name: cpu_seconds(pid) for name, pid in pids.items()}, time.monotonic()
        while time.monotonic() < begin + seconds:
            node.take()
            time.sleep(PERIOD)
        took = time.monotonic() - begin
        used = {name: 100.0 * (cpu_seconds(pid) - before[name]) / took for name, pid in pids.items()}
        node.destroy_node()
        rclpy.try_shutdown()
    return _evaluate(node) | {"cpu_percent": {name: round(percent, 1) for name, percent in used.items()}}


def cpu_seconds(pid: int) -> float:
    """User and system time of a process so far."""
    times = psutil.Process(pid).cpu_times()
    return times.user + times.system


def latencies(node: Listener) -> tuple[list[float], list[float]]:
    """Of each tick with three predictions [ms]: both samples at the host -> last one published, and -> last heard."""
    packets = decode_file(b"".join(raw for _, raw in node.packets))
    received = np.array([stamp for stamp, _ in node.packets])
    of_start: dict[int, list[tuple[int, int]]] = {}
    for start, issued, heard in node.predictions:
        of_start.setdefault(start, []).append((issued, heard))
    to_published, to_heard = [], []
    for start, three in of_start.items():
        # A start is the newest instant at which both are known: the first packet measured then or later, found by the
        # stamp it carries, and the first steering angle of then or later.
        packet = int(np.searchsorted(packets.utc_ns, start))
        angle = int(np.searchsorted(node.steering, start))
        if len(three) == len(MODELS) and packet < len(received) and angle < len(node.steering):
            known = max(received[packet], node.steering[angle])
            to_published.append((max(issued for issued, _ in three) - known) * 1e-6)
            to_heard.append((max(heard for _, heard in three) - known) * 1e-6)
    return to_published, to_heard


def _evaluate(node: Listener) -> dict:
    to_published, to_heard = latencies(node)
    gaps = np.diff([stamp for stamp, _ in node.packets]) * 1e-6
    return {
        "packets_heard": len(node.packets),
        "ticks_with_three_predictions": len(to_published),
        "samples_to_third_prediction_published_ms": _percentiles(to_published),
        "samples_to_third_prediction_heard_ms": _percentiles(to_heard),
        "between_packets_ms": _percentiles(gaps),
    }


def _percentiles(values: object) -> dict:
    return {f"p{q}": float(np.percentile(values, q)) for q in (50, 99)} | {"max": float(np.max(values))}


if __name__ == "__main__":
    print(run())
