"""Resampling, filtering and masked correlation of two recordings of one signal: the parts of clock_alignment.py."""

from dataclasses import dataclass

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft
from scipy.signal import butter, sosfiltfilt

RATE = 100.0  # Hz of the grid on which signals are filtered
DECIMATION = 5  # the filtered signals hold nothing above a few hertz, so the fit needs no more than 20 Hz
STEP = DECIMATION / RATE
LONGEST_GAP = 0.15  # s; a longer one is not bridged
FILTER_SETTLES = 0.5  # s at 1 Hz cut-off: masked on both sides of a gap, inversely proportional to the cut-off


@dataclass(frozen=True)
class Resampled:
    """A signal on a regular grid: values [its unit], and where they are measured (not gap, not edge). origin [s]."""

    origin: float
    values: np.ndarray
    known: np.ndarray

    @property
    def time(self) -> np.ndarray:
        return self.origin + STEP * np.arange(len(self.values))


def resample(time: np.ndarray, values: np.ndarray, cutoff: float, angle: bool = False) -> Resampled:
    """Linear interpolation to 100 Hz, zero-phase Butterworth low-pass (order 4), every fifth point kept.

    Args:
        time: [s], strictly increasing, at least 2.
        values: NaN where not to be used.
        cutoff: of the low-pass [Hz], the same for both recordings, so that it shifts neither against the other.
        angle: values are an angle [rad], wrapped or not; the result is its rate [rad/s], in which the unknown zero of
            the angle cancels. Filtered first: a difference of neighbours would be all rounding.
    """
    good = np.isfinite(values)
    time, values = time[good], np.unwrap(values[good]) if angle else values[good]
    if len(time) < 2:
        return Resampled(0.0, np.zeros(0), np.zeros(0, dtype=bool))
    start = np.ceil(time[0] * RATE) / RATE
    grid = start + np.arange(max(int((time[-1] - start) * RATE), 0) + 1) / RATE
    sampled = np.interp(grid, time, values)
    right = np.clip(np.searchsorted(time, grid), 1, len(time) - 1)
    bridged = time[right] - time[right - 1] <= LONGEST_GAP
    sos = butter(4, cutoff, fs=RATE, output="sos")
    if len(grid) > 50:
        sampled = sosfiltfilt(sos, sampled, padtype="odd", padlen=min(len(grid) - 1, int(3 * RATE / cutoff)))
    margin = int(FILTER_SETTLES / cutoff * RATE)
    if angle:
        sampled = np.gradient(sampled) * RATE if len(grid) > 1 else np.zeros_like(sampled)
    known = ~_widened(~bridged, margin)
    known[:margin] = known[len(known) - margin :] = False
    return Resampled(float(start), sampled[::DECIMATION], known[::DECIMATION])


def _widened(flags: np.ndarray, margin: int) -> np.ndarray:
    if not flags.any() or margin == 0:
        return flags
    count = np.concatenate(([0], np.cumsum(flags)))
    index = np.arange(len(flags))
    low = np.maximum(index - margin, 0)
    high = np.minimum(index + margin + 1, len(flags))
    return count[high] > count[low]


def masked_correlation(reference: Resampled, other: Resampled, minimum_overlap: float) -> tuple[np.ndarray, np.ndarray]:
    """Normalised correlation of two masked series at every lag, each over its own overlap.

        r(l) = cov(f, g_l) / sqrt(var(f) var(g_l)),   sums over the points known in both at lag l

    Args:
        minimum_overlap: points known in both [s]; r is 0 at lags with fewer.

    Returns:
        lags [s], other's time + lag = reference's time; and r in [-1, 1].

    Source: Padfield, Masked object registration in the Fourier domain, IEEE Trans. Image Processing 21 (2012).
    """
    m1, m2 = reference.known.astype(float), other.known.astype(float)
    # Removing the mean first keeps the rounding errors of the transforms far below the sums.
    f = np.where(reference.known, reference.values - _mean(reference), 0.0)
    g = np.where(other.known, other.values - _mean(other), 0.0)
    total = len(f) + len(g) - 1
    size = next_fast_len(total, real=True)
    mf1, mf2, ff, gf = rfft(m1, size), np.conj(rfft(m2, size)), rfft(f, size), np.conj(rfft(g, size))

    def lagged(spectrum: np.ndarray) -> np.ndarray:
        row = irfft(spectrum, size)
        return np.concatenate((row[size - len(g) + 1 :], row[: len(f)]))

    n = np.maximum(np.round(lagged(mf1 * mf2)), 1.0)
    sum_f, sum_g = lagged(ff * mf2), lagged(mf1 * gf)
    covariance = lagged(ff * gf) - sum_f * sum_g / n
    variance_f = lagged(rfft(f * f, size) * mf2) - sum_f**2 / n
    variance_g = lagged(mf1 * np.conj(rfft(g * g, size))) - sum_g**2 / n
    # A stretch without variation correlates with anything: it must carry a share of the whole variance.
    floor_f, floor_g = (1e-3 * v.max(initial=0.0) + 1e-12 for v in (variance_f, variance_g))
    usable = (n * STEP >= minimum_overlap) & (variance_f > floor_f) & (variance_g > floor_g)
    r = np.zeros(len(n))
    r[usable] = covariance[usable] / np.sqrt(variance_f[usable] * variance_g[usable])
    lags = (np.arange(len(n)) - (len(g) - 1)) * STEP + reference.origin - other.origin
    return lags, np.clip(r, -1.0, 1.0)


def _mean(signal: Resampled) -> float:
    return float(signal.values[signal.known].mean()) if signal.known.any() else 0.0
