"""Finds the units of recorded angles and the axes of velocities; rotates velocities over ground into body axes."""

import re
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from canedge_bridge.units import UNITS
from st_core.types import map_to_body, wrap_angle

from .csv_table import Table
from .errors import RunError

MAP_FRAMES = {"map", "odom", "world", "enu", "ned", "gps", "gnss", "navsat"}
"""Words in the frame_id of a velocity over ground: names of map frames and of receivers."""
MIN_COURSE_SPEED = 1.0
"""Lowest speed [m/s] at which the direction of the velocity is used; noise of 0.05 m/s then changes it by 3 degrees."""
MIN_COMPARED_SAMPLES = 20
"""Minimum number of samples for comparing positions with the integrated speed, or yaw with the course over ground."""
MAX_COMPARED_SAMPLES = 10_000
MIN_CORRELATION = 0.5
"""The sign of a correlation, or of the mean cosine between motion and heading, is used only above this magnitude."""
SIGNIFICANT_DEVIATIONS = 3.0
"""Minimum ratio of a sum to its standard deviation (p = 0.003), or of two standard deviations, to be significant."""
MAX_AGREEING_ANGLE = 0.1
"""[rad]. Two directions agree if their median difference, caused by sideslip and noise, is smaller than this. Of two
interpretations, the one with the smaller difference is accepted if that of the other is larger by more than this."""
MIN_DISAGREEING_ANGLE = 0.3
"""[rad]. If the difference between heading and course is larger, the heading has a different unit or direction."""
MAX_DEVIATION_RATIO = 0.5  # of two mean-square deviations from the motion; a smaller ratio shows which angle is right
MAX_RADIANS = 6.4  # rad; without motion, an angle is in degrees if its first value has a larger magnitude
HEADING, COURSE = "compass_heading", "course"
EARTH_RADIUS = 6.37e6  # m
MIN_COURSE_SPREAD = 0.03
"""[rad]. If the angle between velocity and change of position varies by less than this in both interpretations, their
lateral velocities differ by less than 3 % of the speed, and both are valid."""


def convert_odometry(values: dict[str, np.ndarray], frame_id: str) -> list[str]:
    """Converts INS channels of odometry messages to a map with x to the east and to body axes with y to the left;
    changes `values` and returns warnings.

    If a word of frame_id is ned, x is north, y east and yaw a compass heading. Whether z of the body axes also points
    down then follows from the sign of the yaw rate, or else of the lateral motion. If neither is significant, z is
    assumed to point down, unless the velocities are over ground: the sign of velocity_y is then known.
    """
    notes, is_ned = [], "ned" in re.split("[^a-z]+", frame_id.lower())
    if is_ned:
        values["x"], values["y"], values["yaw"] = values["y"], values["x"], np.pi / 2 - values["yaw"]
        notes.append(f"frame_id is {frame_id!r}: x, y and yaw were converted from north, east and compass heading")
    rotation_warning = rotate_to_body_axes(values)  # "" unless the velocities are over ground
    if is_ned and (values["velocity_y"].any() or values["yaw_rate"].any()):
        products = np.diff(values["yaw"]) * values["yaw_rate"][1:]
        total, deviation = float(np.sum(products)), float(np.sqrt(np.sum(products**2)))
        sign = total if abs(total) > SIGNIFICANT_DEVIATIONS * deviation else _correlate_lateral_motion(values)
        if sign < 0 or not (sign or rotation_warning):
            changed = ("yaw_rate",) if rotation_warning else ("yaw_rate", "velocity_y")
            values.update({name: -values[name] for name in changed})
            notes.append(f"z of the body axes points down: the sign of {' and '.join(changed)} was changed" if sign else
                         "the sign of yaw_rate and velocity_y was changed: the data do not show whether z of the body "
                         "axes points down, which was assumed")
    return [*notes, rotation_warning] if rotation_warning else notes


