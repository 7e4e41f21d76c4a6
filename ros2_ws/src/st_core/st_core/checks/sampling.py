"""How a recording was sampled: stamps, gaps, values that repeat, stand still or are rounded; each channel's noise."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from ..regression import white_noise
from .finding import HORIZON, LIMITS, Advice, AuxiliaryData, Channel, Finding, InsQuality, Severity, merged
from .motion import LONGEST_GAP, Motion, spans

UNITS = {"x": "m", "y": "m", "yaw": "rad", "velocity_x": "m/s", "velocity_y": "m/s", "yaw_rate": "rad/s",
         "acceleration_x": "m/s^2", "acceleration_y": "m/s^2", "road_wheel_angle": "rad"}
STEERING = ("road_wheel_angle", "steering_wheel_angle")
HELD = 0.7  # share of the changes that come at the same interval in a channel held at a lower rate
FEW = 0.01  # share of rows below which a fault of single rows is a note
MISSED = 0.05  # share of the time lost in gaps from which on whole conditions may be missing
EVEN = 0.05  # relative; mean spacing of a slower sensor against rows per sample: a gap shifts it by its share
SLOWER = 1.5  # rows between two samples of a slower sensor, on average
SLOWEST = 15.0  # Hz; positions held at a lower rate are half a metre old at 15 m/s, on average a quarter
FROZEN = 1.5  # s without any change; quieter channels are given ten times their own usual pause
EXCUSED = 10.0
SPARED = ("velocity_y", "acceleration_x", "acceleration_y")  # many recordings have none; paths can be scored without
WORST_GYRO = 0.02  # rad/s of bias that must not make a yaw look frozen


def channels(motion: Motion, auxiliary: AuxiliaryData) -> dict[str, Channel]:
    """Every channel of the drive."""
    found = {}
    for name, unit in UNITS.items():
        time, values = _series(motion, name)
        if values is None or len(values) < 3:
            continue
        spacing = np.diff(time)
        gaps = spacing[spacing > LONGEST_GAP]
        found[name] = Channel(
            unit, len(values), float(1.0 / np.median(spacing)), len(gaps), float(spacing.max()),
            white_noise(values) if len(values) > 3 else 0.0,
            resolution(values), float(np.mean(np.diff(values) == 0.0)), int(auxiliary.missing.get(name, 0)))
    return found


def _series(motion: Motion, name: str) -> tuple[np.ndarray, np.ndarray | None]:
    if name == "road_wheel_angle":
        return motion.steering_time, motion.steering
    values = getattr(motion, name)
    if values is None:
        return motion.time, None
    known = np.isfinite(values)
    return motion.time[known], values[known]


def resolution(values: np.ndarray) -> float:
    """Smallest step of the values, where they lie on a grid; 0 where none is seen."""
    steps = np.abs(np.diff(values))
    steps = steps[steps > 0.0]
    if len(steps) < 20:
        return 0.0
    smallest = float(np.percentile(steps, 2))
    multiples = steps / smallest
    # An even motion without noise has even steps, too; rounded values also repeat, or step by different multiples.
    if len(steps) == len(values) - 1 and float(np.ptp(multiples)) < 0.5:
        return 0.0
    grid = np.abs(multiples - np.round(multiples)) < 0.1
    small = multiples < 4.5  # larger multiples fit any grid
    return smallest if small.sum() >= 10 and grid[small].mean() > 0.95 else 0.0


def timing(motion: Motion, auxiliary: AuxiliaryData, left_out: Sequence[Finding] = ()) -> list[Finding]:
    """Stamps, gaps and missing rows. left_out: findings of samples that were left out, which do not count as gaps."""
    findings = []
    for signal, stamps in auxiliary.stamps.items():
        findings += _stamps(signal, np.asarray(stamps, np.int64))
    for signal, time in (("INS", motion.time), ("steering", motion.steering_time)):
        findings += _gaps(signal, time, [span for one in left_out for span in one.where])
    missing = []
    for channel, count in auxiliary.missing.items():
        # Samples without an acceleration were kept, those without another channel were not.
        left = len(motion.steering_time if channel in STEERING else motion.time)
        share = count / max(left if channel.startswith("acceleration") else left + count, 1)
        if count:
            rows = auxiliary.stamps.get("INS", np.zeros(0))
            if channel in STEERING:
                rows = auxiliary.stamps.get("steering", rows)
            slower = 0.0 if channel.startswith("acceleration") else _slower_rate(
                motion.steering_time if channel in STEERING else motion.time, rows * 1e-9, share)
            missing.append(_missing(channel, count, share, slower))
    return findings + merged(missing)


def _missing(channel: str, count: int, share: float, slower: float) -> Finding:
    """slower: Hz of a sensor that fills only some of the rows, 0 where that is not why they are empty."""
    if slower:
        text = (f"{channel}: {100 * share:.2g} % of the rows hold no value, and those that do are evenly spaced: it "
                f"was recorded at {slower:.3g} Hz")
        advice = "nothing, if that is the rate of the sensor"
    else:
        text = f"{channel}: {count} rows hold no usable value ({100 * share:.2g} %); they were left out"
        advice = "look at what the logger writes there"
    severity = Severity.NOTE if slower or share <= FEW else Severity.WARNING
    return Finding("values_missing", severity, (channel,), text, share, "1", None, (), None, Advice("look", advice))


def _slower_rate(time: np.ndarray, rows: np.ndarray, missing: float) -> float:
    """Hz of samples [s] that are evenly spaced, to a row, among all rows [s], but for one in a hundred; else 0.

    missing: share of the rows without one. After a gap the others are a row apart: that is not a slower sensor.
    """
    spacing, between = np.diff(time), np.diff(rows)
    if len(spacing) < 20 or len(between) < 20:
        return 0.0
    row = float(np.median(between))
    usual = row / max(1.0 - missing, 1e-9)
    within = np.abs(spacing - usual) <= 1.05 * row
    even = np.mean(~within) <= FEW and abs(float(spacing[within].mean()) / usual - 1.0) <= EVEN
    return 1.0 / usual if usual >= SLOWER * row and even else 0.0


def _stamps(signal: str, stamps: np.ndarray) -> list[Finding]:
    if len(stamps) < 2:
        return []
    step = np.diff(stamps)
    newest = np.maximum.accumulate(stamps)[:-1]
    findings = []
    # After one step back, every row is lost until the newest stamp before it is reached again.
    old = (stamps[1:] <= newest) & (step != 0)
    for name, back, lost in (("time_order", step < 0, old), ("time_duplicates", step == 0, step == 0)):
        if not back.any():
            continue
        count, share = int(lost.sum()), float(lost.mean())
        far = -float(step.min()) * 1e-9
        reset = name == "time_order" and far > LONGEST_GAP
        where = tuple((float(t), float(t)) for t in (newest[back] - stamps[0])[:20] * 1e-9)
        text = (f"the stamps of the {signal} go back {int(back.sum())} time{'s' if back.sum() > 1 else ''}, by up to "
                f"{far:.4g} s: {count} of {len(stamps)} rows ({100 * share:.2g} %) are not used" if reset else
                f"{count} of {len(stamps)} stamps of the {signal} "
                f"{'go back' if name == 'time_order' else 'are there twice'}; those rows were left out")
        advice = ("look at the logger: its clock was set back, or it restarted; split the recording there into runs"
                  if reset else "look at how the rows were stamped and merged")
        severity = Severity.WARNING if reset or share > FEW else Severity.NOTE
        findings.append(Finding(name, severity, ("time",), text, share, where=where, advice=Advice("look", advice)))
    return findings


def _gaps(signal: str, time: np.ndarray, left_out: Sequence[tuple[float, float]]) -> list[Finding]:
    spacing = np.diff(time)
    # A slow recording has no gap between every two of its samples.
    long = np.flatnonzero(spacing > max(LONGEST_GAP, 1.5 * float(np.median(spacing)))) if len(spacing) else spacing
    long = np.array([k for k in long if not any(time[k] < begin and end < time[k + 1] for begin, end in left_out)], int)
    if not len(long):
        return []
    missing = float((spacing[long] - np.median(spacing)).sum())
    where = tuple((float(time[k]), float(time[k + 1])) for k in long)
    share = missing / max(float(time[-1] - time[0]), 1e-9)
    severity = Severity.WARNING if share > MISSED else Severity.NOTE
    count = f"{len(long)} gap{'s' if len(long) > 1 else ''}"
    longest = spacing[long].max()
    text = f"{count} of the {signal}, {missing:.2f} s in all, longest {longest:.2f} s: nothing is scored there"
    return [Finding("time_gaps", severity, ("time",) if signal == "INS" else ("road_wheel_angle",), text, missing, "s",
                    None, where, None, Advice("look", "look at the logger: lost packets, a full buffer"))]


def stuck(motion: Motion, known: Mapping[str, Channel]) -> list[Finding]:
    """Channels that are held at a lower rate, or stand still while the car moves."""
    findings = []
    for name in known:
        time, row = _series(motion, name)
        if row is None:
            continue
        findings += _held(name, time, row) or _frozen(name, time, row, motion, known[name].resolution)
    return merged(findings)


def rounded(motion: Motion, findings: Sequence[Finding]) -> list[Finding]:
    """Channels that are rounded so coarsely that it matters, but for those that the findings call held."""
    held = {channel for one in findings if one.name == "samples_repeated" for channel in one.channels}
    speed = float(np.median(motion.speed))
    return merged([one for name in REACH if name not in held for one in _rounded(name, motion, speed)])


def _pauses(row: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(first index, number of samples) of each run of equal values."""
    edges = np.concatenate(([0], np.flatnonzero(np.diff(row) != 0.0) + 1, [len(row)]))
    return edges[:-1], np.diff(edges)


