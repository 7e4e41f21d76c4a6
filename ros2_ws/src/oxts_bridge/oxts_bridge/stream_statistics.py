"""Figures over the stream for the diagnostics: rate, gaps, and how far the stamps are from the host's clock."""

from collections import deque
from dataclasses import dataclass
from statistics import median

from .stream import Received

# A step longer than this many usual ones is a gap.
GAP_STEPS = 1.75
# Offsets kept: four seconds at 250 Hz.
_KEPT = 1000


@dataclass
class Window:
    """Since the previous call of take(): packets, mean rate [1/s], gaps and the longest step [s]."""

    packets: int
    rate: float
    gaps: int
    longest: float


class StreamStatistics:
    """Fed with every fresh timed packet of the series (no triggers, nothing late: those are not part of the rhythm)."""

    def __init__(self) -> None:
        self.gaps = 0
        self._usual_ns = 0
        self._last_gps_ns: int | None = None
        self._offsets: deque[int] = deque(maxlen=_KEPT)
        self._window = [0, 0, 0, 0]  # packets, ns covered, gaps, longest step

    def add(self, received: Received) -> None:
        if received.gps_ns is None:
            return
        if self._last_gps_ns is not None:
            step = received.gps_ns - self._last_gps_ns
            if step > 0:
                self._step(step)
        self._last_gps_ns = received.gps_ns
        if received.received_ns is not None and received.utc_ns is not None:
            self._offsets.append(received.utc_ns - received.received_ns)

    def _step(self, step: int) -> None:
        window = self._window
        window[0] += 1
        window[1] += step
        window[3] = max(window[3], step)
        if not self._usual_ns:
            self._usual_ns = step
        elif step > GAP_STEPS * self._usual_ns:
            window[2] += 1
            self.gaps += 1
            # Slowly: a changed rate becomes the usual one, a lost packet hardly counts.
            self._usual_ns += min(step - self._usual_ns, self._usual_ns) // 64
        else:
            self._usual_ns += (step - self._usual_ns) // 64

    def take(self) -> Window:
        packets, covered, gaps, longest = self._window
        self._window = [0, 0, 0, 0]
        return Window(packets, packets / (covered * 1e-9) if covered else 0.0, gaps, longest * 1e-9)

    def newest_minus_host(self) -> float | None:
        """Time of the newest packet minus its receive time [s]."""
        return self._offsets[-1] * 1e-9 if self._offsets else None

    def stamp_minus_host(self) -> tuple[float, float] | None:
        """(median, the value 99 % are above) of packet time minus receive time [s]; negative: the packet is older."""
        offsets = sorted(self._offsets.copy())
        if not offsets:
            return None
        return median(offsets) * 1e-9, offsets[len(offsets) // 100] * 1e-9
