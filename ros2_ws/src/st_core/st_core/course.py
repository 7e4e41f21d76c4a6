"""Known course: speed and curvature along the path, from recordings of earlier drives at the same place.

A course is a set of passes: paths of recordings, split at pauses and sampled every SPACING metres. Laps, opposite
directions and branches are not merged: a mean of slow and fast laps would fit neither. `Course.find_near` finds the
passes near a position and in a given direction, `CourseTracker` weights them. Checked by: test_course.py.
"""

import hashlib
import json
import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy  # imports integrate, ndimage and spatial at their first use: a predictor without a course starts faster

from .errors import ConfigurationError, StCoreError, add_prefix
from .log import DriveLog, LogSignals
from .planned_inputs import SLIP_FREE_ANGLE, path_inputs
from .timeseries import NANOSECOND
from .types import InputSequence, wrap_angle
from .vehicle import VehicleParameters
from .yaml_text import check_keys, load

SPACING = 1.0  # m between points along the path: 8 points in a right-angle turn of the smallest radius, 5 m
SMOOTHING_LENGTH = 3.0  # m, moving average of curvature and direction: about one wheelbase
MAX_DISTANCE = 4.0  # m, largest distance from the car to a pass: includes passes in the neighbouring lane
MAX_DIRECTION_DIFFERENCE = 0.5  # rad, between the course angles of car and pass; beyond it, the pass crosses or opposes
PAUSE_SPEED = 0.5  # m/s; slower driving is excluded, because the curvature is undefined at standstill
MAX_GAP = 0.1  # s, maximum time between samples of a pass
MIN_LENGTH = 20.0  # m, minimum length of a pass; above 4 m/s, a shorter pass ends within the horizon of 5 s
MAX_ORIGIN_DISTANCE = 5000.0  # m between map origins; beyond it the axes differ by 1 mrad at latitude 50 deg
SCHEMA = 1
POINTS_KEY = "\npoints: |\n"
COLUMNS = ("x", "y", "direction", "curvature", "speed")
RETURN_LENGTHS = (40.0, 100.0)  # l_1 and l_2 [m]: at 15 m/s a third of an offset remains after 10 s
DIFFERENCE_SCALES = {"position": 2.0, "direction": 0.1, "speed": 0.1, "curvature": 0.01}
"""Typical differences between drives of one driver on one course [m, rad, fraction of the speed, 1/m]."""
MAX_DIFFERENCE = 7.0  # the course is not used if d of `CourseTracker` exceeds this for every candidate
RECENT_TIME = 2.0  # s, length of the past driving that is compared with a candidate
BLEND_TIME = 0.3  # s, time constant of the transition from measured to predicted inputs: reaction lag of a driver
DECAY_TIME = 0.7  # s, time constant of the decaying acceleration: drivers move the pedals about once a second
FORGETTING_TIME = 10.0  # s, time constant of the mean squared errors E: two horizons
INITIAL_CURVATURE_ERRORS, INITIAL_SPEED_ERRORS = (1.0, 0.2), (1.0, 1.0, 0.5, 0.3)
"""Initial E [m^2], in the order of the forecasts of `CourseTracker`, from leave-one-out errors of real laps."""
SQUARED_ERROR_LIMITS = (0.01, 9.0)  # m^2; lower: accuracy of the INS, upper: limits the influence of a single error
MAX_JUMP = 2.0  # m; the tracker restarts if displacement and distance driven differ by more than this + 10 %
MIN_COVERAGE, MAX_COVERAGE = 1.2, 2.0  # horizons; minimum and largest used driving time of a pass ahead


@dataclass(frozen=True, eq=False)
class Pass:
    """Continuous path of a recording.

    points: (n, 5), every SPACING m, columns as COLUMNS: INS point in the map frame [m], course angle of the INS point
    from east, counter-clockwise positive [rad], curvature yaw_rate/v_x [1/m], positive to the left, v_x [m/s].
    """

    recording: str  # name
    digests: tuple[str, ...]  # sha256 of the files of the recording
    points: np.ndarray


class NearPoint(NamedTuple):
    """Point of a pass near the car."""

    pass_index: int  # index in `Course.passes`
    row: int  # index in the points of this pass
    distance: float  # from the car [m]


