"""A 10 s log of weaving at about 12 m/s, steering and INS at 100 Hz; its channels are independent waves."""

import numpy as np
from st_core.log import DriveLog
from st_core.timeseries import NANOSECOND


def weaving_log() -> DriveLog:
    time_ns = np.arange(0, 10_000_000_000, 10_000_000, dtype=np.int64)
    t = time_ns * NANOSECOND
    velocity_x, velocity_y = 12.0 + np.sin(0.7 * t), 0.2 * np.sin(2.0 * t)
    yaw, yaw_rate = 0.1 * np.sin(1.5 * t), 0.15 * np.cos(1.5 * t)
    acceleration_x = 0.7 * np.cos(0.7 * t) - velocity_y * yaw_rate
    acceleration_y = 0.4 * np.cos(2.0 * t) + velocity_x * yaw_rate
    return DriveLog("weaving", time_ns, 12.0 * t, np.sin(t), yaw, velocity_x, velocity_y, yaw_rate, time_ns,
                    0.06 * np.sin(2.0 * t + 0.3), None, acceleration_x, acceleration_y)
