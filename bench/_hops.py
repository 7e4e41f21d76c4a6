"""Latency of a prediction from both sockets to a subscriber, divided at every available stamp.

"Received" is the middleware's stamp in the listener, a process on the same machine; messages reach the predictor at
about the same time.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

# Begin and end of each hop, by its name.
HOPS = {
    "INS: kernel -> odometry written": ("packet", "odometry_written"),
    "INS: odometry written -> received": ("odometry_written", "odometry_received"),
    "CAN: kernel -> steering written": ("frame", "steering_written"),
    "CAN: steering written -> received": ("steering_written", "steering_received"),
    "both received -> first model begins": ("complete", "begun"),
    "first model begins -> last prediction issued": ("begun", "issued"),
    "last prediction issued -> written": ("issued", "written"),
    "last prediction written -> received": ("written", "received"),
    "all: both in the kernel -> last prediction received": ("known", "received"),
}
# A new subscription receives the first messages late, all at once.
SETTLE_NS = 1_000_000_000
COMPUTE = "of which in the models"


@dataclass(frozen=True)
class Stream:
    """Samples of one input, in order. stamp: of the measurement; kernel, written, received: later stamps; all in ns."""

    stamp: np.ndarray
    kernel: np.ndarray
    written: np.ndarray
    received: np.ndarray

    def first_from(self, start: int) -> int | None:
        """Row of the first sample measured at `start` or later; None at the end and before the listener has settled."""
        row = int(np.searchsorted(self.stamp, start))
        return row if row < len(self.stamp) and start >= self.stamp[0] + SETTLE_NS else None


@dataclass(frozen=True)
class Issued:
    """One prediction: issued, written, received, and the processor time of its model; all in ns."""

    issued: int
    written: int
    received: int
    compute: int


def marks(start: int, odometry: Stream, steering: Stream, made: Sequence[Issued]) -> dict[str, int] | None:
    """Instants of a tick and compute time of its models [ns]; None if one of its samples was not received.

    start: instant of its state, the newest at which both inputs were known.
    """
    ins, angle = odometry.first_from(start), steering.first_from(start)
    if ins is None or angle is None:
        return None
    last = max(made, key=lambda one: one.issued)
    found = {
        "packet": int(odometry.kernel[ins]), "odometry_written": int(odometry.written[ins]),
        "odometry_received": int(odometry.received[ins]), "frame": int(steering.kernel[angle]),
        "steering_written": int(steering.written[angle]), "steering_received": int(steering.received[angle]),
        "begun": min(one.issued - one.compute for one in made), "issued": last.issued, "written": last.written,
        "received": max(one.received for one in made), "compute": sum(one.compute for one in made),
    }
    return found | {"known": max(found["packet"], found["frame"]),
                    "complete": max(found["odometry_received"], found["steering_received"])}


def hops(ticks: Sequence[Mapping[str, int]]) -> dict[str, dict[str, float]]:
    """Median, 99 % quantile and maximum [ms] by name of the hop, in the order of the path."""
    rows: dict[str, dict[str, float]] = {}
    for name, (begin, end) in HOPS.items():
        rows[name] = percentiles([(tick[end] - tick[begin]) * 1e-6 for tick in ticks])
        if end == "issued":
            rows[COMPUTE] = percentiles([tick["compute"] * 1e-6 for tick in ticks])
    return rows


def percentiles(values: object) -> dict[str, float]:
    return {f"p{q}": float(np.percentile(values, q)) for q in (50, 99)} | {"max": float(np.max(values))}
