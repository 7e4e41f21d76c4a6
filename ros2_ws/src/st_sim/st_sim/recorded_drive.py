"""Reads a recorded drive from a CSV file; it replaces the simulated car as the source of the sensor data.

Columns, at the CG and in SI units: t, x (east), y (north), yaw (from east), vx (forward), vy (left), yaw_rate, ax, ay,
and delta, the road-wheel angle, positive to the left. Values are interpolated linearly, without smoothing. The
yaw acceleration, which matters only for an INS away from the CG, is the slope of the yaw rate. Wheel speeds equal vx.
"""

import csv
import math
from bisect import bisect_right
from pathlib import Path

import numpy as np
from st_core.errors import ConfigurationError
from st_core.vehicle import VehicleParameters

from .plant import DRIVE, Truth

COLUMNS = ("t", "x", "y", "yaw", "vx", "vy", "yaw_rate", "ax", "ay", "delta")


class RecordedDrive:
    """A recorded drive for a Stream. Time 0 is the first row; after the end, the last row is repeated."""

    def __init__(self, file: str | Path, car: VehicleParameters):
        """Raises ConfigurationError naming the file and the line or column."""
        table = _read_table(Path(file))
        self._car = car
        table[:, COLUMNS.index("yaw")] = np.unwrap(table[:, COLUMNS.index("yaw")])
        self._times = (table[:, 0] - table[0, 0]).tolist()
        self._rows, self._slopes = table.tolist(), (np.diff(table, axis=0) / np.diff(table[:, :1], axis=0)).tolist()
        self._time, self._index = 0.0, 0
        self.duration: float | None = self._times[-1]

    def advance(self, time: float) -> None:
        self._time = min(time, self._times[-1])
        self._index = min(max(bisect_right(self._times, self._time) - 1, 0), len(self._rows) - 2)

    def make_truth(self) -> Truth:
        slopes, elapsed = self._slopes[self._index], self._time - self._times[self._index]
        _, x, y, yaw, vx, vy, yaw_rate, ax, ay, delta = (
            value + elapsed * slope for value, slope in zip(self._rows[self._index], slopes, strict=True))
        rates = dict(zip(COLUMNS, slopes, strict=True))
        ratio = self._car.steering_ratio
        return Truth(time=self._time, x=x, y=y, z=0.0, yaw=yaw, velocity_x=vx, velocity_y=vy, yaw_rate=yaw_rate,
                     acceleration_x=ax, acceleration_y=ay, yaw_acceleration=rates["yaw_rate"],
                     steering_wheel_angle=delta * ratio, road_wheel_angle=delta,
                     steering_wheel_rate=rates["delta"] * ratio, wheel_speed=(vx, vx, vx, vx), gear=DRIVE)


def _read_table(path: Path) -> np.ndarray:
    try:
        with path.open(newline="", encoding="utf-8") as stream:
            reader = csv.DictReader(stream)
            missing = [name for name in COLUMNS if name not in (reader.fieldnames or ())]
            if missing:
                raise ConfigurationError(f"{path}: column {missing[0]} is missing; required: {', '.join(COLUMNS)}")
            rows: list[list[float]] = []
            for row in reader:
                line = f"{path}: line {reader.line_num}"
                try:
                    values = [float(row[name]) for name in COLUMNS]
                except (TypeError, ValueError):
                    values = [math.nan]
                if not all(map(math.isfinite, values)):
                    raise ConfigurationError(f"{line}: not all of {', '.join(COLUMNS)} are finite numbers")
                if rows and values[0] <= rows[-1][0]:
                    raise ConfigurationError(f"{line}: t does not increase")
                rows.append(values)
    except OSError as error:
        raise ConfigurationError(f"--drive {path}: cannot be read: {error.strerror}") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise ConfigurationError(f"{path}: not a CSV file: {error}") from None
    if len(rows) < 2:
        raise ConfigurationError(f"{path}: at least 2 rows are required, not {len(rows)}")
    return np.array(rows)
