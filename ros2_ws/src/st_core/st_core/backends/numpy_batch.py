"""Backend that computes batches with numpy arrays, without further dependencies."""

from typing import Any

import numpy as np

from ..integrate import rk4_step
from ..models import Model
from ..types import STATE_NAMES

LANES = 1
BLOCK_SIZE = 4096  # columns per call: enough to amortise the overhead of a call, few enough for the L2 cache


def advance(model: Model, p: Any, start: np.ndarray, w: np.ndarray, offsets: np.ndarray, step: float,
            points: np.ndarray) -> np.ndarray:
    """States of all columns at the points; see `st_core.backends`."""
    out = np.empty((len(points), len(STATE_NAMES), start.shape[1]))
    rows = {int(point): row for row, point in enumerate(points)}
    with np.errstate(all="ignore"):
        for first in range(0, start.shape[1], BLOCK_SIZE):
            columns = slice(first, min(first + BLOCK_SIZE, start.shape[1]))
            count = columns.stop - first
            state = tuple(np.ascontiguousarray(start[:, columns]))
            now = tuple(w[:, offsets[0] + first:offsets[0] + first + count])
            for k in range(max(rows, default=0) + 1):
                if k in rows:
                    for target, values in zip(out[rows[k]], state, strict=False):
                        target[columns] = values
                if k < max(rows):
                    middle, end = (tuple(w[:, o:o + count]) for o in offsets[2 * k + 1:2 * k + 3] + first)
                    state = rk4_step(model.rhs, state, now, middle, end, p, step)
                    now = end
    return out