@dataclass(frozen=True, eq=False)
class Course:
    """Passes at one place. origin: (latitude, longitude) of the map frame [deg]; None if not recorded."""

    passes: tuple[Pass, ...]
    origin: tuple[float, float] | None = None

    @cached_property
    def _lookup(self) -> tuple["scipy.spatial.cKDTree", np.ndarray, np.ndarray, np.ndarray]:
        """Search tree of all points; the points (n, 5); index of the pass, and row within the pass, of each point."""
        points = np.concatenate([pass_.points for pass_ in self.passes])
        sizes = [len(pass_.points) for pass_ in self.passes]
        return (scipy.spatial.cKDTree(points[:, :2]), points, np.repeat(np.arange(len(sizes)), sizes),
                np.concatenate([np.arange(size) for size in sizes]))

    def find_near(self, x: float, y: float, direction: float) -> list[NearPoint]:
        """Nearest point of each lap that is within MAX_DISTANCE and in the direction of the car; the nearest lap first.

        x, y: INS point in the map frame [m]. direction: course angle from east, counter-clockwise positive [rad].
        """
        if not self.passes:
            return []
        tree, points, index, row = self._lookup
        near = np.array(sorted(tree.query_ball_point((x, y), MAX_DISTANCE)), int)
        near = near[np.abs(wrap_angle(points[near, 2] - direction)) < MAX_DIRECTION_DIFFERENCE]
        index, row = index[near], row[near]
        distance = np.hypot(points[near, 0] - x, points[near, 1] - y)
        # The points of one lap have consecutive rows; the row jumps at the next lap of the same pass.
        starts = np.flatnonzero((np.diff(index, prepend=-1) != 0) | (np.diff(row, prepend=-9) > 1))
        nearest = [lap[distance[lap].argmin()] for lap in np.split(np.arange(len(near)), starts)[1:]]
        return [NearPoint(int(index[k]), int(row[k]), float(distance[k]))
                for k in sorted(nearest, key=distance.__getitem__)]

    def exclude(self, digests: Sequence[str]) -> "Course":
        """The course without the passes of recordings with these digests, so that no run is predicted from itself."""
        return Course(tuple(p for p in self.passes if not set(p.digests) & set(digests)), self.origin)

    def shift(self, east: float, north: float) -> "Course":
        """The course in a parallel map frame, in which the origin of the course is at (east, north) [m]; `origin` is
        unchanged. Raises StCoreError for a distance beyond MAX_ORIGIN_DISTANCE."""
        if not (distance := math.hypot(east, north)) <= MAX_ORIGIN_DISTANCE:  # also rejects NaN
            raise StCoreError(f"the course was recorded elsewhere: the map origins are {distance / 1000.0:.1f} km "
                              f"apart (limit {MAX_ORIGIN_DISTANCE / 1000.0:g} km)")
        offset = np.array([east, north, 0.0, 0.0, 0.0])
        return replace(self, passes=tuple(replace(pass_, points=pass_.points + offset) for pass_ in self.passes))

    def to_yaml(self) -> str:
        """The text of a course file: a header, then the points of all passes, with positions rounded to 1 cm."""
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
        """The course from the text of a file. origin: file name in errors. Raises ConfigurationError."""
        return add_prefix(f"{origin}: ", lambda: cls._read(text),
                          "not a complete course file; write one with st course build")

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
        passes = tuple(Pass(str(entry["recording"]), tuple(entry["digests"]), part)
                       for entry, part in zip(entries, np.split(points, ends[:-1]), strict=True))
        origin = document["origin"]
        return cls(passes, None if origin is None else (float(origin[0]), float(origin[1])))


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def split_into_passes(log: DriveLog, digests: Sequence[str]) -> list[Pass]:
    """Passes of a drive, at least MIN_LENGTH long, split at pauses, gaps and jumps. Raises StCoreError without any."""
    time = (log.ins_time_ns - log.ins_time_ns[:1]) * 1e-9
    intervals = np.diff(time)
    displacement = np.hypot(np.diff(log.x), np.diff(log.y))
    expected = 0.5 * (log.velocity_x[1:] + log.velocity_x[:-1]) * intervals
    is_slow = np.minimum(log.velocity_x[1:], log.velocity_x[:-1]) < PAUSE_SPEED
    breaks = is_slow | (intervals > MAX_GAP) | (np.abs(displacement - expected) > 0.5 + 0.5 * expected)
    edges = np.flatnonzero(np.diff(np.concatenate([[True], breaks, [True]]).astype(int)))
    passes = []
    for rows in (slice(first, last + 1) for first, last in edges.reshape(-1, 2).tolist()):
        x, y, speed = log.x[rows], log.y[rows], log.velocity_x[rows]
        distance = scipy.integrate.cumulative_trapezoid(speed, time[rows], initial=0.0)
        if distance[-1] < MIN_LENGTH:
            continue
        grid = np.arange(0.0, distance[-1], SPACING)
        east, north, curvature, speed = (np.interp(grid, distance, v)
                                         for v in (x, y, log.yaw_rate[rows] / speed, speed))
        curvature, d_x, d_y = (scipy.ndimage.uniform_filter1d(v, round(SMOOTHING_LENGTH / SPACING), mode="nearest")
                               for v in (curvature, np.gradient(east), np.gradient(north)))
        direction = np.unwrap(np.arctan2(d_y, d_x))
        passes.append(Pass(log.name, tuple(digests), np.stack([east, north, direction, curvature, speed], axis=1)))
    if not passes:
        raise StCoreError(f"{log.name}: no {MIN_LENGTH:g} m of continuous driving faster than {PAUSE_SPEED:g} m/s; "
                          "leave this recording out of the course")
    return passes


