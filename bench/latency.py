"""Latency from the samples at the socket to the three published paths, at 250 Hz NCOM and full CAN rate.

It is split at every available time stamp. The time of receipt of a message is that in the middleware of the listener, a
process on the same machine; the predictor receives it at about the same time.
"""

import os
import time
from contextlib import ExitStack

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


class Listener(Node):
    """Records when samples reached the host and were published, and when predictions were published, in rows of ns."""

    def __init__(self) -> None:
        super().__init__("latency_listener")
        self.packets: list[tuple[int, bytes]] = []  # (received, as sent)
        self.odometry: list[tuple[int, int, int]] = []  # (stamp, written, received)
        self.angles: list[tuple[int, int, int]] = []  # (stamp, written, received)
        # (start, issued, written, received, processor time of the model).
        self.predictions: list[tuple[int, int, int, int, int]] = []
        qos = QoSProfile(depth=1000)
        self._packets = PolledSubscription(self, Ncom, "ins/ncom", qos)
        self._odometry = PolledSubscription(self, Odometry, "ins/odometry", qos)
        self._steering = PolledSubscription(self, Steering, "vehicle/steering", qos)
        self._models = [PolledSubscription(self, Prediction, f"predictor/{m}/prediction", qos) for m in MODELS]

    def take(self) -> None:
        self.packets += [(to_nanoseconds(message.header.stamp), bytes(message.raw_packet))
                         for message, _, _ in self._packets.take()]
        for rows, subscription in ((self.odometry, self._odometry), (self.angles, self._steering)):
            rows += [(to_nanoseconds(message.header.stamp), sent, received)
                     for message, received, sent in subscription.take()]
        for subscription in self._models:
            self.predictions += [
                (to_nanoseconds(message.header.stamp), to_nanoseconds(message.issued_at), sent, received,
                 round(message.compute_time * 1e9)) for message, received, sent in subscription.take()]


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


def collect_ticks(node: Listener) -> dict[str, np.ndarray]:
    """Instants of the ticks for which all samples and predictions were received, and processor time of their models;
    all [ns].

    A tick predicts from the newest instant at which both inputs were known: its samples are the first from then on.
    """
    packets = decode_file(b"".join(raw for _, raw in node.packets))
    kernel = dict(zip(packets.utc_ns.tolist(), (stamp for stamp, _ in node.packets), strict=True))
    ins = np.array([(stamp, kernel[stamp], *later) for stamp, *later in sorted(node.odometry) if stamp in kernel])
    # The steering latency of the virtual car is zero, so that the stamp of an angle is that of the kernel.
    steering = np.array([(stamp, stamp, *later) for stamp, *later in sorted(node.angles)])
    predictions = np.array(sorted(node.predictions))
    starts, first, counts = np.unique(predictions[:, 0], return_index=True, return_counts=True)
    chosen = (counts == len(MODELS)) & (starts >= max(ins[0, 0], steering[0, 0]) + SETTLING_TIME_NS)
    chosen &= starts <= min(ins[-1, 0], steering[-1, 0])
    ins, steering = (rows[np.searchsorted(rows[:, 0], starts[chosen])] for rows in (ins, steering))
    rows = predictions[first[chosen][:, None] + np.arange(len(MODELS))]  # (ticks, models, 5), in the order of issue
    ticks = {"packet": ins[:, 1], "odometry_written": ins[:, 2], "odometry_received": ins[:, 3],
             "frame": steering[:, 1], "steering_written": steering[:, 2], "steering_received": steering[:, 3],
             "first_model_started": (rows[:, :, 1] - rows[:, :, 4]).min(axis=1), "issued": rows[:, -1, 1],
             "written": rows[:, -1, 2], "received": rows[:, :, 3].max(axis=1), "compute": rows[:, :, 4].sum(axis=1)}
    return ticks | {"both_in_kernel": np.maximum(ticks["packet"], ticks["frame"]),
                    "both_received": np.maximum(ticks["odometry_received"], ticks["steering_received"])}


def percentiles(duration_ns: np.ndarray) -> dict[str, float]:
    """Median, 99 % quantile and maximum [ms]."""
    return {f"p{q}": float(np.percentile(duration_ns, q)) * 1e-6 for q in (50, 99)} | {
        "max": float(np.max(duration_ns)) * 1e-6}


def _evaluate(node: Listener) -> dict:
    ticks, hops = collect_ticks(node), {}
    for name, (begin, end) in HOPS.items():
        hops[name] = percentiles(ticks[end] - ticks[begin])
        if end == "issued":
            hops["of which in the models"] = percentiles(ticks["compute"])
    return {
        "packets_received": len(node.packets),
        "ticks_with_three_predictions": len(ticks["issued"]),
        "samples_to_third_prediction_published_ms": percentiles(ticks["issued"] - ticks["both_in_kernel"]),
        "samples_to_third_prediction_received_ms": percentiles(ticks["received"] - ticks["both_in_kernel"]),
        "between_packets_ms": percentiles(np.diff([stamp for stamp, _ in node.packets])),
        "hops_ms": hops,
    }
