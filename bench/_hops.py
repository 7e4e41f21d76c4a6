"""Latency of a prediction from the sockets of INS and CAN to a subscriber, split at every available time stamp.

The time of receipt of a message is that in the middleware of the listener, a process on the same machine; the predictor
receives it at about the same time.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

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
