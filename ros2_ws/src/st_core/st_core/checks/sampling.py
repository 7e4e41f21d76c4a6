"""Checks of sampling (time stamps, gaps, held, frozen, clipped and rounded values) and of the INS status."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.integrate import cumulative_trapezoid

from ..log import INS_SIGNALS, OPTIONAL_INS_SIGNALS, STEERING
from ..prediction import PredictionSettings
from ..regression import white_noise
from ..timeseries import NANOSECOND, find_ascending
from .finding import HORIZON, LIMITS, Advice, AuxiliaryData, Finding, InsQuality, Sampling, Severity, merge_findings
from .motion import MAX_GAP, MAX_LISTED_TIMES, Motion, find_groups, find_spans, find_time_intervals

UNITS = {"x": "m", "y": "m", "yaw": "rad", "velocity_x": "m/s", "velocity_y": "m/s", "yaw_rate": "rad/s",
         "acceleration_x": "m/s^2", "acceleration_y": "m/s^2", "road_wheel_angle": "rad"}
ALL_INS_SIGNALS = "every INS signal"
STAMPED_CHANNELS = {"INS": ("time",), "steering": ("road_wheel_angle",)}  # channels affected by wrong time stamps
MIN_HELD_FRACTION = 0.7  # minimum fraction of the samples that are in groups of equal values, of about median length
MIN_HELD_RATE = 15.0  # Hz; at 15 m/s, positions held at this rate lag by up to 1 m, and by 0.5 m on average
PREDICTION_GAP = PredictionSettings().maximum_gap
MAX_ANGLE_INTERVAL = 0.5  # s; largest sampling interval at which turns are compared: half a window of `compute_ratios`
MAX_LONG_FRACTION = 0.05  # fraction of intervals above PREDICTION_GAP; at 10 Hz, 92 % of 5 s horizons then contain one
MAX_GAP_FRACTION = 0.05  # fraction of the time in gaps above which whole driving conditions may be missing
MIN_ROWS_PER_SAMPLE = 1.5  # minimum sampling interval, in rows, of a sensor that is slower than the rows
SPACING_TOLERANCE = 0.05  # largest relative deviation of the sensor's mean sampling interval from the expected one
MIN_FREEZE_TIME = 1.5  # s; minimum duration of a frozen channel
MIN_CLIP_TIME = 0.3  # s; minimum duration of a clipped value
MIN_CURVATURE_SPEED = 2.0  # m/s; at lower speeds, the curvature is not checked
MIN_CURVATURE_CHANGE = 0.1  # minimum relative change of the curvature while a clipped steering angle is constant
MIN_FROZEN_CURVATURE_CHANGE = 0.3  # MIN_CURVATURE_CHANGE of a frozen angle; saturating tyres cause 0.2
CLIP_RATIO = 8.0  # minimum number of samples at a clipped value, divided by the number at each adjacent value
MIN_FREEZE_RATIO = 10.0  # minimum ratio of the duration of a frozen value to the 98 % quantile for all constant values
OPTIONAL_CHANNELS = ("velocity_y", "acceleration_x", "acceleration_y")  # not needed to score predicted paths
MAX_INTERVAL_RATIO = 1.5  # largest ratio of a sampling interval to the median; a longer one contains a lost sample
MAX_AXIS_FRACTION = 0.9  # fraction of the speed along one axis above which the other coordinate may be constant
MAX_SPEED_NOISE = 0.5  # m/s; reported by a receiver at standstill while the position is constant
MAX_GYRO_BIAS = 0.02  # rad/s; a constant yaw counts as frozen only at a larger yaw rate
LOCKED_STATUS = 4  # NCOM byte 21
RTK_MODES = (5, 6, 15, 16, 23, 24, 28, 29)  # NCOM position modes RTK float and integer: live, post-processed, gx, ix
ROUNDING_STEPS = 3.0  # expected change, in steps of the resolution, below which a rounded channel may stay constant
MIN_MEASURED_STEPS = 20  # minimum number of steps or intervals from which a resolution or a rate is estimated


def describe_channels(motion: Motion, auxiliary: AuxiliaryData) -> dict[str, Sampling]:
    """Rate, gaps, noise and resolution of every channel of the drive."""
    channels = {}
    for name, time, values in _iterate_channels(motion):
        spacing = np.diff(time)
        channels[name] = Sampling(
            UNITS[name], len(values), float(1.0 / np.median(spacing)), int((spacing > MAX_GAP).sum()),
            float(spacing.max()), white_noise(values) if len(values) > 3 else 0.0, estimate_resolution(time, values),
            float(np.mean(np.diff(values) == 0.0)), int(auxiliary.missing.get(name, 0)))
    return channels


def _iterate_channels(motion: Motion) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """(name, time [s], values) of each recorded channel, without NaN, if it has three samples or more."""
    for name in UNITS:
        time, values = ((motion.steering_time, motion.steering) if name == "road_wheel_angle" else
                        (motion.time, getattr(motion, name)))
        if values is not None and (finite := np.isfinite(values)).sum() >= 3:
            yield name, time[finite], values[finite]


def estimate_resolution(time: np.ndarray, values: np.ndarray) -> float:
    """Quantisation step of values, in their unit; 0 if they are not quantised. time: ascending [s]. Steps across lost
    samples are ignored, because in uniform motion they are always multiples of one step."""
    spacing = np.diff(time)
    steps = np.abs(np.diff(values))[spacing < MAX_INTERVAL_RATIO * float(np.median(spacing))]
    all_change, steps = bool((steps > 0.0).all()), steps[steps > 0.0]
    if len(steps) < MIN_MEASURED_STEPS:
        return 0.0
    smallest = float(np.percentile(steps, 2))
    multiples = steps / smallest
    # Uniform motion without noise also has equal steps, but rounded values repeat or step by different multiples.
    if all_change and float(np.ptp(multiples)) < 0.5:
        return 0.0
    is_on_grid = np.abs(multiples - np.round(multiples)) < 0.1
    small = multiples < 4.5  # larger multiples fit any grid
    return smallest if small.sum() >= 10 and is_on_grid[small].mean() > 0.95 else 0.0


def check_timing(motion: Motion, auxiliary: AuxiliaryData, excluded: Sequence[Finding],
                 start_ns: int) -> Iterator[Finding]:
    """Findings about time stamps, gaps and missing values. excluded: findings about samples that were left out; their
    times are not reported as gaps. start_ns: zero of the times in the findings."""
    for signal, stamps in auxiliary.stamps.items():
        yield from _check_stamps(signal, np.asarray(stamps, np.int64), start_ns)
    for signal, time in (("INS", motion.time), ("steering", motion.steering_time)):
        yield from _check_gaps(signal, time, [interval for finding in excluded for interval in finding.times])
    yield from merge_findings(_make_missing_values_finding(channel, count, motion, auxiliary)
                              for channel, count in auxiliary.missing.items() if count)


def _make_missing_values_finding(channel: str, count: int, motion: Motion, auxiliary: AuxiliaryData) -> Finding:
    time, signal = (motion.steering_time, "steering") if channel in STEERING else (motion.time, "INS")
    stamps = auxiliary.stamps.get(signal, auxiliary.stamps.get("INS", np.zeros(0)))
    row_is_kept = channel in OPTIONAL_INS_SIGNALS  # a row that lacks only such a signal is kept
    fraction, rate = count / max(len(time) + (0 if row_is_kept else count), 1), 0.0
    spacing, row_spacing = np.diff(time), np.diff(stamps * NANOSECOND)
    if not row_is_kept and min(len(spacing), len(row_spacing)) >= MIN_MEASURED_STEPS:
        # Evenly spaced samples indicate a sensor slower than the rows; one interval in a hundred may deviate.
        row = float(np.median(row_spacing))
        expected = row / max(1.0 - fraction, 1e-9)
        within = np.abs(spacing - expected) <= 1.05 * row
        if expected >= MIN_ROWS_PER_SAMPLE * row and np.mean(~within) <= LIMITS.max_note_fraction and (
                abs(float(spacing[within].mean()) / expected - 1.0) <= SPACING_TOLERANCE):
            rate = 1.0 / expected
    if rate:
        text = (f"{channel}: {100 * fraction:.3g} % of the rows have no value, and the others are evenly spaced: it "
                f"was recorded at {rate:.3g} Hz")
        advice = "no action is needed if that is the sensor's rate"
    else:
        text = (f"{channel}: {count} rows have no usable value ({100 * fraction:.3g} %); they were "
                f"{'kept without it' if row_is_kept else 'left out'}")
        advice = "check what the logger writes in these rows"
    severity = Severity.NOTE if rate or fraction <= LIMITS.max_note_fraction else Severity.WARNING
    return Finding("values_missing", severity, (channel,), text, fraction, advice=Advice("text", advice))


def make_rejected_frames_finding(time: np.ndarray, frames: int, reason: str) -> Finding:
    """Finding about steering frames that the decoder rejected. time: of these frames, ascending [s since the first INS
    measurement]. frames: number of all frames."""
    fraction = len(time) / frames
    text = (f"road_wheel_angle: {len(time)} of {frames} frames between {time[0]:.2f} and {time[-1]:.2f} s were "
            f"received but not used: {reason}")
    severity = Severity.NOTE if fraction <= MAX_GAP_FRACTION else Severity.WARNING
    advice = Advice("text", "check the steering sensor, and its range and max_rate in the signal table")
    return Finding("values_missing", severity, ("road_wheel_angle",), text, fraction,
                   times=find_time_intervals(time, MAX_GAP), advice=advice)


def _check_stamps(signal: str, stamps: np.ndarray, start_ns: int) -> Iterator[Finding]:
    if len(stamps) < 2:
        return
    step, is_ascending = np.diff(stamps), find_ascending(stamps)
    newest = np.maximum.accumulate(np.where(is_ascending, stamps, stamps[is_ascending][0]))[:-1]
    lost_rows = ~is_ascending & np.append(True, step != 0)
    for name, faulty, lost in (("time_order", step < 0, lost_rows), ("time_duplicates", step == 0, step == 0)):
        if not faulty.any():
            continue
        count, fraction = int(lost.sum()), float(lost.sum()) / len(stamps)
        largest = -float(step.min()) * NANOSECOND
        was_reset = name == "time_order" and largest > MAX_GAP
        times = tuple((float(t), float(t)) for t in (newest[faulty] - start_ns)[:MAX_LISTED_TIMES] * NANOSECOND)
        if was_reset:
            text = (f"{signal} time stamps jump back {int(faulty.sum())} time{'s' if faulty.sum() > 1 else ''}, by "
                    f"up to {largest:.4g} s: {count} of {len(stamps)} rows ({100 * fraction:.3g} %) are not used")
            advice = "check the logger: its clock was set back, or it restarted; split the recording there into runs"
        else:
            text = (f"{count} of {len(stamps)} {signal} time stamps "
                    f"{'are out of order' if name == 'time_order' else 'are duplicates'}; those rows were left out")
            advice = "check how the rows were time-stamped and merged"
        severity = Severity.WARNING if was_reset or fraction > LIMITS.max_note_fraction else Severity.NOTE
        yield Finding(name, severity, STAMPED_CHANNELS[signal], text, fraction, times=times,
                      advice=Advice("text", advice))


def _check_gaps(signal: str, time: np.ndarray, excluded_times: Sequence[tuple[float, float]]) -> list[Finding]:
    if len(time) < 2:
        return []
    spacing = np.diff(time)
    typical = float(np.median(spacing))
    long_fraction = float((np.round(spacing, 9) > PREDICTION_GAP).mean())
    # At twice the required rate or above, long intervals are gaps, which are listed with their times below.
    if typical > 0.5 * PREDICTION_GAP and long_fraction > MAX_LONG_FRACTION:
        text = (f"the {signal} has one sample every {typical:.3g} s, and {100.0 * long_fraction:.0f} % of the "
                f"intervals exceed {PREDICTION_GAP:g} s; no prediction is made across these, so few or none can be "
                "scored")
        if signal == "INS" and typical > MAX_GAP:
            exception = ", except for axes and units of angles" if typical <= MAX_ANGLE_INTERVAL else ""
            text += f"; channels are not compared with each other{exception}"
        return [Finding("time_gaps", Severity.WARNING, STAMPED_CHANNELS[signal], text, typical, "s",
                        advice=Advice("text", f"record the {signal} at a higher rate, or check whether "
                                      "samples are lost"))]
    gaps = [k for k in np.flatnonzero(spacing > MAX_GAP)
            if not any(time[k] < begin and end < time[k + 1] for begin, end in excluded_times)]
    if not gaps:
        return []
    missing = float((spacing[gaps] - typical).sum())
    times = tuple((float(time[k]), float(time[k + 1])) for k in gaps)
    fraction = missing / max(float(time[-1] - time[0]), 1e-9)
    severity = Severity.WARNING if fraction > MAX_GAP_FRACTION else Severity.NOTE
    text = (f"{len(gaps)} gap{'s' if len(gaps) > 1 else ''} in the {signal} data, {missing:.2f} s in total, longest "
            f"{spacing[gaps].max():.2f} s: no prediction is scored there")
    return [Finding("time_gaps", severity, STAMPED_CHANNELS[signal], text, missing, "s", times=times,
                    advice=Advice("text", "check the logger: lost packets, a full buffer, a restart, or a clock step"))]


def find_stuck_channels(motion: Motion, channels: Mapping[str, Sampling]) -> list[Finding]:
    """Findings about channels that are held at a lower rate, clipped, or constant while the car moves."""
    is_new = np.any([np.diff(getattr(motion, name), prepend=np.nan) != 0.0 for name in INS_SIGNALS], axis=0)
    findings = _check_frozen(ALL_INS_SIGNALS, motion.time, np.cumsum(is_new), motion, 0.0, MAX_GAP)
    motion = drop_frozen_samples(motion, findings)
    for name, time, values in _iterate_channels(motion):
        resolution = channels[name].resolution
        findings += (_check_held(name, time, values) or _check_clipped(name, time, values, motion, resolution)
                     or _check_frozen(name, time, values, motion, resolution))
    return merge_findings(findings)


def find_coarse_channels(motion: Motion, held: set[str]) -> list[Finding]:
    """Findings about channels rounded so coarsely that the initial state has a relevant error, except held channels."""
    speed = float(np.median(motion.speed))
    findings = []
    for name, (distance, grows_with_speed) in POSITION_EFFECT.items():
        step, unit = estimate_resolution(motion.time, getattr(motion, name)), UNITS[name]
        # The standard deviation of the rounding error is step / sqrt(12).
        effect = step / np.sqrt(12.0) * distance * (speed if grows_with_speed else 1.0)
        if name in held or effect < LIMITS.min_reported_effect:
            continue
        degrees = f" ({np.rad2deg(step):.2g} deg)" if unit.startswith("rad") else ""
        findings.append(Finding("resolution_coarse", LIMITS.severity(effect), (name,),
                                f"{name} is rounded to {step:.3g} {unit}{degrees}", step, unit, effect=effect,
                                advice=Advice("text", f"log {name} with more digits")))
    step = estimate_resolution(motion.steering_time, motion.steering) if len(motion.steering) > 1 else 0.0
    if step >= LIMITS.steering_offset and "road_wheel_angle" not in held:
        text = f"road_wheel_angle is rounded to {step:.3g} rad ({np.rad2deg(step):.2g} deg at the road wheels)"
        findings.append(Finding("resolution_coarse", Severity.WARNING, ("road_wheel_angle",), text, step, "rad",
                                advice=Advice("text", "log the steering with more digits")))
    return merge_findings(findings)


def _check_held(name: str, time: np.ndarray, values: np.ndarray) -> list[Finding]:
    """Finding about a channel that changes only once in k samples, with a constant k."""
    first, last = find_groups(np.diff(values) != 0.0)
    lengths = last - first + 1
    if len(lengths) < MIN_MEASURED_STEPS:
        return []
    median = float(np.median(lengths))
    regular_fraction = float(lengths[np.abs(lengths - median) <= max(0.1 * median, 0.5)].sum() / lengths.sum())
    if median < 2.0 or regular_fraction < MIN_HELD_FRACTION:
        return []
    rate = 1.0 / (median * float(np.median(np.diff(time))))
    text = f"{name} changes only once in {median:g} samples: it was recorded at {rate:.3g} Hz and held"
    severity = Severity.WARNING if rate < MIN_HELD_RATE else Severity.NOTE
    return [Finding("samples_repeated", severity, (name,), text, 1.0 - len(lengths) / len(values),
                    advice=Advice("text", f"log {name} at its own rate, or interpolate it first"))]


def _check_clipped(name: str, time: np.ndarray, values: np.ndarray, motion: Motion, resolution: float) -> list[Finding]:
    """Finding about a channel that stays at its largest or smallest value several times, while other channels change. A
    rounded signal also repeats its maximum, but repeats the adjacent value almost as often."""
    first, last = find_groups(np.diff(values) != 0.0)
    lengths = last - first + 1
    clipped: list[int] = []
    for limit in (values.min(), values.max()) if name in RELATED_QUANTITIES and len(first) > 2 else ():
        long = 1 + np.flatnonzero((values[first[1:-1]] == limit) & (
            lengths[1:-1] > CLIP_RATIO * np.maximum(lengths[:-2], lengths[2:])))
        held = [int(k) for k in long if time[last[k]] - time[first[k]] > MIN_CLIP_TIME
                and _should_change(name, time[first[k]], time[last[k]], motion, resolution)]
        clipped += held if len(held) > 1 else []
    if not clipped:
        return []
    times = tuple(sorted((float(time[first[k]]), float(time[last[k]])) for k in clipped))
    limits = " and ".join(f"{limit:.4g}" for limit in sorted({float(values[first[k]]) for k in clipped}))
    text = f"{name} stays at {limits} {UNITS[name]} {len(clipped)} times while other channels change: it is clipped"
    advice = Advice("text", f"increase the range of the sensor or of its signal: the true {name} is beyond it"
                    + (", unless the steering is at its stop" if name == "road_wheel_angle" else ""))
    return [Finding("channel_clipped", Severity.WARNING, (name,), text, float(np.abs(values[first[clipped]]).max()),
                    UNITS[name], times=times, advice=advice)]


def _check_frozen(name: str, time: np.ndarray, values: np.ndarray, motion: Motion, resolution: float,
                  min_time: float = MIN_FREEZE_TIME) -> list[Finding]:
    """Finding about a channel constant for more than `min_time` [s], much longer than usual, while others change."""
    first, last = find_groups(np.diff(values) != 0.0)
    duration = time[last] - time[first]
    usual_duration = float(np.sort(duration)[max(int(0.98 * len(duration)) - 1, 0)]) if len(duration) > 5 else 0.0
    frozen = [k for k in np.flatnonzero(duration > max(min_time, MIN_FREEZE_RATIO * usual_duration))
              if _should_change(name, time[first[k]], time[last[k]], motion, resolution, MIN_FROZEN_CURVATURE_CHANGE)]
    if not frozen:
        return []
    seconds = float(duration[frozen].sum())
    times = tuple((float(time[first[k]]), float(time[last[k]])) for k in frozen)
    text = f"{name} is constant for {seconds:.1f} s while the car moves"
    if name == "velocity_y" and not values.any():
        text = "velocity_y is missing or 0 throughout, so the initial sideslip of each prediction is unknown"
    throughout = seconds > 0.5 * float(time[-1] - time[0])
    severity = Severity.ERROR if throughout and name not in OPTIONAL_CHANNELS else Severity.WARNING
    if throughout:
        advice = Advice("text", f"record {name}; no correction can replace it")
    elif name == "road_wheel_angle":
        advice = Advice("text", "check the steering sensor: its frames repeat one value")
    else:
        advice = Advice.for_run_yaml({"leave_out": [[round(begin, 2), round(end, 2)] for begin, end in times]})
    affected = INS_SIGNALS if name == ALL_INS_SIGNALS else (name,)
    return [Finding("channel_frozen", severity, affected, text, seconds, "s", times=times, advice=advice)]


def _should_change(name: str, begin: float, end: float, motion: Motion, resolution: float,
                   min_curvature_change: float = MIN_CURVATURE_CHANGE) -> bool:
    """Whether a channel should have changed by more than its resolution, according to the other channels.
    min_curvature_change: smallest relative change of the curvature at which the steering angle should have changed."""
    in_interval = (motion.time >= begin) & (motion.time <= end)
    if name == "road_wheel_angle":
        in_interval &= np.abs(motion.velocity_x) > MIN_CURVATURE_SPEED
    if in_interval.sum() < 3:
        return False
    if name in RATES:
        rate, bias, min_change = RATES[name]
        rises = [cumulative_trapezoid(sign * rate(motion)[in_interval] - bias, motion.time[in_interval], initial=0.0)
                 for sign in (1.0, -1.0)]  # between any two times, as the net change of a lap is 0
        change = max(float((rise - np.minimum.accumulate(rise)).max()) for rise in rises)
        return change > max(ROUNDING_STEPS * resolution, min_change)
    related, min_change = RELATED_QUANTITIES[name]
    expected = related(motion)[in_interval]
    change = np.ptp(np.percentile(expected, [5, 95]))
    if name == "road_wheel_angle":  # while the wheel is held, as at its stop, curvature changes with speed only
        speed = motion.velocity_x[in_interval]
        curvature, terms = expected / speed, np.stack([np.ones_like(speed), speed**2], axis=1)
        residual = curvature - terms @ np.linalg.lstsq(terms, curvature, rcond=None)[0]
        return bool(change > min_change and np.ptp(np.percentile(residual, [5, 95]))
                    > min_curvature_change * np.median(np.abs(curvature)))
    return bool(change > max(min_change, ROUNDING_STEPS * resolution if name in CHANNELS_WITH_SAME_UNIT else 0.0))


def _compute_mean_rate(time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Mean rate of change in the half second after each sample; within half a second of the end, the last rate."""
    count = max(round(0.5 / float(np.median(np.diff(time)))), 1)
    rate = (values[count:] - values[:-count]) / (time[count:] - time[:-count])
    return np.concatenate([rate, np.full(len(time) - len(rate), rate[-1] if len(rate) else 0.0)])