class EgoMotion(NamedTuple):
    """Measured motion of the INS point at the start of a prediction."""

    time_ns: int  # ns
    x: float  # m, map frame
    y: float  # m, map frame
    yaw: float  # rad, map frame
    velocity_x: float  # m/s, body axes
    velocity_y: float  # m/s, body axes
    yaw_rate: float  # rad/s
    velocity_x_dot: float  # m/s^2
    road_wheel_angle: float  # rad

    @property
    def direction(self) -> float:
        """Course angle of the INS point from east, counter-clockwise positive [rad]."""
        return self.yaw + math.atan2(self.velocity_y, self.velocity_x)

    @property
    def curvature(self) -> float:
        """Curvature of the path [1/m], positive to the left."""
        return self.yaw_rate / max(self.velocity_x, PAUSE_SPEED)


@dataclass(frozen=True, eq=False)
class CourseForecast:
    """Inputs over the horizon, predicted from a course."""

    inputs: InputSequence | None  # on the half-step grid of the horizon; None if the course is not used
    curvature_weight: float = 0.0  # weight of the course in the curvature, 0 to 1
    speed_weight: float = 0.0  # weight of the course in the speed, 0 to 1
    reason: str = ""  # why the course is not used, or ""


_Candidate = tuple[float, np.ndarray]  # d^2; (speed [m/s], curvature [1/m]) every SPACING m ahead, (2, n)


_PendingForecast = tuple[float, EgoMotion, np.ndarray, np.ndarray]
"""Distance driven before the start [m], motion at the start, length of the horizon according to each speed forecast
[m], and path according to the course, (points, 2) [m], SPACING apart."""


