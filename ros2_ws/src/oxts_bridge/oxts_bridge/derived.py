"""Derives the vendor's additional quantities from decoded packets: level-frame values, speed, slip, distance, ISO axes.

Level frame: forward, right, down without pitch and roll; Iso: forward, left, up. NaN where an input is missing, and in
packets without valid navigation (status other than 3, 4, 21, 22); angular accelerations (Yx, Yy, Yz) and filtered
values are also given at status 2, but not at 21 and 22. Checked by: tests/golden/test_ncom_vectors.py.
"""

from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
from scipy.signal import lfilter, lfilter_zi

from .file_decoder import EMPTY, REGULAR, UNKNOWN_TIME, Columns
from .geometry import Attitude, Vector, compute_radii, flu_from_frd
from .motion import Motion
from .ncom import STATUS_ONLY, Packet

EARTH_RATE = 7.2921151467e-5  # rad/s
MIN_TRACK_SPEED = 0.14  # m/s; lowest speed with a track while the unit gives no velocity accuracy
# Distance is not integrated across a step of the packet time that is backward or longer than this [s] (joined files).
LONGEST_STEP = 10.0
_STEP_TOLERANCE = 0.01  # two successive steps give the sampling rate if they differ by less than this fraction

SettingHistory: TypeAlias = Sequence[tuple[int, tuple[Any, ...]]]
"""Values of one group of status fields: (index of the first packet to which they apply, values; None: invalid)."""


def derive_columns(columns: Columns, velocity_accuracy: SettingHistory, acceleration_filter: SettingHistory,
                   rate_filter: SettingHistory) -> Mapping[str, np.ndarray]:
    """Derived columns by name, in the order and units (of m, deg, s) of the vendor's tools.

    velocity_accuracy: north and east [m/s].  acceleration_filter, rate_filter: cutoff [Hz] and damping ratio.
    """
    has_fix = (columns.kind != EMPTY) & ~columns.approximate
    names = ("acceleration", "angular_rate", "latitude", "longitude", "altitude", "velocity_ned", "heading", "pitch",
             "roll")
    motion = Motion.from_packet(Packet(**{name: np.where(has_fix, getattr(columns, name), np.nan) for name in names}))
    out: dict[str, np.ndarray] = {}
    attitude, seconds = motion.attitude, compute_gps_seconds(columns)
    level_axes = Attitude(np.zeros(len(columns)), attitude.pitch, attitude.roll)
    level_rate = flu_from_frd(level_axes.to_enu(motion.angular_velocity))
    s, c = np.sin(attitude.yaw), np.cos(attitude.yaw)
    east, north, up = motion.velocity
    out["Vf"], out["Vl"] = east * c + north * s, east * s - north * c
    _add_speed_and_slip(out, motion, level_rate[2], velocity_accuracy)
    _add_distances(out, columns, seconds)
    out["Af"], out["Al"], out["Ad"] = flu_from_frd(level_axes.to_enu(motion.acceleration))
    out["Wf"], out["Wl"], out["Wd"] = np.degrees(level_rate)
    _add_angular_acceleration(out, columns, seconds)
    _add_filtered(out, columns, seconds, acceleration_filter, rate_filter)
    for prefix, vector in (("IsoVo", motion.body_velocity), ("IsoVh", (out["Vf"], -out["Vl"], up)),
                           ("IsoAo", _compute_ground_acceleration(motion))):
        out[f"{prefix}X"], out[f"{prefix}Y"], out[f"{prefix}Z"] = vector
    return out


def compute_gps_seconds(columns: Columns) -> np.ndarray:
    """GPS seconds since 1980-01-06, NaN if unknown.

    Minutes and milliseconds are added as floats, as in the vendor's tools: the rounding error of 2e-7 s affects the
    tools' angular accelerations and distances.
    """
    is_timed = columns.gps_ns != UNKNOWN_TIME
    minutes, remainder = np.divmod(np.where(is_timed, columns.gps_ns, 0), 60_000_000_000)
    milliseconds, fine = np.divmod(remainder, 1_000_000)
    return np.where(is_timed, minutes * 60.0 + milliseconds * 0.001 + fine * 1e-9, np.nan)


