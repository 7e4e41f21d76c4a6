"""Faults other than factors, offsets and delays. Each edit returns the corrupted recording and its true value."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from st_core.log import DriveLog

from .recording import RTK_INTEGER, STEERING, TIMED, Recording, select_rows

DIFFERENTIAL = 4  # NCOM position mode without RTK
MIN_SPEED = 1.5  # m/s; the car moves above it
Edited = tuple[Recording, float]


def _generator(recording: Recording) -> np.random.Generator:
    return np.random.default_rng(len(recording.log.x))


def change_time_unit(r: Recording, factor: float) -> Edited:
    """Time stamps that advance `factor` times too fast, from the first one on."""
    start = r.log.start_ns

    def speed_up(time_ns: np.ndarray) -> np.ndarray:
        return start + (time_ns - start) * round(factor)
    series = {name: replace(part, time_ns=speed_up(part.time_ns)) for name in TIMED
              if (part := getattr(r.auxiliary, name)) is not None}
    log = {name: speed_up(getattr(r.log, name)) for name in ("ins_time_ns", "steering_time_ns")}
    return r.with_log(**log).with_auxiliary(**series), factor


def remove_spans(*fractions: float) -> Callable[[Recording, float], Edited]:
    """Gaps at fractions of the duration, of the same length each. True value: total duration of the INS gaps [s]."""
    def edit(r: Recording, seconds: float) -> Edited:
        starts = [fraction * r.log.duration for fraction in fractions]

        def is_recorded(time_ns: np.ndarray) -> np.ndarray:
            time = (time_ns - r.log.ins_time_ns[0]) * 1e-9
            return ~np.any([(time > start) & (time < start + seconds) for start in starts], axis=0)
        corrupted = select_rows(r, is_recorded(r.log.ins_time_ns), is_recorded(r.log.steering_time_ns))
        steps = np.diff(corrupted.time)
        return corrupted, float(steps[steps > 0.25].sum())
    return edit


def repeat_stamps(r: Recording, fraction: float) -> Edited:
    """A `fraction` of the recorded rows repeats the time of the previous row; readers leave these rows out."""
    generator = _generator(r)

    def repeat(time: np.ndarray) -> np.ndarray:
        count = round(fraction / (1 - fraction) * len(time))
        rows = np.sort(generator.choice(len(time), count, replace=False))
        return np.insert(time, rows + 1, time[rows])
    return r.with_auxiliary(stamps={name: repeat(time) for name, time in r.auxiliary.stamps.items()}), fraction


def swap_stamps(r: Recording, fraction: float) -> Edited:
    """A `fraction` of the rows has an earlier time than the previous row; readers leave these rows out."""
    generator, stamps, rising = _generator(r), {}, {}
    for name, in_order in r.auxiliary.stamps.items():
        time = in_order.copy()
        rows = 2 * generator.choice(len(time) // 2, round(fraction * len(time)), replace=False)
        time[rows], time[rows + 1] = in_order[rows + 1], in_order[rows]
        stamps[name] = time
        rising[name] = np.ones(len(time), bool)
        # The later time comes first and is kept; in the log, which is in order, its row is the second.
        rising[name][rows] = False
    return select_rows(r, rising["INS"], rising["steering"]).with_auxiliary(stamps=stamps), fraction


def add_jitter(r: Recording, size: float) -> Edited:
    """Times with random errors of standard deviation `size` [s], in the same order. True value: standard deviation of
    the change of the intervals [s]."""
    time = r.log.ins_time_ns
    noise = np.round(size * 1e9 * _generator(r).standard_normal(len(time))).astype(np.int64)
    min_steps = 1000 * np.arange(len(time))  # 1 us between rows
    late = np.maximum.accumulate(time + noise - min_steps) + min_steps
    fields = {"ins_time_ns": late}
    if np.array_equal(time, r.log.steering_time_ns):
        fields["steering_time_ns"] = late
    return r.with_log(**fields), float(np.std(np.diff(late) - np.diff(time))) * 1e-9


def drop_rows(r: Recording, fraction: float) -> Edited:
    """A `fraction` of the rows has no yaw rate; readers leave these rows out."""
    is_recorded = _generator(r).random(len(r.log.x)) >= fraction
    corrupted = select_rows(r, is_recorded, np.ones(len(r.log.steering_time_ns), bool))
    missing = int((~is_recorded).sum())
    return corrupted.with_auxiliary(missing={"yaw_rate": missing}), missing / len(is_recorded)


def exchange_axes(r: Recording, sign: float) -> Edited:
    return r.with_log(x=sign * r.log.y, y=sign * r.log.x), sign


def mirror_axis(r: Recording, axis: float) -> Edited:
    name = "y" if axis else "x"
    return r.with_log(**{name: -getattr(r.log, name)}), -1.0


def to_compass(r: Recording, factor: float) -> Edited:
    return r.with_log(yaw=np.pi / 2 - r.log.yaw), factor


def to_wrapped_degrees(r: Recording, factor: float) -> Edited:
    """Yaw from -180 to 180 deg in the file, which readers unwrap as if it were in rad."""
    wrapped = (r.log.yaw * factor + 180.0) % 360.0 - 180.0
    return r.with_log(yaw=np.unwrap(wrapped)), factor


def move_positions_ahead(log: DriveLog, distance: float) -> DriveLog:
    return replace(log, x=log.x + distance * np.cos(log.yaw), y=log.y + distance * np.sin(log.yaw))


def make_positions_stale(r: Recording, fraction: float) -> Edited:
    old = _generator(r).random(len(r.log.x)) < fraction
    old[0] = False
    rows = np.arange(len(old)) - old
    # The finding counts the steps back, from a new position to an old one.
    return r.with_log(x=r.log.x[rows], y=r.log.y[rows]), float(np.mean(old[1:] & ~old[:-1]))


def jump_every_second(r: Recording, size: float) -> Edited:
    """Positions that jump by `size` [m] and, a second later, back."""
    second = np.floor(r.time)
    return _shift_positions(r, size * (second % 2)), float(np.count_nonzero(np.diff(second % 2)))


def jump_once(r: Recording, size: float) -> Edited:
    """Positions with a constant offset from the middle of the moving rows on."""
    moving = np.flatnonzero(np.abs(r.log.velocity_x) > MIN_SPEED)
    return _shift_positions(r, size * (np.arange(len(r.log.x)) >= moving[len(moving) // 2])), 1.0


def _shift_positions(r: Recording, offset: np.ndarray) -> Recording:
    return r.with_log(x=r.log.x + 0.6 * offset, y=r.log.y + 0.8 * offset)


def round_channels(*channels: str) -> Callable[[Recording, float], Edited]:
    return lambda r, step: (r.with_log(**{c: np.round(getattr(r.log, c) / step) * step for c in channels}), step)


def hold_values(channel: str) -> Callable[[Recording, float], Edited]:
    """Updates a channel only `rate` [Hz] times a second. True value: fraction of rows that repeat the previous one."""
    def edit(r: Recording, rate: float) -> Edited:
        new = np.diff(np.floor(r.time * rate), prepend=-1.0) > 0
        rows = np.maximum.accumulate(np.where(new, np.arange(len(new)), 0))
        return r.with_log(**{channel: getattr(r.log, channel)[rows]}), float(np.mean(~new))
    return edit


def freeze(*channels: str) -> Callable[[Recording, float], Edited]:
    """Freezes channels while the first one varies most. True value: duration for which that one is constant [s]."""
    def edit(r: Recording, seconds: float) -> Edited:
        start = find_busiest_span(r, channels[0], seconds)
        if start is None:
            raise ValueError(f"{r.name}: the car never moves for {seconds:g} s")
        fields = {}
        for channel in channels:
            if (values := getattr(r.log, channel)) is not None:
                rows = _window(r, channel, start, seconds)
                fields[channel] = values.copy()
                fields[channel][rows] = values[rows.start]
        return r.with_log(**fields), _constant_duration(r, channels[0], fields[channels[0]], start)
    return edit


def _constant_duration(r: Recording, channel: str, values: np.ndarray, start: float) -> float:
    """Duration [s] for which a channel has its value at `start` [s]; a rounded channel may have it a little earlier."""
    time = r.log.steering_time_ns if channel in STEERING else r.log.ins_time_ns
    row = _window(r, channel, start, 1.0).start
    changes = np.flatnonzero(np.diff(values)) + 1
    after = np.searchsorted(changes, row, "right")
    first = changes[after - 1] if after else 0
    last = changes[after] - 1 if after < len(changes) else len(values) - 1
    return float(time[last] - time[first]) * 1e-9


def find_busiest_span(r: Recording, channel: str, seconds: float) -> float | None:
    """Start [s] of the span in which a channel varies most while the car moves; None if there is none."""
    speed, best = np.abs(r.log.velocity_x), None
    for start in np.arange(1.0, r.log.duration - seconds - 1.0):
        rows = _window(r, channel, start, seconds)
        spread = np.std(getattr(r.log, channel)[rows])
        if speed[_window(r, "x", start, seconds)].min() > MIN_SPEED and (best is None or spread > best[0]):
            best = spread, float(start)
    return None if best is None else best[1]


def _window(r: Recording, channel: str, start: float, seconds: float) -> slice:
    time = r.log.steering_time_ns if channel in STEERING else r.log.ins_time_ns
    first = int(r.log.ins_time_ns[0])
    ends = [first + round(t * 1e9) for t in (start, start + seconds)]
    return slice(*np.searchsorted(time, ends).tolist())


def is_at_standstill(r: Recording) -> np.ndarray:
    return np.abs(r.log.velocity_x) < 0.05


def creep(r: Recording, speed: float) -> Edited:
    """A forward velocity that does not become zero when the car stops."""
    return r.with_log(velocity_x=np.where(is_at_standstill(r), speed, r.log.velocity_x)), speed


def lose_rtk(r: Recording, fraction: float) -> Edited:
    quality = r.auxiliary.quality
    time = np.linspace(0.0, 1.0, len(quality.time_ns))
    lost = np.abs(time - 0.5) < fraction / 2
    modes = np.where(lost, DIFFERENTIAL, RTK_INTEGER).astype(float)
    return r.with_auxiliary(quality=replace(quality, position_mode=modes)), float(lost.mean())


def worsen_accuracy(r: Recording, accuracy: float) -> Edited:
    quality = r.auxiliary.quality
    quality = replace(quality, position_accuracy=np.full(len(quality.time_ns), accuracy))
    return r.with_auxiliary(quality=quality), accuracy
