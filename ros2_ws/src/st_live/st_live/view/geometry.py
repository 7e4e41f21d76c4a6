"""What the view shows, in the axes of a screen: x to the right, y DOWN, as Rerun's 2D views have it.

Two pictures, both around the car. On the map north is up and east is right, so y is the negative of north. From the
driver's seat the car's heading is up, so a point to the left of the car is on the left.
"""

import numpy as np
from st_core.frames import map_to_body

Pose = tuple[float, float, float]


def north_up(x, y, pose: Pose) -> np.ndarray:
    """(..., 2) screen coordinates [m] of map points x east, y north [m], around a car at pose (x, y [m], yaw [rad])."""
    return np.stack(np.broadcast_arrays(np.asarray(x) - pose[0], pose[1] - np.asarray(y)), axis=-1)


def heading_up(x, y, pose: Pose) -> np.ndarray:
    """(..., 2) screen coordinates [m] of map points, seen from the INS point of a car at pose (x, y [m], yaw [rad])."""
    forward, left = map_to_body(np.asarray(x) - pose[0], np.asarray(y) - pose[1], pose[2])
    return np.stack(np.broadcast_arrays(-left, -forward), axis=-1)


def grid(pose: Pose, spacing: float, reach: float) -> list[tuple[np.ndarray, np.ndarray]]:
    """Lines (x, y) [m] of the map's own grid within `reach` of the car."""
    lines = []
    for axis in (0, 1):
        first = np.ceil((pose[axis] - reach) / spacing) * spacing
        for value in np.arange(first, pose[axis] + reach, spacing):
            fixed, along = np.full(2, value), pose[1 - axis] + reach * np.array([-1.0, 1.0])
            lines.append((fixed, along) if axis == 0 else (along, fixed))
    return lines
