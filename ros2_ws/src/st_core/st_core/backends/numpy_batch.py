"""Backend that computes batches with numpy arrays, without further dependencies."""

from typing import Any

import numpy as np

from ..integrate import Derivative, rk4_step
from ..models import Model
from ..types import STATE_NAMES

LANES = 1
# Columns per call: enough to make the overhead of a call small, few enough for the second-level cache.
BLOCK = 4096


def advance(model: Model, p: Any, start: np.ndarray, w: np.ndarray, offsets: np.ndarray, step: float,
            points: np.ndarray) -> np.ndarray:
    """States of all columns at the points, as defined in the package."""
    out = np.empty((len(points), len(STATE_NAMES), start.shape[1]))
    with np.errstate(all="ignore"):
        for first in range(0, start.shape[1], BLOCK):
            columns = slice(first, min(first + BLOCK, start.shape[1]))
            _advance(model.rhs, p, start[:, columns], w, offsets + first, step, points, out[:, :, columns])
    return out


def _advance(rhs: Derivative, p: Any, start: np.ndarray, w: np.ndarray, offsets: np.ndarray, step: float,
             points: np.ndarray, out: np.ndarray) -> None:
    count = start.shape[1]
    rows = {int(point): row for row, point in enumerate(points)}
    state = tuple(np.ascontiguousarray(start))
    now = tuple(w[:, offsets[0]:offsets[0] + count])
    for k in range(max(rows, default=0) + 1):
        if k in rows:
            for target, values in zip(out[rows[k]], state, strict=False):
                target[:] = values
        if k < max(rows):
            middle, end = (tuple(w[:, o:o + count]) for o in offsets[2 * k + 1:2 * k + 3])
            state = rk4_step(rhs, state, now, middle, end, p, step)
            now = end
