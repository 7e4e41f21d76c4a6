"""The second-order low-pass that units announce in channels 63 and 74 and leave to the receiver to apply.

    y0 = b0 x0 + b1 x1 + b2 x2 - a1 y1 - a2 y2,    K = tan(pi fc/fs),  D = K^2 + 2 z K + 1,
    b = (K^2, 2 K^2, K^2)/D,  a1 = 2 (K^2 - 1)/D,  a2 = (K^2 - 2 z K + 1)/D

Source: ncom.md section 10. Checked by: tests/golden/test_ncom_vectors.py (case filters).
"""

from math import pi, tan

# Two successive steps must agree this closely before a sampling rate is read off them.
_STEP_TOLERANCE = 0.01


class LowPass:
    """One signal. output: None until three evenly timed samples and a setting with fc < fs/2 are there; the input
    when off."""

    def __init__(self) -> None:
        self.output: float | None = None
        self._off = False
        self._setting: tuple[float, float] | None = None
        self._running = False
        self._times: list[float] = []
        self._inputs: list[float] = []
        self._outputs = [0.0, 0.0, 0.0]
        self._b = self._a = (0.0, 0.0, 0.0)

    def configure(self, cutoff: float | None, damping: float | None) -> None:
        """cutoff [Hz], damping ratio; both 0: filter off; None (the unit says invalid): as before."""
        if cutoff is None or damping is None:
            return
        self._off = cutoff == 0 and damping == 0
        if cutoff > 0 and damping > 0 and (cutoff, damping) != self._setting:
            self._setting = (cutoff, damping)
            self._start()

    def feed(self, time: float, value: float) -> float | None:
        """Take a sample [s]; returns the output for it."""
        if self._off:
            self.output = value
            return value
        self._times = [*self._times[-2:], time]
        self._inputs = [*self._inputs[-2:], value]
        if self._running:
            self._outputs = [*self._outputs[1:], 0.0]
            self._outputs[2] = self._next(self._inputs, self._outputs)
        else:
            self._start()
        self.output = self._outputs[2] if self._running else None
        return self.output

    def _start(self) -> None:
        self._running = False
        if self._setting is None or len(self._times) < 3:
            return
        older, newer = self._times[1] - self._times[0], self._times[2] - self._times[1]
        if not (newer > 0 and older > 0 and abs(older / newer - 1) < _STEP_TOLERANCE):
            return
        cutoff, damping = self._setting
        ratio = cutoff * (newer + older) / 2
        if ratio >= 0.5:
            return
        k = tan(pi * ratio)
        d = k * k + 2 * damping * k + 1
        self._b = (k * k / d, 2 * k * k / d, k * k / d)
        self._a = (1.0, 2 * (k * k - 1) / d, (k * k - 2 * damping * k + 1) / d)
        x2, x1, _ = self._inputs
        self._outputs = [x2, 0.0, 0.0]
        self._outputs[1] = self._next([x2, x2, x1], [x2, x2, 0.0])
        self._outputs[2] = self._next(self._inputs, self._outputs)
        self._running = True

    def _next(self, inputs: list[float], outputs: list[float]) -> float:
        b, a = self._b, self._a
        return b[0] * inputs[2] + b[1] * inputs[1] + b[2] * inputs[0] - a[1] * outputs[1] - a[2] * outputs[0]
