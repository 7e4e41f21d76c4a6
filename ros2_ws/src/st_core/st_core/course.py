"""Known course: speed and curvature along the path, from recordings of earlier drives at the same place.

A course is a set of passes: paths of recordings, split at pauses and sampled every SPACING metres. Laps, opposite
directions and branches are not merged: a mean of slow and fast laps would fit neither. `Course.find_near` finds the
passes near a position in a direction, and `course_tracker` weights them. Checked by: test_course.py.
"""

import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.spatial import cKDTree

from .errors import ConfigurationError, StCoreError
from .log import DriveLog
from .types import wrap_angle
from .yaml_text import check_keys, load

SPACING = 1.0  # m between points along the path: 8 points in a right-angle turn of the smallest radius, 5 m
SMOOTHING_LENGTH = 3.0  # m, moving average of curvature and direction: about one wheelbase
MAX_DISTANCE = 4.0  # m, largest distance of a pass from the car: one lane and its neighbour
MAX_HEADING_DIFFERENCE = 0.5  # rad, course angle of car minus pass; above it: the opposite direction or a crossing
PAUSE_SPEED = 0.5  # m/s; a course neither contains nor predicts slower driving: curvature is undefined at standstill
MAX_GAP = 0.1  # s, maximum time between samples of a pass
MIN_LENGTH = 20.0  # m, minimum length of a pass; above 4 m/s, a shorter pass ends within the horizon of 5 s
MAX_ORIGIN_DISTANCE = 5000.0  # m between map origins; beyond it the axes differ by 1 mrad at latitude 50 deg
SCHEMA = 1
POINTS_KEY = "\npoints: |\n"
COLUMNS = ("x", "y", "direction", "curvature", "speed")


@dataclass(frozen=True, eq=False)
class Pass:
    """Continuous path of a recording.

    points: (n, 5), every SPACING m, columns as COLUMNS: INS point in the map frame [m], course angle of the INS point
    from east, counter-clockwise + [rad], curvature yaw_rate/v_x [1/m], left +, v_x [m/s].
    """

    recording: str  # name of the recording
    digests: tuple[str, ...]  # sha256 of its files
    points: np.ndarray


class NearPoint(NamedTuple):
    """Point of a pass near the car. pass_index: in `Course.passes`; row: in its points. distance: from the car [m]."""

    pass_index: int
    row: int
    distance: float


