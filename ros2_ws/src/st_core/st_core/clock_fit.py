"""Fits offset and drift between two clocks: resampling, masked correlation for a coarse offset, robust joint fit."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft
from scipy.integrate import trapezoid
from scipy.interpolate import CubicSpline
from scipy.ndimage import maximum_filter1d
from scipy.signal import butter, sosfiltfilt, sosfreqz

from .clock_types import Peak
from .regression import robust_deviation

RATE = 100.0  # Hz, sampling rate at which signals are filtered
DECIMATION = 5  # to 20 Hz, which is enough because the filtered signals contain only a few hertz
STEP = DECIMATION / RATE  # s, between the samples of a resampled signal
MAX_GAP = 0.15  # s, longest gap that is interpolated
FILTER_SETTLING_PERIODS = 0.5  # periods of the cut-off frequency, masked on both sides of a gap
DRIFT_PRIOR_PPM = 100.0  # standard deviation of the drift; two quartz clocks differ by 20 to 50 ppm
PEAK_DISTANCE = 2.0  # s, minimum distance of the second peak of the correlation from the first
BLOCK_DURATION = 5.0  # s; residuals further apart than this count as independent
ITERATIONS = 12
# The iteration ends with a step below MIN_STEP [s, s/s] or TOLERANCE times the standard error (independent residuals).
TOLERANCE, MIN_STEP = 0.003, (1e-6, 1e-9)
MAX_OFFSET_STEP = 0.3  # s, largest change of the offset in one iteration


@dataclass(frozen=True)
class Series:
    """A signal on a regular grid."""

    origin: float  # s, time of the first sample
    values: np.ndarray
    known: np.ndarray  # True for samples away from gaps and ends

    @cached_property
    def time(self) -> np.ndarray:
        return self.origin + STEP * np.arange(len(self.values))

    @cached_property
    def _coefficients(self) -> np.ndarray:
        return CubicSpline(self.time, self.values).c

    def interpolate(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(values, slopes) of the cubic spline at instants [s] within the series. Linear interpolation would attenuate
        the noise between the samples, and thus favour some offsets."""
        index = np.minimum(((time - self.origin) / STEP).astype(np.int64), len(self.values) - 2)
        t, (a, b, c, d) = time - self.time[index], self._coefficients[:, index]
        return ((a * t + b) * t + c) * t + d, (3.0 * a * t + 2.0 * b) * t + c


def resample(time: np.ndarray, values: np.ndarray, cutoff: float, is_angle: bool = False) -> Series:
    """Interpolate a signal to 100 Hz, low-pass filter it if longer than 0.5 s, and reduce it to every fifth sample.

    time: [s], strictly increasing. values: NaN where unusable. cutoff: cut-off frequency [Hz] of the zero-phase
    Butterworth filter of order 4, equal for both recordings. is_angle: values are an angle [rad], wrapped or not; the
    result is its rate [rad/s], because the zero of the angle is unknown. The angle is filtered before it is
    differentiated, because the filter reflects a signal about its end samples, which are noisy in a rate.
    """
    finite = np.isfinite(values)
    time, values = time[finite], np.unwrap(values[finite]) if is_angle else values[finite]
    if len(time) < 2:
        return Series(0.0, np.zeros(0), np.zeros(0, dtype=bool))
    start = np.ceil(time[0] * RATE) / RATE
    grid = start + np.arange(max(int((time[-1] - start) * RATE), 0) + 1) / RATE
    sampled = np.interp(grid, time, values)
    right = np.clip(np.searchsorted(time, grid), 1, len(time) - 1)
    is_bridged = time[right] - time[right - 1] <= MAX_GAP
    sos = butter(4, cutoff, fs=RATE, output="sos")
    if len(grid) > 50:
        sampled = sosfiltfilt(sos, sampled, padtype="odd", padlen=min(len(grid) - 1, int(3 * RATE / cutoff)))
    margin = int(FILTER_SETTLING_PERIODS / cutoff * RATE)
    if is_angle:
        sampled = np.gradient(sampled) * RATE if len(grid) > 1 else np.zeros_like(sampled)
    known = maximum_filter1d((~is_bridged).astype(np.uint8), 2 * margin + 1, mode="constant") == 0
    known[:margin] = known[len(known) - margin:] = False
    return Series(float(start), sampled[::DECIMATION], known[::DECIMATION])


