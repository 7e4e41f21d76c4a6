"""Where the time of a prediction goes: the way from both sockets to a subscriber, cut at every stamp there is.

"Heard" is the middleware's stamp in the listener, another process than the predictor on the same machine: what
the predictor itself hears arrives about then.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

# From a mark to a later one, by the name of the hop.
HOPS = {
    "INS: kernel -> odometry written": ("packet", "odometry_written"),
    "INS: odometry written -> heard": ("odometry_written", "odometry_heard"),
    "CAN: kernel -> steering written": ("frame", "steering_written"),
    "CAN: steering written -> heard": ("steering_written", "steering_heard"),
    "both heard -> first model begins": ("complete", "begun"),
    "first model begins -> last prediction issued": ("begun", "issued"),
    "last prediction issued -> written": ("issued", "written"),
    "last prediction written -> heard": ("written", "heard"),
    "all: both in the kernel -> last prediction heard": ("known", "heard"),
}
# A subscription that is new gets the first messages late, all at once.
SETTLE_NS = 1_000_000_000
COMPUTE = "of it in the models"


@dataclass(frozen=True)
class Stream:
    """Samples of one input, in order. stamp: of the measurement; kernel, written, heard: on the way; all in ns."""

    stamp: np.ndarray
    kernel: np.ndarray
    written: np.ndarray
    heard: np.ndarray

    def first_from(self, start: int) -> int | None:
        """The first sample measured at an instant or later; None before the listener had settled, and at the end."""
        row = int(np.searchsorted(self.stamp, start))
        return row if row < len(self.stamp) and start >= self.stamp[0] + SETTLE_NS else None


@dataclass(frozen=True)
class Made:
    """One prediction: issued, written, heard [ns], and the time its model took [ns]."""

    issued: int
    written: int
    heard: int
    compute: int


def marks(start: int, odometry: Stream, steering: Stream, made: Sequence[Made]) -> dict[str, int] | None:
    """The instants [ns] of a tick, and `compute`; None where a sample of it was not heard.

    start: instant of its state, the newest at which both inputs were known.
    """
    ins, angle = odometry.first_from(start), steering.first_from(start)
    if ins is None or angle is None:
        return None
    last = max(made, key=lambda one: one.issued)
    found = {
        "packet": int(odometry.kernel[ins]), "odometry_written": int(odometry.written[ins]),
        "odometry_heard": int(odometry.heard[ins]), "frame": int(steering.kernel[angle]),
        "steering_written": int(steering.written[angle]), "steering_heard": int(steering.heard[angle]),
        "begun": min(one.issued - one.compute for one in made), "issued": last.issued, "written": last.written,
        "heard": max(one.heard for one in made), "compute": sum(one.compute for one in made),
    }
    return found | {"known": max(found["packet"], found["frame"]),
                    "complete": max(found["odometry_heard"], found["steering_heard"])}


def hops(ticks: Sequence[Mapping[str, int]]) -> dict[str, dict[str, float]]:
    """Name of the hop -> median, 99 % and longest [ms], in the order of the way."""
    rows: dict[str, dict[str, float]] = {}
    for name, (begin, end) in HOPS.items():
        rows[name] = percentiles([(tick[end] - tick[begin]) * 1e-6 for tick in ticks])
        if end == "issued":
            rows[COMPUTE] = percentiles([tick["compute"] * 1e-6 for tick in ticks])
    return rows


def percentiles(values: object) -> dict[str, float]:
    return {f"p{q}": float(np.percentile(values, q)) for q in (50, 99)} | {"max": float(np.max(values))}
