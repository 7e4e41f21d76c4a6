"""Checks of time stamps for bursts and jitter, and of positions for jumps, stale samples, noise and deviations."""

from dataclasses import replace

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.stats import binomtest

from ..log import DriveLog
from ..regression import SIGMA_PER_MAD
from ..timeseries import NANOSECOND
from .finding import HORIZON, LIMITS, Advice, Alternative, Finding, Severity
from .motion import MAX_GAP, MAX_LISTED_TIMES, MIN_MOVING_SPEED, Motion, estimate_spacing, even_out, find_time_intervals
from .position import VARYING_FINDINGS
from .sampling import MIN_MEASURED_STEPS, STAMPED_CHANNELS, estimate_resolution

OUTLIER_SIGMAS = 6.0  # number of robust standard deviations above which a step is not noise
MIN_DEVIATION_WINDOWS = 20  # minimum number of windows of 1 s in which deviations are checked
MIN_CHECKED_STEPS = 50  # minimum number of steps to check jitter, stale samples and noise
MIN_NOISE = 0.05  # m per axis; white noise is 2 cm for RTK positions, and far less for INS positions
MIN_JUMP = 0.2  # m; the distance in 10 ms at 20 m/s
MAX_LISTED_JUMPS = 50  # largest number of jumps that are listed and left out
JUMP_MARGIN = 0.5 * MAX_GAP + 0.01  # s; time left out on each side of a jump, so that a gap results
MIN_STALE_SAMPLES = 5
STALE_WARNING_FRACTION = 0.05  # fraction of stale samples above which their finding is a warning
MIN_AGE, MAX_AGE = 0.15, 1.2  # limits of the age of a stale sample divided by the sampling interval
MIN_AGE_RATIO, MAX_AGE_RATIO = 0.5, 1.6  # limits of the age of a stale sample divided by the median age
MAX_AGE_SPREAD = 0.35  # largest robust standard deviation of the ages of stale samples, divided by their median
MIN_STEP_BALANCE = 0.5  # minimum ratio between the numbers of forward and backward steps
MAX_CROSS_TRACK_FRACTION = 0.3  # largest cross-track component of the step of a stale sample, divided by the step
MAX_BURST_INTERVAL = 0.25  # largest interval within a burst, divided by the mean interval
MIN_BURST_LENGTH = 2.0  # minimum mean number of samples in a burst
MAX_STEP_RATIO = 1.5  # largest median step of an angle sent only on change, divided by its smallest step
MAX_PAUSE_RATIO = 3.0  # longest pause between bursts divided by the median one; longer ones are gaps


def spread_bursts(log: DriveLog) -> tuple[DriveLog, list[Finding]]:
    """(the drive, with evenly spaced time stamps of each signal that arrives in bursts; the findings)."""
    findings = []
    for signal, name, values in (("INS", "ins_time_ns", log.x + 1j * log.y),
                                 ("steering", "steering_time_ns", log.road_wheel_angle)):
        stamps = getattr(log, name)
        if len(stamps) < MIN_MEASURED_STEPS:
            continue
        time = (stamps - stamps[0]) * NANOSECOND
        spacing, steps = np.diff(time), np.abs(np.diff(values))
        is_pause = spacing > MAX_BURST_INTERVAL * estimate_spacing(time)
        count, period = len(spacing) / is_pause.sum(), float(np.median(spacing[is_pause]))  # samples per burst, s
        max_gap = max(MAX_PAUSE_RATIO * period, MAX_GAP)
        # An angle sent only on change never repeats, and mostly changes by one step of its resolution.
        is_sent_on_change = signal == "steering" and np.median(steps) < MAX_STEP_RATIO * steps.min()
        if count < MIN_BURST_LENGTH or is_sent_on_change or (  # or the signal changes more in the pauses: gaps
                MAX_BURST_INTERVAL * steps[is_pause & (spacing <= max_gap)].mean() > steps[~is_pause].mean()):
            continue
        # The last sample of a burst has the smallest delay.
        k, ends = np.arange(len(time)), np.append(np.flatnonzero(is_pause), len(time) - 1)
        end = ends[np.searchsorted(ends, k)]
        even = even_out(time[end] - (end - k) * estimate_spacing(time), round(MAX_PAUSE_RATIO * count), max_gap)
        deviation = float(np.std(time - even))
        log = replace(log, **{name: stamps[0] + np.round(even / NANOSECOND).astype(np.int64)})
        effect = deviation * float(np.median(np.abs(log.velocity_x))) if signal == "INS" else None
        text = (f"the {signal} samples come in bursts of {count:.0f} every {period:.2g} s: their time stamps are the "
                "times at which they were received or written, not measured")
        advice = Advice("text", "use the time of measurement (GPS time), or that of each message on the bus")
        findings.append(Finding("time_jitter", LIMITS.severity(effect or 0.0, deviation >= LIMITS.severe_lag),
                                STAMPED_CHANNELS[signal], text, deviation, "s", effect=effect, advice=advice))
    return log, findings


