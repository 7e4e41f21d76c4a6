"""Checks the range and the rate of change of a signal, live frame by frame, or in all frames of a log at once."""

from collections import deque
from collections.abc import Iterable

import numpy as np

from .signals import MessageSpec, SignalSpec

# If more than MAX_IMPLAUSIBLE of the last PLAUSIBILITY_FRAMES values of a signal (1 s at 100 Hz) are implausible, even
# plausible values are withheld until MAX_IMPLAUSIBLE in a row are plausible: a wrong DBC also yields some of these.
PLAUSIBILITY_FRAMES, MAX_IMPLAUSIBLE = 100, 10

Reference = tuple[int, float]  # (time [ns], value in the unit of the signal) of an earlier frame


def _is_reachable(signal: SignalSpec, message: MessageSpec, value: float, time_ns: int,
                  references: Iterable[Reference | None]) -> bool:
    """Whether the rate limit permits the change from any reference; True if no reference is within the timeout."""
    recent = [(last_ns, last) for last_ns, last in filter(None, references)
              if 0 < time_ns - last_ns <= message.timeout_ns]
    # An elapsed time of at least one period is assumed, because frames can arrive closer together than they were sent.
    return not recent or any(
        abs(value - last) <= signal.max_rate * max((time_ns - last_ns) * 1e-9, message.period)
        for last_ns, last in recent)


class Plausibility:
    """Checks the range and the rate of change of one signal, frame by frame. It detects, for example, a wrong byte
    order while the steering wheel turns: a change by 1 becomes a change by 256."""

    def __init__(self, signal: SignalSpec, message: MessageSpec):
        self._signal, self._message = signal, message
        self._previous: Reference | None = None  # previous frame if it is in range
        self._last_plausible: Reference | None = None
        self._recent: deque[bool] = deque(maxlen=PLAUSIBILITY_FRAMES)

    def accepts(self, value_si: float, time_ns: int) -> bool:
        """Whether this value [SI] is in range and reachable from the previous value or from the last plausible one. A
        single outlier or true step therefore invalidates only one frame. Values out of range are never a reference."""
        signal = self._signal
        value = value_si / signal.factor
        in_range = signal.minimum <= value <= signal.maximum
        plausible = in_range and _is_reachable(signal, self._message, value, time_ns,
                                               (self._previous, self._last_plausible))
        self._previous = (time_ns, value) if in_range else None
        if plausible:
            self._last_plausible = self._previous
        self._recent.append(plausible)
        return plausible

    @property
    def fault(self) -> str:
        """Reason why plausible values of the signal are currently withheld too; empty if they are not."""
        count = self._recent.count(False)
        if count <= MAX_IMPLAUSIBLE or all(list(self._recent)[-MAX_IMPLAUSIBLE:]):
            return ""
        signal = self._signal
        return (f"{signal.dbc.name} decodes to implausible values in {count} of the last {len(self._recent)} frames: "
                f"outside {signal.minimum:g} .. {signal.maximum:g} {signal.unit}, or changing faster than "
                f"{signal.max_rate:g} {signal.unit}/s; check the sensor, and start bit, byte order, factor in the DBC")


def find_plausible_frames(signal: SignalSpec, message: MessageSpec, time_ns: np.ndarray,
                          values: np.ndarray) -> np.ndarray:
    """Mask (n,) of the frames with a value in range and within the rate limit, without those that are isolated among
    implausible frames. Unlike in `Plausibility`, the first plausible frames after implausible ones are accepted.
    time_ns, values [SI]: (n,), of the frames of a log that contain the signal."""
    physical, frames = values / signal.factor, np.arange(len(values))
    in_range = (physical >= signal.minimum) & (physical <= signal.maximum)
    elapsed_ns = np.diff(time_ns)
    plausible = np.zeros(len(values), dtype=bool)
    plausible[1:] = in_range[1:] & in_range[:-1] & (elapsed_ns > 0) & (elapsed_ns <= message.timeout_ns) & (
        np.abs(np.diff(physical)) <= signal.max_rate * np.maximum(elapsed_ns * 1e-9, message.period))
    last_plausible = np.maximum.accumulate(np.where(plausible, frames, -1))
    last_accepted = -1
    for frame in np.flatnonzero(in_range & ~plausible).tolist():  # a jump, or no previous frame to compare with
        earlier = (max(last_accepted, int(last_plausible[frame])), frame - 1 if in_range[frame - 1] else -1)
        references = [(int(time_ns[k]), float(physical[k])) for k in earlier if k >= 0]
        if _is_reachable(signal, message, float(physical[frame]), int(time_ns[frame]), references):
            plausible[frame], last_accepted = True, frame
    count = np.concatenate(([0], np.cumsum(~plausible)))  # number of implausible frames before each frame
    recent = count[1:] - count[np.maximum(frames + 1 - PLAUSIBILITY_FRAMES, 0)]
    _, run, lengths = np.unique(count[1:][plausible], return_inverse=True, return_counts=True)
    isolated = np.zeros(len(values), dtype=bool)
    isolated[plausible] = lengths[run] < MAX_IMPLAUSIBLE
    return plausible & ~((recent > MAX_IMPLAUSIBLE) & isolated)
