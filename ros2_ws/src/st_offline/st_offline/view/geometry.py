"""What the view shows, in the axes of a screen: x to the right, y DOWN, as Rerun's 2D views have it.

Two pictures. On the map north is up and east is right, so y is the negative of north. From the driver's seat the car's
heading is up, so a point to the left of the car is on the left.
"""

import numpy as np
from st_core.frames import map_to_body


def north_up(x, y) -> np.ndarray:
    """(..., 2) screen coordinates [m] of map points x east, y north [m]."""
    return np.stack(np.broadcast_arrays(x, -np.asarray(y)), axis=-1)


def heading_up(x, y, pose: tuple[float, float, float]) -> np.ndarray:
    """(..., 2) screen coordinates [m] of map points, seen from the INS point of a car at pose (x, y [m], yaw [rad])."""
    forward, left = map_to_body(np.asarray(x) - pose[0], np.asarray(y) - pose[1], pose[2])
    return np.stack(np.broadcast_arrays(-left, -forward), axis=-1)
