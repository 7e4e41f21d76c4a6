"""Live bands: half-widths under the conditions at the start, their adaptation to scores, and their coverage.

A sequential test detects coverage significantly below the nominal level p; the alternative is q = ALTERNATIVE_RATIO p.
Each scored window contributes its log likelihood ratio:

    l = log((1 - q) / (1 - p))  if the path left the band,   log(q / p)  if it stayed inside
    S <- max(0, S + w l),     warning if S >= log(FALSE_WARNING_TIME)

Overlapping windows are not independent, so the weight w of a window is the time between the starts of the previous
window and this window, divided by the horizon, at most 1. S is then at most the log of a likelihood ratio averaged over
all sequences of windows spaced by a whole horizon (Jensen's inequality), so the test is an e-detector: if every path
stays inside with probability p or more given the past, the mean time to a false warning is at least FALSE_WARNING_TIME.
Source: Shin, Ramdas and Rinaldo, E-detectors, New England Journal of Statistics in Data Science 2023 (CUSUM type).
Checked by: test_bands_live.py. Measured false warnings and delays: docs/manual/bands.md.
"""

import math
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product

import numpy as np

from ..evaluation import Score
from ..log_evaluation import MODES
from ..measurement_history import DERIVATIVE, VELOCITY_X, YAW_RATE, MeasurementHistory
from ..timeseries import NANOSECOND
from .calibration import LEVELS, Band, ModelMode, to_predicted_frame
from .file import Bands
from .scale import MAX_LOG_SCALE, activity_instants, compute_magnitudes, compute_scalar_features, steering_activity

GAIN, START_GAIN, SETTLING_TIME = 0.1, 0.3, 30.0  # 1/s, 1/s, s; bands are 5 % wider than with the best constant factor
MIN_FACTOR, MAX_FACTOR = 0.05, 100.0  # 1; far below and far above any calibrated factor
DEFAULT_FACTORS = {0.5: 1.6, 0.9: 3.0}  # median and 90 % quantile of the largest of 300 correlated normal errors
SCALE_FORGETTING = 120.0  # s; averaging time of the squared errors; covers most manoeuvres on a road
DEFAULT_SCALE = (0.3, 0.3, 0.02)  # m, m, rad at 1 s ahead, proportional to the squared time; soon outweighed by errors
WARM_UP = 120.0  # s of scored driving before a band without a calibration is issued
PRIOR_WEIGHT = 5.0  # s; DEFAULT_SCALE has the weight of errors over this time
MIN_SQUARED_ERROR = 1.0e-8  # m^2, m^2, rad^2; keeps the scale above 0
MAX_WEIGHT = 1.0  # s; longest time that one score represents, even after a pause
MAX_WAITING_PREDICTIONS = 10_000  # largest number of predictions stored until their scores arrive
ALTERNATIVE_RATIO = 5.0 / 9.0  # q / p: 50 % coverage of a 90 % band; coverage above 73 % reduces S
FALSE_WARNING_TIME = 7200.0  # horizons; minimum mean time to a false warning: ten hours with horizons of 5 s
WARNING_END_FRACTION = 0.5  # of the limit of S; a warning ends when S falls below this fraction


