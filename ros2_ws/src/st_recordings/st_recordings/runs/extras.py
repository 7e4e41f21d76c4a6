"""Further channels of a recording, for checks: speed by the wheels, a second output of the INS, its quality."""

from collections.abc import Mapping

import numpy as np
from st_core.checks import Series
from st_core.timeseries import interpolate

NEAR_NS = 100_000_000  # two wheels are compared at instants between samples no further apart

# The axle that is not steered shows the car's own speed; then the other one, then what the car makes of both.
_SPEEDS = (("wheel_speed_rear_left", "wheel_speed_rear_right"), ("wheel_speed_front_left", "wheel_speed_front_right"),
           ("vehicle_speed",))
SPEEDS = tuple(name for names in _SPEEDS for name in names)


def car_speed(speeds: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> Series | None:
    """Speed of the car by its wheels [m/s]: mean of the rear ones, else of the front ones, else its own speed signal.

    speeds: name (wheel_speed_rear_left ..., vehicle_speed) -> (time [ns], rising; values [m/s]).
    """
    for names in _SPEEDS:
        if all(name in speeds and np.isfinite(speeds[name][1]).any() for name in names):
            time_ns = speeds[names[0]][0]
            return series(time_ns, np.mean([interpolate(*_finite(*speeds[name]), time_ns, NEAR_NS) for name in names],
                                           axis=0))
    return None


def series(time_ns: np.ndarray, values: np.ndarray) -> Series | None:
    """What is known of a signal, where its time rises; None for nothing."""
    time_ns, values = _finite(np.asarray(time_ns, np.int64), values)
    if not len(time_ns):
        return None
    newer = np.diff(np.maximum.accumulate(time_ns), prepend=time_ns[:1] - 1) > 0
    return Series(time_ns[newer], values[newer])


def mostly_known(values: np.ndarray | None) -> bool:
    """Whether a channel that may miss samples is of use: it is there, and at least half of it is."""
    return values is not None and len(values) > 0 and bool(np.isfinite(values).mean() >= 0.5)


def _finite(time_ns: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    known = np.isfinite(values)
    return time_ns[known], values[known]