def _held(name: str, time: np.ndarray, row: np.ndarray) -> list[Finding]:
    """A channel that changes at every k-th sample only, k the same throughout."""
    _, lengths = _pauses(row)
    if len(lengths) < 20:
        return []
    usual = float(np.median(lengths))
    regular = float(lengths[np.abs(lengths - usual) <= max(0.1 * usual, 0.5)].sum() / lengths.sum())
    if usual < 2.0 or regular < HELD:
        return []
    rate = 1.0 / (usual * float(np.median(np.diff(time))))
    share = 1.0 - len(lengths) / len(row)
    text = f"{name} changes only at every {usual:g}th sample: it was recorded at {rate:.3g} Hz and held"
    severity = Severity.WARNING if rate < SLOWEST else Severity.NOTE
    return [Finding("samples_repeated", severity, (name,), text, share,
                    advice=Advice("look", f"log {name} at its own rate, or interpolate it before"))]


def _frozen(name: str, time: np.ndarray, row: np.ndarray, motion: Motion, step: float) -> list[Finding]:
    first, lengths = _pauses(row)
    last = np.minimum(first + lengths - 1, len(time) - 1)
    lasted = time[last] - time[first]
    usual = float(np.sort(lasted)[max(int(0.98 * len(lasted)) - 1, 0)]) if len(lasted) > 5 else 0.0
    bad = [k for k in np.flatnonzero(lasted > max(FROZEN, EXCUSED * usual))
           if _should_change(name, time[first[k]], time[last[k]], motion, step)]
    if not bad:
        return []
    seconds = float(lasted[bad].sum())
    where = tuple((float(time[first[k]]), float(time[last[k]])) for k in bad)
    text = f"{name} is constant for {seconds:.1f} s while the car moves"
    throughout = seconds > 0.5 * float(time[-1] - time[0])
    severity = Severity.ERROR if throughout and name not in SPARED else Severity.WARNING
    ins = name != "road_wheel_angle"
    stretches = [[round(a, 2), round(b, 2)] for a, b in where]
    advice = (Advice("look", f"nothing can be made of it: record {name}") if throughout else
            Advice("run.yaml", f"leave_out: {stretches}", {"leave_out": stretches}) if ins else
            Advice("look", "look at the steering sensor: its frames repeat one value there"))
    return [Finding("channel_frozen", severity, (name,), text, seconds, "s", None, where, None, advice)]