def _add_speed_and_slip(out: dict, motion: Motion, yaw_rate: np.ndarray, velocity_accuracy: SettingHistory) -> None:
    """Slip is track minus heading. yaw_rate: clockwise, in level axes [rad/s].

    Track, slip and curvature are NaN up to a speed of 2 sqrt(north^2 + east^2) of the velocity accuracies.
    """
    east, north, up = motion.velocity
    speed = np.hypot(north, east)
    out["Speed2d"] = speed
    out["Speed3d"] = np.sqrt(north**2 + east**2 + up**2)
    limits = np.array([MIN_TRACK_SPEED, *(MIN_TRACK_SPEED if None in sigma else 2 * (sigma[0]**2 + sigma[1]**2) ** 0.5
                                          for _, sigma in velocity_accuracy)])
    newest = np.searchsorted([first for first, _ in velocity_accuracy], np.arange(len(speed)), side="right")
    moving = np.greater(speed, limits[newest], where=~np.isnan(speed), out=np.zeros(len(speed), bool))
    track = np.where(moving, np.degrees(np.arctan2(east, north)), np.nan)
    slip = track - 90.0 + np.degrees(motion.attitude.yaw)
    out["Track"] = track
    out["Slip"] = slip - 360.0 * np.ceil((slip - 180.0) / 360.0)
    out["Curvature"] = np.divide(yaw_rate, speed, where=moving, out=np.full(len(speed), np.nan))


def _add_distances(out: dict, columns: Columns, seconds: np.ndarray) -> None:
    """Add the trapezoidal integral of the speed, also at the times of trigger packets, which do not enter the sum."""
    for name, speed in (("Dist2d", out["Speed2d"]), ("Dist3d", out["Speed3d"])):
        usable = ~np.isnan(speed) & ~np.isnan(seconds)
        series = np.flatnonzero(usable & (columns.kind == REGULAR) & (columns.order == 0))
        # The vendor's tools skip the first packet if it sets the minute.
        if len(series) and columns.channel[series[0]] == 0:
            earlier = slice(0, series[0])
            sets_minute = (columns.navigation_status[earlier] == STATUS_ONLY) & (columns.channel[earlier] == 0)
            series = series[0 if sets_minute.any() else 1 :]
        distance = np.full(len(speed), np.nan)
        if len(series):
            step = np.diff(seconds[series])
            step[(step < 0) | (step > LONGEST_STEP)] = 0.0
            total = np.concatenate([[0.0], np.cumsum(0.5 * (speed[series][1:] + speed[series][:-1]) * step)])
            remaining = np.flatnonzero(usable & ~np.isin(np.arange(len(speed)), series))
            distance[series] = total
            before = np.searchsorted(series, remaining) - 1
            remaining, before = remaining[before >= 0], before[before >= 0]
            last = series[before]
            elapsed = np.where(columns.kind[remaining] == REGULAR, 0.0, seconds[remaining] - seconds[last])
            distance[remaining] = total[before] + 0.5 * (speed[remaining] + speed[last]) * elapsed
        out[name] = distance


def _add_angular_acceleration(out: dict, columns: Columns, seconds: np.ndarray) -> None:
    """Add the backward difference of the angular rate [deg/s^2] for regular packets."""
    rate = np.degrees(columns.angular_rate)
    series = np.flatnonzero((columns.kind == REGULAR) & ~np.isnan(seconds) & ~np.isnan(rate).any(axis=0))
    result = np.full(rate.shape, np.nan)
    if len(series) > 1:
        step = np.diff(seconds[series])
        forward = step > 0
        result[:, series[1:][forward]] = (np.diff(rate[:, series], axis=1)[:, forward]) / step[forward]
    out["Yx"], out["Yy"], out["Yz"] = result


