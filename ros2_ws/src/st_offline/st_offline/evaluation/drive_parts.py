"""Divides a drive into its labelled parts, or into detected turns, circles, straights and braking phases."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter1d
from st_core.log import DriveLog
from st_recordings.runs import Label

GRID_STEP = 0.1  # s
SMOOTHING_TIME = 1.0  # s, moving average; short enough to resolve both halves of a double lane change
STANDSTILL_SPEED = 0.5  # m/s
# A bend begins above the first limit of curvature or lateral acceleration, and ends below the second limits of both.
CURVATURE_LIMITS = (0.01, 0.005)  # 1/m
LATERAL_ACCELERATION_LIMITS = (0.8, 0.4)  # m/s^2
MIN_PART_DURATION = 1.5  # s; a shorter part is merged into its longer neighbour
MIN_LONGITUDINAL_ACCELERATION = 0.7  # m/s^2, magnitude of the mean in a straight classified as braking or accelerating
MIN_TURN, MIN_U_TURN, MIN_CIRCLE = np.radians([30.0, 150.0, 240.0])  # rad, heading change


@dataclass(frozen=True)
class DrivePart:
    """Part of a drive. start, end [s]: since the first INS measurement. heading_change [rad]: positive to the left."""

    name: str
    start: float
    end: float
    heading_change: float


def segment_drive(log: DriveLog, labels: Sequence[Label] = ()) -> list[DrivePart]:
    """Labelled parts of a drive; without labels, detected parts in time order. Empty for fewer than two INS samples."""
    if len(log.ins_time_ns) < 2:
        return []
    time = (log.ins_time_ns - log.ins_time_ns[0]) * 1e-9
    if labels:
        end_yaws = [np.interp((part.start, part.end), time, log.yaw).tolist() for part in labels]
        return [DrivePart(part.name, part.start, part.end, last - first)
                for part, (first, last) in zip(labels, end_yaws, strict=True)]
    grid = np.arange(0.0, time[-1] + 0.5 * GRID_STEP, GRID_STEP)
    speed, yaw_rate, yaw = (np.interp(grid, time, v) for v in (log.velocity_x, log.yaw_rate, log.yaw))
    width = 2 * round(0.5 * SMOOTHING_TIME / GRID_STEP) + 1
    states = _classify_samples(*(uniform_filter1d(values, min(width, len(grid)), mode="nearest")
                                 for values in (speed, yaw_rate)))
    parts = []
    for first, last in _merge_short_intervals(states, round(MIN_PART_DURATION / GRID_STEP)):
        start, end, heading_change = float(grid[first]), float(grid[last]), float(yaw[last] - yaw[first])
        acceleration = float(speed[last] - speed[first]) / max(end - start, GRID_STEP)
        parts.append(DrivePart(_name_part(states[first], heading_change, acceleration), start, end, heading_change))
    return parts


def assign_horizons(parts: Sequence[DrivePart], midpoints: np.ndarray) -> list[slice]:
    """Indices of the horizons whose midpoints are in each part. midpoints: ascending [s]."""
    return [slice(*np.searchsorted(midpoints, (part.start, part.end)).tolist()) for part in parts]


def _classify_samples(speed: np.ndarray, yaw_rate: np.ndarray) -> np.ndarray:
    """State of each sample, with hysteresis: -2 standing, -1 right bend, 0 straight, 1 left bend."""
    curvature, lateral = yaw_rate / np.maximum(speed, 1.0), speed * yaw_rate
    is_bend = (np.abs(curvature) > CURVATURE_LIMITS[0]) | (np.abs(lateral) > LATERAL_ACCELERATION_LIMITS[0])
    may_be_bend = (np.abs(curvature) > CURVATURE_LIMITS[1]) | (np.abs(lateral) > LATERAL_ACCELERATION_LIMITS[1])
    sides = np.sign(yaw_rate).astype(int)
    states = np.zeros(len(speed), int)
    side = 0
    for i, (v, begins, continues, sign) in enumerate(zip(speed, is_bend, may_be_bend, sides, strict=True)):
        side = sign if begins or (continues and sign == side) else 0
        states[i] = -2 if v < STANDSTILL_SPEED else side
    return states


def _merge_short_intervals(states: np.ndarray, shortest: int) -> list[tuple[int, int]]:
    """(first, last) index of each interval of equal states. An interval of fewer than `shortest` samples is merged into
    its longer neighbour; `states` is modified in place."""
    while True:
        edges = [0, *(np.flatnonzero(np.diff(states)) + 1).tolist(), len(states)]
        sizes = np.diff(edges)
        i = int(sizes.argmin())
        if len(sizes) == 1 or sizes[i] >= shortest:
            # The last point of an interval is the first of the next, so that heading changes add up.
            return [(a, min(b, len(states) - 1)) for a, b in itertools.pairwise(edges)]
        longer_neighbour = max((j for j in (i - 1, i + 1) if 0 <= j < len(sizes)), key=lambda j: sizes[j])
        states[edges[i]:edges[i + 1]] = states[edges[longer_neighbour]]


def _name_part(state: int, heading_change: float, acceleration: float) -> str:
    if state == -2:
        return "standing"
    size = abs(heading_change)
    if state == 0 and size < MIN_TURN:
        if abs(acceleration) <= MIN_LONGITUDINAL_ACCELERATION:
            return "straight"
        return "braking" if acceleration < 0.0 else "accelerating"
    turn = "circle" if size >= MIN_CIRCLE else "U-turn" if size >= MIN_U_TURN else "turn"
    shape = "bend" if size < MIN_TURN else "wide curve" if state == 0 else turn
    return f"{'left' if (state or heading_change) > 0 else 'right'} {shape}"
