"""Aligns the clocks of two recordings by the signals that both contain.

    t_reference = t_other + offset + drift (t_other - t_0),    t_0: `Alignment.at_ns`

`reference` is the INS recording, `other` the CAN log. An alignment has an uncertainty and a verdict with reasons.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from .clock_fit import DRIFT_PRIOR_PPM, MAX_GAP, STEP, Fit, Pair, Series, find_peaks, fit, mean_correlation, resample
from .clock_types import MAX_SPAN, Alignment, SharedSignal, SignalAgreement, Verdict, describe_step, refused_alignment
from .regression import SIGMA_PER_MAD

COARSE_CUTOFF, FINE_CUTOFF = 0.5, 4.0  # Hz, of the low-pass while the drift is unknown, and in the final fit
STAMP_RESOLUTION = 50e-6  # s, of logger time stamps; their rounding error is part of the uncertainty
GOOD_CORRELATION, USABLE_CORRELATION = 0.95, 0.80  # doubtful: one signal below GOOD; refused: all below USABLE
MIN_OVERLAP = 20.0  # s, minimum overlap in the second search, after one with 40 % of the shorter recording has failed
ATYPICAL_DRIFT_PPM = 200.0  # two quartz clocks differ by less
MAX_CLOCK_STEP = 0.05  # s; an alignment with a larger clock step is refused
MAX_DISAGREEMENT = 0.005  # s; doubtful: the offset from a single signal differs from the common offset by more
MAX_TIME_FRAME_RESIDUAL = 0.02  # s; doubtful: the offset from a time frame differs from the fitted line by more
GOOD_DEVIATION, USABLE_DEVIATION = 0.005, 0.05  # s, of the offset; doubtful above GOOD, refused above USABLE
MANUAL_SEARCH, MANUAL_TOLERANCE = 5.0, 0.01  # s; search range and smallest tolerance when checking a manual offset
STEP_SEARCH, WIDE_STEP_SEARCH = 5.0, 40.0  # s, search range for clock steps; WIDE if a signal fits poorly
STANDSTILL_MARGIN_NS = 2_000_000_000  # ns; standstill is used up to this time before and after motion
WINDOW_DURATION = 30.0  # s, length of a window
MAX_WINDOWS = 150  # largest number of windows, evenly spaced in a long recording
MIN_CORRELATION = 0.9  # a window is left out if the correlation of its highest peak is lower
MAX_PEAK_RATIO = 0.97  # a window is left out if its second peak, divided by the highest, is higher
MAX_LAG_DEVIATION = 0.05  # s; a window is left out if the standard deviation of its lag is larger
MIN_CLOCK_STEP = 0.01  # s, smallest step reported
TYPICAL_DRIFT = 50e-6  # s/s, standard deviation of the prior of the drift
MIN_STEP_COST_REDUCTION = 30.0  # minimum reduction of the normalised sum of squares by a step
OUTLIER_LIMIT = 5.0  # residual / standard deviation of a window: scale of its robust weight, and largest value counted


@dataclass(frozen=True)
class WindowLag:
    """Offset of a window minus the common offset."""

    time: float  # middle of the window [s, other clock]
    lag: float  # s
    deviation: float  # standard deviation [s]


class ClockStep(NamedTuple):
    time: float  # s, other clock
    size: float  # increase of the lag [s]


class _ResampledSignals(NamedTuple):
    """The usable signals of two recordings, resampled and low-pass filtered."""

    coarse: list[Pair]  # at COARSE_CUTOFF
    fine: list[Pair]  # at FINE_CUTOFF
    reasons: tuple[str, ...]  # why signals are left out; not empty if there are no pairs
    reference_ns: int = 0  # origin of the times of the reference
    other_ns: int = 0  # origin of the times of the other recording
    latency_uncertainty: float = 0.0  # largest of the signals [s]


def _resample_signals(signals: Sequence[SharedSignal]) -> _ResampledSignals:
    """Resample the signals that are known in both recordings and vary."""
    usable, reasons = [], []
    for signal in signals:
        known = [np.isfinite(v) for v in (signal.reference, signal.other)]
        if min(k.sum() for k in known) < 2:
            reasons.append(f"{signal.name} is missing in one recording")
            continue
        spans = [float(t[-1] - t[0]) * 1e-9 for t in (signal.reference_time_ns, signal.other_time_ns)]
        if max(spans) > MAX_SPAN:
            reasons.append(f"{signal.name} spans {max(spans) / 86400:.0f} days: a clock was probably set")
            continue
        values = [v[k] for v, k in zip((signal.reference, signal.other), known, strict=True)]
        deviation = min(float(np.std(np.unwrap(v) if signal.is_angle else v)) for v in values)
        if deviation <= signal.min_deviation:
            reasons.append(f"{signal.name} hardly varies (standard deviation {deviation:.3g})")
            continue
        usable.append(signal)
    if not usable:
        return _ResampledSignals([], [], tuple(reasons or ["the recordings share no signal"]))
    coarse, fine = [], []
    reference_ns, other_ns = int(usable[0].reference_time_ns[0]), int(usable[0].other_time_ns[0])
    for signal in usable:
        reference = (signal.reference_time_ns - reference_ns) * 1e-9
        other = (signal.other_time_ns - other_ns) * 1e-9 - signal.latency
        pairs = [Pair(signal.name, resample(reference, signal.reference, cutoff, signal.is_angle), resample(
            other, signal.other, cutoff, signal.is_angle)) for cutoff in (COARSE_CUTOFF, FINE_CUTOFF)]
        if all(series.known.any() for pair in pairs for series in (pair.reference, pair.other)):
            coarse.append(pairs[0])
            fine.append(pairs[1])
        else:  # the low-pass masks 1 s on both sides of a gap
            reasons.append(f"{signal.name} has no 2 s stretch without a gap above {MAX_GAP:g} s in one recording")
    return _ResampledSignals(coarse, fine, tuple(reasons), reference_ns, other_ns,
                             max(signal.latency_uncertainty for signal in usable))


def manual_alignment(offset_ns: int, at_ns: int, signals: Sequence[SharedSignal] = ()) -> Alignment:
    """Alignment by an offset given by hand [ns], valid at the log time at_ns [ns], and checked against the signals."""
    offset = offset_ns * 1e-9
    check = align(signals, search=(offset - MANUAL_SEARCH, offset + MANUAL_SEARCH)) if signals else refused_alignment()
    manual = Alignment(at_ns, offset_ns, 0.0, float("nan"), float("nan"), "by hand", Verdict.DOUBTFUL,
                      ("the offset was given by hand and could not be checked",))
    if check.verdict is Verdict.REFUSED:
        return manual
    difference = check.offset_ns * 1e-9 - offset
    reason = (f"the offset was given by hand; that from the shared signals differs by {difference * 1e3:+.0f} ms in "
              "the middle of the overlap")
    agrees = abs(difference) < max(2 * check.offset_deviation, MANUAL_TOLERANCE)
    return replace(manual, verdict=Verdict.GOOD if agrees else Verdict.DOUBTFUL, reasons=(reason,),
                   signals=check.signals, peak=check.peak, second_peak=check.second_peak, overlap=check.overlap)


def align(signals: Sequence[SharedSignal], search: tuple[float, float] | None = None) -> Alignment:
    """Alignment by the signals of both recordings.

    Coarse: masked normalised cross-correlation at all lags, averaged over the signals. Fine: robust joint fit of offset
    and drift (`clock_fit.fit`). The verdict depends on the fitted correlations, a similar second peak, the uncertainty
    of the offset, the agreement of the signals, the drift, and steps of a clock. The recordings must overlap by 40 % of
    the shorter one and at least 10 s, or by 20 s if no such offset fits. search: range of the offset [s].

    For unusable recordings the alignment is refused, with reasons; no exception is raised. Valid for drifts of a few
    hundred ppm and recordings of up to two days. Checked by: tests/golden/test_alignment.py, test_clock_alignment.py.
    """
    series = _resample_signals(signals)
    if not series.fine:
        return refused_alignment(*series.reasons)
    result = _align_with_overlap(series, _compute_min_overlap(series.fine), search)
    best = max((s.correlation for s in result.signals), default=0.0)
    if result.verdict is Verdict.REFUSED and best < USABLE_CORRELATION:
        short_alignment = _align_with_overlap(series, MIN_OVERLAP, search)
        if short_alignment.verdict is not Verdict.REFUSED:
            return short_alignment.with_doubts(f"the recordings share only {short_alignment.overlap:.0f} s")
    return result


def _compute_min_overlap(pairs: Sequence[Pair]) -> float:
    """Minimum overlap of the recordings [s]: 40 % of the shorter one, at least 10 s."""
    shorter = min(max(series.known.sum() for series in recording) * STEP
                  for recording in ([p.reference for p in pairs], [p.other for p in pairs]))
    return max(0.4 * shorter, 10.0)


def _align_with_overlap(series: _ResampledSignals, minimum_overlap: float,
                        search: tuple[float, float] | None) -> Alignment:
    fine, reasons = series.fine, series.reasons
    origin_difference = (series.reference_ns - series.other_ns) * 1e-9
    span = (search[0] - origin_difference, search[1] - origin_difference) if search else (-np.inf, np.inf)
    peaks = find_peaks(fine, minimum_overlap, span)
    if peaks is None:
        return refused_alignment(*reasons, f"the recordings do not share {minimum_overlap:.0f} s of similar motion")
    coarse = peaks[0].offset
    # The offset is fitted in the middle of the overlap, where its estimate is nearly uncorrelated with the drift.
    low = max(min(p.other.origin for p in fine), min(p.reference.origin for p in fine) - coarse)
    high = min(max(p.other.time[-1] for p in fine), max(p.reference.time[-1] for p in fine) - coarse)
    middle = (low + high) / 2
    try:
        solution = fit(series.coarse, coarse, middle)
        solution = fit(fine, solution.offset, middle, solution.drift)
    except ValueError as error:
        return refused_alignment(*reasons, str(error))
    single_fits = [fit([pair], solution.offset, middle, solution.drift, free_drift=False) for pair in fine]
    agreements = [
        SignalAgreement(pair.name, single.offset - solution.offset, single.offset_deviation, residual, correlation)
        for pair, single, residual, correlation in zip(fine, single_fits, solution.residual, solution.correlation,
                                                       strict=True)]
    excess = 0.0  # variance between the signals in excess of their uncertainties [s^2]
    weights = np.array([s.deviation**-2 for s in agreements])
    if (count := np.count_nonzero(weights)) > 1:
        variance = float((weights * np.array([s.difference for s in agreements]) ** 2).sum() / weights.sum())
        excess = max(variance - float(count / weights.sum()), 0.0)
    offset_deviation = float(np.sqrt(solution.offset_deviation**2 + excess + series.latency_uncertainty**2
                                     + STAMP_RESOLUTION**2 / 12))
    # The rounding error of the stamps changes slowly, so it does not average out.
    drift_deviation = float(np.hypot(solution.drift_deviation, STAMP_RESOLUTION / max(high - low, 1.0))) * 1e6
    peak, second_peak = (p._replace(offset=p.offset + origin_difference) for p in peaks)
    result = Alignment(
        series.other_ns + round(middle * 1e9),
        series.reference_ns - series.other_ns + round(solution.offset * 1e9), solution.drift * 1e6,
        offset_deviation, drift_deviation, "shared signals", Verdict.GOOD, reasons, tuple(agreements), peak,
        second_peak, max(high - low, 0.0))
    return _add_verdict(result, solution, fine, series.other_ns)


def _add_verdict(result: Alignment, solution: Fit, pairs: Sequence[Pair], other_ns: int) -> Alignment:
    refusals, doubts = [], []
    # Correlations after the fit are used, because drift reduces the peak of the coarse search.
    lowest_correlation = min(max(s.correlation, 0.0) for s in result.signals)
    highest_correlation = max(s.correlation for s in result.signals)
    if highest_correlation < USABLE_CORRELATION:
        refusals.append(f"the signals do not match (correlation {highest_correlation:.2f} at best): the recordings "
                        "do not overlap in time, are not of the same drive, or part of a signal is wrong")
    elif lowest_correlation < GOOD_CORRELATION:
        worst = min(result.signals, key=lambda s: s.correlation)
        doubts.append(f"{worst.name} fits poorly: correlation {worst.correlation:.2f}, below {GOOD_CORRELATION}")
    if result.is_ambiguous and result.peak and result.second_peak:
        (best, correlation), (second, second_correlation) = result.peak, result.second_peak
        doubts.append(f"an offset {second - best:+.2f} s away fits nearly as well, with correlation "
                      f"{second_correlation:.2f} against {correlation:.2f} (repeated laps?)")
    cause = ("little motion" if highest_correlation >= GOOD_CORRELATION else
             f"the signals differ (correlation {highest_correlation:.2f} at best)")
    if solution.offset_deviation > USABLE_DEVIATION:
        known = np.isfinite(solution.offset_deviation)
        refusals.append(f"{cause}: the uncertainty of the offset is "
                        f"{f'{solution.offset_deviation * 1e3:.0f} ms' if known else 'infinite'}")
    elif solution.offset_deviation > GOOD_DEVIATION:
        doubts.append(f"{cause}: the uncertainty of the offset is {solution.offset_deviation * 1e3:.1f} ms")
    for signal in result.signals:
        if abs(signal.difference) > max(MAX_DISAGREEMENT, 3 * signal.deviation):
            doubts.append(f"the offset from {signal.name} alone differs by {signal.difference * 1e3:+.1f} ms")
    doubts += _describe_unusual_drift(result)
    search = WIDE_STEP_SEARCH if lowest_correlation < GOOD_CORRELATION else STEP_SEARCH
    if step := find_clock_step(measure_window_lags(pairs, solution.offset, search)):
        reason = describe_step(step.size, other_ns * 1e-9 + step.time - result.at_ns * 1e-9)
        # The other doubts are consequences of the step.
        unusable = abs(step.size) > MAX_CLOCK_STEP or not np.isfinite(solution.offset_deviation)
        refusals, doubts = ([reason], []) if unusable else ([], [reason])
    if refusals:
        return replace(result, verdict=Verdict.REFUSED, reasons=(*result.reasons, refusals[0]))
    return result.with_doubts(*doubts)


def _describe_unusual_drift(result: Alignment) -> list[str]:
    if abs(result.drift_ppm) - 2.0 * result.drift_deviation > ATYPICAL_DRIFT_PPM:
        return [f"a drift of {result.drift_ppm:.0f} ppm exceeds that of quartz clocks"]
    return []


def correlation_curve(signals: Sequence[SharedSignal]) -> tuple[np.ndarray, np.ndarray]:
    """(offsets [s], reference minus other clock; mean correlation of the signals at each); empty if no signal is
    usable. The correlation is 0 where the overlap is below 40 % of the shorter recording or below 10 s."""
    series = _resample_signals(signals)
    curve = mean_correlation(series.fine, _compute_min_overlap(series.fine), (-np.inf, np.inf)) if series.fine else None
    return ((curve[0] + (series.reference_ns - series.other_ns) * 1e-9, curve[1]) if curve
            else (np.zeros(0), np.zeros(0)))


def residual_lags(signals: Sequence[SharedSignal], alignment: Alignment) -> list[WindowLag]:
    """Offsets measured in windows of 30 s, within +/- 2 s, minus those of the alignment; times since at_ns [s]."""
    series = _resample_signals(signals)
    if not series.fine:
        return []
    middle = (alignment.at_ns - series.other_ns) * 1e-9
    offset = (alignment.offset_ns - (series.reference_ns - series.other_ns)) * 1e-9
    lags = measure_window_lags(series.fine, offset, 2.0)
    drift = alignment.drift_ppm * 1e-6
    return [WindowLag(w.time - middle, w.lag - drift * (w.time - middle), w.deviation) for w in lags]


def mask_standstill(time_ns: np.ndarray, values: np.ndarray, speed_time_ns: np.ndarray, speed: np.ndarray,
                    threshold: float = 0.3) -> np.ndarray:
    """The values, with NaN where no speed above `threshold` [m/s] was recorded within 2 s. Standstill contains no
    information about the offset, but correlates with every other standstill."""
    moving_ns = speed_time_ns[np.isfinite(speed) & (np.abs(speed) > threshold)]
    if not len(moving_ns):
        return np.full(len(values), np.nan)
    last = np.flatnonzero(np.append(np.diff(moving_ns) > 2 * STANDSTILL_MARGIN_NS, True))  # in each interval
    first = np.append(0, last[:-1] + 1)
    index = np.searchsorted(moving_ns[first] - STANDSTILL_MARGIN_NS, time_ns, side="right") - 1
    moves_nearby = (index >= 0) & (time_ns <= moving_ns[last[index]] + STANDSTILL_MARGIN_NS)
    return np.where(moves_nearby, values, np.nan)


def _fit_robust_line(time: np.ndarray, offset: np.ndarray) -> tuple[np.ndarray, np.ndarray, float, np.ndarray]:
    """((offset [s], drift), residuals [s], scale of the residuals [s], covariance of offset and drift)."""
    design = np.stack([np.ones_like(time), time], axis=1)
    weight = np.ones_like(time)
    for _ in range(20):
        solution = np.linalg.lstsq(design * weight[:, None], offset * weight, rcond=None)[0]
        residual = offset - design @ solution
        scale = max(SIGMA_PER_MAD * float(np.median(np.abs(residual))), 1e-5)
        weight = (1 + (residual / (2 * scale)) ** 2) ** -0.25
    weighted_design = design * weight[:, None]
    prior = np.diag([0.0, (scale / (DRIFT_PRIOR_PPM * 1e-6)) ** 2])
    return solution, residual, scale, scale**2 * np.linalg.inv(weighted_design.T @ weighted_design + prior)


def align_by_time_frame(other_time_ns: np.ndarray, reference_time_ns: np.ndarray, resolution: float = 0.001,
                        latency: float = 0.0, latency_uncertainty: float = 0.0) -> Alignment:
    """Alignment by CAN frames that contain the time of the INS: a robust line (soft L1) through their offsets, or
    through the median offset of each second if there are two or more frames per second.

    other_time_ns: log stamps [ns] of the frames that contain a time; before GNSS lock, frames contain none.
    reference_time_ns: UTC in these frames [ns], with a resolution [s]. latency: delay from the time in a frame to its
    log stamp [s], with standard deviation latency_uncertainty [s].
    """
    if len(other_time_ns) < 2:
        return refused_alignment("fewer than two time frames contain a time (did the INS have no GNSS lock?)")
    if abs(int(other_time_ns[-1]) - int(other_time_ns[0])) * 1e-9 > MAX_SPAN:
        return refused_alignment("the log spans days: its clock was probably set during the recording")
    other_ns, reference_ns = int(other_time_ns[0]), int(reference_time_ns[0])
    time = (other_time_ns - other_ns) * 1e-9 - latency
    offset = (reference_time_ns - reference_ns) * 1e-9 - time
    second = np.floor(time - time[0]).astype(np.int64)
    edges = np.nonzero(np.diff(second, prepend=second[0] - 1, append=second[-1] + 1))[0]
    if len(edges) - 1 <= 0.5 * len(time):
        time, offset = (np.array([np.median(v[a:b]) for a, b in pairwise(edges)]) for v in (time, offset))
    middle = float(time[0] + time[-1]) / 2
    solution, residual, scale, covariance = _fit_robust_line(time - middle, offset)
    # The truncation error does not average out if the frame interval is nearly a multiple of the resolution.
    rounding = resolution / np.sqrt(12)
    result = Alignment(
        other_ns + round(middle * 1e9), reference_ns - other_ns + round(float(solution[0]) * 1e9),
        float(solution[1]) * 1e6,
        float(np.sqrt(covariance[0, 0] + rounding**2 + latency_uncertainty**2)),
        float(np.sqrt(covariance[1, 1])) * 1e6, "time frame", Verdict.GOOD, overlap=float(time[-1] - time[0]))
    # The offsets are searched for a step, not the residuals, because a step also changes the slope of the fitted line.
    median, edges = np.median(offset), np.linspace(0, len(time), min(len(time), MAX_WINDOWS) + 1).astype(int)
    lags = [WindowLag(float(np.median(time[a:b])) - middle, float(np.median(offset[a:b]) - median), scale)
            for a, b in pairwise(edges)]
    step = find_clock_step(lags)
    if step and abs(step.size) > MAX_CLOCK_STEP:
        return replace(result, verdict=Verdict.REFUSED, reasons=(describe_step(step.size, step.time),))
    doubts = []
    worst = int(np.argmax(np.abs(residual)))
    if abs(residual[worst]) > MAX_TIME_FRAME_RESIDUAL:
        doubts.append(f"the time frames do not lie on one line: {residual[worst] * 1e3:+.0f} ms at "
                      f"{time[worst] - middle:+.0f} s from the middle (a clock may have been set)")
    doubts += _describe_unusual_drift(result)
    return result.with_doubts(*doubts)


def measure_window_lags(pairs: Sequence[Pair], offset: float, search: float) -> list[WindowLag]:
    """Lags of windows of 30 s, relative to `offset` [s] and within +/- `search` [s]. Windows with a low or ambiguous
    correlation or an uncertain lag are left out."""
    lags = []
    first = min(p.other.origin for p in pairs)
    last = max(p.other.time[-1] for p in pairs)
    for start in np.arange(first, last - WINDOW_DURATION / 2, max(WINDOW_DURATION, (last - first) / MAX_WINDOWS)):
        middle = start + WINDOW_DURATION / 2
        segments = [Pair(p.name, _cut(p.reference, start + offset - search, start + offset + WINDOW_DURATION + search),
                         _cut(p.other, start, start + WINDOW_DURATION)) for p in pairs]
        segments = [p for p in segments if p.other.known.sum() * STEP > WINDOW_DURATION / 3 and p.reference.known.any()]
        peaks = find_peaks(segments, WINDOW_DURATION / 3) if segments else None
        if peaks is None:
            continue
        best, second = peaks
        if best.correlation < MIN_CORRELATION or second.correlation > MAX_PEAK_RATIO * best.correlation:
            continue
        try:
            fine = fit(segments, best.offset, middle, free_drift=False)
        except ValueError:
            continue
        if fine.offset_deviation < MAX_LAG_DEVIATION and abs(fine.offset - offset) <= search + 1.0:
            lags.append(WindowLag(float(middle), fine.offset - offset, fine.offset_deviation))
    return lags


def _cut(signal: Series, start: float, end: float) -> Series:
    low = int(np.clip(np.ceil((start - signal.origin) / STEP), 0, len(signal.values)))
    high = int(np.clip(np.ceil((end - signal.origin) / STEP), low, len(signal.values)))
    return Series(signal.origin + low * STEP, signal.values[low:high], signal.known[low:high])


def find_clock_step(lags: Sequence[WindowLag]) -> ClockStep | None:
    """The step that explains the window lags far better than a straight line; None if there is no such step.

        lag(t) = a + b t     against     lag(t) = a + b t + size [t > time],     prior of b: 0 +/- 50 ppm

    There must be at least two windows on each side; a step below 10 ms is ignored.
    """
    if len(lags) < 4:
        return None
    time = np.array([w.time for w in lags])
    lag = np.array([w.lag for w in lags])
    deviation = np.array([max(w.deviation, 1e-3) for w in lags])
    time = time - time.mean()
    line = np.stack([np.ones_like(time), time], axis=1)
    cost_without_step, _ = _fit_with_drift_prior(line, lag, deviation)
    fits = []
    for k in range(2, len(lags) - 1):
        after = (np.arange(len(lags)) >= k).astype(float)
        cost, solution = _fit_with_drift_prior(np.column_stack([line, after]), lag, deviation)
        fits.append((cost, ClockStep((lags[k - 1].time + lags[k].time) / 2, float(solution[2]))))
    cost, step = min(fits, key=lambda candidate: candidate[0])
    return step if cost_without_step - cost >= MIN_STEP_COST_REDUCTION and abs(step.size) >= MIN_CLOCK_STEP else None


def _fit_with_drift_prior(design: np.ndarray, value: np.ndarray, deviation: np.ndarray) -> tuple[float, np.ndarray]:
    """(sum of capped squares, solution) of a robust fit; the prior of the drift, column 1, is 0 +/- TYPICAL_DRIFT."""
    prior = np.zeros((1, design.shape[1]))
    prior[0, 1] = 1 / TYPICAL_DRIFT
    weight = 1 / deviation
    for _ in range(10):
        rows = np.vstack([design * weight[:, None], prior])
        solution = np.linalg.lstsq(rows, np.append(value * weight, 0.0), rcond=None)[0]
        scaled_residual = (value - design @ solution) / deviation
        weight = 1 / deviation / np.sqrt(1 + (scaled_residual / OUTLIER_LIMIT) ** 2)
    cost = np.minimum(scaled_residual**2, OUTLIER_LIMIT**2).sum() + (solution[1] / TYPICAL_DRIFT) ** 2
    return float(cost), solution