def check_position_steps(motion: Motion) -> tuple[Motion, list[Finding]]:
    """(motion, findings) of a check of position steps for jumps, stale samples, noise and jitter of the time stamps.

        d_k = p_k - p_{k-1} - integral of R(yaw) v dt

    A jump is one large d. A stale position, which is older by one receiver interval h, causes a step back along the
    track by v h, and the next new position an equal step forward. Time stamps that jitter are replaced by evenly spaced
    ones, and then nothing else is reported.
    """
    if len(motion.time) < MIN_CHECKED_STEPS:
        return motion, []
    # d_k, as east + i north [m], and its along-track part divided by the speed [s], NaN at standstill.
    errors = np.diff(motion.position) - np.diff(cumulative_trapezoid(motion.velocity_map, motion.time, initial=0.0))
    speed, to_track = motion.speed[1:], np.exp(-1j * np.angle(motion.velocity_map[1:]))  # rotation into the track
    along = np.where(speed > MIN_MOVING_SPEED, (errors * to_track).real / np.maximum(speed, MIN_MOVING_SPEED), np.nan)
    jitter = _check_jitter(motion, along)
    if jitter:
        return replace(motion, time=even_out(motion.time)), jitter
    rounding = max(estimate_resolution(motion.time, motion.x), estimate_resolution(motion.time, motion.y))
    is_stale, findings = _check_stale(motion, errors, along, rounding)
    findings += _check_jumps(motion, errors, along, is_stale, rounding)
    within = np.diff(motion.time) <= MAX_GAP
    if rounding == 0.0 and within.sum() >= MIN_CHECKED_STEPS:
        # With white noise of positions, |d_k - median| has a Rayleigh distribution with median 1.665 sigma.
        sigma = float(np.median(np.abs(_subtract_median(errors[within])))) / 1.665
        if sigma >= MIN_NOISE:
            text = f"positions are noisy: white noise with a standard deviation of {sigma:.2f} m per axis"
            advice = Advice("text", "record with RTK, or use the positions of the INS, not of the receiver")
            findings.append(Finding("position_noise", LIMITS.severity(sigma), ("x", "y"), text, sigma, "m",
                                    effect=sigma, advice=advice))
    return motion, findings


def _subtract_median(errors: np.ndarray) -> np.ndarray:
    return errors - np.median(errors.real) - 1j * np.median(errors.imag)


