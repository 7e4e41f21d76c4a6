"""Adaptive bands: scores of earlier predictions, which become available one horizon later, correct the band factor.

For one model, mode and level with half-widths c s(t), and the score S = max over t, a of |e_a(t)| / s_a(t):

    log c  <-  log c + g w (1{S > c_issued} - (1 - level))

a: along, across or yaw; w: time between the starts of this and the previously scored prediction [s], at most 1 s;
c_issued: the factor issued with the prediction. For any distribution of the errors, if c stays between MIN_FACTOR and
MAX_FACTOR for T seconds, the fraction of this time outside the band differs from 1 - level by at most

    (log(MAX / MIN) + g D) / (g T),         D: horizon [s]

This guarantees the coverage in the long run, but not for the next prediction or a single minute. The gain g decreases
from START_GAIN to GAIN with time constant SETTLING_TIME. Without a calibrated scale, s is the root mean square of the
errors of the run, exponentially weighted (SCALE_FORGETTING).
Source: Gibbs and Candes, Adaptive conformal inference under distribution shift, NeurIPS 2021; as a quantile tracker:
Angelopoulos, Candes and Tibshirani, Conformal PID control for time series prediction, NeurIPS 2023. Checked by:
test_bands_adaptive.py.
"""

import math
from collections import deque

import numpy as np

from ..timeseries import NANOSECOND
from .calibration import LEVELS, Band

GAIN, START_GAIN, SETTLING_TIME = 0.1, 0.3, 30.0  # 1/s, 1/s, s; bands are 5 % wider than with the best constant factor
MIN_FACTOR, MAX_FACTOR = 0.05, 100.0  # 1; far below and above calibrated factors
DEFAULT_FACTORS = {0.5: 1.6, 0.9: 3.0}  # median and 90 % quantile of the largest of 300 correlated normal errors
SCALE_FORGETTING = 120.0  # s; averaging time of the squared errors, which contains most manoeuvres on a road
DEFAULT_SCALE = (0.3, 0.3, 0.02)  # m, m, rad at 1 s ahead, proportional to the squared time; errors soon replace it
WARM_UP = 120.0  # s of scored driving before a band without a calibration is issued
PRIOR_WEIGHT = 5.0  # s; weight of DEFAULT_SCALE against the errors
MIN_SQUARED_ERROR = 1.0e-8  # m^2, m^2, rad^2; keeps the scale above 0
MAX_WEIGHT = 1.0  # s; longest time that one score represents, also after a pause
MAX_WAITING = 10_000  # number of predictions stored until their scores arrive


class AdaptiveBand:
    """The band of one model and mode. time: (points,) ahead, without the start [s]. band: calibrated band; None to
    estimate the band from the errors of the run alone."""

    def __init__(self, time: np.ndarray, band: Band | None = None):
        self._time, self._band, self.is_calibrated = np.asarray(time, float), band, band is not None
        self._logs = {}  # logarithm of the factor, by level
        known = {} if band is None else band.factors
        for level in LEVELS:
            # Without a factor of this level, that of the nearest level is scaled by the ratio of the default factors.
            nearest = min(known, key=lambda other: abs(other - level), default=level)
            default, of_nearest = np.interp((level, nearest), list(DEFAULT_FACTORS), list(DEFAULT_FACTORS.values()))
            self._logs[level] = math.log(known.get(nearest, default) * default / of_nearest)
        self._squares = np.square(np.outer(self._time**2, DEFAULT_SCALE))
        self._weight = self._elapsed = 0.0
        self._last_ns: int | None = None
        self._issued: deque[tuple[int, np.ndarray, dict[float, float]]] = deque()
        self._pending: deque[tuple[int, np.ndarray]] = deque()

    @property
    def remaining_warm_up(self) -> float:
        """Scored driving [s] still required before the band is issued; 0 with a calibration."""
        return 0.0 if self._band else max(WARM_UP - self._elapsed, 0.0)

    @property
    def factors(self) -> dict[float, float]:
        """Factor by level, not decreasing with the level."""
        values = np.maximum.accumulate([math.exp(log) for log in self._logs.values()])
        return dict(zip(self._logs, values.tolist(), strict=True))

    def issue(self, start_ns: int, scale: np.ndarray | None = None) -> dict[float, np.ndarray]:
        """Half-widths (points, 3) [m, m, rad] by level for a prediction from start_ns; stored until its score arrives.

        scale: (points, 3) [m, m, rad] of the calibrated band; None: RMS error of the run.
        """
        scale, factors = np.sqrt(self._squares) if scale is None else scale, self.factors
        if self._issued and start_ns <= self._issued[-1][0]:  # after a jump back in time, their scores never arrive
            self._issued.clear()
        self._issued.append((start_ns, scale, factors))
        if len(self._issued) > MAX_WAITING:
            self._issued.popleft()
        return {level: factor * scale for level, factor in factors.items()}

    def observe(self, start_ns: int, errors: np.ndarray) -> dict[float, bool]:
        """Correct the factors, and a scale estimated from the run, by errors (points, 3) [m, m, rad] in the predicted
        frame. Call in order of time. Returns, by level, whether the whole path was inside; empty without `issue` for
        this start, or with an error that is not finite.
        """
        while self._issued and self._issued[0][0] < start_ns:
            self._issued.popleft()
        if not self._issued or self._issued[0][0] != start_ns or not np.isfinite(errors).all():
            return {}
        _, scale, factors = self._issued.popleft()
        interval = MAX_WEIGHT if self._last_ns is None else (start_ns - self._last_ns) * NANOSECOND
        weight = min(max(interval, 0.0), MAX_WEIGHT)
        self._last_ns = start_ns
        gain = GAIN + (START_GAIN - GAIN) * math.exp(-self._elapsed / SETTLING_TIME)
        self._elapsed += weight
        score = float((np.abs(errors) / scale).max())
        for level, issued in factors.items():
            updated = self._logs[level] + gain * weight * (float(score > issued) - (1.0 - level))
            self._logs[level] = min(max(updated, math.log(MIN_FACTOR)), math.log(MAX_FACTOR))
        if self._band is None:  # the running mean square of the errors, forgotten after SCALE_FORGETTING
            self._weight = min(self._weight + weight, SCALE_FORGETTING)
            fraction = weight / (self._weight + PRIOR_WEIGHT)
            self._squares += fraction * (np.maximum(np.square(errors), MIN_SQUARED_ERROR) - self._squares)
        return {level: score <= issued for level, issued in factors.items()}

    def replay(self, starts_ns: np.ndarray, conditions: np.ndarray,
               errors: np.ndarray) -> tuple[dict[float, np.ndarray], np.ndarray]:
        """(factors (n,) by level, scales (n, points, 3)) along a drive, from the scores available at each start.

        Continues the previous call. starts_ns: (n,) ascending [ns]. conditions: (n, 4). errors: (n, points, 3) in the
        predicted frame; NaN if not scored.
        """
        calibrated = None if self._band is None else self._band.scale(conditions)
        horizon_ns = round(float(self._time[-1]) / NANOSECOND)
        factors: dict[float, list[float]] = {level: [] for level in self._logs}
        scales = np.empty(errors.shape)
        for k, start in enumerate(starts_ns.tolist()):
            while self._pending and self._pending[0][0] + horizon_ns <= start:
                self.observe(*self._pending.popleft())
            scales[k] = np.sqrt(self._squares) if calibrated is None else calibrated[k]
            self.issue(start, scales[k])
            self._pending.append((start, errors[k]))
            for level, factor in self.factors.items():
                factors[level].append(factor)
        return {level: np.array(values) for level, values in factors.items()}, scales