def _compute_rate_along_axis(motion: Motion, velocity: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Velocity along an axis of the map; 0 where the positions along the other axis account for the speed, since
    the cause may be a yaw error."""
    return np.where(np.abs(_compute_mean_rate(motion.time, other)) < MAX_AXIS_FRACTION * motion.speed, velocity, 0.0)


# Position error [m] at the end of the horizon per unit of initial error; whether it is proportional to the speed.
POSITION_EFFECT = {
    "x": (1.0, False), "y": (1.0, False), "yaw": (HORIZON, True), "velocity_x": (HORIZON, False),
    "velocity_y": (LIMITS.yaw_settling_time * HORIZON, False), "yaw_rate": (LIMITS.yaw_settling_time * HORIZON, True)}
# By channel: its rate of change from other channels, the largest bias of that rate, and the smallest expected change.
RATES: Mapping[str, tuple[Callable[[Motion], np.ndarray], float, float]] = {
    ALL_INS_SIGNALS: (lambda m: m.speed, MAX_SPEED_NOISE, 1.0),
    "x": (lambda m: _compute_rate_along_axis(m, m.velocity_map.real, m.y), MAX_SPEED_NOISE, 1.0),
    "y": (lambda m: _compute_rate_along_axis(m, m.velocity_map.imag, m.x), MAX_SPEED_NOISE, 1.0),
    "yaw": (lambda m: m.yaw_rate, MAX_GYRO_BIAS, 0.05)}
# By channel: a quantity derived from other channels, and its range [SI] above which the channel cannot be constant.
RELATED_QUANTITIES: Mapping[str, tuple[Callable[[Motion], np.ndarray], float]] = {
    "velocity_x": (lambda m: np.hypot(_compute_mean_rate(m.time, m.x), _compute_mean_rate(m.time, m.y)), 0.3),
    "velocity_y": (lambda m: m.yaw_rate, 0.05),
    "acceleration_x": (lambda m: _compute_mean_rate(m.time, m.velocity_x), 0.5),
    "acceleration_y": (lambda m: m.velocity_x * m.yaw_rate, 0.5),
    "yaw_rate": (lambda m: _compute_mean_rate(m.time, m.yaw), 0.05),
    "road_wheel_angle": (lambda m: m.yaw_rate, 0.05),
}
CHANNELS_WITH_SAME_UNIT = ("velocity_x", "acceleration_x", "acceleration_y", "yaw_rate")  # as their related quantity


def drop_frozen_samples(motion: Motion, findings: Sequence[Finding]) -> Motion:
    """The motion with gaps in place of the samples of frozen or clipped channels, unless these are the majority."""
    for finding in (f for f in findings if f.name in ("channel_frozen", "channel_clipped")):
        for is_steering in {channel == "road_wheel_angle" for channel in finding.channels}:
            time = motion.steering_time if is_steering else motion.time
            usable = ~np.any([(time >= begin) & (time <= end) for begin, end in finding.times], axis=0)
            if usable.sum() > 0.5 * len(usable):
                motion = motion.select_ins(usable) if not is_steering else replace(
                    motion, steering_time=time[usable], steering=motion.steering[usable])
    return motion


def interpolate_held_channels(motion: Motion, held: set[str]) -> Motion:
    """The motion with held INS channels interpolated between their changes."""
    for name in held & {*INS_SIGNALS, *OPTIONAL_INS_SIGNALS}:
        if (values := getattr(motion, name)) is not None:
            changes = np.flatnonzero(np.diff(values, prepend=np.nan) != 0.0)
            motion = replace(motion, **{name: np.interp(motion.time, motion.time[changes], values[changes])})
    return motion


def check_quality(quality: InsQuality | None, start_ns: int) -> Iterator[Finding]:
    """Findings from the status and accuracy reported by the INS. start_ns: zero of the times [ns]."""
    if quality is None or len(quality.time_ns) < 2:
        return
    time = (quality.time_ns - start_ns) * NANOSECOND

    def list_times(mask: np.ndarray) -> tuple[tuple[float, float], ...]:
        return tuple((float(time[first]), float(time[last])) for first, last in find_spans(mask)[:MAX_LISTED_TIMES])

    mode, status = quality.position_mode, quality.navigation_status
    without_rtk = np.isfinite(mode) & (mode >= 0) & ~np.isin(mode, RTK_MODES)
    not_locked = np.isfinite(status) & (status != LOCKED_STATUS)
    for mask, condition in ((without_rtk, "without RTK"), (not_locked, "not locked")):
        if not mask.any():
            continue
        fraction = float(mask.mean())
        text = f"the INS is {condition} for {100 * fraction:.0f} % of the time, during which its positions may drift"
        severity = Severity.WARNING if fraction > LIMITS.max_note_fraction else Severity.NOTE
        yield Finding("ins_mode", severity, ("ins",), text, fraction, times=list_times(mask), advice=Advice(
            "text", "leave out these intervals, or post-process the raw data of the INS"))
    accuracy = quality.position_accuracy
    known = np.isfinite(accuracy)
    median = float(np.median(accuracy[known])) if known.any() else 0.0
    if median >= LIMITS.warning_effect:
        text = f"the median standard deviation of position reported by the INS is {median:.2f} m"
        yield Finding("ins_accuracy", LIMITS.severity(median), ("ins",), text, median, "m",
                      times=list_times(known & (accuracy >= LIMITS.warning_effect)), effect=median,
                      advice=Advice("text", "record with RTK, or post-process the raw data of the INS"))
