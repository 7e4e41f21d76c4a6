"""Exports an NCOM file to CSV for `st ncom`: the values of every packet, and every change of the status.

The values include the vendor's derived quantities: level-frame values, speed, slip, distance, ISO axes. Axes of the
level frame: forward, right, down, without pitch and roll; of columns named Iso: forward, left, up. A derived value
is empty where an input is missing, and in packets without valid navigation (status other than 3, 4, 21, 22). Angular
accelerations (Yx, Yy, Yz) and filtered values are also written at status 2, but not at 21 and 22.
Checked by: tests/golden/test_ncom_vectors.py.
"""

import csv
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from scipy.signal import lfilter, lfilter_zi
from scipy.spatial.transform import Rotation

from .channels import B6_BIT7_CLEAR, FIELDS, Value
from .file_decoder import EMPTY, KINDS, REGULAR, TRIGGER, UNKNOWN_TIME, Columns, decode_file
from .geometry import Attitude, Vector, compute_radii, flu_from_frd
from .motion import Motion
from .ncom import RAW_IMU, STATUS_ONLY, WEEK_MS, NcomError, Packet
from .status import RAW_FIELDS, StatusTracker

Change: TypeAlias = tuple[int, int, str, Value]
"""Change of a status field: packet, channel, field, value (None: invalid)."""

TRIGGER_NAMES = {24: "in1down", 43: "in1up", 65: "out1", 79: "in2down", 80: "in2up", 81: "out2"}
_LARGEST_UMAC_STATUS = 10  # the vendor's tools limit the code of the robot interface to this value
# In these fields, "invalid" means "no new value": the last value remains valid, as in the vendor's tools.
_RETAINED_FIELDS = frozenset(
    name for fields in FIELDS.values() for name, field in fields.items()
    if name.startswith("Inn") or name == "Undulation" or field.validity is B6_BIT7_CLEAR)
_DERIVATION_FIELDS = {4: ("VnAcc", "VeAcc"), 60: ("Ned2SurfHeading", "Ned2SurfPitch", "Ned2SurfRoll"),
                      63: ("AngAccFiltFreq", "AngAccFiltZeta"), 74: ("LinAccFiltFreq", "LinAccFiltZeta")}
"""Status channel -> fields on which derived columns and surface angles depend."""
_SURFACE_ANGLES = ("Surf2OutHeading", "Surf2OutPitch", "Surf2OutRoll")
_ROWS_PER_WRITE = 1 << 12
EARTH_RATE = 7.2921151467e-5  # rad/s
MIN_TRACK_SPEED = 0.14  # m/s; lowest speed with a track while the velocity accuracy is unknown
# Distance is not integrated across a time step that is negative or longer than this [s], as occurs in joined files.
LONGEST_STEP = 10.0
_STEP_TOLERANCE = 0.01  # two successive steps give the sampling rate if they differ by less than this fraction

SettingHistory: TypeAlias = Sequence[tuple[int, tuple[Any, ...]]]
"""Values of one group of status fields: (index of the first packet to which they apply, values; None: invalid)."""


