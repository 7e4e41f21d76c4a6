"""An INS recording in the axes of the suite, whatever instrument wrote it."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from st_core.checks import InsQuality


@dataclass(frozen=True)
class Motion:
    """What clock alignment needs of an INS recording: SI, body axes, yaw from east; absolute: times are UTC."""

    time_ns: np.ndarray
    velocity_x: np.ndarray
    yaw_rate: np.ndarray
    yaw: np.ndarray | None = None
    absolute: bool = True


@dataclass(frozen=True)
class InsLog:
    """Every packet with a fix. time_ns: UTC of the measurement, strictly increasing.

    position: (3, n) east, north, up of `origin` [m], INS point. yaw: from east counter-clockwise, unwrapped; pitch:
    nose down +, roll: right side down + [rad] (axes forward, left, up). velocity: (3, n) body axes [m/s]. rate: (3, n)
    body axes [rad/s]. acceleration: (3, n) specific force, body axes [m/s^2]. origin: latitude, longitude [rad],
    altitude [m]. stamps_ns: times of all that was sent, with a fix or not. quality: as the unit reports it, or None.
    absolute: whether the times are UTC.
    """

    file: Path
    time_ns: np.ndarray
    position: np.ndarray
    yaw: np.ndarray
    pitch: np.ndarray
    roll: np.ndarray
    velocity: np.ndarray
    rate: np.ndarray
    acceleration: np.ndarray
    origin: tuple[float, float, float]
    stamps_ns: np.ndarray
    quality: InsQuality | None
    warnings: tuple[str, ...] = ()
    absolute: bool = True

    @property
    def motion(self) -> Motion:
        return Motion(self.time_ns, self.velocity[0], self.rate[2], self.yaw, self.absolute)


def planar(file: Path, time_ns: np.ndarray, values: Mapping[str, np.ndarray], warnings: tuple[str, ...] = (),
           absolute: bool = True) -> InsLog:
    """An INS recording that gives no more than the motion in the plane: attitude and vertical motion are zero.

    values: x, y, yaw, velocity_x, velocity_y, yaw_rate, and acceleration_x, acceleration_y where they are known.
    """
    zero, unknown = np.zeros(len(time_ns)), np.full(len(time_ns), np.nan)
    acceleration = [values.get(f"acceleration_{axis}", unknown) for axis in "xy"]
    return InsLog(file, time_ns, np.stack([values["x"], values["y"], zero]), values["yaw"], zero, zero,
                  np.stack([values["velocity_x"], values["velocity_y"], zero]),
                  np.stack([zero, zero, values["yaw_rate"]]), np.stack([*acceleration, unknown]), (0.0, 0.0, 0.0),
                  time_ns, None, warnings, absolute)