def _correlate_lateral_motion(values: Mapping[str, np.ndarray]) -> float:
    """Correlation of velocity_y with the lateral displacement between samples; 0 below MIN_CORRELATION."""
    middle = values["yaw"][1:] - np.diff(values["yaw"]) / 2
    lateral = ((np.diff(values["x"]) + 1j * np.diff(values["y"])) * np.exp(-1j * middle)).imag
    velocity = values["velocity_y"][1:]
    scale = float(np.sqrt(np.sum(lateral**2) * np.sum(velocity**2)))
    correlation = float(np.sum(lateral * velocity)) / max(scale, 1e-12)
    return correlation if abs(correlation) > MIN_CORRELATION else 0.0


def rotate_to_body_axes(columns: dict[str, np.ndarray], frame_id: str = "") -> str:
    """Rotates velocity_x and velocity_y into body axes if they are velocities over ground; changes `columns`.

    The direction of the velocity decides: it is about 0 in body axes, and about yaw over ground; both plus 180 degrees
    if the positions show that the car moves backward. If both fit, as on a road to the east, the positions decide if
    only one agrees with them, or else frame_id; without a map frame, body axes are assumed. Returns a warning if the
    velocities do not have the axes that frame_id names, else "".
    """
    velocity = columns["velocity_x"] + 1j * columns["velocity_y"]
    rows = np.flatnonzero((np.abs(velocity) > MIN_COURSE_SPEED) & np.isfinite(columns["yaw"]))
    if len(rows) < MIN_COMPARED_SAMPLES:
        return ""
    moving, yaw = velocity[rows], columns["yaw"][rows] + (np.pi if _moves_backward(columns) else 0.0)
    body_angle, *map_angles = (float(np.median(np.abs(wrap_angle(np.angle(direction) - yaw)))) for direction in (
        moving * np.exp(1j * columns["yaw"][rows]), moving, 1j * moving.conj()))
    frame_is_map = is_map = not MAP_FRAMES.isdisjoint(re.split("[^a-z]+", frame_id.lower()))
    if min(body_angle, *map_angles) < MAX_AGREEING_ANGLE < abs(body_angle - min(map_angles)):
        is_map = min(map_angles) < body_angle
    elif min(body_angle, *map_angles) < MAX_AGREEING_ANGLE and columns.keys() >= {"x", "y"}:
        spreads = _compare_with_positions(columns, velocity)
        if max(spreads) > max(SIGNIFICANT_DEVIATIONS * min(spreads), MIN_COURSE_SPREAD):
            is_map = spreads[1] < spreads[0]
    axes = "body axes"
    if is_map:
        is_north_first = map_angles[1] < map_angles[0] - MAX_AGREEING_ANGLE
        axes = "the north and east" if is_north_first else "the east and north"
        velocity = 1j * velocity.conj() if is_north_first else velocity
        columns["velocity_x"], columns["velocity_y"] = map_to_body(velocity.real, velocity.imag, columns["yaw"])
    frame = f" (frame_id is {frame_id!r})" if frame_id else ""
    return "" if is_map == frame_is_map else (
        f"velocity_x and velocity_y agree with the motion only as velocities {'to ' if is_map else 'in '}{axes}{frame}"
        f"{'; they were rotated into body axes' if is_map else ''}")


def _compare_with_positions(columns: Mapping[str, np.ndarray], velocity: np.ndarray) -> tuple[float, float]:
    """Standard deviations [rad] of the angle from the velocity, in body axes and over ground, to the steps of the
    position; a constant angle, such as from a misaligned INS, has no influence."""
    products = (np.diff(columns["x"]) + 1j * np.diff(columns["y"])) * velocity[1:].conj()
    products = np.stack((products * np.exp(-1j * columns["yaw"][1:]), products))
    products = products[:, np.isfinite(products).all(axis=0)]
    resultants = np.abs(products.sum(axis=1)) / max(float(np.abs(products[0]).sum()), 1e-12)
    in_body_axes, over_ground = (float(np.sqrt(max(2.0 - 2.0 * length, 0.0))) for length in resultants)
    return in_body_axes, over_ground


def _moves_backward(columns: Mapping[str, np.ndarray]) -> bool:
    """Whether the positions move mostly against the heading above MIN_COURSE_SPEED; False without positions."""
    if not columns.keys() >= {"x", "y"}:
        return False
    steps = np.diff(columns["x"]) + 1j * np.diff(columns["y"])
    fast = np.hypot(columns["velocity_x"], columns["velocity_y"])[1:] > MIN_COURSE_SPEED
    forward = (steps * np.exp(-1j * columns["yaw"][1:])).real
    return bool(np.nansum(forward[fast]) < -MIN_CORRELATION * np.nansum(np.abs(steps[fast])))