def rate_noise(interval: float, cutoff: float) -> float:
    """Standard deviation [1/s] of the rate from `resample`, for an angle with white noise of standard deviation 1 in
    samples `interval` [s] apart: from the gains of interpolation, both passes of the filter and differentiation."""
    interval = max(interval, 1.0 / RATE)
    frequency, response = sosfreqz(butter(4, cutoff, fs=RATE, output="sos"), 4096, fs=RATE)
    gain = np.square(np.abs(response) * np.sinc(frequency * interval)) * np.sin(2.0 * np.pi * frequency / RATE) * RATE
    return float(np.sqrt(2.0 * interval * trapezoid(gain**2, frequency)))


def masked_correlation(reference: Series, other: Series, minimum_overlap: float) -> tuple[np.ndarray, np.ndarray]:
    """(lags [s], reference time minus other time; normalised correlation of two masked series at each lag).

        r(l) = cov(f, g_l) / sqrt(var(f) var(g_l)),   over the samples known in both series at lag l

    minimum_overlap: duration of the samples known in both [s]; r is 0 at lags with less, or with hardly any variation.
    Source: Padfield, Masked object registration in the Fourier domain, IEEE Trans. Image Processing 21 (2012).
    """
    mask_f, mask_g = reference.known.astype(float), other.known.astype(float)
    # The mean is removed first, so that the rounding errors of the transforms stay far below the sums.
    f, g = (np.where(s.known, s.values - (s.values[s.known].mean() if s.known.any() else 0.0), 0.0)
            for s in (reference, other))
    size = next_fast_len(len(f) + len(g) - 1, real=True)
    f_hat, mask_f_hat = rfft(f, size), rfft(mask_f, size)
    g_hat, mask_g_hat = np.conj(rfft(g, size)), np.conj(rfft(mask_g, size))

    def transform_back(spectrum: np.ndarray) -> np.ndarray:
        row = irfft(spectrum, size)
        return np.concatenate((row[size - len(g) + 1 :], row[: len(f)]))  # from the most negative lag on

    n = np.maximum(np.round(transform_back(mask_f_hat * mask_g_hat)), 1.0)  # common samples at each lag
    sum_f, sum_g = transform_back(f_hat * mask_g_hat), transform_back(mask_f_hat * g_hat)
    covariance = transform_back(f_hat * g_hat) - sum_f * sum_g / n
    variance_f = transform_back(rfft(f * f, size) * mask_g_hat) - sum_f**2 / n
    variance_g = transform_back(mask_f_hat * np.conj(rfft(g * g, size))) - sum_g**2 / n
    # An overlap with almost no variation correlates with anything, so a fraction of the largest variance is required.
    floor_f, floor_g = (1e-3 * v.max(initial=0.0) + 1e-12 for v in (variance_f, variance_g))
    usable = (n * STEP >= minimum_overlap) & (variance_f > floor_f) & (variance_g > floor_g)
    r = np.zeros(len(n))
    r[usable] = covariance[usable] / np.sqrt(variance_f[usable] * variance_g[usable])
    lags = (np.arange(len(n)) - (len(g) - 1)) * STEP + reference.origin - other.origin
    return lags, np.clip(r, -1.0, 1.0)


@dataclass(frozen=True)
class Pair:
    """One shared signal of both recordings; the time of `other` is corrected for the latency."""

    name: str
    reference: Series
    other: Series


@dataclass(frozen=True)
class Fit:
    """Fitted relation t_reference = t_other + offset + drift (t_other - middle); middle: see `fit`."""

    offset: float  # s
    drift: float  # s/s
    offset_deviation: float  # standard deviation [s]; inf if the signals have no motion in common
    drift_deviation: float  # standard deviation [s/s]; inf like offset_deviation
    residual: tuple[float, ...]  # RMS residual of each signal, divided by the standard deviation of its reference
    correlation: tuple[float, ...]  # of each signal


