"""What the vendor's tools compute from the packets: level-frame values, speed, slip, distance, ISO axes. Column by
column.

Conventions (ncom.md section 10): level frame = forward, right, down; Iso = forward, left, up. All from valid
navigation only (status 3, 4, 21, 22). Where an input is missing the result is NaN. Checked by:
tests/golden/test_ncom_vectors.py.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from .file_decoder import EMPTY, REGULAR, UNKNOWN_TIME, Columns
from .geodesy import ECCENTRICITY_SQUARED, SEMI_MAJOR_AXIS
from .low_pass import LowPass

EARTH_RATE = 7.2921151467e-5
# Taken as the accuracy of the horizontal speed where the unit has not sent one [m/s].
UNKNOWN_SPEED_ACCURACY = 0.14
# Distance is not integrated across a longer step of the packet time, nor a backward one: that is a joined file or a
# set clock.
LONGEST_STEP = 10.0

@dataclass
class Settings:
    """What derived values need from the status channels, each as (packet index, value) from which packet on it holds.

    speed_accuracy: 2 sqrt(north^2 + east^2) [m/s], NaN unknown.  acceleration_filter, rate_filter: (cutoff [Hz],
    damping).
    """

    speed_accuracy: list[tuple[int, float]]
    acceleration_filter: list[tuple[int, tuple[float | None, float | None]]]
    rate_filter: list[tuple[int, tuple[float | None, float | None]]]


def derive(columns: Columns, settings: Settings) -> Mapping[str, np.ndarray]:
    """By name, in the order of the table; deg, deg/s, m, m/s, m/s^2 as the vendor shows them."""
    fix = (columns.kind != EMPTY) & ~columns.approximate
    velocity = np.where(fix, columns.velocity_ned, np.nan)
    heading, pitch, roll = (np.where(fix, angle, np.nan) for angle in (columns.heading, columns.pitch, columns.roll))
    acceleration = np.where(fix, columns.acceleration, np.nan)
    rate = np.where(fix, columns.angular_rate, np.nan)
    out: dict[str, np.ndarray] = {}
    level = _level_matrix(pitch, roll)
    seconds = float_seconds(columns)
    level_velocity, level_rate = _to_level_heading(velocity, heading), _apply(level, rate)
    out["Vf"], out["Vl"] = level_velocity[0], level_velocity[1]
    _speed_and_slip(out, velocity, heading, level_rate[2], _held(settings.speed_accuracy, len(columns)))
    _distances(out, columns, seconds)
    out["Af"], out["Al"], out["Ad"] = _apply(level, acceleration)
    out["Wf"], out["Wl"], out["Wd"] = np.degrees(level_rate)
    _angular_acceleration(out, columns, seconds)
    _filtered(out, columns, seconds, settings)
    for prefix, frd in (("IsoVo", _apply_transposed(level, level_velocity)), ("IsoVh", level_velocity),
                        ("IsoAo", _without_gravity(columns, velocity, heading, level, acceleration))):
        out[f"{prefix}X"], out[f"{prefix}Y"], out[f"{prefix}Z"] = frd[0], -frd[1], -frd[2]
    return out


def float_seconds(columns: Columns) -> np.ndarray:
    """GPS seconds since 1980-01-06, NaN unknown. Minutes and the rest are added as floats because the vendor's tools
    do: a difference of two such times carries 2e-7 s of rounding, and the reference values of Y and Dist carry it with
    them."""
    known = columns.gps_ns != UNKNOWN_TIME
    minutes, rest = np.divmod(np.where(known, columns.gps_ns, 0), 60_000_000_000)
    milliseconds, fine = np.divmod(rest, 1_000_000)
    return np.where(known, minutes * 60.0 + milliseconds * 0.001 + fine * 1e-9, np.nan)


def _level_matrix(pitch: np.ndarray, roll: np.ndarray) -> list[list[np.ndarray]]:
    """Ry(pitch) Rx(roll): vehicle axes to level axes."""
    sp, cp, sr, cr = np.sin(pitch), np.cos(pitch), np.sin(roll), np.cos(roll)
    return [[cp, sp * sr, sp * cr], [0 * sp, cr, -sr], [-sp, cp * sr, cp * cr]]


def _apply(matrix: list[list[np.ndarray]], vector: np.ndarray) -> np.ndarray:
    return np.array([row[0] * vector[0] + row[1] * vector[1] + row[2] * vector[2] for row in matrix])


def _apply_transposed(matrix: list[list[np.ndarray]], vector: np.ndarray) -> np.ndarray:
    return np.array([sum(matrix[i][j] * vector[i] for i in range(3)) for j in range(3)])


def _to_level_heading(ned: np.ndarray, heading: np.ndarray) -> np.ndarray:
    """Rz(heading) transposed: north, east, down to forward, right, down."""
    s, c = np.sin(heading), np.cos(heading)
    return np.array([ned[0] * c + ned[1] * s, -ned[0] * s + ned[1] * c, ned[2]])


def _speed_and_slip(
    out: dict, velocity: np.ndarray, heading: np.ndarray, yaw_rate: np.ndarray, accuracy: np.ndarray
) -> None:
    north, east, down = velocity
    speed = np.hypot(north, east)
    out["Speed2d"] = speed
    out["Speed3d"] = np.sqrt(north**2 + east**2 + down**2)
    limit = np.where(np.isnan(accuracy), UNKNOWN_SPEED_ACCURACY, accuracy)
    moving = np.greater(speed, limit, where=~np.isnan(speed), out=np.zeros(len(speed), bool))
    track = np.where(moving, np.degrees(np.arctan2(east, north)), np.nan)
    slip = track - np.degrees(heading)
    out["Track"] = track
    out["Slip"] = slip - 360.0 * np.ceil((slip - 180.0) / 360.0)
    out["Curvature"] = np.divide(yaw_rate, speed, where=moving, out=np.full(len(speed), np.nan))


def _held(changes: list[tuple[int, float]], count: int) -> np.ndarray:
    """A value that holds from a packet on, as a column."""
    if not changes:
        return np.full(count, np.nan)
    where = np.array([index for index, _ in changes])
    values = np.array([np.nan if value is None else value for _, value in changes], float)
    newest = np.searchsorted(where, np.arange(count), side="right") - 1
    return np.where(newest >= 0, values[np.maximum(newest, 0)], np.nan)


def _distances(out: dict, columns: Columns, seconds: np.ndarray) -> None:
    """Trapezoidal sum of speed; a trigger packet reads it without advancing it."""
    for name, speed in (("Dist2d", out["Speed2d"]), ("Dist3d", out["Speed3d"])):
        usable = ~np.isnan(speed) & ~np.isnan(seconds)
        series = np.flatnonzero(usable & (columns.kind == REGULAR) & (columns.order == 0))
        series = series[_sets_minute(columns, series) :]
        distance = np.full(len(speed), np.nan)
        if len(series):
            step = np.diff(seconds[series])
            step[(step < 0) | (step > LONGEST_STEP)] = 0.0
            total = np.concatenate([[0.0], np.cumsum(0.5 * (speed[series][1:] + speed[series][:-1]) * step)])
            others = np.flatnonzero(usable & ~np.isin(np.arange(len(speed)), series))
            distance[series] = total
            before = np.searchsorted(series, others) - 1
            others, before = others[before >= 0], before[before >= 0]
            last = series[before]
            further = np.where(columns.kind[others] == REGULAR, 0.0, seconds[others] - seconds[last])
            distance[others] = total[before] + 0.5 * (speed[others] + speed[last]) * further
        out[name] = distance


def _sets_minute(columns: Columns, series: np.ndarray) -> int:
    """1 if the first packet of the series is the one that sets the minute: the vendor's tools count distance from the
    next."""
    if not len(series) or columns.channel[series[0]] != 0:
        return 0
    earlier = slice(0, series[0])
    return int(not np.any((columns.navigation_status[earlier] == 10) & (columns.channel[earlier] == 0)))


def _angular_acceleration(out: dict, columns: Columns, seconds: np.ndarray) -> None:
    """Backward difference of the angular rate over the packet time [deg/s^2], regular packets only."""
    rate = np.degrees(columns.angular_rate)
    series = np.flatnonzero((columns.kind == REGULAR) & ~np.isnan(seconds) & ~np.isnan(rate).any(axis=0))
    result = np.full(rate.shape, np.nan)
    if len(series) > 1:
        step = np.diff(seconds[series])
        forward = step > 0
        result[:, series[1:][forward]] = (np.diff(rate[:, series], axis=1)[:, forward]) / step[forward]
    out["Yx"], out["Yy"], out["Yz"] = result


def _filtered(out: dict, columns: Columns, seconds: np.ndarray, settings: Settings) -> None:
    regular = (columns.kind == REGULAR) & ~np.isnan(seconds)
    groups = (
        ("FiltA", columns.acceleration, settings.acceleration_filter),
        ("FiltY", np.array([out["Yx"], out["Yy"], out["Yz"]]), settings.rate_filter),
    )
    for prefix, signal, changes in groups:
        for axis, values in zip("xyz", signal, strict=True):
            filtered = np.full(len(seconds), np.nan)
            series = np.flatnonzero(regular & ~np.isnan(signal).any(axis=0))
            if changes:
                _run_filter(filtered, series, seconds, values, changes)
            out[prefix + axis] = filtered


def _run_filter(
    filtered: np.ndarray,
    series: np.ndarray,
    seconds: np.ndarray,
    values: np.ndarray,
    changes: list[tuple[int, tuple[float | None, float | None]]],
) -> None:
    low_pass = LowPass()
    waiting = list(changes)
    for i, time, value in zip(series.tolist(), seconds[series].tolist(), values[series].tolist(), strict=True):
        while waiting and waiting[0][0] <= i:
            low_pass.configure(*waiting.pop(0)[1])
        output = low_pass.feed(time, value)
        if output is not None:
            filtered[i] = output


def _without_gravity(
    columns: Columns, velocity: np.ndarray, heading: np.ndarray, level: list[list[np.ndarray]], acceleration: np.ndarray
) -> np.ndarray:
    """Acceleration of the vehicle over ground in vehicle axes (FRD): a = A + R_no^T (g - (2 w_ie + w_en) x v)."""
    latitude, height = columns.latitude, columns.altitude
    north, east, down = velocity
    s, c = np.sin(latitude), np.cos(latitude)
    w = 1 - ECCENTRICITY_SQUARED * s**2
    normal = SEMI_MAJOR_AXIS / np.sqrt(w)
    meridian = normal * (1 - ECCENTRICITY_SQUARED) / w
    turn_north = 2 * EARTH_RATE * c + east / (normal + height)
    turn_east = -north / (meridian + height)
    turn_down = -2 * EARTH_RATE * s - east * s / c / (normal + height)
    extra = np.array(
        [
            -(turn_east * down - turn_down * east),
            -(turn_down * north - turn_north * down),
            gravity(latitude, height) - (turn_north * east - turn_east * north),
        ]
    )
    return acceleration + _apply_transposed(level, _to_level_heading(extra, heading))


def gravity(latitude: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Normal gravity [m/s^2] at latitude [rad], height [m]; the fall-off holds for height > 0."""
    surface = 9.780318 * (1 + 5.3024e-3 * np.sin(latitude) ** 2 - 5.9e-6 * np.sin(2 * latitude) ** 2)
    return surface / (1 + np.maximum(height, 0) / 6367435.68) ** 2
