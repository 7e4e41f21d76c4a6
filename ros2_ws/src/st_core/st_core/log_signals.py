"""Interpolates the signals of a recorded drive at any instants; values in gaps are unknown.

The vectorised counterpart of `measurement_history.MeasurementHistory`, with identical results.
Checked by: test_batch.py.
"""

from copy import copy
from typing import Literal

import numpy as np

from .log import INS_SIGNALS, DriveLog
from .timeseries import NANOSECOND, Neighbours, filtered_derivative, find_neighbours
from .vehicle import VehicleParameters

Acceleration = Literal["causal", "zero_phase"]


def share_memory(log: DriveLog, other: DriveLog, *names: str) -> bool:
    """Whether the named arrays of two drives share memory; each drive has its own views of the memory."""
    pairs = [(getattr(log, name), getattr(other, name)) for name in names]
    return all(a.size == b.size and a.ctypes.data == b.ctypes.data for a, b in pairs)


class LogSignals:
    """Measurements of a DriveLog at any instants; NaN where unknown.

    maximum_gap [s], filter_cutoff [Hz], acceleration: as maximum_gap, cutoff, mode of `timeseries.filtered_derivative`.
    """

    def __init__(self, log: DriveLog, maximum_gap: float, filter_cutoff: float, acceleration: Acceleration = "causal"):
        self.log = log
        self.maximum_gap = maximum_gap
        self._gap_ns = round(maximum_gap / NANOSECOND)
        self._filter: tuple[float, Acceleration] = (filter_cutoff, acceleration)
        _, self.velocity_x_dot = filtered_derivative(
            log.ins_time_ns, log.velocity_x, filter_cutoff, maximum_gap, acceleration)

    def for_log(self, log: DriveLog) -> "LogSignals":
        """The signals of another drive with the same settings; they share the derivative if the speed is the same."""
        if not share_memory(log, self.log, "ins_time_ns", "velocity_x"):
            return LogSignals(log, self.maximum_gap, *self._filter)
        other = copy(self)
        other.log = log
        return other

    @property
    def common_end_ns(self) -> int:
        """The last instant at which INS and steering can both be known [ns]; 0 if one of them is empty."""
        times = self.log.ins_time_ns, self.log.steering_time_ns
        return min(int(t[-1]) if len(t) else 0 for t in times)

    def ins_at(self, times_ns: np.ndarray, *names: str) -> list[np.ndarray]:
        """The named INS signals (fields of DriveLog, or velocity_x_dot) at instants of any shape [ns]."""
        columns = [self.velocity_x_dot if name == "velocity_x_dot" else getattr(self.log, name) for name in names]
        return self._at(self.log.ins_time_ns, columns, times_ns)

    def road_wheel_angle_at(self, times_ns: np.ndarray) -> np.ndarray:
        """Road wheel angle [rad], left +, at instants of any shape [ns]."""
        return self.sample(self.log.steering_time_ns, self.log.road_wheel_angle, times_ns)

    def sample(self, time_ns: np.ndarray, values: np.ndarray, at_ns: np.ndarray) -> np.ndarray:
        """Any signal, known at time_ns [ns, ascending], at instants `at_ns` of any shape [ns]."""
        return self._at(time_ns, [values], at_ns)[0]

    def states_at(self, times_ns: np.ndarray, vehicle: VehicleParameters) -> np.ndarray:
        """States at the CG, (n, 6), columns as types.STATE_NAMES; see `types.ins_to_cg`."""
        x, y, yaw, velocity_x, velocity_y, yaw_rate = self.ins_at(times_ns, *INS_SIGNALS)
        cosine, sine, d_x, d_y = np.cos(yaw), np.sin(yaw), vehicle.cg_to_ins_x, vehicle.cg_to_ins_y
        return np.stack([x - cosine * d_x + sine * d_y, y - sine * d_x - cosine * d_y,
                         velocity_x + yaw_rate * d_y, velocity_y - yaw_rate * d_x, yaw, yaw_rate], axis=-1)

    def _at(self, times: np.ndarray, columns: list[np.ndarray], instants: np.ndarray) -> list[np.ndarray]:
        instants = np.asarray(instants, np.int64)
        if not len(times):
            return [np.full(instants.shape, np.nan) for _ in columns]
        neighbours = self._find_neighbours(times, instants)
        return [neighbours.interpolate(column) for column in columns]

    def _find_neighbours(self, times: np.ndarray, instants: np.ndarray) -> Neighbours:
        return find_neighbours(times, instants, self._gap_ns)
