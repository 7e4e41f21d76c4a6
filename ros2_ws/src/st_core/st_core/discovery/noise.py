"""What errors noise alone leaves."""

import numpy as np

from ..log import INS_SIGNALS
from .windows import Windows


def floor(windows: Windows) -> dict[str, float]:
    """By column, at the end of the horizon, one standard deviation [SI]; see `channels.Channel.noise`."""
    grid = windows.starts_ns[:, None] + np.round(np.linspace(0.0, windows.time[-1], 101) * 1e9).astype(np.int64)
    way = float(windows.time[-1]) / 100.0, *windows.measured_at(grid, *INS_SIGNALS)
    return {column: value for channel in windows.channels
            for column, value in zip(channel.columns, channel.left(windows.joined, *way), strict=True)}