def _check_stale(motion: Motion, errors: np.ndarray, along: np.ndarray,
                 rounding: float) -> tuple[np.ndarray, list[Finding]]:
    """(mask of the steps due to stale samples, the findings). along: see `check_position_steps`."""
    known = np.isfinite(along)
    no_steps = np.zeros(len(along), bool)
    if known.sum() < MIN_CHECKED_STEPS:
        return no_steps, []
    step = along - np.median(along[known])  # s, < 0: back along the track
    spacing = float(np.median(np.diff(motion.time)))
    small = np.abs(step[known]) < MIN_AGE * spacing
    spread = SIGMA_PER_MAD * float(np.median(np.abs(step[known][small]))) if small.any() else np.inf
    speed = motion.speed[1:]
    across = np.sqrt(np.maximum(np.abs(errors) ** 2 - np.where(known, along * speed, 0.0) ** 2, 0.0))
    # At low speed, position noise resembles an age of many milliseconds, but is as large across the track as along it.
    noise = SIGMA_PER_MAD * float(np.median(across[known]))
    large = (known & (np.abs(step) > max(OUTLIER_SIGMAS * spread, MIN_AGE * spacing))
             & (np.abs(step) * speed > OUTLIER_SIGMAS * noise))
    # Stale samples cause steps along the track only, whereas jumps have any direction.
    if large.sum() < MIN_STALE_SAMPLES or np.median(across[large]) > MAX_CROSS_TRACK_FRACTION * np.median(
            np.abs(errors[large])):
        return no_steps, []
    age = float(np.median(np.abs(step[large])))
    ages_are_similar = SIGMA_PER_MAD * float(np.median(np.abs(np.abs(step[large]) - age))) < MAX_AGE_SPREAD * age
    back, forward = known & (step < -MIN_AGE_RATIO * age), known & (step > MIN_AGE_RATIO * age)
    steps_are_balanced = MIN_STEP_BALANCE < forward.sum() / max(back.sum(), 1) < 1.0 / MIN_STEP_BALANCE
    if not ages_are_similar or not steps_are_balanced or age > MAX_AGE * spacing or (
            float(np.median(np.abs(errors[large]))) < 3.0 * rounding):
        return no_steps, []
    fraction = float(back.sum() / known.sum())
    trials = max(round(float(known.sum()) * spacing), 1)  # errors of neighbouring samples are not independent
    ends = binomtest(round(fraction * trials), trials).proportion_ci(method="wilson")
    interval = min(float(ends.low), fraction), max(float(ends.high), fraction)
    text = (f"{100 * fraction:.3g} % of the positions are stale: they step back to where the car was "
            f"{age * 1e3:.0f} ms earlier, and the next ones step forward again")
    severity = Severity.WARNING if fraction > STALE_WARNING_FRACTION else Severity.NOTE
    is_stale = ((back | forward) & (np.abs(step) < MAX_AGE_RATIO * age)
                & (across < MAX_CROSS_TRACK_FRACTION * np.abs(errors)))
    times = find_time_intervals(motion.time[1:][back], 5.0)[:MAX_LISTED_TIMES]
    return is_stale, [Finding(
        "position_stale", severity, ("x", "y"), text, fraction, "1", interval, times,
        age * float(np.median(speed[known])),
        Advice("text", "record each position with the time of its measurement, or leave out rows with a stale one"))]


def _check_jumps(motion: Motion, errors: np.ndarray, along: np.ndarray, is_stale: np.ndarray,
                 rounding: float) -> list[Finding]:
    """Finding about large steps. A clock set forward by T during the drive acts like jumps -v T along the track."""
    size = np.abs(_subtract_median(errors))
    within = (np.diff(motion.time) <= MAX_GAP) & ~is_stale
    large = within & (size > max(OUTLIER_SIGMAS * SIGMA_PER_MAD * float(np.median(size)), MIN_JUMP, 2.0 * rounding))
    count = int(large.sum())
    if not count:
        return []
    times = tuple((float(motion.time[k]), float(motion.time[k + 1])) for k in np.flatnonzero(large))
    median, largest = float(np.median(size[large])), float(size[large].max())
    text = (f"positions jump {count} time{'s' if count > 1 else ''} without a matching velocity: median "
            f"{median:.2f} m, largest {largest:.2f} m")
    fraction = min(count * HORIZON / max(float(motion.time[-1] - motion.time[0]), 1.0), 1.0)
    effect = median * float(np.sqrt(fraction))
    # Intervals with jumps become gaps, across which no prediction is scored.
    advice = Advice.for_run_yaml({"leave_out": [
        [round(begin - JUMP_MARGIN, 2), round(end + JUMP_MARGIN, 2)]
        for begin, end in find_time_intervals(np.unique(times), 2.0 * JUMP_MARGIN)]})
    if count > MAX_LISTED_JUMPS:
        advice = Advice("text", "too many jumps to leave out: record with RTK, or post-process the raw data of the INS")
    finding = Finding("position_jumps", LIMITS.severity(effect, largest >= LIMITS.warning_effect), ("x", "y"), text,
                      float(count), "1", None, times[:MAX_LISTED_JUMPS], effect, advice)
    across = np.sqrt(np.maximum(1.0 - (along * motion.speed[1:] / np.abs(errors)) ** 2, 0.0))[large]
    if np.all(across < MAX_CROSS_TRACK_FRACTION):  # the advice is also valid for a clock step
        seconds = -float(along[large][np.argmax(np.abs(along[large]))])
        clock = Alternative(f"the clock jumped by {'up to ' if count > 1 else ''}{seconds:+.2f} s")
        finding = replace(finding, channels=("x", "y", "time"), alternatives=(clock,))
    return [finding]


