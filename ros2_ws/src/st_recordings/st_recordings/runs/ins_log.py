"""INS measurements of any recording in the axes of `DriveLog`, selection of usable time stamps, and vehicle speed."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from st_core.checks import InsQuality, Series
from st_core.timeseries import find_ascending, interpolate

from .errors import format_count

# Signals for the speed of the car in order of preference: the unsteered axle gives the most accurate speed.
_SPEED_SETS = (("wheel_speed_rear_left", "wheel_speed_rear_right"),
               ("wheel_speed_front_left", "wheel_speed_front_right"), ("vehicle_speed",))
SPEEDS = tuple(name for names in _SPEED_SETS for name in names)
MAX_WHEEL_GAP_NS = 100_000_000  # longest gap across which the speed of a wheel is interpolated
LATEST_TIME = 9.0e9  # s since 1970, in the year 2255; int64 nanoseconds end in the year 2262
MAX_LOST_FRACTION = 0.01  # of the rows; if more are out of order in time, the clock may have been set back
MAX_UNEVEN_FRACTION = 0.3
"""Ratio of short steps between sorted times to rows out of order; if it is smaller, only the order is wrong."""
MAX_END_STEP_RATIO = 10.0
"""Multiple of the 95th percentile of the steps; a longer first or last time step means a wrong first or last time."""


@dataclass(frozen=True)
class InsLog:
    """INS measurements with a fix.

    values: channel of DriveLog -> samples, for recorded channels (at least one number); yaw is unwrapped.
    """

    file: Path
    time_ns: np.ndarray  # measurement times, strictly increasing
    values: Mapping[str, np.ndarray]
    stamps_ns: np.ndarray  # time_ns or, for NCOM, the times of all packets, with or without a fix
    origin: tuple[float, float, float] | None = None  # latitude, longitude [rad], altitude [m]; None if unknown
    quality: InsQuality | None = None  # as reported by the unit
    warnings: tuple[str, ...] = ()
    is_utc: bool = True  # whether the times are UTC


def yaw_from_quaternion(x: np.ndarray, y: np.ndarray, z: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Yaw [rad] in (-pi, pi] of quaternions from body to map axes, which need not be normalised; NaN for norm 0."""
    is_unset = x * x + y * y + z * z + w * w == 0
    return np.where(is_unset, np.nan, np.arctan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z))


def compute_car_speed(speeds: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> Series | None:
    """Speed of the car [m/s]: mean of the rear wheels, or else of the front wheels, or else the speed signal of the
    car. None without any of them.

    speeds: name (one of SPEEDS) -> (ascending times [ns], values [m/s]).
    """
    for names in _SPEED_SETS:
        if all(name in speeds and np.isfinite(speeds[name][1]).any() for name in names):
            time_ns = speeds[names[0]][0]
            wheels = [interpolate(*_select_finite(*speeds[name]), time_ns, MAX_WHEEL_GAP_NS) for name in names]
            return make_series(time_ns, np.mean(wheels, axis=0))
    return None


def make_series(time_ns: np.ndarray, values: np.ndarray) -> Series | None:
    """Finite samples of a signal, without those that are out of order in time; None if there are none."""
    time_ns, values = _select_finite(np.asarray(time_ns, np.int64), values)
    if not len(time_ns):
        return None
    rows = find_ascending(time_ns)
    return Series(time_ns[rows], values[rows])


def is_mostly_known(values: np.ndarray) -> bool:
    """Whether an optional channel has a value in at least half of the samples."""
    return len(values) > 0 and bool(np.isfinite(values).mean() >= 0.5)


def _select_finite(time_ns: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    is_finite = np.isfinite(values)
    return time_ns[is_finite], values[is_finite]


def are_stored_out_of_order(time_ns: np.ndarray) -> bool:
    """Whether times (n,) are out of order, but evenly spaced once sorted. If the clock was set back, sorted times are
    uneven: two parts overlap, and every other step in the overlap is at most half as long, below 3/4 of the median."""
    lost_fraction = 1.0 - np.mean(find_ascending(time_ns)) if len(time_ns) else 0.0
    steps = np.diff(np.sort(time_ns))
    return bool(lost_fraction > MAX_LOST_FRACTION
                and np.mean(steps < 0.75 * np.median(steps)) < MAX_UNEVEN_FRACTION * lost_fraction)


def select_usable_rows(time_ns: np.ndarray, noun: str) -> tuple[np.ndarray, list[str]]:
    """(indices of rows with strictly ascending times, warnings about the other rows).

    Rows are left out as in `find_ascending`. If their fraction exceeds MAX_LOST_FRACTION, and the longest part without
    a backward step has about as many rows as would remain, the clock was set back while recording, and only this part
    is used. Of more than 10 rows, the first or the last is left out if its time is far from that of its neighbour.

    time_ns: (n,) int64, in the order of the recording. noun: plural name of the rows, for the warnings.
    """
    n = len(time_ns)
    rows = np.flatnonzero(find_ascending(time_ns))
    lost_count = n - len(rows)
    warnings = []
    backward_steps = -np.diff(time_ns)[np.diff(time_ns) < 0] * 1e-9
    longest_part = rows[:0]
    if len(backward_steps) and lost_count > max(MAX_LOST_FRACTION * n, 1):
        parts = np.split(np.arange(n), np.flatnonzero(np.diff(time_ns) < 0) + 1)
        longest_part = max(parts, key=len)
        longest_part = longest_part[find_ascending(time_ns[longest_part])]
    if len(longest_part) and n - len(longest_part) <= lost_count + MAX_LOST_FRACTION * n:
        rows = longest_part
        times = f"{len(backward_steps)} times, first " if len(backward_steps) > 1 else ""
        warnings.append(f"the clock was set back {times}by {backward_steps[0]:.3f} s: "
                        f"{format_count(n - len(rows), n, noun)} are not used; split the recording to use them")
    elif lost_count:
        is_newest = np.diff(np.maximum.accumulate(time_ns), prepend=time_ns[:1] - 1) > 0
        reason = "out of order in time" if np.delete(is_newest, rows).any() else "not later than those before them"
        warnings.append(f"{format_count(lost_count, n, noun)} are {reason}; they were left out")
    steps = np.diff(time_ns[rows])
    if len(rows) <= 10:
        return rows, warnings
    max_end_step = MAX_END_STEP_RATIO * np.percentile(steps, 95)  # not the median, because rows may arrive in batches
    if steps[-1] > max_end_step:
        warnings.append(f"the last of {n} {noun} is {steps[-1] * 1e-9:.3f} s after the previous one; it was left out")
        rows = rows[:-1]
    if len(rows) > 10 and steps[0] > max_end_step:
        warnings.append(f"the first of {n} {noun} is {steps[0] * 1e-9:.3f} s before the next one; it was left out")
        rows = rows[1:]
    return rows, warnings
