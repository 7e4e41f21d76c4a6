"""Conditions at the start of a prediction, which determine the width of its band and are known in advance.

    speed                 |v_x| [m/s]
    lateral_acceleration  |v_x r| [m/s^2]
    forward_acceleration  |velocity_x_dot| [m/s^2]
    steering_activity     root mean square of d(delta)/dt over the ACTIVITY_SPAN before the start [rad/s]

Velocity, yaw rate and acceleration are those of the INS point; delta is the road wheel angle.
Checked by: test_bands_live.py.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..log import LogSignals
from ..log_evaluation import LATERAL_ACCELERATION_EDGES, SPEED_EDGES
from ..timeseries import NANOSECOND

CONDITIONS = ("speed", "lateral_acceleration", "forward_acceleration", "steering_activity")
UNITS = {"speed": "m/s", "lateral_acceleration": "m/s^2", "forward_acceleration": "m/s^2", "steering_activity": "rad/s"}
ACTIVITY_SPAN = 1.0  # s; about the duration of a steering correction; the live predictor stores two seconds
ACTIVITY_STEP = 0.05  # s; 0.1 deg at the steering wheel with a ratio of 16 resolves rates of 0.002 rad/s
_INSTANTS_NS = np.round(np.arange(-ACTIVITY_SPAN, 0.5 * ACTIVITY_STEP, ACTIVITY_STEP) / NANOSECOND).astype(np.int64)


def activity_instants(start_ns: int | np.ndarray) -> np.ndarray:
    """Instants (..., 21) [ns] of the road wheel angles that `steering_activity` uses, for starts (...) [ns]."""
    return np.asarray(start_ns, np.int64)[..., None] + _INSTANTS_NS


def steering_activity(angle: np.ndarray) -> np.ndarray:
    """RMS steering rate [rad/s] of road wheel angles (..., 21) [rad] at `activity_instants`; NaN if one is NaN."""
    rates = (angle[..., 1:] - angle[..., :-1]) / ACTIVITY_STEP
    return np.sqrt((rates * rates).mean(axis=-1))


def compute_conditions(velocity_x: float | np.ndarray, yaw_rate: float | np.ndarray,
                       velocity_x_dot: float | np.ndarray, activity: float | np.ndarray) -> np.ndarray:
    """Conditions (..., 4), columns as CONDITIONS, from velocity_x [m/s], yaw_rate [rad/s] and velocity_x_dot [m/s^2] at
    the INS point, and `steering_activity` [rad/s]."""
    magnitudes = compute_magnitudes(velocity_x, yaw_rate, velocity_x_dot, activity)
    return np.stack(np.broadcast_arrays(*magnitudes), axis=-1).astype(float)


def compute_magnitudes(velocity_x: Any, yaw_rate: Any, velocity_x_dot: Any, activity: Any) -> tuple[Any, ...]:
    """The four conditions as separate arrays, or as floats, which take a tenth of the time for one start."""
    return abs(velocity_x), abs(velocity_x * yaw_rate), abs(velocity_x_dot), abs(activity)


def conditions_at(signals: LogSignals, starts_ns: np.ndarray) -> np.ndarray:
    """Conditions (n, 4), columns as CONDITIONS, at starts (n,) [ns] of a recorded drive; NaN where unknown."""
    speed, yaw_rate, acceleration = signals.ins_at(starts_ns, "velocity_x", "yaw_rate", "velocity_x_dot")
    activity = steering_activity(signals.road_wheel_angle_at(activity_instants(starts_ns)))
    return compute_conditions(speed, yaw_rate, acceleration, activity)


MIN_STARTS = 10  # minimum number of starts of a run in a cell of speed and lateral acceleration; 1 s at 10 starts/s
MIN_RUNS_IN_CELL = 2  # minimum number of runs with MIN_STARTS; one run does not show the variation between runs
CELL_EDGES = {CONDITIONS.index("speed"): SPEED_EDGES,
              CONDITIONS.index("lateral_acceleration"): LATERAL_ACCELERATION_EDGES}
"""Edges of the cells by column of the conditions."""


def find_cells(conditions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cells of conditions (n, 4): indices (n,) of the bins of speed, and of lateral acceleration."""
    row, column = (np.searchsorted(edges, conditions[:, k], side="right") - 1 for k, edges in CELL_EDGES.items())
    return row, column


@dataclass(frozen=True, eq=False)
class CalibrationDomain:
    """Conditions with enough calibration runs: cells of speed and lateral acceleration, and limits of the others."""

    starts: np.ndarray  # number by (speed, lateral acceleration) bin, 0 if fewer than MIN_RUNS_IN_CELL had MIN_STARTS
    largest: tuple[float, float]  # forward_acceleration [m/s^2], steering_activity [rad/s]

    @classmethod
    def of(cls, conditions: Sequence[np.ndarray]) -> "CalibrationDomain":
        """The domain of conditions (n, 4), one array for each run."""
        starts = np.zeros((len(conditions), *map(len, CELL_EDGES.values())), int)
        for run, counts in zip(conditions, starts, strict=True):
            np.add.at(counts, find_cells(run), 1)
        enough = (starts >= MIN_STARTS).sum(axis=0) >= MIN_RUNS_IN_CELL
        rows = np.concatenate(conditions)
        return cls(np.where(enough, starts.sum(axis=0), 0), (float(rows[:, 2].max()), float(rows[:, 3].max())))

    def contains(self, conditions: np.ndarray) -> np.ndarray:
        """(n,) bool: whether conditions (n, 4) are in the domain; False where one is NaN."""
        known = np.isfinite(conditions).all(axis=1)
        rows = np.where(known[:, None], conditions, 0.0)
        return known & (self.starts[find_cells(rows)] > 0) & (rows[:, 2:] <= self.largest).all(axis=1)

    def describe_outside(self, condition: Sequence[float]) -> str:
        """One-line reason why four conditions are outside the domain; empty if they are inside."""
        if self.contains(np.array([condition], float))[0]:
            return ""
        for name, value in zip(CONDITIONS, condition, strict=True):
            if not np.isfinite(value):
                return f"{name.replace('_', ' ')} is unknown"
        for name, value, limit in zip(CONDITIONS[2:], condition[2:], self.largest, strict=True):
            if value > limit:
                text = name.replace("_", " ").replace("forward acceleration", "|forward acceleration|")
                return f"{text} {value:.3g} {UNITS[name]} exceeds the calibrated {limit:.3g}"
        return (f"{condition[0]:.1f} m/s with {condition[1]:.1f} m/s^2 lateral acceleration: fewer than "
                f"{MIN_RUNS_IN_CELL} calibration runs have {MIN_STARTS} predictions in this range")