class AdaptiveBand:
    """The band of one model and mode, corrected by the scores of predictions that started at least one horizon earlier.

    A level has half-widths c s(t). The score S = max over t, a of |e_a(t)| / s_a(t) updates its factor c:

        log c  <-  log c + g w (1{S > c_issued} - (1 - level))

    a: along, across or yaw; w: time between the starts of this and the previously scored prediction [s], at most 1 s;
    c_issued: the factor issued with the prediction. For any distribution of the errors, if c stays between MIN_FACTOR
    and MAX_FACTOR for T seconds, the fraction of this time outside the band differs from 1 - level by at most

        (log(MAX / MIN) + g D) / (g T),         D: horizon [s]

    This guarantees the coverage in the long run, but not for the next prediction or a single minute. The gain g
    decreases from START_GAIN to GAIN with time constant SETTLING_TIME. Without a calibrated scale, s is the root mean
    square of the errors of the run, exponentially weighted (SCALE_FORGETTING).
    Source: Gibbs and Candes, Adaptive conformal inference under distribution shift, NeurIPS 2021; as a quantile
    tracker: Angelopoulos, Candes and Tibshirani, Conformal PID control for time series prediction, NeurIPS 2023.
    Checked by: test_bands_adaptive.py.

    time: (points,) ahead, without the start [s]. band: the calibrated band; if None, the errors of the run alone
    determine the half-widths.
    """

    def __init__(self, time: np.ndarray, band: Band | None = None):
        self._time, self._band, self.is_calibrated = np.asarray(time, float), band, band is not None
        self._log_factors = {}  # by level
        calibrated_factors = {} if band is None else band.factors
        for level in LEVELS:
            # A level without a factor gets that of the nearest level, scaled by the ratio of the default factors.
            nearest = min(calibrated_factors, key=lambda other: abs(other - level), default=level)
            default, reference = np.interp((level, nearest), list(DEFAULT_FACTORS), list(DEFAULT_FACTORS.values()))
            self._log_factors[level] = math.log(calibrated_factors.get(nearest, default) * default / reference)
        self._squares = np.square(np.outer(self._time**2, DEFAULT_SCALE))
        self._weight = self._elapsed = 0.0
        self._last_ns: int | None = None
        self._issued_bands: deque[tuple[int, np.ndarray, dict[float, float]]] = deque()
        self._pending_errors: deque[tuple[int, np.ndarray]] = deque()

    @property
    def remaining_warm_up(self) -> float:
        """Scored driving [s] still required before the band is issued; 0 with a calibration."""
        return 0.0 if self._band else max(WARM_UP - self._elapsed, 0.0)

    @property
    def factors(self) -> dict[float, float]:
        """Factor by level, not decreasing with the level."""
        values = np.maximum.accumulate([math.exp(log) for log in self._log_factors.values()])
        return dict(zip(self._log_factors, values.tolist(), strict=True))

    def issue(self, start_ns: int, scale: np.ndarray | None = None) -> dict[float, np.ndarray]:
        """Half-widths (points, 3) [m, m, rad] by level for a prediction from start_ns, stored until it is scored.
        scale: (points, 3) [m, m, rad] of the calibrated band; None: RMS error of the run."""
        scale, factors = np.sqrt(self._squares) if scale is None else scale, self.factors
        if self._issued_bands and start_ns <= self._issued_bands[-1][0]:  # time jumped back: no score will follow
            self._issued_bands.clear()
        self._issued_bands.append((start_ns, scale, factors))
        if len(self._issued_bands) > MAX_WAITING_PREDICTIONS:
            self._issued_bands.popleft()
        return {level: factor * scale for level, factor in factors.items()}

    def observe(self, start_ns: int, errors: np.ndarray) -> None:
        """Update the factors, and the scale if it is estimated from the run, by the errors (points, 3) [m, m, rad] of a
        prediction in the predicted frame. Non-finite errors, and errors of a start without a band, are ignored. Call in
        order of time."""
        while self._issued_bands and self._issued_bands[0][0] < start_ns:
            self._issued_bands.popleft()
        if not self._issued_bands or self._issued_bands[0][0] != start_ns or not np.isfinite(errors).all():
            return
        _, scale, factors = self._issued_bands.popleft()
        interval = MAX_WEIGHT if self._last_ns is None else (start_ns - self._last_ns) * NANOSECOND
        weight = min(max(interval, 0.0), MAX_WEIGHT)
        self._last_ns = start_ns
        gain = GAIN + (START_GAIN - GAIN) * math.exp(-self._elapsed / SETTLING_TIME)
        self._elapsed += weight
        score = float((np.abs(errors) / scale).max())
        for level, factor in factors.items():
            updated = self._log_factors[level] + gain * weight * (float(score > factor) - (1.0 - level))
            self._log_factors[level] = min(max(updated, math.log(MIN_FACTOR)), math.log(MAX_FACTOR))
        if self._band is None:  # exponentially weighted mean square of the errors
            self._weight = min(self._weight + weight, SCALE_FORGETTING)
            fraction = weight / (self._weight + PRIOR_WEIGHT)
            self._squares += fraction * (np.maximum(np.square(errors), MIN_SQUARED_ERROR) - self._squares)

    def replay(self, starts_ns: np.ndarray, conditions: np.ndarray,
               errors: np.ndarray) -> tuple[dict[float, np.ndarray], np.ndarray]:
        """(factors (n,) by level, scales (n, points, 3)) along a drive, from the scores available at each start.
        Further calls continue the drive. starts_ns: (n,) ascending [ns]. conditions: (n, 4). errors: (n, points, 3) in
        the predicted frame; NaN if not scored."""
        calibrated = None if self._band is None else self._band.scale(conditions)
        horizon_ns = round(float(self._time[-1]) / NANOSECOND)
        factors: dict[float, list[float]] = {level: [] for level in self._log_factors}
        scales = np.empty(errors.shape)
        for k, start in enumerate(starts_ns.tolist()):
            while self._pending_errors and self._pending_errors[0][0] + horizon_ns <= start:
                self.observe(*self._pending_errors.popleft())
            scales[k] = np.sqrt(self._squares) if calibrated is None else calibrated[k]
            self.issue(start, scales[k])
            self._pending_errors.append((start, errors[k]))
            for level, factor in self.factors.items():
                factors[level].append(factor)
        return {level: np.array(values) for level, values in factors.items()}, scales


