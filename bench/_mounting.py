"""Changes recordings as if the INS were mounted differently from the vehicle file."""

from dataclasses import replace

import numpy as np
from st_core.log import DriveLog


def rotate_ins(log: DriveLog, angle: float) -> DriveLog:
    """The log of an INS that is rotated to the left by `angle` [rad]."""
    c, s = np.cos(angle), np.sin(angle)
    accelerations = {}
    if log.acceleration_x is not None and log.acceleration_y is not None:
        accelerations = {"acceleration_x": c * log.acceleration_x + s * log.acceleration_y,
                         "acceleration_y": c * log.acceleration_y - s * log.acceleration_x}
    return replace(log, yaw=log.yaw + angle, velocity_x=c * log.velocity_x + s * log.velocity_y,
                   velocity_y=c * log.velocity_y - s * log.velocity_x, **accelerations)


def move_ins(log: DriveLog, x: float) -> DriveLog:
    """The log of an INS that is `x` [m] further forward; the yaw acceleration is that of a smoothed yaw rate."""
    accelerations = {}
    if log.acceleration_x is not None:
        accelerations["acceleration_x"] = log.acceleration_x - x * log.yaw_rate**2
    if log.acceleration_y is not None:
        rate = np.convolve(log.yaw_rate, np.ones(5) / 5, "same")
        slope = np.gradient(rate, log.ins_time_ns * 1e-9)
        accelerations["acceleration_y"] = log.acceleration_y + x * slope
    return replace(log, x=log.x + x * np.cos(log.yaw), y=log.y + x * np.sin(log.yaw),
                   velocity_y=log.velocity_y + x * log.yaw_rate, **accelerations)
