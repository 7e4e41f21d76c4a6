"""Whether a decoded signal can be what it is called: inside its range, and no faster than anything can move."""

from collections import deque

from .signals import SignalSpec

# A verdict needs this many frames, one second of a 100 Hz signal; a stray frame must not condemn a good DBC.
_WINDOW = 100
_TOLERATED = 10


class Plausibility:
    """Judges the values of one signal, newest frame by newest frame.

    A swapped byte order shows on a turning wheel at once: one step of the low byte becomes a jump of 256 steps.
    """

    def __init__(self, spec: SignalSpec, period: float, timeout: float):
        """period: seconds between frames. timeout: seconds after which a value says nothing about the next."""
        self._spec = spec
        self._period = period
        self._remember_ns = int(timeout * 1e9)
        self._last: tuple[int, float] | None = None
        self._recent: deque[bool] = deque(maxlen=_WINDOW)
        self.implausible = 0

    def accepts(self, si: float, time_ns: int) -> bool:
        """Whether this value [SI] is possible. A jump is judged against the value before it, possible or not."""
        value = si / self._spec.factor
        possible = self._spec.minimum <= value <= self._spec.maximum and self._reachable(value, time_ns)
        self._last = (time_ns, value)
        self._recent.append(possible)
        self.implausible += not possible
        return possible

    def _reachable(self, value: float, time_ns: int) -> bool:
        if self._last is None or not 0 < time_ns - self._last[0] <= self._remember_ns:
            return True
        # Frames can arrive closer together than they were sent: no shorter than the period counts.
        elapsed = max((time_ns - self._last[0]) * 1e-9, self._period)
        reach = self._spec.max_rate * elapsed
        return abs(value - self._last[1]) <= reach

    @property
    def nonsense(self) -> str:
        """Why the signal is not to be used at present, empty when it is fine; good frames heal it."""
        bad = self._recent.count(False)
        if bad <= _TOLERATED:
            return ""
        spec = self._spec
        return (f"{spec.dbc.name} decodes to nonsense: {bad} of the last {len(self._recent)} frames are outside "
                f"{spec.minimum:g} .. {spec.maximum:g} {spec.unit} or jump faster than {spec.max_rate:g} {spec.unit}/s;"
                " check byte order, start bit and factor in the DBC")
