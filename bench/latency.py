"""Latency from the samples at the socket to the three published paths, at 250 Hz NCOM and full CAN rate.

It is split at every available time stamp. The time of receipt of a message is that in the middleware of the listener, a
process on the same machine; the predictor receives it at about the same time.
"""

import os
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass

import numpy as np
import psutil
import rclpy
from nav_msgs.msg import Odometry
from oxts_bridge.file_decoder import decode_file
from rclpy.node import Node
from rclpy.qos import QoSProfile
from st_core.models import MODELS
from st_msgs.msg import Ncom, Prediction, Steering
from st_ros.polling import PolledSubscription, to_nanoseconds

from ._suite import attach_view, run_suite

PERIOD = 0.05  # s between two calls of `take`; meanwhile messages wait in the middleware with their time of arrival
# Name of each hop -> its first and last instant.
HOPS = {
    "INS: kernel -> odometry written": ("packet", "odometry_written"),
    "INS: odometry written -> received": ("odometry_written", "odometry_received"),
    "CAN: kernel -> steering written": ("frame", "steering_written"),
    "CAN: steering written -> received": ("steering_written", "steering_received"),
    "both received -> first model begins": ("both_received", "first_model_started"),
    "first model begins -> last prediction issued": ("first_model_started", "issued"),
    "last prediction issued -> written": ("issued", "written"),
    "last prediction written -> received": ("written", "received"),
    "all: both in the kernel -> last prediction received": ("both_in_kernel", "received"),
}
SETTLING_TIME_NS = 1_000_000_000  # a new subscription receives its first messages late and all at once
COMPUTE = "of which in the models"


@dataclass(frozen=True)
class Stream:
    """Samples of one input in order. stamp: measurement time; kernel, written, received: later stamps; all [ns]."""

    stamp: np.ndarray
    kernel: np.ndarray
    written: np.ndarray
    received: np.ndarray

    def first_from(self, start: int) -> int | None:
        """Row of the first sample measured at `start` or later; None after the last sample and in the settling time."""
        row = int(np.searchsorted(self.stamp, start))
        return row if row < len(self.stamp) and start >= self.stamp[0] + SETTLING_TIME_NS else None


@dataclass(frozen=True)
class IssuedPrediction:
    """A prediction: when it was issued, written and received, and the processor time of its model; all [ns]."""

    issued: int
    written: int
    received: int
    compute: int


def collect_instants(start: int, odometry: Stream, steering: Stream,
                     predictions: Sequence[IssuedPrediction]) -> dict[str, int] | None:
    """Instants of a tick and processor time of its models [ns]; None if one of its samples was not received.

    start: time of the predicted state, the newest at which both inputs were known.
    """
    ins, angle = odometry.first_from(start), steering.first_from(start)
    if ins is None or angle is None:
        return None
    last = max(predictions, key=lambda prediction: prediction.issued)
    instants = {
        "packet": int(odometry.kernel[ins]), "odometry_written": int(odometry.written[ins]),
        "odometry_received": int(odometry.received[ins]), "frame": int(steering.kernel[angle]),
        "steering_written": int(steering.written[angle]), "steering_received": int(steering.received[angle]),
        "first_model_started": min(prediction.issued - prediction.compute for prediction in predictions),
        "issued": last.issued, "written": last.written,
        "received": max(prediction.received for prediction in predictions),
        "compute": sum(prediction.compute for prediction in predictions),
    }
    return instants | {"both_in_kernel": max(instants["packet"], instants["frame"]),
                       "both_received": max(instants["odometry_received"], instants["steering_received"])}


def hop_durations(ticks: Sequence[Mapping[str, int]]) -> dict[str, dict[str, float]]:
    """Name of each hop, in the order of the path -> median, 99 % quantile and maximum of its duration [ms]."""
    rows: dict[str, dict[str, float]] = {}
    for name, (begin, end) in HOPS.items():
        rows[name] = percentiles([(tick[end] - tick[begin]) * 1e-6 for tick in ticks])
        if end == "issued":
            rows[COMPUTE] = percentiles([tick["compute"] * 1e-6 for tick in ticks])
    return rows


def percentiles(values: object) -> dict[str, float]:
    return {f"p{q}": float(np.percentile(values, q)) for q in (50, 99)} | {"max": float(np.max(values))}


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
        self._odometry = PolledSubscription(self, Odometry, "ins/odometry", qos)
        self._steering = PolledSubscription(self, Steering, "vehicle/steering", qos)
        self._models = [PolledSubscription(self, Prediction, f"predictor/{m}/prediction", qos) for m in MODELS]

    def take(self) -> None:
        self.packets += [(to_nanoseconds(message.header.stamp), bytes(message.raw_packet))
                         for message, _, _ in self._packets.take()]
        self.odometry += [(to_nanoseconds(message.header.stamp), sent, received)
                          for message, received, sent in self._odometry.take()]
        self.angles += [(to_nanoseconds(message.header.stamp), sent, received)
                        for message, received, sent in self._steering.take()]
        for subscription in self._models:
            for message, received, sent in subscription.take():
                start, issued = to_nanoseconds(message.header.stamp), to_nanoseconds(message.issued_at)
                prediction = IssuedPrediction(issued, sent, received, round(message.compute_time * 1e9))
                self.predictions.setdefault(start, []).append(prediction)


def run() -> dict:
    """Latency [ms] from the arrival of both samples of a start until the last of three predictions is published and
    received, and duration of each hop.

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