def check_position_deviations(motion: Motion, findings: list[Finding]) -> list[Finding]:
    """Finding about times without jumps at which positions deviate from velocity and yaw within the horizon far more
    than usual. findings: those so far, for which `motion` is corrected."""
    windows, count = motion.make_windows(1.0), round(HORIZON)
    # A cause that varies during the drive leaves a residual after its correction, which is not a separate fault.
    if len(windows) < MIN_DEVIATION_WINDOWS or any(f.name in VARYING_FINDINGS and f.interval is None for f in findings):
        return []
    jumps = [time for finding in findings if finding.name == "position_jumps" for time in finding.times]
    errors = windows.change(motion.position) - windows.integral(motion.velocity_map)
    # The correction of a lag extrapolates the values at the edges of gaps.
    is_inner = np.append(False, windows.are_adjacent) & np.append(windows.are_adjacent, False)
    sums = np.cumsum(np.append(0.0, is_inner * _subtract_median(errors)))
    size, begin = np.abs(sums[count:] - sums[:-count]), windows.time[:1 - count]
    median = float(np.median(size))
    large = size > max(LIMITS.warning_effect, OUTLIER_SIGMAS * SIGMA_PER_MAD * median)
    times = tuple((first, last + HORIZON) for first, last in find_time_intervals(begin[large], HORIZON) if not any(
        first <= end and jump <= last + HORIZON for jump, end in jumps))
    if not times:
        return []
    inside = large & np.any([(begin >= first) & (begin <= last) for first, last in times], axis=0)
    largest, effect = float(size[inside].max()), float(np.sqrt(np.mean(np.where(inside, size, 0.0) ** 2)))
    text = (f"positions deviate {len(times)} time{'s' if len(times) > 1 else ''} from velocity and yaw, by up to "
            f"{largest:.2f} m within {HORIZON:g} s, but usually by {median:.2f} m: are satellite signals reflected or "
            "lost?")
    severity = LIMITS.severity(effect, severe=True)
    advice = Advice.for_run_yaml({"leave_out": [[round(first, 1), round(last, 1)] for first, last in times]})
    return [Finding("position_deviation", severity, ("x", "y"), text, largest, "m", None, times, effect, advice)]


def _check_jitter(motion: Motion, along: np.ndarray) -> list[Finding]:
    """Finding about uneven time stamps of a smooth motion, for which d / v = mean dt - dt."""
    spacing = np.diff(motion.time)
    median = float(np.median(spacing))
    inside = (spacing < MAX_GAP) & np.isfinite(along)
    if inside.sum() < MIN_CHECKED_STEPS:
        return []
    uneven = (spacing - median)[inside]
    power, deviation = float(np.sum(uneven**2)), float(np.std(uneven))
    # A few large steps are gaps or changes of the clock.
    few_large_steps = float(np.sort(uneven**2)[-MIN_STALE_SAMPLES:].sum()) > 0.5 * power
    # 1 if the motion is smooth, 0 if the stamps are correct
    slope = float(np.sum(along[inside] * -uneven) / max(power, 1e-300))
    effect = deviation * float(np.median(motion.speed[1:][inside]))
    if deviation < 0.05 * median or few_large_steps or slope < 0.5 or effect < LIMITS.min_reported_effect:
        return []
    text = f"the time stamps jitter by {deviation * 1e3:.1f} ms but the motion is smooth: they are times of reception"
    return [Finding("time_jitter", LIMITS.severity(effect), ("time",), text, deviation, "s", effect=effect,
                    advice=Advice("text", "use the time of measurement (GPS time)"))]
