"""Latency from the samples at the socket to the three published paths, at 250 Hz NCOM and full CAN rate."""

import os
import time
from contextlib import ExitStack

import numpy as np
import psutil
import rclpy
from _hops import IssuedPrediction, Stream, collect_instants, hop_durations, percentiles
from _suite import run_suite
from _view import attach_view
from nav_msgs.msg import Odometry
from oxts_bridge.file_decoder import decode_file
from rclpy.node import Node
from rclpy.qos import QoSProfile
from st_live.nodes.player import read_header_stamp
from st_msgs.msg import Ncom, Prediction, Steering
from st_ros.polling import PolledSubscription, to_nanoseconds

MODELS = ("kinematic", "linear", "nonlinear")
PERIOD = 0.05  # s between two calls of `take`; meanwhile messages wait in the middleware with their time of arrival


class Listener(Node):
    """Records when samples reached the host and were published, and when predictions were published."""

    def __init__(self) -> None:
        super().__init__("latency_listener")
        self.packets: list[tuple[int, bytes]] = []  # (received [ns], as sent)
        self.predictions: dict[int, list[IssuedPrediction]] = {}  # by start
        self.odometry: list[tuple[int, int, int]] = []  # (stamp, written, received) [ns]
        self.angles: list[tuple[int, int, int]] = []  # (stamp, written, received) [ns]
        qos = QoSProfile(depth=1000)
        self._packets = PolledSubscription(self, Ncom, "ins/ncom", qos)
        self._odometry = PolledSubscription(self, Odometry, "ins/odometry", qos, raw=True)
        self._steering = PolledSubscription(self, Steering, "vehicle/steering", qos)
        self._models = [PolledSubscription(self, Prediction, f"predictor/{m}/prediction", qos) for m in MODELS]

    def take(self) -> None:
        self.packets += [(to_nanoseconds(message.header.stamp), bytes(message.raw_packet))
                         for message, _, _ in self._packets.take()]
        self.odometry += [(read_header_stamp(data), sent, received) for data, received, sent in self._odometry.take()]
        self.angles += [(to_nanoseconds(message.header.stamp), sent, received)
                        for message, received, sent in self._steering.take()]
        for subscription in self._models:
            for message, received, sent in subscription.take():
                start, issued = to_nanoseconds(message.header.stamp), to_nanoseconds(message.issued_at)
                prediction = IssuedPrediction(issued, sent, received, round(message.compute_time * 1e9))
                self.predictions.setdefault(start, []).append(prediction)


def run() -> dict:
    """Latency [ms] from the arrival of both samples of a start until the last of three predictions is published and
    received, and duration of each hop (_hops.py).

    cpu_percent: load of each process, in per cent of a core. ST_BENCH_SECONDS and ST_BENCH_NCOM_RATE [Hz] change the
    run, as do the variables of _suite.py. ST_BENCH_VIEW=runs or hangs attaches a view.
    """
    seconds, attached = float(os.environ.get("ST_BENCH_SECONDS", "60")), os.environ.get("ST_BENCH_VIEW", "")
    rate = int(os.environ.get("ST_BENCH_NCOM_RATE", "250"))
    with ExitStack() as stack:
        suite = stack.enter_context(run_suite(seconds + (30 if attached else 10), rate))
        if attached:
            stack.enter_context(attach_view(suite, {"runs": False, "hangs": True}[attached]))
        rclpy.init()
        node = Listener()
        pids = {child.name: child.process.pid for child in suite.children}
        before, begin = {name: processor_time(pid) for name, pid in pids.items()}, time.monotonic()
        while time.monotonic() < begin + seconds:
            node.take()
            time.sleep(PERIOD)
        elapsed = time.monotonic() - begin
        loads = {name: 100.0 * (processor_time(pid) - before[name]) / elapsed for name, pid in pids.items()}
        node.destroy_node()
        rclpy.try_shutdown()
    return _evaluate(node) | {"cpu_percent": {name: round(percent, 1) for name, percent in loads.items()}}


def processor_time(pid: int) -> float:
    """User and system time of a process until now [s]."""
    times = psutil.Process(pid).cpu_times()
    return times.user + times.system


def collect_ticks(node: Listener) -> list[dict[str, int]]:
    """Instants of the ticks for which all samples and predictions were received; see `collect_instants`."""
    packets = decode_file(b"".join(raw for _, raw in node.packets))
    kernel = dict(zip(packets.utc_ns.tolist(), (stamp for stamp, _ in node.packets), strict=True))
    rows = [(stamp, kernel[stamp], *later) for stamp, *later in sorted(node.odometry) if stamp in kernel]
    ins = Stream(*np.array(rows, np.int64).reshape(-1, 4).T)
    # The steering latency of the virtual car is zero, so that the stamp of an angle is that of the kernel.
    rows = [(stamp, stamp, *later) for stamp, *later in sorted(node.angles)]
    steering = Stream(*np.array(rows, np.int64).reshape(-1, 4).T)
    ticks = [collect_instants(start, ins, steering, predictions) for start, predictions in node.predictions.items()
             if len(predictions) == len(MODELS)]
    return [tick for tick in ticks if tick is not None]


def latencies_ms(ticks: list[dict[str, int]], end: str = "issued") -> list[float]:
    """Time from the arrival of both samples of a tick to the instant `end` of its last prediction."""
    return [(tick[end] - tick["both_in_kernel"]) * 1e-6 for tick in ticks]


def _evaluate(node: Listener) -> dict:
    ticks = collect_ticks(node)
    return {
        "packets_received": len(node.packets),
        "ticks_with_three_predictions": len(ticks),
        "samples_to_third_prediction_published_ms": percentiles(latencies_ms(ticks)),
        "samples_to_third_prediction_received_ms": percentiles(latencies_ms(ticks, "received")),
        "between_packets_ms": percentiles(np.diff([stamp for stamp, _ in node.packets]) * 1e-6),
        "hops_ms": hop_durations(ticks),
    }
