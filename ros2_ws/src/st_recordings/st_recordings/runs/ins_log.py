"""An INS recording in the axes of the suite, of any instrument; usable time stamps; vehicle speed from the wheels."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from st_core.checks import InsQuality, Series
from st_core.log import INS_SIGNALS, OPTIONAL_INS_SIGNALS
from st_core.timeseries import interpolate

from .errors import format_share

# The unsteered axle gives the most accurate speed of the car; then the other axle, then the speed signal of the car.
_SPEEDS = (("wheel_speed_rear_left", "wheel_speed_rear_right"), ("wheel_speed_front_left", "wheel_speed_front_right"),
           ("vehicle_speed",))
SPEEDS = tuple(name for names in _SPEEDS for name in names)
MAX_WHEEL_GAP_NS = 100_000_000  # longest gap across which the speed of a wheel is interpolated
LATEST_TIME = 9.0e9  # s since 1970, year 2255; whole nanoseconds do not reach much further
MAX_LOST_SHARE = 0.01
"""Fraction of rows not newer than all before, above which the clock was set back, and only one stretch is used."""
MAX_END_STEP = 10.0
"""Ratio of the first or last time step to the 95th percentile of all, above which that stamp is wrong."""


@dataclass(frozen=True)
class InsLog:
    """INS measurements with a fix, in axes forward, left, up. NaN where a channel was not recorded.

    time_ns: when measured, strictly increasing. position: (3, n) east, north, up of `origin` [m], INS point. yaw: from
    east counter-clockwise, unwrapped; pitch: nose down +, roll: right side down + [rad]. velocity: (3, n) body axes
    [m/s]. rate: (3, n) body axes [rad/s]. acceleration: (3, n) specific force, body axes [m/s^2]. origin: latitude,
    longitude [rad], altitude [m], None for positions that were recorded in metres. stamps_ns: times of all samples,
    with a fix or not. quality: as the unit reports it, or None. absolute: whether the times are UTC.
    """

    file: Path
    time_ns: np.ndarray
    position: np.ndarray
    yaw: np.ndarray
    pitch: np.ndarray
    roll: np.ndarray
    velocity: np.ndarray
    rate: np.ndarray
    acceleration: np.ndarray
    origin: tuple[float, float, float] | None
    stamps_ns: np.ndarray
    quality: InsQuality | None
    warnings: tuple[str, ...] = ()
    absolute: bool = True


def build_planar_ins_log(file: Path, time_ns: np.ndarray, values: Mapping[str, np.ndarray],
                         warnings: tuple[str, ...] = (), absolute: bool = True,
                         origin: tuple[float, float, float] | None = None) -> InsLog:
    """An INS log of motion in the plane: pitch, roll and vertical motion are zero.

    values: any of x, y, yaw, velocity_x, velocity_y, yaw_rate, acceleration_x, acceleration_y.
    """
    zero, unknown = np.zeros(len(time_ns)), np.full(len(time_ns), np.nan)
    x, y, yaw, velocity_x, velocity_y, yaw_rate, *acceleration = (values.get(name, unknown) for name in (
        *INS_SIGNALS, *OPTIONAL_INS_SIGNALS[:2]))
    return InsLog(file, time_ns, np.stack([x, y, zero]), yaw, zero, zero, np.stack([velocity_x, velocity_y, zero]),
                  np.stack([zero, zero, yaw_rate]), np.stack([*acceleration, unknown]), origin, time_ns, None, warnings,
                  absolute)


def yaw_from_quaternion(x: np.ndarray, y: np.ndarray, z: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Yaw [rad] in (-pi, pi] of quaternions from body to map axes, of any length; NaN for length 0."""
    unset = x * x + y * y + z * z + w * w == 0
    return np.where(unset, np.nan, np.arctan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z))


def compute_car_speed(speeds: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> Series | None:
    """Speed of the car from its wheels [m/s]: mean of the rear ones, else of the front ones, else its speed signal.

    speeds: name (one of SPEEDS) -> (time [ns], ascending; values [m/s]).
    """
    for names in _SPEEDS:
        if all(name in speeds and np.isfinite(speeds[name][1]).any() for name in names):
            time_ns = speeds[names[0]][0]
            wheels = [interpolate(*_select_finite(*speeds[name]), time_ns, MAX_WHEEL_GAP_NS) for name in names]
            return make_series(time_ns, np.mean(wheels, axis=0))
    return None


def make_series(time_ns: np.ndarray, values: np.ndarray) -> Series | None:
    """The finite samples of a signal with ascending time; None without any."""
    time_ns, values = _select_finite(np.asarray(time_ns, np.int64), values)
    if not len(time_ns):
        return None
    rows = is_newer(time_ns)
    return Series(time_ns[rows], values[rows])


def is_newer(time_ns: np.ndarray) -> np.ndarray:
    """Whether each time is later than all before it."""
    return np.diff(np.maximum.accumulate(time_ns), prepend=time_ns[:1] - 1) > 0


def is_mostly_known(values: np.ndarray | None) -> bool:
    """Whether at least half of an optional channel was recorded."""
    return values is not None and len(values) > 0 and bool(np.isfinite(values).mean() >= 0.5)


def _select_finite(time_ns: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    known = np.isfinite(values)
    return time_ns[known], values[known]


def select_usable_rows(time_ns: np.ndarray, what: str) -> tuple[np.ndarray, list[str]]:
    """(rows of strictly ascending time, warnings with the fraction that is not used).

    Single rows that are not later than all before are left out. If these are more than MAX_LOST_SHARE, the clock was
    set back while recording: only the longest stretch without a step back is used. A first or last row with
    a stamp far from the others is left out. time_ns: (n,) int64 in the order of the recording. what: noun for the
    rows, plural.
    """
    n = len(time_ns)
    rows = np.flatnonzero(is_newer(time_ns))
    lost = n - len(rows)
    notes = []
    back = -np.diff(time_ns)[np.diff(time_ns) < 0] * 1e-9
    longest = _find_longest_stretch(time_ns) if len(back) and lost > max(MAX_LOST_SHARE * n, 1) else rows[:0]
    if len(longest) and n - len(longest) <= lost + MAX_LOST_SHARE * n:
        rows = longest
        often = f"{len(back)} times, first" if len(back) > 1 else "once,"
        notes.append(f"the clock was set back {often} by {back[0]:.3f} s: "
                     f"{format_share(n - len(rows), n, what)} are not used; split the recording to use them")
    elif lost:
        notes.append(f"{format_share(lost, n, what)} are not later than all before; they were left out")
    steps = np.diff(time_ns[rows])
    usual = np.percentile(steps, 95) if len(rows) > 10 else 0.0  # rows may arrive in batches
    if len(rows) > 10 and steps[-1] > MAX_END_STEP * usual:
        notes.append(f"the last of {n} {what} is {steps[-1] * 1e-9:.3f} s after the previous one; it was left out")
        rows = rows[:-1]
    if len(rows) > 10 and steps[0] > MAX_END_STEP * usual:
        notes.append(f"the first of {n} {what} is {steps[0] * 1e-9:.3f} s before the next one; it was left out")
        rows = rows[1:]
    return rows, notes


def _find_longest_stretch(time_ns: np.ndarray) -> np.ndarray:
    """The rows of ascending time in the longest stretch without a step back."""
    edges = np.concatenate(([0], np.flatnonzero(np.diff(time_ns) < 0) + 1, [len(time_ns)]))
    longest = int(np.argmax(np.diff(edges)))
    rows = np.arange(edges[longest], edges[longest + 1])
    return rows[is_newer(time_ns[rows])]