def read_angles(table: Table, use_positions: bool) -> Table:
    """The table with yaw, heading and course in the unit in which they agree with the motion: with the velocities to
    the east and north, which also distinguish yaw from heading, or else with the steps of the position (up to a
    constant angle, because the map may be rotated).

    If the motion does not show the unit, angles between -180 and 360 without a stated unit that wrap by 360 or begin
    above MAX_RADIANS are in degrees.
    """
    columns, sources, warnings = dict(table.columns), dict(table.sources), list(table.warnings)
    has_velocities = columns.keys() >= {"velocity_east", "velocity_north"}
    first, last, motion = _find_motion(table, use_positions)

    def compute_deviation(name: str, angle: np.ndarray) -> float:
        """RMS angle [rad] between yaw and the motion, forward or backward; NaN if unknown."""
        yaw = angle if name == "yaw" else np.pi / 2 - angle
        direction = np.exp(1j * yaw[first]) + np.exp(1j * yaw[last])
        products = (direction * motion.conj())[np.abs(motion) > MIN_COURSE_SPEED]
        doubled = np.exp(2j * np.angle(products[np.isfinite(products)]))  # forward and backward are the same
        if len(doubled) < MIN_COMPARED_SAMPLES:
            return np.nan
        cosine = doubled.mean().real if has_velocities else np.abs(doubled.mean())
        return float(np.sqrt(max(2.0 - 2.0 * cosine, 0.0))) / 2.0

    for channel in [name for name in ("yaw", HEADING) if name in sources][:1] + [COURSE] * (COURSE in sources):
        source = sources[channel]
        if source.unit not in ("rad", "deg") or (source.has_stated_unit and not has_velocities):
            continue
        names = ("yaw", HEADING) if has_velocities and channel != COURSE else (channel,)
        angles = {(name, unit): columns[channel] / source.factor * UNITS["angle"][unit][0]
                  for unit in ("rad", "deg") for name in names}
        deviations = {key: compute_deviation(key[0], angle) for key, angle in angles.items()}
        recorded, best, text = (channel, source.unit), min(deviations, key=lambda key: deviations[key]), ""
        values = angles[channel, "rad"][np.isfinite(columns[channel])]
        looks_like_degrees = len(values) > 0 and values.min() > -180.5 and values.max() < 360.5 and bool(
            np.abs(np.diff(values)).max(initial=0.0) > 180.0 or abs(values[0]) > MAX_RADIANS)
        # A yaw in rad, read as deg, is almost constant, which fits a straight road: deg must fit better than that.
        constant_rms, deg_rms = compute_deviation("yaw", np.zeros(len(columns[channel]))), deviations[channel, "deg"]
        in_radians = deg_rms > MIN_COURSE_SPREAD and deviations[recorded] ** 2 < MAX_DEVIATION_RATIO * deg_rms ** 2
        shows_unit = looks_like_degrees or deviations[best] ** 2 < MAX_DEVIATION_RATIO * constant_rms ** 2
        if shows_unit and deviations[recorded] > max(SIGNIFICANT_DEVIATIONS * deviations[best], MIN_DISAGREEING_ANGLE):
            motion_name = "velocities to the east and north" if has_velocities else "positions"
            text = f"agrees with the {motion_name} only as {best[0]} in {best[1]}; it was read as such"
        elif looks_like_degrees and not source.has_stated_unit and not in_radians and not (
                channel == "yaw" and "yaw_rate" in sources):
            best = channel, "deg"
            text = f"has values from {values.min():.4g} to {values.max():.4g}: they were read as degrees"
        if text:
            del columns[channel], sources[channel]
            columns[best[0]], sources[best[0]] = angles[best], replace(source, unit=best[1])
            warnings.append(f"{table.file}: column {source.name} {text}")
    return replace(table, columns=columns, sources=sources, warnings=tuple(warnings))


