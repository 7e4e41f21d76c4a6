"""A periodic road, defined by its curvature as a function of distance, and its speed profile."""

import bisect
import math
from collections.abc import Sequence
from itertools import accumulate
from typing import NamedTuple

import numpy as np

POSE_SPACING = 0.1  # m, between stored poses; linear interpolation between them has an error of 0.1 mm at R = 11.5 m
SPEED_SPACING = 0.25  # m, between stored speeds


class Pose(NamedTuple):
    """Position [m] and direction of the road [rad, counter-clockwise from east] in map axes."""

    x: float
    y: float
    yaw: float

    def compose(self, other: "Pose") -> "Pose":
        """Pose `other`, given relative to this pose, in map axes."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        return Pose(self.x + c * other.x - s * other.y, self.y + s * other.x + c * other.y, self.yaw + other.yaw)

    def inverse(self) -> "Pose":
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        return Pose(-c * self.x - s * self.y, s * self.x - c * self.y, -self.yaw)


class Piece(NamedTuple):
    """Part of a road: constant target speed [m/s]; curvature [1/m], positive to the left, linear in distance [m]."""

    length: float
    curvature_start: float
    curvature_end: float
    speed: float


def straight(length: float, speed: float) -> list[Piece]:
    return [Piece(length, 0.0, 0.0, speed)]


def turn(radius: float, angle_deg: float, speed: float, blend: float = 0.0) -> list[Piece]:
    """Turn by an angle [deg, > 0: left] with a clothoid transition of length `blend` [m] before and after the arc.
    Raises ValueError if the transitions alone turn by more than the angle."""
    arc = math.radians(abs(angle_deg)) * radius - blend
    if arc < 0:
        raise ValueError(f"a {angle_deg:g} deg turn at radius {radius:g} m is too short for transitions of {blend:g} m")
    curvature = math.copysign(1.0 / radius, angle_deg)
    return [Piece(blend, 0.0, curvature, speed), Piece(arc, curvature, curvature, speed),
            Piece(blend, curvature, 0.0, speed)]


def lane_shift(offset: float, length: float, speed: float) -> list[Piece]:
    """Lateral shift by an offset [m, positive to the left] within a length [m], which ends in the initial heading. The
    curvature is piecewise linear with extremes k and -k, and offset = 2 k (length / 4)^2 for small angles."""
    quarter = length / 4
    k = offset / (2 * quarter**2)
    return [Piece(quarter, 0.0, k, speed), Piece(2 * quarter, k, -k, speed), Piece(quarter, -k, 0.0, speed)]


class Path:
    """A road that repeats its pieces: each lap continues at the end of the previous one. Distances [m] may be < 0."""

    def __init__(self, pieces: Sequence[Piece]):
        """Raises ValueError if the total length is 0."""
        self.pieces = tuple(p for p in pieces if p.length > 0)
        if not self.pieces:
            raise ValueError("the road has no length")
        self._ends = [0.0, *accumulate(piece.length for piece in self.pieces)]
        self.length = self._ends[-1]
        count = max(2, math.ceil(self.length / POSE_SPACING))
        self._step = self.length / count
        distances = np.linspace(0.0, self.length, 2 * count + 1)
        lengths, first, last, _ = np.array(self.pieces).T
        index = np.clip(np.searchsorted(self._ends, distances, side="right") - 1, 0, len(self.pieces) - 1)
        along = distances - np.take(self._ends, index)
        curvature = first[index] + (last - first)[index] * along / (2 * lengths[index])  # mean since the piece's start
        yaws = np.cumsum([0.0, *(first + last) * lengths / 2])[index] + curvature * along
        # Positions by Simpson's rule.
        x, y = (np.cumsum([0.0, *(rate[:-2:2] + 4 * rate[1:-1:2] + rate[2::2])]) * self._step / 6
                for rate in (np.cos(yaws), np.sin(yaws)))
        self._poses = [Pose(*row) for row in np.stack([x, y, yaws[::2]], axis=1).tolist()]
        self._anchor = Pose(0.0, 0.0, 0.0)
        self._lap_starts: dict[float, Pose] = {}

    def anchor(self, distance: float, pose: Pose) -> None:
        """Move the whole road so that it passes through `pose` at `distance`."""
        self._anchor = pose.compose(self.pose(distance).inverse()).compose(self._anchor)
        self._lap_starts.clear()

    def pose(self, distance: float) -> Pose:
        """Pose of the road at a distance, in map axes."""
        lap, along = divmod(distance, self.length)
        index = min(int(along / self._step), len(self._poses) - 2)
        fraction = along / self._step - index
        a, b = self._poses[index], self._poses[index + 1]
        local = Pose(a.x + fraction * (b.x - a.x), a.y + fraction * (b.y - a.y), a.yaw + fraction * (b.yaw - a.yaw))
        if (start := self._lap_starts.get(lap)) is None:
            start = self._anchor
            one_lap = self._poses[-1] if lap > 0 else self._poses[-1].inverse()
            for _ in range(abs(int(lap))):
                start = start.compose(one_lap)
            self._lap_starts[lap] = start
        return start.compose(local)

    def curvature(self, distance: float) -> float:
        """Curvature at a distance [1/m], > 0 in a left turn."""
        piece, along = self._find(distance % self.length)
        return piece.curvature_start + (piece.curvature_end - piece.curvature_start) * along / piece.length

    def speed(self, distance: float) -> float:
        """Target speed of the piece at a distance [m/s]."""
        return self._find(distance % self.length)[0].speed

    def _find(self, along: float) -> tuple[Piece, float]:
        """The piece at a distance within a lap, and the distance from its start."""
        index = min(bisect.bisect_right(self._ends, along), len(self.pieces)) - 1
        return self.pieces[index], along - self._ends[index]


class SpeedProfile:
    """Highest speed along a road within its target speeds and the limits of acceleration and braking [m/s^2, > 0]."""

    def __init__(self, path: Path, acceleration: float, braking: float):
        count = max(4, math.ceil(path.length / SPEED_SPACING))
        self._step, self._length = path.length / count, path.length
        squares = [path.speed(i * self._step) ** 2 for i in range(count)]
        # Two laps, because braking may begin in the previous lap.
        for i in range(2 * count):
            squares[(i + 1) % count] = min(squares[(i + 1) % count], squares[i % count] + 2 * acceleration * self._step)
        for i in range(2 * count, 0, -1):
            squares[(i - 1) % count] = min(squares[(i - 1) % count], squares[i % count] + 2 * braking * self._step)
        self._squares = squares

    def interpolate(self, distance: float) -> tuple[float, float]:
        """Speed [m/s] and acceleration [m/s^2] at a distance."""
        position = (distance % self._length) / self._step
        index = int(position) % len(self._squares)
        first_square, second_square = self._squares[index], self._squares[(index + 1) % len(self._squares)]
        square = first_square + (second_square - first_square) * (position - int(position))
        return math.sqrt(square), (second_square - first_square) / (2 * self._step)
