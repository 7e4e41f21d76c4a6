"""Columns of numpy arrays: what runs where nothing but numpy is installed."""

from typing import Any

import numpy as np

from ..integrate import Derivative, rk4_step
from ..models import Model
from ..types import STATE_NAMES

LANES = 1
# Columns at a time: long enough to hide the cost of a call, short enough for the second-level cache.
BLOCK = 4096


def advance(model: Model, p: Any, start: np.ndarray, w: np.ndarray, offsets: np.ndarray, step: float,
            points: np.ndarray) -> np.ndarray:
    """See the package."""
    out = np.empty((len(points), len(STATE_NAMES), start.shape[1]))
    with np.errstate(all="ignore"):
        for first in range(0, start.shape[1], BLOCK):
            columns = slice(first, min(first + BLOCK, start.shape[1]))
            _advance(model.rhs, p, start[:, columns], w, offsets + first, step, points, out[:, :, columns])
    return out


def _advance(rhs: Derivative, p: Any, start: np.ndarray, w: np.ndarray, offsets: np.ndarray, step: float,
             points: np.ndarray, out: np.ndarray) -> None:
    count = start.shape[1]
    wanted = {int(point): row for row, point in enumerate(points)}
    state = tuple(np.ascontiguousarray(start))
    now = tuple(w[:, offsets[0]:offsets[0] + count])
    for k in range(max(wanted, default=0) + 1):
        if k in wanted:
            for row, values in zip(out[wanted[k]], state, strict=False):
                row[:] = values
        if k < max(wanted):
            middle, end = (tuple(w[:, o:o + count]) for o in offsets[2 * k + 1:2 * k + 3])
            state = rk4_step(rhs, state, now, middle, end, p, step)
            now = end
