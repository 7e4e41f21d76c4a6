"""An INS recording in the axes of the suite, whatever instrument wrote it."""

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
    altitude [m]. stamps_ns: times of all that was sent, with a fix or not. quality: what the unit says of itself.
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
    quality: InsQuality
    warnings: tuple[str, ...] = ()

    @property
    def motion(self) -> Motion:
        return Motion(self.time_ns, self.velocity[0], self.rate[2], self.yaw)
