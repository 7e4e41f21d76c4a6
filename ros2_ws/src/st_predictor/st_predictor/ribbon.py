"""A band as a ribbon around its path: what is drawn of it on a map."""

from dataclasses import dataclass

import numpy as np
from st_core.frames import body_to_map

MODE = "forecast"
"""The question that is drawn: with inputs held, as the path itself is made."""


@dataclass(frozen=True, eq=False)
class Ribbon:
    """The area that the band leaves to the path: edges left, right (n, 2) in m, map frame, start first."""

    level: float
    left: np.ndarray
    right: np.ndarray

    def triangles(self, stride: int) -> np.ndarray:
        """(k, 3, 2): the area, made of every `stride`-th point, the last of the path and the end."""
        last = len(self.left) - 1
        rows = np.unique(np.append(np.arange(0, last, stride), (last - 1, last)))
        left, right = self.left[rows], self.right[rows]
        return np.concatenate([np.stack([left[:-1], right[:-1], left[1:]], axis=1),
                               np.stack([right[:-1], right[1:], left[1:]], axis=1)])


def ribbon(level: float, pose: tuple[np.ndarray, np.ndarray, np.ndarray], along: np.ndarray,
           across: np.ndarray) -> Ribbon:
    """Of half-widths (n,) [m] at poses x, y [m], yaw [rad] (n,) each. At its end it reaches `along` beyond the path."""
    x, y, yaw = pose
    ahead = np.append(np.zeros(len(x)), along[-1])
    wide, turn = np.append(across, across[-1]), np.append(yaw, yaw[-1])
    middle = np.stack([np.append(x, x[-1]), np.append(y, y[-1])], axis=1)
    edges = [middle + np.stack(body_to_map(ahead, side * wide, turn), axis=1) for side in (1.0, -1.0)]
    return Ribbon(level, *edges)