def _find_motion(table: Table, use_positions: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Steps as from `compute_steps`; if the velocities to the east and north are known, each step is a single row."""
    columns, rows = table.columns, np.flatnonzero(table.is_usable)
    if columns.keys() >= {"velocity_east", "velocity_north"}:
        rows = rows[:: max(len(rows) // MAX_COMPARED_SAMPLES, 1)]
        return rows, rows, (columns["velocity_east"] + 1j * columns["velocity_north"])[rows]
    for x, y in (("x", "y"), ("longitude", "latitude")) if use_positions else ():
        if columns.keys() >= {x, y}:
            return compute_steps(table, columns[x], columns[y], is_geographic=x != "x")
    return rows[:0], rows[:0], np.empty(0)


def compute_steps(table: Table, x: np.ndarray, y: np.ndarray, is_geographic: bool
                  ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(first rows, last rows, velocities x + iy [m/s]) of steps of one second; empty if few rows have a position.

    is_geographic: x and y are longitude and latitude [rad].
    """
    rows = np.flatnonzero(table.is_usable & np.isfinite(x) & np.isfinite(y))
    if len(rows) < MIN_COMPARED_SAMPLES:
        return rows[:0], rows[:0], np.empty(0)
    seconds = (table.time_ns - table.time_ns[0]) * 1e-9
    step = min(max(round(1.0 / float(np.median(np.diff(seconds[rows])))), 1), len(rows) - 1)
    first, last = (part[:: max(len(rows) // MAX_COMPARED_SAMPLES, 1)] for part in (rows[:-step], rows[step:]))
    dx, dy = x[last] - x[first], y[last] - y[first]
    if is_geographic:
        dx, dy = EARTH_RADIUS * np.cos(y[first]) * dx, EARTH_RADIUS * dy
    return first, last, (dx + 1j * dy) / (seconds[last] - seconds[first])


def read_geographic(table: Table, columns: Mapping[str, np.ndarray], latitude: np.ndarray, longitude: np.ndarray,
                    warnings: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Latitude and longitude [rad], corrected if the file states no unit and contains radians. Raises RunError if they
    are swapped: they agree with the integrated speed and the heading only the other way round.

    Distances are compared over steps of one second, so that they are large relative to the noise of the receiver.
    """
    unknown = np.full(len(latitude), np.nan)
    speed, yaw = np.abs(columns.get("velocity_x", unknown)), columns.get("yaw", unknown)

    def compare(latitude: np.ndarray, longitude: np.ndarray) -> tuple[float, float]:
        """Medians over steps: (ratio of position distance to driven distance, |course - yaw| [rad]); NaN if slow."""
        first, last, motion = compute_steps(table, longitude, latitude, is_geographic=True)
        driven = 0.5 * (speed[first] + speed[last])
        is_moving = driven > max(MIN_COURSE_SPEED, 0.5 * float(np.nanmedian(np.append(driven, 0.0))))
        if is_moving.sum() < MIN_COMPARED_SAMPLES:
            return np.nan, np.nan
        angles = np.append(np.abs(np.angle(motion * np.exp(-1j * yaw[first])))[is_moving], np.inf)
        return float(np.median(np.abs(motion[is_moving]) / driven[is_moving])), float(np.nanmedian(angles))

    names = [table.sources[name].name for name in ("latitude", "longitude")]
    ratio, angle = compare(latitude, longitude)
    if not table.sources["latitude"].has_stated_unit and 0.8 < ratio * 180.0 / np.pi < 3.0:
        warnings.append(f"{table.file}: {names[0]} and {names[1]} were read in radians: in degrees, they give 1/"
                        f"{1.0 / ratio:.0f} of the driven distance")
        return np.degrees(latitude), np.degrees(longitude)
    if abs(ratio - 1.0) > 0.05 and angle > MIN_DISAGREEING_ANGLE and np.nanmax(np.abs(longitude)) < np.pi / 2:
        ratio, angle = compare(longitude, latitude)
        if abs(ratio - 1.0) < 0.02 and angle < MAX_AGREEING_ANGLE:
            raise RunError(table.file, f"{names[0]} and {names[1]} are swapped: they agree with the driven distance "
                           "and the heading only the other way round", "swap them in a run.yaml, as "
                           f"columns: {{latitude: '{names[1]}', longitude: '{names[0]}'}}")
    return latitude, longitude