def fit(pairs: Sequence[Pair], offset: float, middle: float, drift: float = 0.0, free_drift: bool = True) -> Fit:
    """Fit offset and drift by Gauss-Newton with soft-L1 weights, with a gain and a bias for every signal.

        residual_k(t) = (reference_k(t + offset + drift (t - middle)) - gain_k other_k(t) - bias_k) / scale_k

    middle: instant on the other clock at which the offset applies [s]. offset, drift: initial values.
    The gain absorbs the scale of a wheel speed, the bias a gyro offset; scale_k is a robust standard deviation. The
    uncertainty is a sandwich estimate from blocks of 5 s, since residuals are autocorrelated, but not below that for
    independent residuals and a noise-free reference. The curvature is the product of the slopes of both recordings, in
    which their independent noise averages out. A weak prior (100 ppm) limits the drift. Raises ValueError if the two
    recordings of a signal overlap by less than 2 s, or if the signals do not vary.
    """
    parameters = np.array([offset, drift])
    for _ in range(ITERATIONS):
        normal, curvature, gradient, details = _normal_equations(pairs, parameters, middle, free_drift)
        is_determined = bool(curvature[0, 0] > 0.0 and np.linalg.det(curvature) > 0.0)
        inverse = np.linalg.inv(curvature if is_determined else normal)
        step = -inverse @ gradient
        # The linear model is valid only near the correlation peak, which is therefore approached in several steps.
        step *= MAX_OFFSET_STEP / max(abs(step[0]), MAX_OFFSET_STEP)
        parameters += step
        if (np.abs(step) <= np.maximum(MIN_STEP, TOLERANCE * np.sqrt(np.diag(inverse @ normal @ inverse)))).all():
            break
    # Covariance of the total score, from its sums over blocks of time, which are the same for all signals.
    times, scores, residuals, correlations = zip(*details, strict=True)
    start = min(float(time[0]) for time in times)
    count = int((max(float(time[-1]) for time in times) - start) / BLOCK_DURATION) + 1
    sums = np.zeros((count, 2))
    for time, score in zip(times, scores, strict=True):
        block = ((time - start) / BLOCK_DURATION).astype(np.int64)
        sums += np.stack([np.bincount(block, weights=row, minlength=count) for row in score], axis=1)
    used_blocks = max(int((np.abs(sums).sum(axis=1) > 0).sum()), 1)
    covariance = inverse @ (sums.T @ sums * (used_blocks / max(used_blocks - 4, 1))) @ inverse
    deviations = np.sqrt(np.maximum(np.diag(covariance), np.diag(inverse))) if is_determined else np.full(2, np.inf)
    return Fit(float(parameters[0]), float(parameters[1]), float(deviations[0]), float(deviations[1]), residuals,
               correlations)


_SignalFit = tuple[np.ndarray, np.ndarray, float, float]
"""Fit of one signal: time (n,) of its samples; score (2, n), the product of the weighted residual and its derivatives,
orthogonal to gain and bias; residual and correlation as in `Fit`."""


def _normal_equations(pairs: Sequence[Pair], parameters: np.ndarray, middle: float,
                      free_drift: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[_SignalFit]]:
    """(normal matrix, curvature, gradient, fit of each signal) at parameters = (offset [s], drift). Noise of the
    reference increases the normal matrix, but not the curvature."""
    normal = np.diag([0.0, (DRIFT_PRIOR_PPM * 1e-6) ** -2])
    curvature = normal.copy()
    gradient = np.array([0.0, normal[1, 1] * parameters[1] if free_drift else 0.0])
    details = []
    for pair in pairs:
        rows, reference, slope = select_common_samples(pair, parameters, middle)
        time, other = pair.other.time[rows], pair.other.values[rows]
        if len(time) * STEP < 2.0:
            raise ValueError(f"{pair.name}: less than 2 s with usable values in both recordings")
        _, other_slope = pair.other.interpolate(time)
        weight = np.ones(len(time))  # of the squared residuals, for the soft-L1 loss
        for _ in range(2):
            gain, bias = _fit_weighted_line(other, reference, weight)
            residual = reference - gain * other - bias
            scale = max(robust_deviation(residual), 1e-4 * float(reference.std()), 1e-12)
            weight = 1.0 / np.sqrt(1.0 + (residual / (2 * scale)) ** 2)
        jacobian, other_jacobian = np.zeros((2, 2, len(time)))
        for target, slopes in (jacobian, slope), (other_jacobian, gain * other_slope):
            for k, derivative in enumerate([slopes, slopes * (time - middle)] if free_drift else [slopes]):
                # Project out gain and bias, which contain no information about the clocks.
                gain, bias = _fit_weighted_line(other, derivative, weight)
                target[k] = (derivative - gain * other - bias) / scale
        score = jacobian * (weight * residual / scale)
        normal += [[float((row * column).sum()) for column in jacobian] for row in jacobian * weight]
        cross = np.array([[float((row * column).sum()) for column in other_jacobian] for row in jacobian * weight])
        curvature += 0.5 * (cross + cross.T)
        gradient += score.sum(axis=1)
        deviations = float(reference.std()), float(other.std())
        details.append((time, score, float(np.sqrt(np.mean(residual**2)) / max(deviations[0], 1e-12)),
                        float(np.corrcoef(reference, other)[0, 1]) if min(deviations) > 0 else 0.0))
    if normal[0, 0] <= 0.0:
        raise ValueError("the shared signals do not vary")
    return normal, curvature, gradient, details


