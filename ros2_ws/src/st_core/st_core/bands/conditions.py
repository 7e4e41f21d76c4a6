"""The conditions at a start, on which the width of a band depends: known when the prediction is made, no later.

    speed                 |v_x|                                    [m/s]
    lateral_acceleration  |v_x r|                                  [m/s^2]
    forward_acceleration  |velocity_x_dot|                         [m/s^2]
    steering_activity     root mean square of d(delta)/dt over the ACTIVITY_SPAN before the start [rad/s]

All are magnitudes, at the INS point; delta is the road wheel angle. What the horizon will bring is not among them: a
band that needed it could not be drawn live. Checked by: test_bands_live.py.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..binning import LATERAL_ACCELERATION, SPEED
from ..log_signals import LogSignals
from ..timeseries import NANOSECOND

CONDITIONS = ("speed", "lateral_acceleration", "forward_acceleration", "steering_activity")
UNITS = {"speed": "m/s", "lateral_acceleration": "m/s^2", "forward_acceleration": "m/s^2", "steering_activity": "rad/s"}
ACTIVITY_SPAN = 1.0
"""s. A driver's correction takes about so long; the live predictor remembers two seconds."""
ACTIVITY_STEP = 0.05
"""s. A wheel sensor of 0.1 deg and a ratio of 16 then round the rate to 0.002 rad/s."""
_INSTANTS_NS = np.round(np.arange(-ACTIVITY_SPAN, 0.5 * ACTIVITY_STEP, ACTIVITY_STEP) / NANOSECOND).astype(np.int64)


def activity_instants(start_ns: int | np.ndarray) -> np.ndarray:
    """Instants [ns] of the road wheel angles that `steering_activity` takes: (..., 21) for starts (...)."""
    return np.asarray(start_ns, np.int64)[..., None] + _INSTANTS_NS


def steering_activity(angle: np.ndarray) -> np.ndarray:
    """Root mean square steering rate [rad/s] of road wheel angles (..., 21) [rad] at `activity_instants`.

    NaN where one of them is: with a gap just before the start nothing is known of what the hands do.
    """
    rates = (angle[..., 1:] - angle[..., :-1]) / ACTIVITY_STEP
    return np.sqrt((rates * rates).mean(axis=-1))


def conditions(velocity_x: float | np.ndarray, yaw_rate: float | np.ndarray, velocity_x_dot: float | np.ndarray,
               activity: float | np.ndarray) -> np.ndarray:
    """(..., 4), columns as CONDITIONS. velocity_x [m/s], yaw_rate [rad/s]: at the INS point; velocity_x_dot [m/s^2];
    activity: of `steering_activity` [rad/s].
    """
    parts = np.broadcast_arrays(*magnitudes(*map(np.asarray, (velocity_x, yaw_rate, velocity_x_dot, activity))))
    return np.stack([np.asarray(part, float) for part in parts], axis=-1)


def magnitudes(velocity_x: Any, yaw_rate: Any, velocity_x_dot: Any, activity: Any) -> tuple[Any, ...]:
    """The four of `conditions`, one by one: of numbers, with which one start takes a tenth of the time, or arrays."""
    return abs(velocity_x), abs(velocity_x * yaw_rate), abs(velocity_x_dot), abs(activity)


def conditions_at(signals: LogSignals, starts_ns: np.ndarray) -> np.ndarray:
    """(n, 4), columns as CONDITIONS, at starts (n,) [ns] of a recorded drive; NaN where not known."""
    speed, yaw_rate, acceleration = signals.ins_at(starts_ns, "velocity_x", "yaw_rate", "velocity_x_dot")
    activity = steering_activity(signals.road_wheel_angle_at(activity_instants(starts_ns)))
    return conditions(speed, yaw_rate, acceleration, activity)


FEWEST_STARTS = 10
"""Of a run in a cell of speed and lateral acceleration: one second of driving."""
FEWEST_RUNS = 2
"""With so many starts in a cell: one run does not show how much runs differ there."""
CELLED = {CONDITIONS.index("speed"): SPEED, CONDITIONS.index("lateral_acceleration"): LATERAL_ACCELERATION}
"""Edges by column of the conditions."""


def cells(conditions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Row and column (n,) of conditions (n, 4): numbers of their bins of speed and lateral acceleration."""
    row, column = (np.searchsorted(edges, conditions[:, k], side="right") - 1 for k, edges in CELLED.items())
    return row, column


@dataclass(frozen=True, eq=False)
class CalibrationDomain:
    """starts: (speed bins, lateral acceleration bins), how many were calibrated with; 0 where fewer than FEWEST_RUNS
    runs had FEWEST_STARTS. most: the largest forward_acceleration [m/s^2] and steering_activity [rad/s] among them."""

    starts: np.ndarray
    most: tuple[float, float]

    @classmethod
    def of(cls, conditions: Sequence[np.ndarray]) -> "CalibrationDomain":
        """The domain of conditions (n, 4), one array a run."""
        starts = np.zeros((len(conditions), *(len(edges) for edges in CELLED.values())), int)
        for one, of_run in zip(conditions, starts, strict=True):
            np.add.at(of_run, cells(one), 1)
        enough = (starts >= FEWEST_STARTS).sum(axis=0) >= FEWEST_RUNS
        rows = np.concatenate(conditions)
        return cls(np.where(enough, starts.sum(axis=0), 0), (float(rows[:, 2].max()), float(rows[:, 3].max())))

    def __call__(self, conditions: np.ndarray) -> np.ndarray:
        """(n,) bool: whether conditions (n, 4) were calibrated; False where one is not known."""
        known = np.isfinite(conditions).all(axis=1)
        rows = np.where(known[:, None], conditions, 0.0)
        return known & (self.starts[cells(rows)] > 0) & (rows[:, 2:] <= self.most).all(axis=1)

    def why_not(self, condition: Sequence[float]) -> str:
        """Reason, in one line, why conditions (four numbers) have no band; empty if they have one."""
        if self(np.array([condition], float))[0]:
            return ""
        for name, value in zip(CONDITIONS, condition, strict=True):
            if not np.isfinite(value):
                return f"{name.replace('_', ' ')} not known"
        for name, value, most in zip(CONDITIONS[2:], condition[2:], self.most, strict=True):
            if value > most:
                return f"{name.replace('_', ' ')} {value:.3g} {UNITS[name]}, calibrated up to {most:.3g}"
        return (f"{condition[0]:.1f} m/s with {condition[1]:.1f} m/s^2 across was calibrated by fewer than "
                f"{FEWEST_RUNS} runs")