HalfWidths = dict[tuple[str, float], np.ndarray]
"""Half-widths (points + 1, 3) along, across [m] and in yaw [rad], float32, 0 at the start, by (mode, level)."""


def conditions_now(history: MeasurementHistory, time_ns: int) -> tuple[float, ...]:
    """The four `scale.CONDITIONS` at an instant [ns], like `conditions_at` for recorded drives; NaN if unknown."""
    row = history.ins.row_at(time_ns)
    activity = float(steering_activity(history.steering.sample(activity_instants(time_ns))[:, 0]))
    velocity, rate, acceleration = (math.nan if row is None else row[k] for k in (VELOCITY_X, YAW_RATE, DERIVATIVE))
    return compute_magnitudes(velocity, rate, acceleration, activity)


class CalibratedBands:
    """Half-widths as in `Bands.half_widths`, computed for all models, modes and levels at once.

    models: names of the models, which must all be in the bands (see `Bands.check`). domain: the calibration domain.
    levels: the LEVELS that are in the file. half_widths: by model, overwritten by each update inside the domain.
    scales: (points, 3) along, across [m] and in yaw [rad] at the last such update, by model and mode.
    """

    def __init__(self, bands: Bands, models: Iterable[str]):
        self.domain = bands.domain
        pairs = [(model, mode) for model in models for mode in MODES if (model, mode) in bands.bands]
        self._row: dict[ModelMode, int] = {pair: row for row, pair in enumerate(pairs)}
        self.scales: dict[ModelMode, np.ndarray] = {}
        used_bands = [bands.bands[pair] for pair in pairs]
        self.levels = tuple(level for level in LEVELS if all(level in band.factors for band in used_bands))
        scale = used_bands[0].scale
        self._interpolation = scale.interpolation.T
        coefficients = np.concatenate([2.0 * band.scale.coefficients for band in used_bands])
        self._coefficients = coefficients.reshape(-1, coefficients.shape[-1])
        self._floor = np.square(np.concatenate([band.scale.floors.T for band in used_bands]))
        factors = np.array([[band.factors[level] for band in used_bands] for level in self.levels], np.float32)
        self._factors = factors.repeat(3, axis=1)[:, :, None]
        widths = np.zeros((len(self.levels), len(used_bands), 3, len(scale.time) + 1), np.float32)
        self._widths_ahead = widths.reshape(len(self.levels), -1, widths.shape[-1])[..., 1:]
        self.half_widths: Mapping[str, HalfWidths] = {model: {} for model, _ in pairs}
        for (model, mode), pair_widths in zip(pairs, widths.swapaxes(0, 1), strict=True):
            for level, level_widths in zip(self.levels, pair_widths, strict=True):
                self.half_widths[model][mode, level] = level_widths.T

    def update(self, condition: Sequence[float]) -> bool:
        """Compute `half_widths` for four conditions. False, without an update, outside the calibration domain."""
        if not self.domain.contains(np.array([condition]))[0]:
            return False
        # Clipping at the few knots also limits the interpolated values.
        logs = (self._coefficients @ compute_scalar_features(condition)).clip(-2.0 * MAX_LOG_SCALE, 2.0 * MAX_LOG_SCALE)
        scale = np.exp(logs.reshape(-1, len(self._interpolation)) @ self._interpolation)
        scale += self._floor
        np.sqrt(scale, out=scale)
        self.scales = {pair: scale[3 * row:3 * row + 3].T for pair, row in self._row.items()}
        np.multiply(self._factors, scale.astype(np.float32), out=self._widths_ahead)
        return True


class AdaptiveBands:
    """Bands of all models and modes of a run, each corrected by its scores (`AdaptiveBand`).

    time: (points,) ahead, without the start [s]. bands: calibrated bands of forecast and hindsight. Without them, and
    for the modes plan and course, bands are estimated from the scores alone and are issued after WARM_UP.

    half_widths: as in `CalibratedBands`.
    """

    def __init__(self, time: np.ndarray, models: Sequence[str], modes: Sequence[str] = MODES,
                 bands: Bands | None = None):
        self._calibrated = None if bands is None else CalibratedBands(bands, models)
        calibrated_bands = {} if bands is None else bands.bands
        self._bands = {pair: AdaptiveBand(time, calibrated_bands.get(pair)) for pair in product(models, modes)}
        self.half_widths: Mapping[str, HalfWidths] = {
            model: {(mode, level): np.zeros((len(time) + 1, 3), np.float32) for mode in modes for level in LEVELS}
            for model in models}

    @property
    def remaining_warm_up(self) -> float:
        """Scored driving [s] still required before the first forecast band is issued."""
        return min(band.remaining_warm_up for (_, mode), band in self._bands.items() if mode == "forecast")

    def issue(self, start_ns: int, condition: Sequence[float], modes: Iterable[str]) -> tuple[set[ModelMode], str]:
        """((model, mode) pairs with a band, reason if calibrated pairs have none) for predictions from start_ns.
        Updates `half_widths` for these modes. condition: from `conditions_now`."""
        reason = ""
        if self._calibrated and not self._calibrated.update(condition):
            reason = self._calibrated.domain.describe_outside(condition)
        issued: set[ModelMode] = set()
        for model, half_widths in self.half_widths.items():
            for mode in modes:
                pair = model, mode
                scale = self._calibrated.scales.get(pair) if self._calibrated and not reason else None
                band = self._bands[pair]
                if reason and band.is_calibrated:
                    continue
                widths = band.issue(start_ns, scale)
                if not band.remaining_warm_up:
                    issued.add(pair)
                    for level, level_widths in widths.items():
                        half_widths[mode, level][1:] = level_widths
        return issued, reason

    def observe(self, score: Score) -> None:
        """Update a band by the score of an earlier prediction. Call in order of time for each band."""
        self._bands[score.model, score.mode].observe(score.start_ns, _compute_errors(score))


