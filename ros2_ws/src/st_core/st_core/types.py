"""States, inputs, samples and trajectories: SI units, body axes x forward, y left, yaw from east counter-clockwise."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from .errors import StCoreError

STATE_NAMES = ("x", "y", "velocity_x", "velocity_y", "yaw", "yaw_rate")
STATE_UNITS = ("m", "m", "m/s", "m/s", "rad", "rad/s")

Number: TypeAlias = Any
"""A float or an array of them: what is made of it is of the same kind."""
StateTuple = tuple[float, float, float, float, float, float]


@dataclass(frozen=True, slots=True)
class VehicleState:
    """State of every model, at the centre of gravity (CG). The field order is the state order everywhere.

    x, y: position in the map frame [m]. velocity_x, velocity_y: body axes, forward and left [m/s].
    yaw: from map x (east) counter-clockwise, not wrapped [rad]. yaw_rate: left turn + [rad/s].
    """

    x: float
    y: float
    velocity_x: float
    velocity_y: float
    yaw: float
    yaw_rate: float

    def as_tuple(self) -> StateTuple:
        """The six values as Python floats, in state order."""
        return (float(self.x), float(self.y), float(self.velocity_x),
                float(self.velocity_y), float(self.yaw), float(self.yaw_rate))


@dataclass(frozen=True, slots=True)
class ControlInput:
    """Inputs of every model at one instant: road_wheel_angle [rad], front axle mean, left +; velocity_x_dot [m/s^2]."""

    road_wheel_angle: float
    velocity_x_dot: float


@dataclass(frozen=True, slots=True)
class InputSequence:
    """Inputs over a horizon on the half-step grid 0, step/2, step, ...: 2 * steps + 1 values each, as ControlInput.

    NaN marks an input that is not known; the trajectory is NaN from there on. signals: those a model needs beyond its
    inputs (`Model.signals`), by name, on the same grid.
    """

    road_wheel_angle: np.ndarray
    velocity_x_dot: np.ndarray
    signals: Mapping[str, np.ndarray] = field(default_factory=dict)

    @property
    def known_so_far(self) -> np.ndarray:
        """Whether both inputs are known at each point and at all before it."""
        return np.logical_and.accumulate(np.isfinite(self.road_wheel_angle) & np.isfinite(self.velocity_x_dot), axis=-1)


@dataclass(frozen=True, slots=True)
class Trajectory:
    """States at 0, step, 2 step, ... after the start: `states` is (steps + 1, 6) float64, columns as STATE_NAMES."""

    step: float
    states: np.ndarray

    def __post_init__(self) -> None:
        if self.states.ndim != 2 or self.states.shape[1] != len(STATE_NAMES):
            raise StCoreError(f"a trajectory is (points, {len(STATE_NAMES)}), not {self.states.shape}")

    @property
    def x(self) -> np.ndarray:
        return self.states[:, 0]

    @property
    def y(self) -> np.ndarray:
        return self.states[:, 1]

    @property
    def velocity_x(self) -> np.ndarray:
        return self.states[:, 2]

    @property
    def velocity_y(self) -> np.ndarray:
        return self.states[:, 3]

    @property
    def yaw(self) -> np.ndarray:
        return self.states[:, 4]

    @property
    def yaw_rate(self) -> np.ndarray:
        return self.states[:, 5]

    @property
    def time(self) -> np.ndarray:
        """Seconds after the start of each point."""
        return self.step * np.arange(len(self.states))


class InsSample(NamedTuple):
    """One measurement of the INS, at the INS point.

    time_ns: UTC nanoseconds since the Unix epoch. x, y: map frame [m]. yaw: from east counter-clockwise, wrapped or not
    [rad]. velocity_x, velocity_y: body axes, forward and left [m/s]. yaw_rate: left turn + [rad/s].
    """

    time_ns: int
    x: float
    y: float
    yaw: float
    velocity_x: float
    velocity_y: float
    yaw_rate: float