class CourseTracker:
    """Predicts inputs over the horizon from a recorded course, combined with held inputs according to recent errors.

    At every start the passes near the car are candidates. A candidate predicts, as functions of the distance s ahead,

        v(s) = v_pass(s) v_now / v_pass(0),     k(s) = k_pass(s) + e''(s),    e(s) = A exp(-s / l_1) + B exp(-s / l_2)

    e: lateral offset from the pass, which a driver reduces to 0; A and B follow from the current offset and direction.
    A candidate has the weight exp(-d^2 / 2). d^2 is the sum of the squared differences between the car and the pass in
    position, direction, recent speed and recent curvature, each divided by its scale. The weighted mean of the
    candidates, "course" below, is combined with other forecasts:

        curvature: held, course        speed: acceleration held, zero, decaying with DECAY_TIME, course
        weight of each ~ E^-2,    E: mean squared error of past forecasts, with exponential forgetting (FORGETTING_TIME)

    The error of a curvature forecast is that of the position after the distance actually driven, the error of a speed
    forecast that of the distance. Source: Bates and Granger, The combination of forecasts, 1969. Checked by:
    test_course.py. Measured errors: docs/manual/forecast.md.

    `update` is called at every start, in order of time. The tracker restarts if time runs backward or pauses for a
    horizon or longer, and if the position jumps. horizon, step [s].
    """

    def __init__(self, course: Course, vehicle: VehicleParameters, horizon: float = 5.0, step: float = 0.05):
        self.course, self._vehicle = course, vehicle
        self._time = 0.5 * step * np.arange(round(2.0 * horizon / step) + 1)
        self._horizon_ns = round(horizon / NANOSECOND)
        self.restart()

    def restart(self) -> None:
        """Discard past driving, pending forecasts and errors."""
        self._distance = 0.0
        self._past: deque[tuple[float, EgoMotion]] = deque()
        self._pending: deque[_PendingForecast] = deque()
        self._curvature_errors, self._speed_errors = np.array(INITIAL_CURVATURE_ERRORS), np.array(INITIAL_SPEED_ERRORS)

    def update(self, ego: EgoMotion) -> CourseForecast:
        """The forecast from this start; with a reason and without inputs if the course cannot be used."""
        if not all(map(math.isfinite, ego)) or ego.velocity_x < PAUSE_SPEED:
            return CourseForecast(None, reason="course: the motion of the car is unknown, or the car is too slow")
        self._score(ego, self._advance(ego))
        near_points = self.course.find_near(ego.x, ego.y, ego.direction)
        candidates = [prediction for point in near_points if (prediction := self._predict_from_pass(point, ego))]
        if not candidates:
            return CourseForecast(None, reason=(
                f"course: the earlier drives end within {MIN_COVERAGE:g} horizons" if near_points else
                "course: no earlier drive near the car in its direction"))
        squares = np.array([square for square, _ in candidates])
        if squares.min() > MAX_DIFFERENCE**2:
            return CourseForecast(None, reason="course: no earlier drive has a similar path and speed")
        weights = np.exp(-0.5 * squares)
        return self._combine(candidates, weights / weights.sum(), ego)

    def _advance(self, ego: EgoMotion) -> float:
        """Add a start; return the time since the previous one [s], 0 after a restart."""
        last = self._past[-1][1] if self._past else ego
        elapsed_time = (ego.time_ns - last.time_ns) * NANOSECOND
        distance = 0.5 * (ego.velocity_x + last.velocity_x) * elapsed_time
        has_jumped = abs(math.hypot(ego.x - last.x, ego.y - last.y) - distance) > MAX_JUMP + 0.1 * distance
        if has_jumped or not 0.0 < elapsed_time < self._horizon_ns * NANOSECOND:
            self.restart()
            distance = elapsed_time = 0.0
        self._distance += distance
        self._past.append((self._distance, ego))
        while (ego.time_ns - self._past[0][1].time_ns) * NANOSECOND > RECENT_TIME:
            self._past.popleft()
        return elapsed_time

    def _score(self, ego: EgoMotion, elapsed: float) -> None:
        """Update the mean squared errors with the errors of the forecasts that have ended."""
        new_weight = min(elapsed / FORGETTING_TIME, 1.0)
        while self._pending and self._pending[0][1].time_ns + self._horizon_ns <= ego.time_ns:
            distance, start, distances, path = self._pending.popleft()
            progress = self._distance - distance
            row = min(max(progress / SPACING, 0.0), len(path) - 1.001)
            before, after = path[int(row)], path[int(row) + 1]
            # The forecast with the held curvature is an arc.
            turn = start.curvature * progress
            chord_angle, length = start.direction + 0.5 * turn, progress * float(np.sinc(0.5 * turn / math.pi))
            arc_end = start.x + length * math.cos(chord_angle), start.y + length * math.sin(chord_angle)
            positions = np.array([arc_end, before + (row - int(row)) * (after - before)])
            squares = np.square(positions - (ego.x, ego.y)).sum(axis=1), np.square(distances - progress)
            self._curvature_errors, self._speed_errors = (
                (1.0 - new_weight) * errors + new_weight * np.clip(new, *SQUARED_ERROR_LIMITS)
                for errors, new in zip((self._curvature_errors, self._speed_errors), squares, strict=True))

    def _predict_from_pass(self, point: NearPoint, ego: EgoMotion) -> _Candidate | None:
        """The prediction from a pass; None if the pass ends less than MIN_COVERAGE horizons ahead of the car."""
        points = self.course.passes[point.pass_index].points
        x, y, direction, curvature, speed = points[point.row:].T
        speed = speed * (ego.velocity_x / speed[0])
        arrival = np.cumsum(SPACING / speed)
        if arrival[-1] < MIN_COVERAGE * self._time[-1]:
            return None
        count = int(np.searchsorted(arrival, MAX_COVERAGE * self._time[-1])) + 2
        curvature, speed = curvature[:count], speed[:count]
        distance_behind = np.array([self._distance - distance for distance, _ in self._past])
        rows = np.round(point.row - distance_behind / SPACING).astype(int)
        recent = np.array([[motion.velocity_x, motion.curvature] for _, motion in self._past])[rows >= 0]
        pass_points = points[rows[rows >= 0]]
        direction_error = float(wrap_angle(ego.direction - direction[0]))
        differences = {"position": point.distance, "direction": direction_error,
                       "speed": float(np.sqrt(np.square(np.log(recent[:, 0] / pass_points[:, 4])).mean())),
                       "curvature": float(np.sqrt(np.square(recent[:, 1] - pass_points[:, 3]).mean()))}
        square = sum((differences[name] / scale) ** 2 for name, scale in DIFFERENCE_SCALES.items())
        # e(0) [m] and e'(0) [rad] determine A and B of e(s).
        lateral_offset = math.cos(direction[0]) * (ego.y - y[0]) - math.sin(direction[0]) * (ego.x - x[0])
        (l_1, l_2), s = RETURN_LENGTHS, SPACING * np.arange(len(curvature))
        b = (direction_error + lateral_offset / l_1) / (1.0 / l_1 - 1.0 / l_2)
        curvature = curvature + (lateral_offset - b) / l_1**2 * np.exp(-s / l_1) + b / l_2**2 * np.exp(-s / l_2)
        return square, np.stack([speed, curvature])

    def _combine(self, candidates: list[_Candidate], weights: np.ndarray, ego: EgoMotion) -> CourseForecast:
        length = min(profile.shape[1] for _, profile in candidates)
        course_speed, curvature = np.tensordot(weights, [profile[:, :length] for _, profile in candidates], axes=1)
        integrate = scipy.integrate.cumulative_trapezoid
        arrival = np.concatenate([[0.0], np.cumsum(2.0 * SPACING / (course_speed[1:] + course_speed[:-1]))])
        t, acceleration = self._time, ego.velocity_x_dot
        speed_forecasts = np.stack([ego.velocity_x + acceleration * t, np.full_like(t, ego.velocity_x),
                                    ego.velocity_x + acceleration * DECAY_TIME * (1.0 - np.exp(-t / DECAY_TIME)),
                                    np.interp(t, arrival, course_speed)]).clip(0.0)
        distances = 0.5 * (speed_forecasts[:, 1:] + speed_forecasts[:, :-1]) @ np.diff(t)
        direction = ego.direction + integrate(curvature, dx=SPACING, initial=0.0)
        tangents = np.stack([np.cos(direction), np.sin(direction)], axis=1)
        positions = np.array([[ego.x, ego.y]]) + integrate(tangents, dx=SPACING, axis=0, initial=0.0)
        curvature_weights, speed_weights = (errors**-2.0 / (errors**-2.0).sum()
                                          for errors in (self._curvature_errors, self._speed_errors))
        self._pending.append((self._distance, ego, distances, positions))
        speed = speed_weights @ speed_forecasts
        distance = integrate(speed, dx=float(t[1]), initial=0.0)
        combined_curvature = (curvature_weights[0] * ego.curvature
                              + curvature_weights[1] * np.interp(distance, SPACING * np.arange(length), curvature))
        blend_weight, angle = 1.0 - np.exp(-t / BLEND_TIME), ego.road_wheel_angle
        path = path_inputs(speed, combined_curvature, t, self._vehicle)
        inputs = InputSequence(angle + blend_weight * (path.road_wheel_angle - angle),
                               acceleration + blend_weight * (path.velocity_x_dot - acceleration),
                               {name: angle + blend_weight * (values - angle) for name, values in path.signals.items()})
        return CourseForecast(inputs, float(curvature_weights[1]), float(speed_weights[3]))


def predict_course_inputs(course: Course, signals: LogSignals, vehicle: VehicleParameters, horizon: float, step: float,
                          starts_ns: np.ndarray) -> tuple[np.ndarray, ...]:
    """Inputs over the horizon of each start, predicted from a course; see `log_evaluation.FutureInputs`."""
    tracker = CourseTracker(course, vehicle, horizon, step)
    columns = [*signals.ins_at(starts_ns, *EgoMotion._fields[1:-1]), signals.road_wheel_angle_at(starts_ns)]
    inputs = np.full((3, len(starts_ns), round(2.0 * horizon / step) + 1), np.nan)
    for k, (time_ns, *values) in enumerate(zip(starts_ns.tolist(), *(c.tolist() for c in columns), strict=True)):
        if (future := tracker.update(EgoMotion(time_ns, *values)).inputs) is not None:
            inputs[:, k] = future.road_wheel_angle, future.velocity_x_dot, future.signals[SLIP_FREE_ANGLE]
    return tuple(inputs)
