"""Backend that computes batches with numpy arrays, without further dependencies."""

from typing import Any

import numpy as np

from ..integrate import rk4
from ..models import Model
from ..types import STATE_NAMES

LANES = 1
BLOCK_SIZE = 4096  # columns per call: enough to amortise the overhead of a call, few enough for the L2 cache


def advance(model: Model, p: Any, start: np.ndarray, w: np.ndarray, offsets: np.ndarray, step: float,
            points: np.ndarray) -> np.ndarray:
    """States of all columns at the points; see `st_core.backends`."""
    out = np.empty((len(points), len(STATE_NAMES), start.shape[1]))
    with np.errstate(all="ignore"):
        for first in range(0, start.shape[1], BLOCK_SIZE):
            columns = slice(first, min(first + BLOCK_SIZE, start.shape[1]))
            grid = [tuple(w[:, offset + columns.start:offset + columns.stop])
                    for offset in offsets[:2 * max(points, default=0) + 1]]
            states = rk4(model.rhs, tuple(np.ascontiguousarray(start[:, columns])), grid, p, step)
            for values, point in zip(out, points, strict=True):
                values[:, columns] = states[point][:len(STATE_NAMES)]
    return out
