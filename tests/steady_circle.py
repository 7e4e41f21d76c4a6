"""A steady left circle as the INS of a car would measure it: the known answer of several tests."""

import math
from dataclasses import dataclass

import numpy as np
from st_core.log import DriveLog
from st_core.types import InsSample, VehicleState, cg_to_ins_position, wrap_angle


def cg_to_ins(state: VehicleState, time_ns: int, cg_to_ins_x: float, cg_to_ins_y: float = 0.0) -> InsSample:
    """What the INS point measures when the CG is in `state`: the inverse of `types.ins_to_cg`."""
    x, y = cg_to_ins_position(state.x, state.y, state.yaw, cg_to_ins_x, cg_to_ins_y)
    return InsSample(time_ns, float(x), float(y), state.yaw, state.velocity_x - state.yaw_rate * cg_to_ins_y,
                     state.velocity_y + state.yaw_rate * cg_to_ins_x, state.yaw_rate)


@dataclass(frozen=True)
class Circle:
    """Constant velocity_x, velocity_y [m/s] at the CG, yaw_rate [rad/s]; at time 0 the CG is at the origin, yaw 0."""

    velocity_x: float
    velocity_y: float
    yaw_rate: float
    cg_to_ins_x: float = 0.0

    def state(self, time: float) -> VehicleState:
        drift, yaw = math.atan2(self.velocity_y, self.velocity_x), self.yaw_rate * time
        radius = math.hypot(self.velocity_x, self.velocity_y) / self.yaw_rate
        return VehicleState(radius * (math.sin(yaw + drift) - math.sin(drift)),
                            radius * (math.cos(drift) - math.cos(yaw + drift)),
                            self.velocity_x, self.velocity_y, yaw, self.yaw_rate)

    def ins(self, time: float, time_ns: int = 0) -> InsSample:
        """Yaw wrapped to [-pi, pi), as a unit sends it."""
        sample = cg_to_ins(self.state(time), time_ns, self.cg_to_ins_x)
        return sample._replace(yaw=wrap_angle(sample.yaw))

    def ins_points(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """x, y, yaw of the INS point."""
        samples = [self.ins(float(t)) for t in times]
        return tuple(np.array([getattr(s, name) for s in samples]) for name in ("x", "y", "yaw"))

    def log(self, road_wheel_angle: float, seconds: float) -> DriveLog:
        """INS and steering at 100 Hz, without noise."""
        time = 0.01 * np.arange(round(100 * seconds))
        rows = np.array([self.ins(float(t))[1:] for t in time])
        rows[:, 2] = np.unwrap(rows[:, 2])
        time_ns = 1_700_000_000_000_000_000 + np.round(time * 1e9).astype(np.int64)
        return DriveLog("circle", time_ns, *rows.T, time_ns, np.full(len(time), road_wheel_angle))