def _compute_errors(score: Score) -> np.ndarray:
    """Errors (points, 3) in the predicted frame, without the start, where they are zero by definition."""
    return to_predicted_frame(np.stack([score.longitudinal, score.lateral, score.yaw], axis=-1))[1:]


@dataclass
class BandCoverage:
    """Observed coverage of one model and mode."""

    n: int = 0  # number of scored windows with a band
    inside_counts: dict[float, int] = field(default_factory=dict)  # number with the whole path inside, by level
    has_warning: bool = False  # whether the coverage of the highest level is, or recently was, significantly too low
    statistic: float = 0.0  # S of the highest level, see module docstring; limited to log(FALSE_WARNING_TIME)
    _last_ns: int | None = None

    def coverage_at(self, level: float) -> float:
        """Observed coverage of a level; NaN before its first scored window."""
        return self.inside_counts[level] / self.n if level in self.inside_counts else math.nan

    def add(self, start_ns: int, horizon: float, inside: Mapping[float, bool]) -> None:
        """Count one window with a horizon [s]. inside: whether the whole path was inside, by level."""
        self.n += 1
        for level, is_inside in inside.items():
            self.inside_counts[level] = self.inside_counts.get(level, 0) + is_inside
        level = max(inside)
        previous_ns, self._last_ns = self._last_ns, start_ns
        interval = 0.0 if previous_ns is None else (start_ns - previous_ns) * NANOSECOND / horizon
        weight = min(max(interval, 0.0), 1.0)  # 0 after a jump back in time, as in a replay
        limit, q = math.log(FALSE_WARNING_TIME), ALTERNATIVE_RATIO * level
        ratio = math.log(q / level) if inside[level] else math.log((1.0 - q) / (1.0 - level))
        self.statistic = min(max(self.statistic + weight * ratio, 0.0), limit)
        self.has_warning = self.statistic >= (WARNING_END_FRACTION * limit if self.has_warning else limit)


class CoverageMonitor:
    """Coverage by model and mode. Published bands are stored until their prediction is scored."""

    def __init__(self) -> None:
        self.by_pair: dict[ModelMode, BandCoverage] = {}
        self._waiting: dict[tuple[str, str, int], dict[float, np.ndarray]] = {}

    def add_bands(self, model: str, start_ns: int, half_widths: HalfWidths) -> None:
        """Store the half-widths published with a prediction, for at most MAX_WAITING_PREDICTIONS."""
        for (mode, level), widths in half_widths.items():
            self._waiting.setdefault((model, mode, start_ns), {})[level] = widths
        while len(self._waiting) > MAX_WAITING_PREDICTIONS:
            del self._waiting[next(iter(self._waiting))]

    def add_score(self, score: Score) -> None:
        """Count a complete score of a prediction that was published with a band."""
        by_level = self._waiting.pop((score.model, score.mode, score.start_ns), None)
        if by_level is None or not score.complete:
            return
        errors = np.abs(_compute_errors(score))
        inside = {level: bool((errors <= widths[1:]).all()) for level, widths in by_level.items()}
        coverage = self.by_pair.setdefault((score.model, score.mode), BandCoverage())
        coverage.add(score.start_ns, float(score.horizon[-1]), inside)

    def describe_warnings(self) -> str:
        """One-line text for all bands with `has_warning`; empty if there are none."""
        pairs = []
        for (model, mode), coverage in self.by_pair.items():
            if coverage.has_warning:
                level = max(coverage.inside_counts)
                pairs.append(f"{mode} of {model} ({100 * coverage.coverage_at(level):.0f} % so far, nominal level "
                             f"{100 * level:.0f} %)")
        return (f"coverage of bands is or was significantly below the nominal level: {', '.join(pairs)}; check whether "
                "the car, the road or the driving has changed") if pairs else ""