def _should_change(name: str, begin: float, end: float, motion: Motion, step: float) -> bool:
    """Whether this channel should have changed by more than its resolution `step`, according to the others."""
    inside = (motion.time >= begin) & (motion.time <= end)
    if inside.sum() < 3:
        return False
    if name in ("x", "y", "yaw"):
        rate = {"x": motion.velocity_map[0], "y": motion.velocity_map[1], "yaw": motion.yaw_rate}[name][inside]
        biased = WORST_GYRO if name == "yaw" else 0.0
        moved = max(abs(float(rate.mean())) - biased, 0.0) * (end - begin)
        return moved > max(3.0 * step, 0.05 if name == "yaw" else 1.0)
    other, least = TWINS[name]
    rate = other(motion)[inside]
    rounding = 3.0 * step if name in UNIT_OF_TWIN else 0.0
    return bool(np.percentile(rate, 95) - np.percentile(rate, 5) > max(least, rounding))


def _smooth_rate(time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Over the half second that follows; at the end the last one."""
    count = max(round(0.5 / float(np.median(np.diff(time)))), 1)
    rate = (values[count:] - values[:-count]) / (time[count:] - time[:-count])
    return np.concatenate([rate, np.full(len(time) - len(rate), rate[-1] if len(rate) else 0.0)])


# Position after 5 s per unit of a wrong start [m], and whether it grows with the speed [s].
REACH = {"x": (1.0, False), "y": (1.0, False), "yaw": (HORIZON, True), "velocity_x": (HORIZON, False),
         "velocity_y": (LIMITS.settling * HORIZON, False), "yaw_rate": (LIMITS.settling * HORIZON, True)}
UNIT_OF_TWIN = ("velocity_x", "acceleration_x", "acceleration_y", "yaw_rate")  # channels in the unit of their twin
# What changes with a channel, whatever the sensor, and by how much it must before the channel is called frozen.
TWINS: Mapping[str, tuple[Callable[[Motion], np.ndarray], float]] = {
    "velocity_x": (lambda m: np.hypot(_smooth_rate(m.time, m.x), _smooth_rate(m.time, m.y)), 0.3),
    "velocity_y": (lambda m: m.yaw_rate, 0.05),
    "acceleration_x": (lambda m: _smooth_rate(m.time, m.velocity_x), 0.5),
    "acceleration_y": (lambda m: m.velocity_x * m.yaw_rate, 0.5),
    "yaw_rate": (lambda m: _smooth_rate(m.time, m.yaw), 0.05),
    "road_wheel_angle": (lambda m: np.where(m.velocity_x > 2.0, m.yaw_rate, 0.0), 0.05),
}


def _rounded(name: str, motion: Motion, speed: float) -> list[Finding]:
    """A start wrong by resolution / sqrt(12)."""
    step = resolution(getattr(motion, name))
    distance, while_driving = REACH[name]
    effect = step / np.sqrt(12.0) * distance * (speed if while_driving else 1.0)
    if effect < LIMITS.min_reported_effect:
        return []
    unit = UNITS[name]
    degrees = f" ({np.rad2deg(step):.2g} deg)" if unit.startswith("rad") else ""
    text = f"{name} is rounded to {step:.3g} {unit}{degrees}"
    return [Finding("resolution_coarse", LIMITS.severity(effect), (name,), text, step, unit, effect=effect,
                    advice=Advice("look", f"log {name} with more digits"))]


def unfrozen(motion: Motion, findings: Sequence[Finding]) -> Motion:
    """Motion without the samples of frozen channels; they become gaps."""
    for one in findings:
        if one.name != "channel_frozen":
            continue
        for steering in {channel == "road_wheel_angle" for channel in one.channels}:
            time = motion.steering_time if steering else motion.time
            keep = ~np.any([(time >= begin) & (time <= end) for begin, end in one.where], axis=0)
            if keep.sum() > 0.5 * len(keep):
                motion = motion.where(keep) if not steering else motion.with_(
                    steering_time=time[keep], steering=motion.steering[keep])
    return motion


LOCKED = 4  # NCOM byte 21
RTK = (5, 6)  # NCOM position modes: RTK float, RTK integer


def quality(found: InsQuality | None, start_ns: int) -> list[Finding]:
    if found is None or len(found.time_ns) < 2:
        return []
    time = (found.time_ns - start_ns) * 1e-9
    return [*_mode(found, time), *_accuracy(found, time)]


def _mode(found: InsQuality, time: np.ndarray) -> list[Finding]:
    findings = []
    known = np.isfinite(found.position_mode) & (found.position_mode >= 0)
    lost = known & ~np.isin(found.position_mode, RTK)
    unlocked = np.isfinite(found.navigation_status) & (found.navigation_status != LOCKED)
    for bad, words in ((lost, "without RTK"), (unlocked, "not locked")):
        share = float(bad.mean())
        if share <= 0.0:
            continue
        text = f"the INS is {words} in {100 * share:.0f} % of the time: its positions wander there"
        severity = Severity.WARNING if share > 0.01 else Severity.NOTE
        findings.append(Finding("ins_mode", severity, ("ins",), text, share, where=_stretches(time, bad), advice=Advice(
            "look", "leave these stretches out, or post-process the raw data")))
    return findings


def _accuracy(found: InsQuality, time: np.ndarray) -> list[Finding]:
    known = np.isfinite(found.position_accuracy)
    if not known.any():
        return []
    typical = float(np.median(found.position_accuracy[known]))
    if typical < LIMITS.warning:
        return []
    poor = known & (found.position_accuracy >= LIMITS.warning)
    text = f"the INS's own standard deviation of position is {typical:.2f} m in the median"
    return [Finding("ins_accuracy", LIMITS.severity(typical), ("ins",), text, typical, "m", None,
                    _stretches(time, poor), typical, Advice("look", "record with RTK, or post-process"))]


def _stretches(time: np.ndarray, bad: np.ndarray) -> tuple[tuple[float, float], ...]:
    return tuple((float(time[a]), float(time[b])) for a, b in spans(bad)[:20])