def _add_filtered(out: dict, columns: Columns, seconds: np.ndarray, acceleration_filter: SettingHistory,
                  rate_filter: SettingHistory) -> None:
    regular = (columns.kind == REGULAR) & ~np.isnan(seconds)
    for prefix, signal, changes in (("FiltA", columns.acceleration, acceleration_filter),
                                    ("FiltY", np.array([out["Yx"], out["Yy"], out["Yz"]]), rate_filter)):
        series = np.flatnonzero(regular & ~np.isnan(signal).any(axis=0))
        settings = [(int(np.searchsorted(series, index)), setting) for index, setting in changes]
        for axis, values in zip("xyz", signal, strict=True):
            out[prefix + axis] = filtered = np.full(len(seconds), np.nan)
            filtered[series] = filter_low_pass(seconds[series], values[series], settings)


def filter_low_pass(seconds: np.ndarray, values: np.ndarray, settings: SettingHistory) -> np.ndarray:
    """Values filtered by the second-order low-pass with the settings that the unit sends in channels 63 and 74.

        b = (K^2, 2 K^2, K^2) / D,  a = (1, 2 (K^2 - 1) / D, (K^2 - 2 z K + 1) / D),
        K = tan(pi fc / fs),  D = K^2 + 2 z K + 1

    settings: (index of the first sample, (cutoff fc [Hz], damping ratio z)); both 0: no filter; one 0 or None: ignored.
    NaN until there are a setting with fc < fs / 2 and three evenly spaced samples, of which three may precede a new
    setting; the filter starts in steady state at the first of them.
    Source: NCOM manual 260702. Checked by: tests/golden/test_ncom_vectors.py (case filters).
    """
    output = np.full(len(values), np.nan)
    changes: list[tuple[int, tuple[float, float]]] = []
    for start, (cutoff, damping) in settings:
        if cutoff is None or damping is None or (cutoff > 0) != (damping > 0):
            continue
        if not changes or changes[-1][1] != (cutoff, damping):
            changes.append((start, (cutoff, damping)))
    for number, (start, (cutoff, damping)) in enumerate(changes, 1):
        end = changes[number][0] if number < len(changes) else len(values)
        if not cutoff:
            output[start:end] = values[start:end]
            continue
        steps = np.diff(seconds[max(start - 3, 0) : end])
        older, newer = steps[:-1], steps[1:]
        even = (older > 0) & (np.abs(older - newer) < _STEP_TOLERANCE * newer) & (cutoff * (older + newer) < 1)
        if not even.any():
            continue
        first = max(start - 3, 0) + int(even.argmax())
        k = np.tan(np.pi * cutoff * (seconds[first + 2] - seconds[first]) / 2)
        d = k * k + 2 * damping * k + 1
        b = np.array([k * k, 2 * k * k, k * k]) / d
        a = np.array([d, 2 * (k * k - 1), k * k - 2 * damping * k + 1]) / d
        filtered, _ = lfilter(b, a, values[first + 1 : end], zi=lfilter_zi(b, a) * values[first])
        begin = max(start, first + 2)
        output[begin:end] = filtered[begin - first - 1 :]
    return output


def _compute_ground_acceleration(motion: Motion) -> Vector:
    """Acceleration relative to the ground [m/s^2], FLU: a = A + R^T (g - (2 w_ie + w_en) x v), R from body axes to ENU.

    A: specific force. g: gravity. w_ie: earth rate. w_en: transport rate, of the local frame relative to the earth.
    """
    latitude, height = motion.latitude, motion.altitude
    east, north, _ = motion.velocity
    s, c = np.sin(latitude), np.cos(latitude)
    meridian, normal = compute_radii(latitude)
    rotation = np.array([-north / (meridian + height), 2 * EARTH_RATE * c + east / (normal + height),
                         2 * EARTH_RATE * s + east * s / c / (normal + height)])
    correction = -np.cross(rotation, motion.velocity, axis=0)
    correction[2] -= compute_gravity(latitude, height)
    x, y, z = motion.attitude.to_body(tuple(correction))
    force_x, force_y, force_z = motion.acceleration
    return force_x + x, force_y + y, force_z + z


def compute_gravity(latitude: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Normal gravity [m/s^2] at a latitude [rad] and height [m]; constant below height 0."""
    surface = 9.780318 * (1 + 5.3024e-3 * np.sin(latitude) ** 2 - 5.9e-6 * np.sin(2 * latitude) ** 2)
    return surface / (1 + np.maximum(height, 0) / 6367435.68) ** 2