@dataclass(frozen=True, eq=False)
class Course:
    """Passes at one place. origin: (latitude, longitude) of the map frame [deg]; None if not recorded."""

    passes: tuple[Pass, ...]
    origin: tuple[float, float] | None = None

    @cached_property
    def _indices(self) -> tuple[np.ndarray, np.ndarray]:
        """Index of the pass, and row within the pass, of every point, (points,) each."""
        sizes = [len(pass_.points) for pass_ in self.passes]
        return np.repeat(np.arange(len(sizes)), sizes), np.concatenate([np.arange(n) for n in sizes])

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(np.concatenate([pass_.points[:, :2] for pass_ in self.passes]))

    def find_near(self, x: float, y: float, direction: float) -> list[NearPoint]:
        """Points within MAX_DISTANCE of passes in the direction of the car, one for each lap, the nearest first.

        x, y: INS point in the map frame [m]. direction: course angle from east, counter-clockwise + [rad].
        """
        if not self.passes:
            return []
        near = np.array(sorted(self._tree.query_ball_point((x, y), MAX_DISTANCE)), int)
        if not len(near):
            return []
        index, row = (indices[near] for indices in self._indices)
        points = np.stack([self.passes[n].points[k] for n, k in zip(index.tolist(), row.tolist(), strict=True)])
        aligned = np.abs(wrap_angle(points[:, 2] - direction)) < MAX_HEADING_DIFFERENCE
        index, row, points = index[aligned], row[aligned], points[aligned]
        distance = np.hypot(points[:, 0] - x, points[:, 1] - y)
        # Points of one lap are consecutive; another lap of the same pass begins with a jump of the row.
        begins = np.flatnonzero((np.diff(index, prepend=-1) != 0) | (np.diff(row, prepend=-9) > 1))
        nearest = [NearPoint(int(index[k]), int(row[k]), float(distance[k]))
                   for lap in np.split(np.arange(len(index)), begins)[1:] for k in [lap[distance[lap].argmin()]]]
        return sorted(nearest, key=lambda point: point.distance)

    def exclude(self, digests: Sequence[str]) -> "Course":
        """The course without the passes of recordings with these sha256, so that no run is predicted from itself."""
        return Course(tuple(p for p in self.passes if not set(p.digests) & set(digests)), self.origin)

    def shift(self, east: float, north: float) -> "Course":
        """The course in a parallel map frame, in which `origin`, which is not changed, is at (east, north) [m].

        Raises StCoreError, one line, for a distance beyond MAX_ORIGIN_DISTANCE.
        """
        if not (distance := math.hypot(east, north)) <= MAX_ORIGIN_DISTANCE:  # also refuses NaN
            raise StCoreError(f"the course was recorded elsewhere: the map origins are {distance / 1000.0:.1f} km "
                              f"apart (limit {MAX_ORIGIN_DISTANCE / 1000.0:g} km)")
        offset = np.array([east, north, 0.0, 0.0, 0.0])
        return replace(self, passes=tuple(replace(pass_, points=pass_.points + offset) for pass_ in self.passes))

    def to_yaml(self) -> str:
        """The text of a file that `from_yaml` reads: a header, then the points of all passes, to the centimetre."""
        passes = [{"recording": pass_.recording, "digests": list(pass_.digests), "rows": len(pass_.points)}
                  for pass_ in self.passes]
        header = {"schema": SCHEMA, "spacing": SPACING, "columns": list(COLUMNS),
                  "origin": None if self.origin is None else list(self.origin)}
        rows = [f"  {x:.2f} {y:.2f} {direction:.4f} {curvature:.6f} {speed:.3f}"
                for pass_ in self.passes for x, y, direction, curvature, speed in pass_.points.tolist()]
        lines = ["# Course: speed and curvature along the path of earlier drives, SI units; by `st course build`.",
                 *(f"{key}: {json.dumps(value)}" for key, value in header.items()), "passes:",
                 *(f"- {json.dumps(entry)}" for entry in passes)]
        body = "\n".join([*lines, POINTS_KEY.strip("\n"), *rows])
        return body.replace("passes:\n", f"hash: {_digest(body)}\npasses:\n", 1) + "\n"

    @classmethod
    def from_yaml(cls, text: str, origin: str = "course") -> "Course":
        """The course from the text of a file. origin: file name in errors. Raises ConfigurationError, one line."""
        try:
            return cls._read(text)
        except ConfigurationError as error:
            raise ConfigurationError(f"{origin}: {error}") from None
        except (KeyError, TypeError, ValueError):
            raise ConfigurationError(f"{origin}: not a complete course file; write one with st course build") from None

    @classmethod
    def _read(cls, text: str) -> "Course":
        head, _, rows = text.partition(POINTS_KEY)
        document = load(head)
        keys = ["schema", "spacing", "columns", "origin", "hash", "passes"]
        if not isinstance(document, dict):
            raise ConfigurationError("not a course file; write one with st course build")
        check_keys("", document, keys, required=keys)
        for key, expected in (("schema", SCHEMA), ("spacing", SPACING), ("columns", list(COLUMNS))):
            if document[key] != expected:
                raise ConfigurationError(f"{key}: {document[key]} is not {expected}; run st course build again")
        if _digest(text.replace(f"hash: {document['hash']}\n", "", 1).rstrip("\n")) != document["hash"]:
            raise ConfigurationError("hash: the content was edited or cut off; run st course build again")
        entries = document["passes"] or []
        if not entries:
            raise ConfigurationError("passes: empty; build the course from at least one recording")
        points = np.array(rows.split(), float).reshape(-1, len(COLUMNS))
        ends = np.cumsum([int(entry["rows"]) for entry in entries])
        if ends[-1] != len(points):
            raise ConfigurationError(f"points: {len(points)} rows, but the passes declare {ends[-1]}; run st course "
                                     "build again")
        if not np.isfinite(points).all():
            raise ConfigurationError("points: a value is not finite; run st course build again")
        passes = tuple(Pass(str(entry["recording"]), tuple(entry["digests"]), part)
                       for entry, part in zip(entries, np.split(points, ends[:-1]), strict=True))
        origin = document["origin"]
        return cls(passes, None if origin is None else (float(origin[0]), float(origin[1])))


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def split_into_passes(log: DriveLog, digests: Sequence[str]) -> list[Pass]:
    """Parts of a drive of at least MIN_LENGTH, between pauses, gaps and position jumps. Raises StCoreError if none."""
    time = (log.ins_time_ns - log.ins_time_ns[:1]) * 1e-9
    intervals = np.diff(time)
    displacement = np.hypot(np.diff(log.x), np.diff(log.y))
    travelled = 0.5 * (log.velocity_x[1:] + log.velocity_x[:-1]) * intervals
    slow = np.minimum(log.velocity_x[1:], log.velocity_x[:-1]) < PAUSE_SPEED
    breaks = slow | (intervals > MAX_GAP) | (np.abs(displacement - travelled) > 0.5 + 0.5 * travelled)
    edges = np.flatnonzero(np.diff(np.concatenate([[True], breaks, [True]]).astype(int)))
    passes = []
    for rows in (slice(first, last + 1) for first, last in edges.reshape(-1, 2).tolist()):
        x, y, speed = log.x[rows], log.y[rows], log.velocity_x[rows]
        seconds = (log.ins_time_ns[rows] - log.ins_time_ns[rows][:1]) * 1e-9
        distance = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * np.diff(seconds))])
        if distance[-1] < MIN_LENGTH:
            continue
        grid = np.arange(0.0, distance[-1], SPACING)
        east, north, curvature, speed = (np.interp(grid, distance, v)
                                         for v in (x, y, log.yaw_rate[rows] / speed, speed))
        curvature, d_x, d_y = (uniform_filter1d(v, round(SMOOTHING_LENGTH / SPACING), mode="nearest")
                               for v in (curvature, np.gradient(east), np.gradient(north)))
        direction = np.unwrap(np.arctan2(d_y, d_x))
        passes.append(Pass(log.name, tuple(digests), np.stack([east, north, direction, curvature, speed], axis=1)))
    if not passes:
        raise StCoreError(f"{log.name}: no {MIN_LENGTH:g} m of continuous driving faster than {PAUSE_SPEED:g} m/s; "
                          "leave this recording out of the course")
    return passes