def write_csv(ncom_path: str | Path, csv_path: str | Path, status_path: str | Path | None = None) -> int:
    """Write the packets of an .ncom file, and optionally its status changes, as CSV; returns the number of packets.

    csv_path: columns of `_make_table`, one row per accepted packet; empty: invalid. Units: m, 1/m, m/s, m/s^2, deg,
    deg/s, deg/s^2; times in GPS seconds. status_path: pkt,channel,field,valid,value, one row per change of a field.
    Raises NcomError for a file without packets and if two of the three files are the same; OSError for a file that
    cannot be read or written.
    """
    outputs = [Path(path) for path in (csv_path, status_path) if path is not None]
    for output in outputs:
        if output.exists() and output.samefile(ncom_path):
            raise NcomError(f"output {output} is the recording itself: name a different file")
    if len({output.resolve() for output in outputs}) < len(outputs):
        raise NcomError(f"values and status would both be written to {csv_path}: name two different files")
    columns = decode_file(ncom_path)
    changes, history = _read_status(columns)
    table = _make_table(columns, history)
    with Path(csv_path).open("w", encoding="ascii", newline="") as file:
        file.write(",".join(table) + "\n")
        for start in range(0, len(columns), _ROWS_PER_WRITE):
            rows = slice(start, start + _ROWS_PER_WRITE)
            # str() gives the shortest text that reads back as the same number; NaN becomes empty.
            cells = [["" if text == "nan" else text for text in map(str, column[rows].tolist())]
                     for column in table.values()]
            file.writelines(",".join(row) + "\n" for row in zip(*cells, strict=True))
    if status_path is not None:
        with Path(status_path).open("w", encoding="ascii", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(("pkt", "channel", "field", "valid", "value"))
            writer.writerows((packet, channel, name, int(value is not None), value)
                             for packet, channel, name, value in changes)
    return len(columns)


def _make_table(columns: Columns, history: Mapping[int, SettingHistory]) -> dict[str, np.ndarray]:
    """Columns of the CSV by name. history: values of the fields in _DERIVATION_FIELDS, by channel."""
    is_timed = (columns.gps_ns != UNKNOWN_TIME) & (columns.kind != TRIGGER)
    gps_ms = np.where(is_timed, columns.gps_ns // 1_000_000, 0)
    degrees, out_type = np.degrees, np.array(KINDS, "<U8")[columns.kind]
    for i in np.flatnonzero(columns.kind == TRIGGER):
        out_type[i] = TRIGGER_NAMES[int(columns.channel[i])]
    heading = degrees(columns.heading)
    has_navigation = np.isin(columns.kind, (REGULAR, TRIGGER)) & (columns.navigation_status != RAW_IMU)
    return {
        "pkt": np.arange(len(columns)), "start_offset": columns.offset, "out_type": out_type,
        "nav_mode": columns.navigation_status, "channel": columns.channel, "time": compute_gps_seconds(columns),
        "week": np.where(is_timed, (gps_ms // WEEK_MS).astype(str), ""),
        "tow": np.where(is_timed, gps_ms % WEEK_MS / 1e3, np.nan),
        "quality": np.where(has_navigation, np.where(columns.is_approximate, "approx", "valid"), ""),
        **dict(zip(("Ax", "Ay", "Az"), columns.acceleration, strict=True)),
        **dict(zip(("Wx", "Wy", "Wz"), degrees(columns.angular_rate), strict=True)),
        "Lat": degrees(columns.latitude), "Lon": degrees(columns.longitude), "Alt": columns.altitude,
        **dict(zip(("Vn", "Ve", "Vd"), columns.velocity_ned, strict=True)),
        "Heading": np.where(heading < 0, heading + 360.0, heading),
        "Pitch": degrees(columns.pitch), "Roll": degrees(columns.roll),
        **_derive_columns(columns, history),
    }


def _read_status(columns: Columns) -> tuple[list[Change], Mapping[int, SettingHistory]]:
    """Changes of all status fields, and the values of the fields in _DERIVATION_FIELDS by channel."""
    tracker = StatusTracker()
    last_values: dict[str, Value] = {}
    changes: list[Change] = []
    history: dict[int, list[tuple[int, tuple[Value, ...]]]] = {channel: [] for channel in _DERIVATION_FIELDS}
    positions = np.array([columns.latitude, columns.longitude, columns.altitude]).T
    for i in np.flatnonzero(columns.has_status).tolist():
        channel = int(columns.channel[i])
        seconds = None if columns.gps_ns[i] == UNKNOWN_TIME else columns.gps_ns[i] / 1e9
        position = tuple(positions[i]) if channel == 25 and not np.isnan(positions[i]).any() else None
        fields = tracker.update(channel, columns.batch_s[:, i].tobytes(), seconds, position)
        for name, sent in fields.items():
            value = min(sent, _LARGEST_UMAC_STATUS) if name == "UmacStatus" and sent is not None else sent
            is_reported = name not in RAW_FIELDS and (value is not None or name not in _RETAINED_FIELDS)
            if is_reported and last_values.get(name) != value:
                last_values[name] = value
                changes.append((i, channel, name, value))
        if fields and channel in _DERIVATION_FIELDS:
            # A status applies from the next packet on; in a trigger packet, it applies from this packet on.
            first_packet = i if columns.kind[i] == TRIGGER else i + 1
            history[channel].append((first_packet, tuple(map(tracker.get, _DERIVATION_FIELDS[channel]))))
    changes.extend(_compute_surface_angles(columns, history[60]))
    return sorted(changes, key=lambda change: change[0]), history


def _compute_surface_angles(columns: Columns, surfaces: SettingHistory) -> list[Change]:
    """Changes of the vehicle angles relative to a tilted surface (channel 60) [deg], heading 0..360.

        R_vehicle->surface = R_surface->NED^T R_vehicle->NED,   R = Rz(heading) Ry(pitch) Rx(roll)

    surfaces: index of the first packet and (heading, pitch, roll) of the surface in NED [deg], None: invalid.
    """
    changes: list[Change] = []
    previous: list[float | None] = [None, None, None]
    for (start, angles), (end, _) in pairwise([*surfaces, (len(columns), ())]):
        if None in angles:
            continue
        has_fix = (columns.kind[start:end] != EMPTY) & ~columns.is_approximate[start:end]
        attitude = np.array([columns.heading[start:end], columns.pitch[start:end], columns.roll[start:end]])
        usable = np.flatnonzero(has_fix & ~np.isnan(attitude).any(axis=0))
        surface = Rotation.from_euler("ZYX", np.array(angles, float), degrees=True)
        relative = surface.inv() * Rotation.from_euler("ZYX", attitude[:, usable].T)
        heading, pitch, roll = relative.as_euler("ZYX", degrees=True).T
        heading %= 360.0
        for i, *values in zip((usable + start).tolist(), heading.tolist(), pitch.tolist(), roll.tolist(), strict=True):
            changes.extend((i, int(columns.channel[i]), name, value)
                           for name, value, old in zip(_SURFACE_ANGLES, values, previous, strict=True) if value != old)
            previous = values
    return changes


def _derive_columns(columns: Columns, history: Mapping[int, SettingHistory]) -> dict[str, np.ndarray]:
    """Derived columns by name, in the order of the vendor's tools and in their units (m, deg, s)."""
    has_fix = (columns.kind != EMPTY) & ~columns.is_approximate
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
    _add_speed_and_slip(out, motion, level_rate[2], velocity_accuracy=history[4])
    _add_distances(out, columns, seconds)
    out["Af"], out["Al"], out["Ad"] = flu_from_frd(level_axes.to_enu(motion.acceleration))
    out["Wf"], out["Wl"], out["Wd"] = np.degrees(level_rate)
    # The angular acceleration [deg/s^2] of regular packets is the backward difference of the angular rate.
    is_regular, rate = (columns.kind == REGULAR) & ~np.isnan(seconds), np.degrees(columns.angular_rate)
    series = np.flatnonzero(is_regular & ~np.isnan(rate).any(axis=0))
    step, angular_acceleration = np.diff(seconds[series]), np.full(rate.shape, np.nan)
    forward = step > 0
    angular_acceleration[:, series[1:][forward]] = np.diff(rate[:, series], axis=1)[:, forward] / step[forward]
    out["Yx"], out["Yy"], out["Yz"] = angular_acceleration
    for prefix, signal, changes in (
            ("FiltA", columns.acceleration, history[74]), ("FiltY", angular_acceleration, history[63])):
        series = np.flatnonzero(is_regular & ~np.isnan(signal).any(axis=0))
        settings = [(int(np.searchsorted(series, index)), setting) for index, setting in changes]
        for axis, values in zip("xyz", signal, strict=True):
            out[prefix + axis] = filtered = np.full(len(seconds), np.nan)
            filtered[series] = filter_low_pass(seconds[series], values[series], settings)
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
    """Add speeds, track, slip (track minus heading) and curvature. yaw_rate: clockwise, in level axes [rad/s].

    Track, slip and curvature are NaN at speeds up to twice the velocity accuracy sqrt(VnAcc^2 + VeAcc^2) [m/s], or up
    to MIN_TRACK_SPEED while it is unknown.
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
    """Add the distance [m]: trapezoidal integral of the speed over regular packets, extended to each trigger packet."""
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
            rows = series[0] + np.flatnonzero(usable[series[0]:])
            before = np.searchsorted(series, rows, side="right") - 1
            last = series[before]
            elapsed = np.where(columns.kind[rows] == REGULAR, 0.0, seconds[rows] - seconds[last])
            distance[rows] = total[before] + 0.5 * (speed[rows] + speed[last]) * elapsed
        out[name] = distance


def filter_low_pass(seconds: np.ndarray, values: np.ndarray, settings: SettingHistory) -> np.ndarray:
    """Values filtered by the second-order low-pass with the settings that the unit sends in channels 63 and 74.

        b = (K^2, 2 K^2, K^2) / D,  a = (1, 2 (K^2 - 1) / D, (K^2 - 2 z K + 1) / D),
        K = tan(pi fc / fs),  D = K^2 + 2 z K + 1

    settings: (index of the first sample, (cutoff fc [Hz], damping ratio z)). Both 0: no filter. A setting with only one
    0, or with None, is ignored. NaN until a setting has fc < fs / 2 and three evenly spaced samples, which may precede
    it; the filter starts in steady state at the first of these.
    Source: NCOM manual 260702. Checked by: tests/golden/test_ncom_vectors.py (case filters).
    """
    output = np.full(len(values), np.nan)
    changes: list[tuple[int, tuple[float, float]]] = []
    for start, (cutoff, damping) in settings:
        if cutoff is None or damping is None or (cutoff > 0) != (damping > 0):
            continue
        if not changes or changes[-1][1] != (cutoff, damping):
            changes.append((start, (cutoff, damping)))
    for (start, (cutoff, damping)), (end, _) in pairwise([*changes, (len(values), (0.0, 0.0))]):
        if not cutoff:
            output[start:end] = values[start:end]
            continue
        steps = np.diff(seconds[max(start - 3, 0) : end])
        older, newer = steps[:-1], steps[1:]
        is_even = (older > 0) & (np.abs(older - newer) < _STEP_TOLERANCE * newer) & (cutoff * (older + newer) < 1)
        if not is_even.any():
            continue
        first = max(start - 3, 0) + int(is_even.argmax())
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

    A: specific force. g: normal gravity, constant below height 0. w_ie: earth rate. w_en: transport rate, of the local
    frame relative to the earth.
    """
    latitude, height = motion.latitude, motion.altitude
    east, north, _ = motion.velocity
    s, c = np.sin(latitude), np.cos(latitude)
    meridian, normal = compute_radii(latitude)
    rotation = np.array([-north / (meridian + height), 2 * EARTH_RATE * c + east / (normal + height),
                         2 * EARTH_RATE * s + east * s / c / (normal + height)])
    correction = -np.cross(rotation, motion.velocity, axis=0)
    surface_gravity = 9.780318 * (1 + 5.3024e-3 * s**2 - 5.9e-6 * np.sin(2 * latitude) ** 2)
    correction[2] -= surface_gravity / (1 + np.maximum(height, 0) / 6367435.68) ** 2
    x, y, z = motion.attitude.to_body(tuple(correction))
    force_x, force_y, force_z = motion.acceleration
    return force_x + x, force_y + y, force_z + z