def _fit_weighted_line(x: np.ndarray, y: np.ndarray, weight: np.ndarray) -> tuple[float, float]:
    """(gain, bias) of the weighted least squares line y = gain x + bias; gain 0 if x does not vary."""
    # Sums are used, because dot products would start linear algebra threads for each of these short rows.
    total = float(weight.sum())
    weighted_x = weight * x
    mean_x, mean_y = float(weighted_x.sum()) / total, float((weight * y).sum()) / total
    squares = float((weighted_x * x).sum()) - total * mean_x**2
    if squares <= 1e-12 * max(total * mean_x**2, 1e-12):
        return 0.0, mean_y
    gain = (float((weighted_x * y).sum()) - total * mean_x * mean_y) / squares
    return gain, mean_y - gain * mean_x


def select_common_samples(pair: Pair, parameters: Sequence[float] | np.ndarray,
                          middle: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(indices in `other` of the samples known in both series, values and slopes of the reference at these samples),
    with parameters (offset [s], drift) and middle [s] as in `fit`."""
    known, time = pair.reference.known, pair.other.time
    reference_time = time + parameters[0] + parameters[1] * (time - middle)
    index = np.floor((reference_time - pair.reference.origin) / STEP).astype(np.int64)
    inside = pair.other.known & (index >= 0) & (index < len(known) - 1)
    inside[inside] = known[index[inside]] & known[index[inside] + 1]
    return np.flatnonzero(inside), *pair.reference.interpolate(reference_time[inside])


def mean_correlation(pairs: Sequence[Pair], minimum_overlap: float,
                     span: tuple[float, float]) -> tuple[np.ndarray, np.ndarray] | None:
    """(lags [s], mean of the correlations of the signals) within span [s]; None if the span contains no lag."""
    curves = [masked_correlation(p.reference, p.other, minimum_overlap) for p in pairs]
    low = max(span[0], *(lags[0] for lags, _ in curves))
    high = min(span[1], *(lags[-1] for lags, _ in curves))
    lags = np.arange(low, high + STEP / 2, STEP)
    return (lags, np.mean([np.interp(lags, *curve) for curve in curves], axis=0)) if len(lags) else None


def find_peaks(pairs: Sequence[Pair], minimum_overlap: float,
               span: tuple[float, float] = (-np.inf, np.inf)) -> tuple[Peak, Peak] | None:
    """The two highest peaks of the mean correlation of the signals at offsets within span [s]; None without a positive
    peak. A valley and at least PEAK_DISTANCE separate the second from the first; correlation 0 if there is none."""
    lags, r = mean_correlation(pairs, minimum_overlap, span) or (np.zeros(1), np.zeros(1))
    best = int(np.argmax(r))
    if r[best] <= 0:
        return None
    left, right = _find_valley(r, best, -1), _find_valley(r, best, +1)
    reach = int(PEAK_DISTANCE / STEP)
    remaining = r.copy()
    remaining[min(left, max(best - reach, 0)):max(right, best + reach) + 1] = 0.0
    second = int(np.argmax(remaining))
    return Peak(float(lags[best]), float(r[best])), Peak(float(lags[second]), float(max(remaining[second], 0.0)))


def _find_valley(r: np.ndarray, index: int, direction: int) -> int:
    """Index at which the correlation stops decreasing on one side of a peak."""
    side = r[index:] if direction > 0 else r[index::-1]
    rising = np.nonzero(np.diff(side) > 0)[0]
    return index + direction * int(rising[0] if len(rising) else len(side) - 1)
