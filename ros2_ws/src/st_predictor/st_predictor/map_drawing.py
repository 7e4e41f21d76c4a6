"""Provides the content of map views: measured track, predicted paths with their bands, and the outline of the car."""

from bisect import bisect_left
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from st_core.types import body_to_map
from st_core.vehicle import VehicleParameters

TRACK_SPAN = 90.0  # s of measured track
MAX_PATH_AGE = 1.0  # s; a path of this age or older is not drawn as the newest one
GHOST_AGES = (1.0, 2.0, 3.0, 4.0, 5.0)  # s, ages of the earlier predictions drawn in addition to the newest
GHOST_TOLERANCE = 0.15  # s, largest difference between a prediction's age and a ghost age
DRAWN_MODE = "forecast"  # mode of the drawn bands and paths


class Pose(NamedTuple):
    """Position x, y [m] and yaw [rad] in the map frame."""

    x: float
    y: float
    yaw: float


def make_car_outline(pose: Pose, car: VehicleParameters) -> tuple[np.ndarray, np.ndarray]:
    """Map x, y [m] of the closed outline of the car, with a nose that points forward. pose: of the INS point. Front and
    rear overhang are assumed equal, because the vehicle file contains only the length."""
    overhang = 0.5 * (car.length - car.wheelbase)
    front, rear, side = car.cg_to_front_axle + overhang, -car.cg_to_rear_axle - overhang, 0.5 * car.width
    forward = np.array([rear, 0.6 * front, front, 0.6 * front, rear, rear]) - car.cg_to_ins_x
    left = np.array([side, side, 0.0, -side, -side, side]) - car.cg_to_ins_y
    dx, dy = body_to_map(forward, left, pose.yaw)
    return pose.x + dx, pose.y + dy


@dataclass(frozen=True, eq=False)
class Ribbon:
    """Left and right edges of a band in the map frame, (n, 2) each [m]. level: probability, 0 to 1."""

    level: float
    left: np.ndarray
    right: np.ndarray

    def make_triangles(self, stride: int) -> np.ndarray:
        """(k, 3, 2) triangles [m] that fill the band, with corners at every `stride`-th and at the last two points."""
        last = len(self.left) - 1
        indices = np.unique(np.append(np.arange(0, last, stride), (last - 1, last)))
        left, right = self.left[indices], self.right[indices]
        return np.concatenate([np.stack([left[:-1], right[:-1], left[1:]], axis=1),
                               np.stack([right[:-1], right[1:], left[1:]], axis=1)])


def make_ribbon(level: float, poses: tuple[np.ndarray, np.ndarray, np.ndarray], along: np.ndarray,
                across: np.ndarray) -> Ribbon:
    """The band around a path of poses x, y [m], yaw [rad] with half-widths along and across [m], all (n,). It extends
    `along[-1]` beyond the end of the path."""
    x, y, yaw = poses
    ahead = np.append(np.zeros(len(x)), along[-1])
    half_width, heading = np.append(across, across[-1]), np.append(yaw, yaw[-1])
    middle = np.stack([np.append(x, x[-1]), np.append(y, y[-1])], axis=1)
    edges = [middle + np.stack(body_to_map(ahead, side * half_width, heading), axis=1) for side in (1.0, -1.0)]
    return Ribbon(level, *edges)


@dataclass(frozen=True, eq=False)
class Path:
    """A predicted path of the INS point in the map frame: x, y (n,) [m], one point every `step` [s] from start_ns on.
    ribbons: the bands around it, the widest first; empty without bands."""

    start_ns: int
    step: float
    x: np.ndarray
    y: np.ndarray
    ribbons: tuple[Ribbon, ...] = ()

    def find_position(self, time_ns: int) -> tuple[float, float] | None:
        """Predicted x, y [m] at an instant; None outside the horizon."""
        index = (time_ns - self.start_ns) * 1e-9 / self.step
        if not 0.0 <= index <= len(self.x) - 1:
            return None
        indices = np.arange(len(self.x))
        return float(np.interp(index, indices, self.x)), float(np.interp(index, indices, self.y))


class History:
    """Measured track and newest predictions; times are UTC. Samples that are not newer than the last are ignored; a
    pose that is older by 1 s or more, as after the restart of a replay, clears the history."""

    def __init__(self) -> None:
        self.track: deque[tuple[int, float, float]] = deque()
        self._paths: dict[str, deque[Path]] = {}

    def add_pose(self, time_ns: int, x: float, y: float) -> None:
        if self.track and time_ns <= self.track[-1][0]:
            if time_ns > self.track[-1][0] - 1_000_000_000:
                return
            self.track.clear()
            self._paths.clear()
        self.track.append((time_ns, x, y))
        while time_ns - self.track[0][0] > TRACK_SPAN * 1e9:
            self.track.popleft()

    def add_path(self, model: str, path: Path) -> None:
        paths = self._paths.setdefault(model, deque())
        if paths and path.start_ns <= paths[-1].start_ns:
            return
        paths.append(path)
        while path.start_ns - paths[0].start_ns > (GHOST_AGES[-1] + 1.0) * 1e9:
            paths.popleft()

    @property
    def models(self) -> tuple[str, ...]:
        return tuple(self._paths)

    def find_newest(self, model: str, now_ns: int) -> Path | None:
        """The newest path of one of `models`; None if its age is MAX_PATH_AGE or more."""
        path = self._paths[model][-1]
        return path if now_ns - path.start_ns < MAX_PATH_AGE * 1e9 else None

    def find_ghosts(self, model: str, now_ns: int) -> list[tuple[float, Path]]:
        """(ghost age [s], path) for each of GHOST_AGES with a prediction within GHOST_TOLERANCE, youngest first."""
        paths, ghosts = list(self._paths.get(model, ())), []
        for age in GHOST_AGES:
            start_ns = now_ns - round(age * 1e9)
            index = bisect_left(paths, start_ns, key=lambda p: p.start_ns)
            nearest = min(paths[max(index - 1, 0):index + 1], key=lambda p: abs(p.start_ns - start_ns), default=None)
            if nearest is not None and abs(nearest.start_ns - start_ns) <= GHOST_TOLERANCE * 1e9:
                ghosts.append((age, nearest))
        return ghosts

    def find_predicted_position(self, model: str, now_ns: int) -> tuple[float, float] | None:
        """Predicted x, y [m] at `now_ns`, from the oldest stored prediction that covers it; None without one."""
        for path in self._paths.get(model, ()):
            if (point := path.find_position(now_ns)) is not None and path.start_ns < now_ns:
                return point
        return None
