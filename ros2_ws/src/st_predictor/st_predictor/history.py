"""What a view remembers: the measured track, and the predictions of the last seconds for the ghosts."""

from bisect import bisect_left
from collections import deque
from dataclasses import dataclass

import numpy as np

from .ribbon import Ribbon

TRACK_SPAN = 90.0  # s of measured track kept
GHOST_AGES = (1.0, 2.0, 3.0, 4.0, 5.0)  # s
GHOST_TOLERANCE = 0.15  # s; a ghost further off its age than this is not drawn


@dataclass(frozen=True, eq=False)
class Path:
    """A predicted path of the INS point: x, y (n,) in m, map frame, a point every `step` s from start_ns (UTC) on.

    ribbons: the bands around it, the widest first; none where nothing is stated.
    """

    start_ns: int
    step: float
    x: np.ndarray
    y: np.ndarray
    ribbons: tuple[Ribbon, ...] = ()

    def at(self, time_ns: int) -> tuple[float, float] | None:
        """Where the car was predicted to be at an instant; None outside the horizon."""
        index = (time_ns - self.start_ns) * 1e-9 / self.step
        if not 0.0 <= index <= len(self.x) - 1:
            return None
        grid = np.arange(len(self.x))
        return float(np.interp(index, grid, self.x)), float(np.interp(index, grid, self.y))


class History:
    """Times in ns UTC. Whatever arrives late or twice is dropped; a step back in time begins anew (a replay)."""

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

    def newest(self, model: str) -> Path:
        """Of one of `models`."""
        return self._paths[model][-1]

    def ghosts(self, model: str, now_ns: int) -> list[tuple[float, Path]]:
        """(age in s, path) of the predictions nearest to each of GHOST_AGES, youngest first."""
        paths = list(self._paths.get(model, ()))
        starts = [p.start_ns for p in paths]
        found = []
        for age in GHOST_AGES:
            wanted = now_ns - round(age * 1e9)
            near = bisect_left(starts, wanted)
            candidates = [p for p in paths[max(near - 1, 0):near + 1]]
            best = min(candidates, key=lambda p: abs(p.start_ns - wanted), default=None)
            if best is not None and abs(best.start_ns - wanted) <= GHOST_TOLERANCE * 1e9:
                found.append((age, best))
        return found

    def expected(self, model: str, now_ns: int) -> tuple[float, float] | None:
        """Where the oldest prediction whose horizon reaches this far has the car now; None without one."""
        for path in self._paths.get(model, ()):
            if (point := path.at(now_ns)) is not None and path.start_ns < now_ns:
                return point
        return None
