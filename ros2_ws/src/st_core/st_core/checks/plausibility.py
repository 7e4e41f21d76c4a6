"""Detection of samples that are physically impossible: spikes, sentinel values, values out of range, wrap-arounds.

Each channel is examined alone, before any comparison, so that a faulty sample is not mistaken for a wrong unit. A step
from one sample to the next is large if it exceeds both a physical limit and a multiple of the channel's median step,
which makes the test valid in any unit:

    |v_k - v_{k-1}| > max(limit, 20 median |v_k - v_{k-1}|),   median of the non-zero steps
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..log import INS_SIGNALS, OPTIONAL_INS_SIGNALS, STEERING, DriveLog
from ..timeseries import NANOSECOND
from .finding import LIMITS, Advice, Finding, Severity, merge_findings
from .motion import MAX_GAP, MIN_MOVING_SPEED, estimate_spacing, find_groups, find_spans, find_time_intervals

STEP_MEDIAN_RATIO = 20.0  # minimum ratio of a large step to the median step; noise and quantisation cause smaller steps
HALF_WINDOW = 0.1  # s; half-width of the window that contains a sample's neighbours; at least 2.5 updates
MIN_SENTINEL_SAMPLES = 3  # minimum number of samples of one value between two large steps
MIN_ZERO_TIME = 0.2  # s; minimum duration of the value 0 as a sentinel
SENTINEL_HOLD_RATIO = 3.0  # minimum length of a run of zeros, divided by the 98 % quantile of all run lengths
MAX_IMPLAUSIBLE_FRACTION = 0.5  # above it, the channel is unusable, and none of its samples is left out
MIN_WRAP_RATIO = 0.3  # minimum wrap size divided by the largest plausible step; smaller wraps resemble real changes
WRAP_SPREAD, WRAP_SYMMETRY = 0.1, 0.2  # tolerances of a step and the sum of its ends, as fractions of the wrap size
MAX_WRAPPED_FRACTION = 0.2  # fraction of wrapped samples above which the true range is uncertain
MAX_NET_CHANGE_RATIO = 0.5  # largest ratio of net change to sum of |steps| in noise; 1 in a turn, in any unit
JUMP_RATIO = 30.0  # minimum ratio of a jump to the 90th percentile of non-zero steps; in 17 real drives below 15
MAX_REVERSAL_ERROR = 0.3  # rad; largest difference of a yaw jump from pi that counts as a reversal of the heading
MIN_SAMPLES = 20
MAX_LISTED_INTERVALS = 200  # largest number of time intervals of implausible samples listed in a finding
STEP_TIME = 0.05  # s; interval that `ChannelLimits.max_step` refers to


@dataclass(frozen=True)
class ChannelLimits:
    """Plausible changes and values of a channel of a road car."""

    unit: str
    max_step: float  # largest change within STEP_TIME [unit]; proportionally more in longer intervals
    max_magnitude: float = np.inf  # magnitude above which a value is out of range [unit]


CHANNEL_LIMITS: Mapping[str, ChannelLimits] = {
    "x": ChannelLimits("m", 5.0), "y": ChannelLimits("m", 5.0),  # 100 m/s for 50 ms
    "yaw": ChannelLimits("rad", 0.2),  # 4 rad/s for 50 ms
    "velocity_x": ChannelLimits("m/s", 1.0, 120.0),  # 20 m/s^2 for 50 ms; hardly any road car exceeds 120 m/s
    "velocity_y": ChannelLimits("m/s", 1.0, 40.0),
    "yaw_rate": ChannelLimits("rad/s", 0.3, 5.0),  # 6 rad/s^2 for 50 ms, twice a step steer; spins reach 3 rad/s
    "acceleration_x": ChannelLimits("m/s^2", 15.0, 80.0),  # kerbs and potholes reach 10 m/s^2 in one sample
    "acceleration_y": ChannelLimits("m/s^2", 15.0, 80.0),
    "road_wheel_angle": ChannelLimits("rad", 0.1, 1.3),  # 2 rad/s for 50 ms; 75 degrees, beyond any steering lock
    "steering_wheel_angle": ChannelLimits("rad", 1.5, 25.0),  # 30 rad/s for 50 ms, twice an evasive input; four turns
}


class _ChannelSamples:
    """Finite samples of a varying channel, (n,). rows: their indices in the log."""

    def __init__(self, name: str, rows: np.ndarray, time: np.ndarray, values: np.ndarray):
        self.name, self.limits, self.rows, self.time, self.values = name, CHANNEL_LIMITS[name], rows, time, values
        self.spacing = estimate_spacing(time)  # s
        self.gap = np.diff(time) > max(MAX_GAP, 1.5 * self.spacing)  # whether each step spans a gap, (n - 1,)
        self.step = np.abs(np.diff(values))  # |change| from each sample to the next, (n - 1,) [unit]
        changes = np.flatnonzero(self.step > 0.0)
        self.median_step = float(np.median(self.step[changes]))  # of the non-zero steps
        self.update_interval = float(np.median(np.diff(time[changes + 1])))  # s, median time between changes
        physical = self.limits.max_step * max(1.0, self.spacing / STEP_TIME, self.update_interval / STEP_TIME)
        self.limit = max(physical, STEP_MEDIAN_RATIO * self.median_step)  # largest plausible change [unit]


def drop_implausible(log: DriveLog, start_ns: int) -> tuple[DriveLog, list[Finding]]:
    """(the drive without implausible samples, findings for each kind and channel, equal ones merged). An INS row with
    an implausible sample of INS_SIGNALS is left out, an optional signal becomes NaN, a steering sample is left out of
    the steering only. A channel with mostly implausible samples is not changed. start_ns: zero of the times."""
    masks: dict[str, np.ndarray] = {}  # of the implausible samples, by channel
    findings: list[Finding] = []
    steering = "road_wheel_angle" if log.steering_wheel_angle is None else "steering_wheel_angle"
    for time_ns, names in ((log.ins_time_ns, (*INS_SIGNALS, *OPTIONAL_INS_SIGNALS)),
                           (log.steering_time_ns, (steering,))):
        seconds, moving = (time_ns - start_ns) * NANOSECOND, _detect_motion(log, time_ns)
        for name in names:
            if name in CHANNEL_LIMITS and (values := getattr(log, name)) is not None:
                masks[name], channel_findings = find_implausible_samples(name, seconds, values, moving)
                findings += channel_findings
    with_nan: dict[str, Any] = {name: np.where(mask, np.nan, getattr(log, name)) for name, mask in masks.items()
                                if name in OPTIONAL_INS_SIGNALS}
    log = replace(log, **with_nan)
    faulty_rows, faulty_steering = np.any([masks[name] for name in INS_SIGNALS], axis=0), masks[steering]
    if faulty_rows.any() and not faulty_rows.all():
        usable = np.flatnonzero(~faulty_rows)
        # Unwrapping across an implausible sample may have added a full turn to yaw.
        turns = np.where(np.diff(usable) > 1, np.round(np.diff(log.yaw[usable]) / (2.0 * np.pi)), 0.0)
        log = log.select_ins(usable)
        log = replace(log, yaw=log.yaw - 2.0 * np.pi * np.concatenate(([0.0], np.cumsum(turns))))
    if faulty_steering.any() and not faulty_steering.all():
        log = replace(log, **{key: getattr(log, key)[~faulty_steering] for key in ("steering_time_ns", *STEERING)
                              if getattr(log, key) is not None})
    return log, merge_findings(findings)


def find_implausible_samples(name: str, time: np.ndarray, values: np.ndarray,
                             moving: np.ndarray) -> tuple[np.ndarray, list[Finding]]:
    """(mask (n,) of the samples of one channel to leave out, the findings). No sample is left out if most would be.
    time: (n,) ascending [s]. values: (n,), NaN where unknown; yaw unwrapped. moving: (n,) whether the car moves."""
    left_out = np.zeros(len(values), bool)
    rows = np.flatnonzero(np.isfinite(values))
    if len(rows) < MIN_SAMPLES or np.count_nonzero(np.diff(values[rows])) < 2:
        return left_out, []
    channel = _ChannelSamples(name, rows, time[rows], values[rows])
    samples_by_kind = {}
    large = channel.step > channel.limit  # mask of the steps
    implausible = np.zeros(len(channel.values), bool)
    for kind, samples in (("channel_wraps", _find_wraps(channel)),
                          ("sentinel_values", _find_sentinels(channel, large, moving[channel.rows])),
                          ("sample_spikes", _find_spikes(channel, large)),
                          ("out_of_range", _find_out_of_range(channel, large))):
        samples_by_kind[kind] = np.setdiff1d(samples, np.flatnonzero(implausible))
        implausible[samples] = True
    is_unusable = bool(implausible.mean() > MAX_IMPLAUSIBLE_FRACTION)
    findings = [_make_finding(kind, channel, samples, is_unusable) for kind, samples in samples_by_kind.items()
                if len(samples)]
    left_out[channel.rows[implausible]] = not is_unusable
    if name not in ("x", "y") and len(jumps := _find_jumps(channel, large, implausible)):
        if name == "yaw":  # a yaw in degrees also steps where it wraps, so only a reversal of the heading is reported
            jumps = jumps[(np.abs(channel.step[jumps - 1] - np.pi) < MAX_REVERSAL_ERROR)
                          & moving[channel.rows[jumps]] & moving[channel.rows[jumps - 1]]]
        findings += [_make_finding("channel_jumps", channel, jumps, False)] if len(jumps) else []
    return left_out, findings


def find_broken_channels(findings: Iterable[Finding]) -> set[str]:
    """Channels that cannot be compared with others, because of a jump or a finding that is an error."""
    return {channel for finding in findings for channel in finding.channels
            if finding.name == "channel_jumps" or finding.severity is Severity.ERROR}


def _detect_motion(log: DriveLog, instants_ns: np.ndarray) -> np.ndarray:
    """Mask (n,) of the instants [ns] at which the car moves according to velocity or positions; either may drop out."""
    if len(log.ins_time_ns) < 2:
        return np.zeros(len(instants_ns), bool)
    time, instants = ((t - log.ins_time_ns[0]) * NANOSECOND for t in (log.ins_time_ns, instants_ns))
    begin, end = (np.clip(time + side, time[0], time[-1]) for side in (-0.5, 0.5))
    distance = np.hypot(*(np.interp(end, time, p) - np.interp(begin, time, p) for p in (log.x, log.y)))
    moving = (distance / (end - begin) > MIN_MOVING_SPEED) | (np.abs(log.velocity_x) > MIN_MOVING_SPEED)
    return np.interp(instants, time, moving) > 0.5


def _find_jumps(channel: _ChannelSamples, large: np.ndarray, implausible: np.ndarray) -> np.ndarray:
    """Samples after a step much larger than 90 % of the changes, except at implausible or held values and gaps."""
    constant = channel.step == 0.0  # a step next to a held value belongs to a frozen channel
    is_held = np.append(constant[:1], constant) | np.append(constant, constant[-1:])
    excluded = implausible | (is_held & (channel.update_interval <= 1.5 * channel.spacing))
    extreme = large & (channel.step > JUMP_RATIO * float(np.percentile(channel.step[channel.step > 0.0], 90)))
    return 1 + np.flatnonzero(extreme & ~channel.gap & ~excluded[1:] & ~excluded[:-1])


def _find_wraps(channel: _ChannelSamples) -> np.ndarray:
    """Samples displaced by wrap-arounds, which are steps of one size R from about R/2 to about -R/2 or back. The level
    nearest to 0 is taken as the true one."""
    smallest = max(MIN_WRAP_RATIO * channel.limits.max_step, STEP_MEDIAN_RATIO * channel.median_step)
    steps = np.flatnonzero((channel.step > smallest) & ~channel.gap)
    if len(steps) < 2:
        return steps[:0]
    change = np.diff(channel.values)[steps]
    size = float(np.median(np.abs(change)))
    sum_of_ends = channel.values[steps] + channel.values[steps + 1]
    wraps = (np.abs(np.abs(change) - size) < WRAP_SPREAD * size) & (np.abs(sum_of_ends) < WRAP_SYMMETRY * size)
    # A wrapping channel stays within +/- R/2, unlike one with spikes or sentinels.
    if wraps.sum() < max(2, 0.5 * len(steps)) or np.abs(channel.values).max() > (0.5 + WRAP_SPREAD) * size:
        return steps[:0]
    level = np.zeros(len(channel.values), np.int64)
    level[steps[wraps] + 1] = -np.sign(change[wraps]).astype(np.int64)
    level = np.cumsum(level)
    nearest = min(np.unique(level), key=lambda k: float(np.median(np.abs(channel.values + size * (level - k)))))
    return np.flatnonzero(level != nearest)


def _find_out_of_range(channel: _ChannelSamples, large: np.ndarray) -> np.ndarray:
    """Samples out of range, if most samples are in range and a large step leads out of range or back. A channel in a
    wrong unit would exceed the range gradually, without a large step."""
    outside, borders = np.abs(channel.values) > channel.limits.max_magnitude, np.pad(large, 1)
    spans = find_spans(outside) if outside.mean() <= MAX_IMPLAUSIBLE_FRACTION else []
    return _list_samples((first, last) for first, last in spans if borders[first] or borders[last + 1])


def _list_samples(spans: Iterable[tuple[int, int]]) -> np.ndarray:
    return np.concatenate([np.zeros(0, np.int64), *(np.arange(first, last + 1) for first, last in spans)])


def _find_sentinels(channel: _ChannelSamples, large: np.ndarray, moving: np.ndarray) -> np.ndarray:
    """Samples in runs of one value between large steps: a code for a missing measurement, or 0 in motion. At a gap
    or an end of the drive, one large step suffices."""
    first, last = find_groups(channel.step != 0.0)
    count = last - first + 1
    usual_count = float(np.percentile(count, 98))
    sentinels = []
    # A sentinel 0 is nearer to the usual values than other codes, so 8 median steps count as large, except for
    # velocity_x, since cars stop. In a channel that holds its values, the step must also reach 0.3 of the limit.
    zero_step = max(8.0 * channel.median_step, 0.0 if usual_count < 2.0 else 0.3 * channel.limit)
    step, is_open = np.pad(channel.step, 1), np.pad(channel.gap, 1, constant_values=True)
    is_isolated = np.maximum(step[first], step[last + 1]) > min(zero_step, channel.limit)
    for k in np.flatnonzero(is_isolated & (count >= MIN_SENTINEL_SAMPLES)):
        begin, end = int(first[k]), int(last[k])
        is_zero = channel.values[begin] == 0.0
        # A slowly updated channel also holds the value 0, so only a longer run of zeros is a sentinel.
        if is_zero and not (count[k] > SENTINEL_HOLD_RATIO * usual_count
                            and channel.time[end] - channel.time[begin] >= MIN_ZERO_TIME
                            and moving[begin:end + 1].mean() > 0.5):
            continue
        ends = [begin, end + 1]
        is_large = step[ends] > zero_step if is_zero and channel.name != "velocity_x" else np.pad(large, 1)[ends]
        if is_large.any() and (is_large | is_open[ends]).all():
            sentinels.append((begin, end))
    return _list_samples(sentinels)


def _find_spikes(channel: _ChannelSamples, large: np.ndarray) -> np.ndarray:
    """Samples further than the limit from the median of their neighbours (Hampel 1974, with a physical limit), and
    runs in which most steps are large and irregular; equal large steps are a turn, recorded in a wrong unit."""
    if not large.any():
        return np.zeros(0, np.int64)
    half = max(round(max(HALF_WINDOW, 2.5 * channel.update_interval) / channel.spacing), 2)  # samples
    near = np.flatnonzero(np.convolve(large, np.ones(2 * half + 1), "same") > 0.5)  # samples near a large step
    near = np.unique(np.clip(np.concatenate((near, near + 1)), 0, len(channel.values) - 1))
    segment = np.concatenate(([0], np.cumsum(channel.gap)))  # number of the segment without a gap
    spikes = []
    for part in np.array_split(near, len(near) // 4096 + 1):  # limits the memory
        neighbours = part[:, None] + np.arange(-half, half + 1)
        inside = np.clip(neighbours, 0, len(channel.values) - 1)
        known = (neighbours == inside) & (segment[inside] == segment[part][:, None])
        median = np.nanmedian(np.where(known, channel.values[inside], np.nan), axis=1)
        spikes.append(part[np.abs(channel.values[part] - median) > channel.limit])
    uneven = np.abs(np.diff(channel.values, 2)) > channel.limit
    irregular = np.concatenate(([False], uneven)) | np.concatenate((uneven, [False]))
    dense = np.convolve(large & irregular & ~channel.gap, np.ones(2 * half + 1), "same") > half
    for first, last in find_spans(dense):
        steps = first + np.flatnonzero(large[first:last + 1])
        net_change = abs(channel.values[last + 1] - channel.values[first])
        if len(steps) and net_change < MAX_NET_CHANGE_RATIO * channel.step[first:last + 1].sum():
            spikes.append(np.arange(steps[0] + 1, steps[-1] + 1))
    return np.unique(np.concatenate(spikes))


def _make_finding(kind: str, channel: _ChannelSamples, samples: np.ndarray, is_unusable: bool) -> Finding:
    fraction = len(samples) / len(channel.values)
    values, times = channel.values[samples], channel.time[samples]
    value = float(values[np.argmax(np.abs(values))])
    intervals = find_time_intervals(times, 1.5 * channel.spacing)
    unit = channel.limits.unit
    # Codes for a missing measurement are round numbers in the unit of the file, which is often degrees.
    degrees = f" ({np.rad2deg(value):.6g} {unit.replace('rad', 'deg')})" if unit.startswith("rad") else ""
    value_text = f"{value:.6g} {unit}{degrees}" + (" (unwrapped)" if channel.name == "yaw" else "")
    when = f"at {intervals[0][0]:.2f} s" if len(samples) == 1 else f"between {times[0]:.2f} and {times[-1]:.2f} s"
    count = f"{len(samples)} of {len(channel.values)} samples"
    text = {
        "sample_spikes": f"{channel.name} " + (
            f"is {value_text} {when}, in sample {channel.rows[samples[0]] + 1}" if len(samples) == 1 else
            f"reaches {value_text} {when} ({count})") + ", inconsistent with the neighbouring samples",
        "sentinel_values": f"{channel.name} is {value_text} {when} ({count}): "
                           + ("0 while the car moves" if value == 0.0 else "a code for a missing measurement"),
        "out_of_range": f"{channel.name} reaches {value_text} {when} ({count}), beyond the range of road cars",
        "channel_wraps": f"{channel.name} wraps around at ±{np.abs(channel.values).max():.4g} {unit} "
                         f"{when} ({count}): its signal has too few bits for the values of this drive",
        "channel_jumps": f"{channel.name} jumps {f'{len(samples)} times by up to' if len(samples) > 1 else 'by'} "
                         f"{float(channel.step[samples - 1].max()):.4g} {unit} from one sample to the next "
                         f"{when}, without returning at once: it is left out of all comparisons",
    }[kind]
    severity = Severity.NOTE if kind == "sample_spikes" and fraction <= LIMITS.max_note_fraction else Severity.WARNING
    if is_unusable or (kind == "channel_wraps" and fraction > MAX_WRAPPED_FRACTION):
        severity = Severity.ERROR
    text += "" if is_unusable or kind == "channel_jumps" else "; these samples are left out"
    advice = ("change the definition of the signal: more bits, or a larger factor" if kind == "channel_wraps" else
              "check the sensor and the settings of the logger")
    return Finding(kind, severity, (channel.name,), text, value, unit, None, intervals[:MAX_LISTED_INTERVALS],
                   advice=Advice("text", advice))
