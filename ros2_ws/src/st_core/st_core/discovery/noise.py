"""What errors noise alone leaves, by identities of the sensors: no car, no model."""

import numpy as np

from .. import frames
from .windows import Windows

SPREAD = 1.4826  # of a normal distribution: standard deviation over the median of its magnitude
THIRD = np.sqrt(20.0)  # standard deviation of a third difference of white noise of 1


def floor(windows: Windows) -> dict[str, float]:
    """By column, at the end of the horizon, one standard deviation [SI].

    Position: dead reckoning with measured heading and velocities against the measured way, and what white noise of
    speed and heading at the start makes of it. Heading: the integral of the measured yaw rate against the measured
    turn. Others: third differences, in which the motion of a car is gone.
    """
    log, result = windows.joined, {}
    grid = windows.starts_ns[:, None] + np.round(np.linspace(0.0, windows.time[-1], 101) * 1e9).astype(np.int64)
    step = windows.time[-1] / 100.0
    x, y, yaw, u, v, rate = windows.measured_at(grid, "x", "y", "yaw", "velocity_x", "velocity_y", "yaw_rate")
    cosine, sine = np.cos(yaw), np.sin(yaw)
    east, north = (_integral(values, step) for values in (u * cosine - v * sine, u * sine + v * cosine))
    ahead, left = frames.map_to_body(x[:, -1] - x[:, 0] - east, y[:, -1] - y[:, 0] - north, yaw[:, -1])
    turned = frames.wrap_angle(yaw[:, -1] - yaw[:, 0] - _integral(rate, step))
    horizon = float(windows.time[-1])
    at_start = {"position_longitudinal": _white(log.velocity_x) * horizon,
                "position_lateral": _white(log.yaw) * horizon * float(np.nanmean(u))}
    whole = {"position_longitudinal": ahead, "position_lateral": left, "yaw": turned}
    for column in windows.columns:
        if column in whole:
            off = whole[column][np.isfinite(whole[column])]
            spread = SPREAD * float(np.median(np.abs(off - np.median(off)))) if len(off) else 0.0
            result[column] = float(np.hypot(spread, at_start.get(column, 0.0)))
        else:
            result[column] = _white(getattr(log, column))
    return result


def _white(values: np.ndarray) -> float:
    """Standard deviation of the white noise in samples [their unit]."""
    return SPREAD * float(np.nanmedian(np.abs(np.diff(values, 3)))) / THIRD


def _integral(values: np.ndarray, step: float) -> np.ndarray:
    return (0.5 * (values[:, :-1] + values[:, 1:])).sum(axis=1) * step
