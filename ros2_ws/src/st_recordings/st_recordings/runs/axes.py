"""Finds the axes of recorded velocities, and rotates velocities to the east and north into body axes."""

import re
from collections.abc import Mapping

import numpy as np
from st_core.types import map_to_body, wrap_angle

MAP_FRAMES = {"map", "odom", "world", "enu", "ned", "gps", "gnss", "navsat"}
"""Words in the frame_id of a velocity over ground: names of map frames (REP-105) and of receivers."""
MIN_COURSE_SPEED = 1.0
"""Lowest speed [m/s] at which the direction of the velocity is used; 0.05 m/s of noise then change it by 3 degrees."""
MIN_COMPARED_SAMPLES = 20
"""Minimum number of samples for comparing positions with the integrated speed, or yaw with the course over ground."""
MAX_COMPARED_SAMPLES = 10_000
MIN_CORRELATION = 0.5
"""Minimum magnitude of a correlation of displacement and velocity, or of their mean cosine, that shows a sign."""
SIGNIFICANT_DEVIATIONS = 3.0
"""A sum of independent products differs from 0 (p = 0.003) if it exceeds this multiple of its standard deviation."""
MAX_AGREEING_ANGLE = 0.1
"""[rad]. Two directions agree if their median difference, due to sideslip and noise, is smaller than this. The better
of two interpretations is accepted if the difference of the other is larger by more than this."""
MIN_COURSE_SPREAD = 0.03
"""[rad]. Positions show the axes of the velocity only if one of the two interpretations has a larger standard deviation
from them; below it, both give the same lateral velocity to 3 % of the speed."""


def find_words(frame_id: str) -> set[str]:
    return {*re.split("[^a-z]+", frame_id.lower())}


def convert_odometry(values: dict[str, np.ndarray], frame_id: str) -> list[str]:
    """Converts INS channels of odometry messages to a map with x to the east and to body axes with y to the left;
    changes `values` and returns warnings.

    If a word of frame_id is ned, x is north, y east and yaw a compass heading. Whether z of the body axes also points
    down then follows from the yaw rate, or else from the sideways motion; if neither has a clear sign, it is assumed.
    """
    notes = []
    is_ned = "ned" in find_words(frame_id)
    if is_ned:
        values["x"], values["y"], values["yaw"] = values["y"], values["x"], np.pi / 2 - values["yaw"]
        notes.append(f"frame_id is {frame_id!r}: x, y and yaw were converted from north, east and compass heading")
    warning = rotate_to_body_axes(values)
    products = np.diff(values["yaw"]) * values["yaw_rate"][1:]
    total, deviation = float(np.sum(products)), float(np.sqrt(np.sum(products**2)))
    direction = total if abs(total) > SIGNIFICANT_DEVIATIONS * deviation else _correlate_sideways(values)
    has_signs = values["velocity_y"].any() or values["yaw_rate"].any()
    if is_ned and has_signs and (direction < 0 or not (direction or warning)):
        values["yaw_rate"] = -values["yaw_rate"]
        values["velocity_y"] = values["velocity_y"] if warning else -values["velocity_y"]
        notes.append("z of the body axes points down: the sign of yaw_rate and velocity_y was changed" if direction else
                     "the sign of yaw_rate and velocity_y was changed: the data do not show whether z of the body axes "
                     "points down, which was assumed")
    return [*notes, warning] if warning else notes


def _correlate_sideways(values: Mapping[str, np.ndarray]) -> float:
    """Correlation of velocity_y with the sideways displacement between samples; 0 below MIN_CORRELATION."""
    middle = values["yaw"][1:] - np.diff(values["yaw"]) / 2
    sideways = ((np.diff(values["x"]) + 1j * np.diff(values["y"])) * np.exp(-1j * middle)).imag
    velocity = values["velocity_y"][1:]
    scale = float(np.sqrt(np.sum(sideways**2) * np.sum(velocity**2)))
    correlation = float(np.sum(sideways * velocity)) / max(scale, 1e-12)
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
    rows = rows[:: max(len(rows) // MAX_COMPARED_SAMPLES, 1)]
    moving, yaw = velocity[rows], columns["yaw"][rows] + (np.pi if _moves_backward(columns) else 0.0)
    body_angle, *map_angles = (float(np.median(np.abs(wrap_angle(np.angle(direction) - yaw)))) for direction in (
        moving * np.exp(1j * columns["yaw"][rows]), moving, 1j * moving.conj()))
    frame_is_map = is_map = not MAP_FRAMES.isdisjoint(find_words(frame_id))
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
    position; a constant angle, as of a misaligned INS, does not count."""
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
