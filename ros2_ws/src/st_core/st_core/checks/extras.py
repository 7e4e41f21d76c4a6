"""What a recording holds beside the drive itself, as far as a check can use it."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from .finding import Finding


@dataclass(frozen=True, eq=False)
class Series:
    """time_ns: int64, rising, on the INS clock. values: (n,)."""

    time_ns: np.ndarray
    values: np.ndarray


@dataclass(frozen=True, eq=False)
class InsQuality:
    """What the unit says of itself, each (n,) at time_ns [ns]; NaN where not known.

    navigation_status: NCOM byte 21, 4 = locked. position_mode: NCOM mode number, 6 = RTK integer, 5 = RTK float, -1 or
    NaN unknown. position_accuracy: horizontal standard deviation [m]. heading_accuracy: standard deviation [rad].
    """

    time_ns: np.ndarray
    navigation_status: np.ndarray
    position_mode: np.ndarray
    position_accuracy: np.ndarray
    heading_accuracy: np.ndarray


@dataclass(frozen=True, eq=False)
class Extras:
    """stamps: of "INS" and "steering" in the order of the recording, before anything was left out, int64 ns.

    missing: channel -> rows that held no usable value and were left out. wheel_speed: of the wheels or the car's own
    speed signal [m/s]. ins_speed: forward speed from a second output of the INS (its CAN frames, the NCOM packets
    beside an odometry) [m/s]. corrected: what run.yaml corrected, a phrase each. implausible: findings on samples that
    the reading left out, see `plausibility`. start_ns: first recorded INS measurement; None for that of the drive.
    """

    stamps: Mapping[str, np.ndarray] = field(default_factory=dict)
    missing: Mapping[str, int] = field(default_factory=dict)
    wheel_speed: Series | None = None
    ins_speed: Series | None = None
    quality: InsQuality | None = None
    corrected: tuple[str, ...] = ()
    implausible: tuple[Finding, ...] = ()
    start_ns: int | None = None
